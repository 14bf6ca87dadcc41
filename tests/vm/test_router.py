"""A daemon whose router is away for an hour of a faster clock. On this computer, as the guest is too slow."""

import json
import re
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith.publishing.zenoh_session import EVENT, REPORT, close_session, session
from otolith.storage.history import HistoryReader
from tests.conftest import free_port
from tests.vm import fast_clock
from tests.vm.service import simulated_machine
from tests.waiting import wait_for

SPEED, HOUR = 30, 3600.0
SLOW_WINDOWS = '[window]\nlength = "10 s"\nsample_period = "50 ms"\n'
Started = Callable[[str], "subprocess.Popen[bytes]"]


class Reader:
    """A subscriber to reports and events, which begins after a number."""

    def __init__(self, endpoint: str, after: int | None = None) -> None:
        self.texts: list[str] = []
        self.subscriber = Subscriber(Connection((endpoint,)), self.texts.append, topics=(REPORT, EVENT), after=after)

    def numbers(self, kind: str) -> list[int]:
        """Sequence numbers of reports, or of events."""
        messages = [json.loads(text) for text in tuple(self.texts)]
        return [each["sequence"] for each in messages if ("schema" in each) == (kind == "report")]

    def close(self) -> None:
        self.subscriber.__exit__()


@pytest.fixture
def router_machine(tmp_path: Path) -> Iterator[tuple[str, Started]]:
    """Endpoint of a router, and a function that starts the daemon with a clock that goes on from an earlier one."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    file = simulated_machine(tmp_path, f'[zenoh]\nconnect = ["{endpoint}"]\n')
    text = file.read_text(encoding="utf-8")
    file.write_text(
        re.sub(r'\[window\]\nlength = "1 s"\njitter_limit = "25 ms"\n', SLOW_WINDOWS, text), encoding="utf-8"
    )
    plant = tmp_path / "press-plant.toml"
    text = plant.read_text(encoding="utf-8").replace('start = "0 s"', 'start = "600 s"')  # while the router is away
    plant.write_text(f'sample_period = "50 ms"\n{text}', encoding="utf-8")
    daemons: list[subprocess.Popen[bytes]] = []

    def started(since: str) -> "subprocess.Popen[bytes]":
        daemons.append(fast_clock.start(file, tmp_path / "state", SPEED, since))
        return daemons[-1]

    yield endpoint, started
    for daemon in daemons:
        daemon.terminate()
        daemon.wait(60.0)


def test_nothing_is_lost_in_an_hour_without_router(router_machine: tuple[str, Started], tmp_path: Path) -> None:
    """Reader and daemon end meanwhile, too."""
    endpoint, started = router_machine
    since = f"{time.monotonic_ns()} {time.time_ns()}"
    router, daemon = session([endpoint], settings={"mode": "router"}), started(since)
    early = Reader(endpoint)
    wait_for(lambda: len(early.numbers("report")) >= 5, 300.0)
    (path,) = tmp_path.rglob("*.history.sqlite")
    history = HistoryReader(path)

    def seconds_since(moment: float) -> float:
        return history.latest(1)[0].window.end - moment

    close_session(router)
    gone = history.latest(1)[0].window.end
    early.close()
    wait_for(lambda: seconds_since(gone) >= 0.5 * HOUR, 300.0)
    daemon.kill()
    daemon.wait()
    started(since)
    wait_for(lambda: seconds_since(gone) >= HOUR, 300.0)
    begun = time.monotonic()
    router = session([endpoint], settings={"mode": "router"})
    late = Reader(endpoint, after=max(early.numbers("report") + early.numbers("event")))
    wait_for(
        lambda: bool(late.numbers("report")) and late.numbers("report")[-1] == history.latest(1)[0].sequence, 300.0
    )
    print(f"caught up {time.monotonic() - begun:.1f} s after the router came back")
    seen = len(late.numbers("report"))
    wait_for(lambda: len(late.numbers("report")) >= seen + 3, 300.0)
    late.close()
    close_session(router)
    for kind in ("report", "event"):
        received = early.numbers(kind) + late.numbers(kind)
        kept = [json.loads(text)["sequence"] for text in history.messages(kind, 100_000, received[0] - 1)]
        assert len(received) > {"report": 100, "event": 1}[kind]  # a busy computer misses some of the 360 windows
        assert received == kept[: len(received)]
        assert all(after > before for before, after in pairwise(received))
        print(f"{len(received)} {kind}s")
    assert late.subscriber.order.missed == 0
