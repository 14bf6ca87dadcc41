"""Zenoh: the session's configuration, the keys of a machine, and answers to queries of the history."""

import json
import logging
import math
import os
import queue
import re
import stat
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, Protocol

import zenoh
from pydantic import Field

from otolith.publishing.zenoh_config import (
    ENCRYPTED,
    LEASE,
    OTHERS_WRITE,
    SOCKET,
    SOCKET_MODE,
    TLS_TIMEOUT,
    Settings,
    raise_descriptor_limit,
)
from otolith_drivers.config_files import DocumentModel
from otolith_drivers.errors import ServiceError

log = logging.getLogger(__name__)

CLIENT_TIMEOUT = 1000  # ms for a client to connect
# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_REPLIES = 1000  # to one query
MAX_QUERIES = 64  # that wait; who asks is told of the others at once that they are refused
SHARE = 0.25  # of a core that answers may take for long, and ...
BURST = 1.0  # ... s of it that they may take at once before
MAX_WAIT = 4.5  # s after which nobody waits for an answer any more
JOIN = 1.0  # s for the answer that has begun when the daemon ends
LOG_PAUSE = 60.0  # s between two lines about refused queries
UNITS = {"u": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_RANGE = re.compile(r"([\[\]])([^\[\]]*)\.\.([^\[\]]*)([\[\]])")
_NOW = re.compile(r"now\(\s*(?:([+-]?[0-9.]+)\s*(u|ms|s|m|h|d|w|))?\s*\)")


NUMBER = r"[0-9]{1,18}"


class HistoryQueryDocument(DocumentModel):
    """What a query of ``report`` or ``event`` selects in the history: the parameters behind ``?`` in its selector.

    Between two of them is ``;``. Without ``_time``, ``after`` and ``last`` it is of the latest report.
    """

    time: str | None = Field(default=None, alias="_time", pattern=rf"^\s*{_RANGE.pattern}\s*$")
    """As Zenoh writes it, ``[now(-1h)..now()]`` or ``[2026-01-31T06:00:00Z..]``; outward brackets exclude a bound."""
    after: str | None = Field(default=None, pattern=f"^{NUMBER}$")  # Only documents with a higher ``sequence``
    limit: str | None = Field(default=None, pattern=f"^{NUMBER}$")  # The first ones; at most 1000
    last: str | None = Field(default=None, pattern=f"^{NUMBER}$")  # The last ones; at most 1000


@dataclass(frozen=True, slots=True)
class Selection:
    """What a query asks for."""

    after: int = 0
    start: float | None = None  # Unix s, as end; None for no bound
    end: float | None = None
    limit: int = MAX_REPLIES  # Documents, the first ones; below zero the last ones


def selection(parameters: zenoh.Parameters, now: float) -> Selection | None:
    """Return what the parameters of a query select, None for nothing; raise ValueError if they are malformed."""
    span, after, limit, last = (parameters.get(name) for name in ("_time", "after", "limit", "last"))
    if span is None and after is None and last is None:
        return None
    start, end = (None, None) if span is None else time_range(span, now)
    for name, text in (("after", after), ("limit", limit), ("last", last)):
        if text is not None and not re.fullmatch(NUMBER, text):
            what = "a sequence number" if name == "after" else f"a number of documents, at most {MAX_REPLIES}"
            raise ValueError(f"{name}={text}: write {what}")
    count = min(int(last or limit or MAX_REPLIES), MAX_REPLIES)
    return Selection(int(after or 0), start, end, count if last is None else -count)


def time_range(text: str, now: float) -> tuple[float | None, float | None]:
    """Return begin and end of Zenoh's ``[start..end]`` in Unix s, None for no bound; an outward bracket excludes it.

    Raises:
        ValueError: it is malformed.
    """
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"_time={text}: write it like [now(-1h)..now()] or [2026-01-31T06:00:00Z..]")
    start, end = _instant(match[2], now), _instant(match[3], now)
    if start is not None and match[1] == "]":
        start = math.nextafter(start, math.inf)
    if end is not None and match[4] == "[":
        end = math.nextafter(end, -math.inf)
    return start, end


def _instant(text: str, now: float) -> float | None:
    if not text.strip():
        return None
    if match := _NOW.fullmatch(text.strip()):
        return now + float(match[1] or 0.0) * UNITS[match[2] or ""]
    moment = datetime.fromisoformat(text.strip())
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


