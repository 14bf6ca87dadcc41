"""Machines of a site for tests: reports of any machine, and daemons that publish them over Zenoh."""

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from otolith.health.limits import Level
from otolith.health.schema import EventChange, EventDocument, HealthDocument, ParameterDocument, ReportDocument, Status
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.zenoh_config import Access
from otolith.publishing.zenoh_session import close_session, session
from otolith.storage.decisions import DecisionsFile
from otolith.storage.history import SUFFIX
from otolith.storage.history_writer import Bounds, HistoryWriter
from tests.conftest import free_port
from tests.storage.histories import MACHINE, SITE, START, document, event
from tests.waiting import PATIENCE

BOUNDS = Bounds(50_000_000, 3650, 24)
LIMIT = 7.8  # ohm


def report_of(
    machine: str = MACHINE,
    number: int | None = 1,
    end: float = START,
    value: float = 6.5,
    *,
    state: Level = Level.OK,
    site: str = SITE,
    events: tuple[EventDocument, ...] = (),
) -> ReportDocument:
    """A report with one parameter that has a limit."""
    parameter = ParameterDocument(
        value=value, unit="ohm", nominal=6.5, sd=0.01, low=value - 0.02, high=value + 0.02, limit=LIMIT,
        status=Status.ESTIMATED,
    )  # fmt: skip
    own = {"machine": machine, "site": site, "sequence": number, "parameters": {"R_a": parameter}, "events": events,
           "previous": None if number is None else number - 1,
           "health": HealthDocument(state=state, since=START - 60.0, parts={})}  # fmt: skip
    return document(number or 0, end).model_copy(update=own)


def raised(state: Level = Level.ACT, time: float = START) -> EventDocument:
    """An event that a window raised."""
    update = {"state": state, "advice": "measure resistance and insulation", "since": time}
    return event(1, time, EventChange.RAISED).model_copy(update=update)


def sent(report: ReportDocument) -> tuple[str, bytes]:
    """Key and content of a report as its daemon publishes it."""
    return f"otolith/{report.site}/{report.machine}/report", report.to_json().encode()


class Daemon:
    """What a daemon does with its reports: it numbers, keeps and publishes them."""

    def __init__(self, folder: Path, machine: str, endpoint: str = "", access: Access = Access()) -> None:  # noqa: B008 - immutable
        self.machine, self.endpoint, self.decisions = machine, endpoint, DecisionsFile(folder, SITE, machine)
        self._writer = HistoryWriter(folder / f"{SITE}.{machine}{SUFFIX}", BOUNDS)
        self._numbers, _ = self._writer.open(time.time())
        self._writer.start()
        published = Published(SITE, machine, self._writer, self.decisions)
        self._publisher = Publisher([published], [endpoint] if endpoint else [], access)

    def keep(self, report: ReportDocument) -> ReportDocument:
        """Number a report and keep it."""
        numbered = self._numbers.number(report)
        self._writer.add(numbered)
        return numbered

    def publish(self, report: ReportDocument) -> None:
        """Number a report, keep it, and publish it."""
        self._publisher.publish(self.keep(report))

    def wait(self) -> None:
        """Wait until what was kept can be asked for."""
        self._writer._written.wait(PATIENCE)

    def close(self) -> None:
        """End it."""
        self._publisher.close()
        self._writer.stop(PATIENCE)


class Stranger:
    """Publishes what no daemon would."""

    def __init__(self, machine: str) -> None:
        self.machine, self.endpoint = machine, own_endpoint()
        self._session = session([self.endpoint])

    def publish(self, report: ReportDocument) -> None:
        """Publish a report as it is."""
        self._session.put(*sent(report))

    def close(self) -> None:
        """End it."""
        close_session(self._session)


@contextmanager
def daemons(folder: Path, *machines: str) -> Iterator[list[Daemon]]:
    """Daemons with an endpoint each."""
    with ExitStack() as stack:
        yield [stack.enter_context(closing(Daemon(folder, machine, own_endpoint()))) for machine in machines]


def own_endpoint() -> str:
    """An endpoint of Zenoh that nothing listens on."""
    return f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
