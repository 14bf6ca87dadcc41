"""Zenoh: the session's configuration, the daemon's publisher, and a subscriber for people and tests.

The table of what is published: one row per kind of Zenoh key.
"""

import json
import re
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import zenoh

from otolith.health.schema import ReportDocument
from otolith_drivers.errors import ServiceError


@dataclass(frozen=True, slots=True)
class Topic:
    """One kind of key."""

    key: str
    """Under ``otolith/<site>/<machine>/``; ``*`` stands for a name."""
    content: str
    rate: str

    def under(self, site: str, machine: str, name: str = "") -> str:
        """The whole key."""
        return f"{prefix(site, machine)}/{self.key.replace('*', name)}"


REPORT = Topic("report", "JSON document otolith.report/1; the latest one answers a query", "once per window")
PARAMETER = Topic("parameter/*", "JSON object: the entry of one parameter in the report", "once per window")
ALIVE = Topic("alive", "liveliness token", "while the daemon runs")

TOPICS = (REPORT, PARAMETER, ALIVE)


def prefix(site: str, machine: str) -> str:
    """What all keys of a machine begin with."""
    return f"otolith/{site}/{machine}"


LEASE = 2000  # ms after which a silent peer counts as gone


def session(listen: Iterable[str] = (), connect: Iterable[str] = ()) -> zenoh.Session:
    """An open session in peer mode that reaches only the endpoints it is told: no scouting, no shared memory.

    Raises:
        ServiceError: an endpoint to listen on is in use or malformed.
    """
    settings = {
        "mode": "peer",
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 1.5},
        "open/return_conditions/connect_scouted": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE,
    }
    try:
        config = zenoh.Config()
        for key, value in settings.items():
            config.insert_json5(key, json.dumps(value))
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ServiceError(f"Zenoh cannot open {', '.join([*listen, *connect])}: {_cause(str(error))}") from error


def _cause(said: str) -> str:
    """What went wrong and the way out, from Zenoh's nested message."""
    inner = re.sub(r"[\[\]]|\(os error \d+\)|at /\S+", "", said.rsplit(": [", maxsplit=1)[-1]).strip()
    if "in use" in said:
        return f"{inner}; another daemon publishes there: set zenoh.listen in the machine file, or --listen"
    return f"{inner}; check the endpoint, which is written like tcp/127.0.0.1:7447"


class Publisher:
    """Publishes reports of one machine and answers queries for the latest."""

    def __init__(self, site: str, machine: str, listen: Iterable[str], connect: Iterable[str]) -> None:
        self._session = session(listen, connect)
        self._site, self._machine = site, machine
        self._lock = threading.Lock()
        self._latest: str | None = None
        key = REPORT.under(site, machine)
        self._reports = self._session.declare_publisher(
            key, encoding=zenoh.Encoding.APPLICATION_JSON, congestion_control=zenoh.CongestionControl.DROP
        )
        self._queryable = self._session.declare_queryable(key, self._answer, complete=True)
        self._token = self._session.liveliness().declare_token(ALIVE.under(site, machine))

    def publish(self, document: ReportDocument) -> None:
        """Send the report and one key per parameter; never blocks for a slow subscriber."""
        text = document.to_json()
        with self._lock:
            self._latest = text
        self._reports.put(text)
        for name, parameter in document.parameters.items():
            key = PARAMETER.under(self._site, self._machine, name)
            self._session.put(
                key,
                parameter.model_dump_json(exclude_none=True),
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
            )

    def close(self) -> None:
        """End the session; subscribers see the liveliness token go."""
        self._session.close()  # type: ignore[no-untyped-call]  # its stub says no return type

    def _answer(self, query: zenoh.Query) -> None:
        with query, self._lock:
            if self._latest is not None:
                query.reply(REPORT.under(self._site, self._machine), self._latest, encoding="application/json")


class Listener:
    """Hears the reports of any machine under ``key``, the latest one first if there is one already."""

    def __init__(self, connect: Iterable[str], key: str, hear: Callable[[str], None]) -> None:
        connect = tuple(connect)
        self._session = session(connect=connect)
        self._hear = hear
        self._subscriber = self._session.declare_subscriber(key, self._take)
        for reply in self._session.get(key, timeout=1.0):
            if reply.ok is not None:
                hear(reply.ok.payload.to_string())

    @property
    def connected(self) -> bool:
        """Whether a daemon (or a router) is reached at all."""
        return bool(self._session.info.peers_zid()) or bool(self._session.info.routers_zid())

    def __enter__(self) -> Self:
        """The listener itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the session."""
        self._session.close()  # type: ignore[no-untyped-call]  # its stub says no return type

    def _take(self, sample: zenoh.Sample) -> None:
        self._hear(sample.payload.to_string())