class Archive(Protocol):
    """What answers queries for the past: :class:`otolith.storage.history_writer.HistoryWriter`."""

    def messages(
        self, kind: str, limit: int, after: int = 0, start: float | None = None, end: float | None = None
    ) -> list[str]:
        """Return documents of a kind with a number above ``after`` from ``start`` to ``end``, the oldest first.

        A ``limit`` is of the first ones; one below zero is of the last ones.
        """


def asks_for_past(query: zenoh.Query) -> bool:
    """Whether a query selects documents of the history, or would if it were well written."""
    return any(query.parameters.get(name) is not None for name in ("_time", "after", "last"))


def answer(query: zenoh.Query, key: str, kind: str, latest: str | None, archive: Archive | None) -> None:
    """Reply with the selected documents of a ``kind``, oldest first; with the ``latest`` if nothing is selected."""
    try:
        selected = selection(query.parameters, time.time())
    except (ValueError, OverflowError) as error:
        query.reply_err(str(error))
        return
    if selected is None:
        texts = [] if latest is None else [latest]
    elif archive is None:
        texts = []
    else:
        texts = archive.messages(kind, selected.limit, selected.after, selected.start, selected.end)
    for text in texts:
        query.reply(key, text, encoding="application/json")


class QueryAnswers:
    """Answers queries: one at a time, and for a share of the time, so that they delay no report.

    No query is answered in the thread in which Zenoh receives it: an answer may wait for who asks.
    """

    def __init__(
        self, name: str = "answer-queries", share: float = SHARE, what: str = "queries",
        remedy: str = "ask again later, and for more documents at a time",
    ) -> None:  # fmt: skip
        """``name`` is that of its thread, and ``share`` that of a core which it may take for long.

        Who sends too many of ``what`` is told the ``remedy``.
        """
        self._share, self._what, self._remedy = share, what, remedy
        self._waiting: queue.Queue[tuple[float, zenoh.Query, Callable[[zenoh.Query], None]]] = queue.Queue(MAX_QUERIES)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._told = -LOG_PAUSE
        self.refused = 0  # Queries, since the start
        self._thread.start()

    def add(self, asked: zenoh.Query, reply: Callable[[zenoh.Query], None]) -> None:
        """Have a query answered by ``reply``, or refuse it."""
        try:
            self._waiting.put_nowait((time.monotonic(), asked, reply))
        except queue.Full:
            self._refuse(asked)

    def stop(self) -> None:
        """Begin no further answer."""
        self._stopping.set()

    def close(self) -> None:
        """Answer no more."""
        self.stop()
        self._thread.join(JOIN)

    def _run(self) -> None:
        credit, since = BURST, time.monotonic()  # s of a core
        while not self._stopping.is_set():
            try:
                arrived, asked, reply = self._waiting.get(timeout=JOIN / 2.0)
            except queue.Empty:
                continue
            now = time.monotonic()
            credit, since = min(BURST, credit + self._share * (now - since)), now
            begun = time.thread_time()
            try:
                if now - arrived > MAX_WAIT:
                    self._refuse(asked)
                    continue
                with asked:
                    reply(asked)
            except Exception:  # no query ends the thread
                log.exception("a query is not answered")
            credit -= time.thread_time() - begun
            if credit < 0.0:
                self._stopping.wait(-credit / self._share)

    def _refuse(self, asked: zenoh.Query) -> None:
        self.refused += 1
        with asked:
            asked.reply_err(f"too many {self._what}: {self._remedy}")
        if (now := time.monotonic()) - self._told >= LOG_PAUSE:
            self._told = now
            log.warning("%s come too fast: %d were refused since the start", self._what, self.refused)


@dataclass(frozen=True, slots=True)
class Topic:
    """A kind of Zenoh key."""

    key: str  # Below prefix; * stands for a name

    def under(self, site: str, machine: str, name: str = "") -> str:
        """Return the whole key."""
        return f"{prefix(site, machine)}/{self.key.replace('*', name)}"


REPORT = Topic("report")  # JSON otolith.report/1, once per window; a query returns the latest, or what it selects
PARAMETER = Topic("parameter/*")  # JSON object, once per window: the part of the report about one parameter
EVENT = Topic("event")  # JSON, once when a window raises, changes or clears it; a query returns what it selects
START = Topic("start")  # JSON, as a daemon that starts compiles kernels; a query returns how far it is until it is done
ALIVE = Topic("alive")  # Liveliness token, while the daemon runs
COMMAND = Topic("command")  # Nothing is published: a query with a signed command; declared if somebody may send them

TOPICS = (REPORT, PARAMETER, EVENT, START, ALIVE)


class StartDocument(DocumentModel):
    """How far a daemon is that starts: until it has its kernels it reports nothing."""

    site: str
    machine: str
    done: int  # Kernels that are compiled or loaded
    total: int
    text: str  # The same in words


ROOT = "otolith"
"""The beginning of all keys."""


def prefix(site: str, machine: str) -> str:
    """Return the beginning of all keys of a machine."""
    return f"{ROOT}/{site}/{machine}"


def _with_timeout(endpoint: str) -> str:
    """Return a TLS endpoint with the time that a handshake may take; Zenoh writes what follows ``#`` as ``a=1;b=2``."""
    return f"{endpoint}{';' if '#' in endpoint else '#'}tls_handshake_timeout_ms={TLS_TIMEOUT}"


def session(
    listen: Iterable[str] = (),
    connect: Iterable[str] = (),
    settings: Settings | None = None,
    mode: Literal["peer", "client"] = "peer",
) -> zenoh.Session:
    """Open a session that uses only the given endpoints: no scouting, no shared memory.

    A router passes messages on to clients, not from peer to peer. A client needs an endpoint that answers.

    Raises:
        ServiceError: an endpoint to listen on is in use, one is malformed, or a client reaches none.
    """
    listen, connect = tuple(listen), tuple(connect)
    whole: Settings = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [_with_timeout(each) if each.startswith("tls/") else each for each in listen],
        "connect/endpoints": connect,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 2000, "period_increase_factor": 1.5},
        "open/return_conditions/connect_scouted": False,
        "timestamping/enabled": True,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": LEASE,
        **(settings or {}),
    }
    if mode == "client":
        whole["connect/timeout_ms"] = CLIENT_TIMEOUT
    if any(endpoint.startswith(ENCRYPTED) for endpoint in listen):
        raise_descriptor_limit()
    try:
        config = zenoh.Config()
        for key, value in whole.items():
            config.insert_json5(key, json.dumps(value))
        opened = zenoh.open(config)
    except zenoh.ZError as error:
        raise ServiceError(f"Zenoh cannot open {', '.join([*listen, *connect])}: {_cause(str(error))}") from error
    for endpoint in listen:
        if endpoint.startswith(SOCKET):
            _share(endpoint.removeprefix(SOCKET).partition("#")[0])
    return opened


def protect_files() -> None:
    """Keep other users from writing the files that this process makes, whatever umask it was started with.

    Call it before any thread starts: the umask belongs to the whole process, so it also holds for what threads make.
    """
    before = os.umask(OTHERS_WRITE)
    os.umask(before | OTHERS_WRITE)


def _share(path: str) -> None:
    """Give a socket, which until now only its user can write, to its group as well."""
    handle = os.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        if stat.S_ISSOCK(os.fstat(handle).st_mode):
            Path(f"/proc/self/fd/{handle}").chmod(SOCKET_MODE)
    finally:
        os.close(handle)


def close_session(opened: zenoh.Session) -> None:
    """Close a session; one that Zenoh cannot close in time is logged."""
    try:
        opened.close()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the return type
    except zenoh.ZError as error:  # connections that never finish their handshake delay it beyond Zenoh's limit
        log.warning("the Zenoh session was not closed in time: %s", _cause(str(error)))


def _cause(message: str) -> str:
    """Return the cause from Zenoh's nested message, and the remedy."""
    cause = re.sub(r"[\[\]]|\(os error \d+\)|at /\S+", "", message.rsplit(": [", maxsplit=1)[-1]).strip()
    if "in use" in message or "acquire lock" in message:
        return f"{cause}; another daemon publishes there: set zenoh.listen in the machine file, or --listen"
    return f"{cause}; check the endpoint, which is written like tcp/127.0.0.1:7447 or unixsock-stream//run/a.sock"
