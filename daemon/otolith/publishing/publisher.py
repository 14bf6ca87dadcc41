"""Publishes the reports of machines on all their endpoints; one that cannot be opened does not concern the others.

All endpoints and machines share one Zenoh session. If one of the endpoints cannot be opened, each gets a session of its
own, and a thread tries the rest again. It also looks whether certificates or passwords were replaced: then it opens the
sessions anew.
"""

import contextlib
import logging
import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from functools import partial
from typing import TYPE_CHECKING

import zenoh

from otolith.health.labels import expiry_notices
from otolith.health.schema import CertificateDocument, ReportDocument
from otolith.health.text import announcements
from otolith.publishing.zenoh_config import ENCRYPTED, NOTICE_DAYS, Access, Settings, Validity, listening
from otolith.publishing.zenoh_session import (
    ALIVE,
    COMMAND,
    EVENT,
    PARAMETER,
    REPORT,
    ROOT,
    START,
    QueryAnswers,
    StartDocument,
    Topic,
    answer,
    asks_for_past,
    close_session,
    prefix,
    session,
)
from otolith.storage.decisions import DecisionsFile
from otolith.storage.history_writer import HistoryWriter
from otolith_drivers.config_files import DocumentModel
from otolith_drivers.errors import NotValidNowError, OtolithError, ServiceError

if TYPE_CHECKING:
    from otolith.publishing.commands.desk import CommandDesk

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
FIRST_RETRY, MAX_RETRY = 1.0, 30.0  # s from an endpoint that could not be opened to the next try; it doubles
RENEWAL_INTERVAL = 60.0  # s between two looks at the files of certificates and passwords
CLOSE_WAIT = 1.0  # s for a try that has begun
RENEWAL = "its session is opened anew"  # Why endpoints wait whose files were replaced
UNAVAILABLE = (ServiceError, NotValidNowError)  # What may be different later; everything else is a mistake


@dataclass(eq=False, slots=True)
class Published:
    """A machine that is published; queries for its earlier reports and events are answered from ``archive``.

    What commands decide about it is written into ``decisions``.
    """

    site: str
    machine: str
    archive: HistoryWriter | None = None
    decisions: DecisionsFile | None = None
    desk: "CommandDesk | None" = None  # Once somebody may send commands
    latest: str | None = None  # Its report, under the lock of the publisher as what follows
    start: str | None = None

    @property
    def prefix(self) -> str:
        """The beginning of its keys."""
        return prefix(self.site, self.machine)


@dataclass(frozen=True, slots=True)
class _Endpoints:
    """Endpoints that share a session."""

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        return ", ".join((*self.listen, *self.connect))

    @property
    def single(self) -> "Iterator[_Endpoints]":
        """Each endpoint to listen on alone, and those to connect to, which Zenoh itself tries again."""
        yield from (_Endpoints((endpoint,)) for endpoint in self.listen)
        if self.connect:
            yield _Endpoints(connect=self.connect)


Declared = zenoh.Publisher | zenoh.Queryable[None] | zenoh.LivelinessToken


@dataclass(frozen=True, slots=True)
class _Session:
    """A session, and what is declared in it for as long as it is open."""

    endpoints: _Endpoints
    opened: zenoh.Session
    reports: dict[tuple[str, str], zenoh.Publisher]  # By site and machine, as what else is declared of it
    declared: dict[tuple[str, str], tuple[Declared, ...]]
    access: Access
    stamps: tuple[object, ...]  # Of the files of ``access`` when it was opened


class Publisher:
    """Publishes the reports of machines and answers queries for the latest ones, and for earlier ones."""

    def __init__(
        self,
        machines: Sequence[Published],
        listen: Iterable[str],
        access: Access = Access(),  # noqa: B008 - immutable
        *,
        of_hall: bool = False,
    ) -> None:
        """Where they listen on a socket of this computer, it has the name of the first machine.

        That of a hall may publish machines of any name, as some may be added later.

        Raises:
            ConfigurationError: the machine file, or a file that it names, is wrong.
        """
        self._machines = {(each.site, each.machine): each for each in machines}
        self._first, self._listen, self._access, self._of_hall = machines[0], tuple(listen), access, of_hall
        self._lock, self._closing, self._wake = threading.Lock(), threading.Event(), threading.Event()
        self._validity, self._warned_on = Validity(), date.min
        # When it was last told that a certificate expires, by its end; Unix s
        self._noticed = {} if access.zenoh.tls is None else _notices(self._first.archive)
        self._refused = ""  # Why files that were replaced cannot be used
        self._unusable: tuple[object, ...] = ()  # Stamps of the files at the latest look that could not use them
        self._sessions: tuple[_Session, ...] = ()
        self._answers, self._latest = QueryAnswers(), QueryAnswers("answer-latest", share=1.0)
        # Apart from queries, so that no reader of the history shuts out who may send commands
        self._commands = QueryAnswers("answer-commands", what="commands", remedy="give it again later")
        self._waiting: dict[_Endpoints, str] = {}  # And why they could not be opened
        self._thread = threading.Thread(target=self._keep_open, name="open-endpoints", daemon=True)
        everything = _Endpoints(self._listen, tuple(access.zenoh.connect))
        try:
            self._open(everything)
        except UNAVAILABLE as error:
            self._open_each(everything, error)
        self.warn_of_expiry(datetime.now(UTC))
        self._thread.start()

    @property
    def endpoints(self) -> str:
        """The endpoints that are open, in words."""
        with self._lock:
            return ", ".join(each.endpoints.text for each in self._sessions) or "no endpoint yet"

    @property
    def is_idle(self) -> bool:
        """Whether it publishes no machine."""
        return not self._machines

    def shares(self, listen: tuple[str, ...], access: Access) -> bool:
        """Whether machines with these endpoints, readers and certificates have the same session."""
        own = self._access
        return (self._listen, own.zenoh, own.path.parent.absolute()) == (
            listen,
            access.zenoh,
            access.path.parent.absolute(),
        )

    def add(self, machine: Published) -> None:
        """Publish a further machine; readers that are connected find it."""
        with self._lock:
            self._machines[machine.site, machine.machine] = machine
            for each in self._sessions:
                self._declare(each, machine)

    def remove(self, site: str, machine: str) -> None:
        """Publish a machine no longer; subscribers see its liveliness token disappear."""
        name, ended = (site, machine), list[Declared]()
        with self._lock:
            self._machines.pop(name, None)
            for each in self._sessions:
                ended += each.declared.pop(name, ())
                each.reports.pop(name, None)
        for declared in ended:  # without the lock, for which an answer that is under way may wait
            with contextlib.suppress(zenoh.ZError):  # the session was closed meanwhile
                declared.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stub lacks the return type

    def publish(self, document: ReportDocument, text: str = "") -> None:
        """Send the report, each parameter, and the events that it changed; a slow subscriber never blocks.

        ``text`` is the JSON of the report, if it was made already.
        """
        text = text or document.to_json()
        others: list[tuple[str, DocumentModel]] = [
            (PARAMETER.under(document.site, document.machine, name), item) for name, item in document.parameters.items()
        ]
        others += [(EVENT.under(document.site, document.machine), event) for event in announcements(document)]
        texts = [(key, item.json_line()) for key, item in others]
        name = document.site, document.machine
        with self._lock:  # so that no session is closed meanwhile
            if name not in self._machines:
                return
            self._machines[name].latest = text
            for each in self._sessions:
                each.reports[name].put(text)
            for key, own in texts:
                self._put(key, own)

    def reload(self, access: Access) -> None:
        """Let a thread take over certificates, passwords and readers of a changed machine file."""
        self._access = access
        self._wake.set()

    def publish_start(self, document: StartDocument) -> None:
        """Tell how far the daemon is that starts; a document that is done is the last one."""
        text = document.json_line()
        with self._lock:
            if (own := self._machines.get((document.site, document.machine))) is None:
                return
            own.start = text if document.done < document.total else None
            self._put(START.under(own.site, own.machine), text)

    def outages(self, now: datetime) -> dict[str, str]:
        """Return the endpoints where nobody can connect, and why."""
        with self._lock:
            outages = {f"reports on {endpoints.text}": reason for endpoints, reason in self._waiting.items()}
        if self._validity.end is not None and now > self._validity.end:
            outages["reports to other computers"] = self._validity.warning(now)
        return outages

    def warn_of_expiry(self, now: datetime) -> None:
        """Log once a day that the certificate expires soon or has expired."""
        if now.date() != self._warned_on and (warning := self._validity.warning(now)):
            self._warned_on = now.date()
            log.warning("%s", warning)

    def warning(self, now: datetime) -> str:
        """Return that the certificate expires soon or has expired; else an empty text."""
        return self._validity.warning(now)

    @property
    def certificate(self) -> CertificateDocument | None:
        """Of its encrypted endpoints; None without one."""
        end, lifetime = self._validity.end, self._validity.lifetime
        return None if end is None else CertificateDocument(since=(end - lifetime).timestamp(), until=end.timestamp())

    def expiry_notice(self, now: datetime) -> Validity | None:
        """Return the validity of the certificate once after each of its ``notices`` was reached."""
        validity = self._validity
        if validity.end is None or now > validity.end:
            return None
        end = validity.end.timestamp()
        reached = min((rest for rest in validity.notices if validity.end - now <= rest), default=None)
        if reached is None or end - self._noticed.get(end, -math.inf) <= reached.total_seconds():
            return None
        self._noticed[end] = now.timestamp()
        return validity

    def close(self) -> None:
        """Close the sessions; subscribers see the liveliness token disappear."""
        self._closing.set()
        self._wake.set()
        self._thread.join(CLOSE_WAIT)
        answering = self._commands, self._answers, self._latest
        for each in answering:  # all together, so that the daemon ends in time
            each.stop()
        for each in answering:
            each.close()
        with self._lock:
            sessions, self._sessions = self._sessions, ()
        for own in sessions:
            close_session(own.opened)

    def _put(self, key: str, text: str) -> None:
        """Put a document on each session; the caller has the lock, so that no session is closed meanwhile."""
        for each in self._sessions:
            each.opened.put(
                key,
                text,
                encoding=zenoh.Encoding.APPLICATION_JSON,
                congestion_control=zenoh.CongestionControl.DROP,
            )

    def _open_each(self, everything: _Endpoints, error: OtolithError) -> None:
        """Open what can be opened after all endpoints together gave the ``error``."""
        single = list(everything.single)
        for endpoints in single:
            if len(single) > 1:
                try:
                    self._open(endpoints)
                    continue
                except UNAVAILABLE as own:
                    error = own
            with self._lock:
                self._waiting = {**self._waiting, endpoints: str(error)}
            log.warning("no reports on %s: %s; it is tried again", endpoints.text, error)

    def _keep_open(self) -> None:
        pause = FIRST_RETRY
        while True:
            self._wake.wait(pause if self._waiting else RENEWAL_INTERVAL)
            self._wake.clear()
            if self._closing.is_set():
                return
            pause = min(2.0 * pause, MAX_RETRY) if self._waiting else FIRST_RETRY
            self._renew()
            self._retry()

    def _renew(self) -> None:
        """Close each session whose files were replaced, or whose access was changed, if they can be used now.

        Its endpoints wait from then on, and are opened like all that wait.
        """
        with self._lock:
            sessions, access = self._sessions, self._access
        stamps, before = access.stamps(), self._unusable
        self._unusable = ()
        for each in sessions:
            if each.access == access and each.stamps == stamps:
                continue
            try:
                self._settings(access, each.endpoints)
            except Exception as error:  # noqa: BLE001 - a file may be half written; no bug ends the thread
                self._unusable, reason = stamps, str(error) or type(error).__name__
                if stamps == before and reason != self._refused:  # else the other file may follow
                    self._refused = reason
                    log.warning("%s: not taken over: %s", each.endpoints.text, reason)
                continue
            self._refused = ""
            with self._lock:
                self._sessions = tuple(other for other in self._sessions if other is not each)
                self._waiting = {**self._waiting, each.endpoints: RENEWAL}
            try:
                close_session(each.opened)
            except Exception as error:  # noqa: BLE001 - as above
                log.warning("%s: the session before was not closed: %s", each.endpoints.text, error)

    def _retry(self) -> None:
        """Open the endpoints that wait; of several that cannot be opened together, each gets a session of its own."""
        due = dict(self._waiting)
        while due:
            endpoints, before = due.popitem()
            reason, parts = "", [endpoints]
            try:
                self._open(endpoints)
            except Exception as error:  # noqa: BLE001 - OtolithError, OSError of a disk, or a bug: none ends it
                reason, parts = str(error) or type(error).__name__, list(endpoints.single) or parts
            if len(parts) > 1:
                due |= dict.fromkeys(parts, "")
            elif reason and reason != before:
                log.warning("no reports on %s: %s; it is tried again", endpoints.text, reason)
            elif not reason:
                end = "" if self._validity.end is None else f", which are valid until {self._validity.end:%Y-%m-%d}"
                renewed = f": certificates, passwords and readers are taken over{end}"
                log.info("reports on %s%s", endpoints.text, renewed if before == RENEWAL else " as well")
            with self._lock:
                rest = {each: text for each, text in self._waiting.items() if each != endpoints}
                self._waiting = rest | dict.fromkeys(parts if reason else (), reason)

    def _open(self, endpoints: _Endpoints) -> None:
        """Open a session; raise what is in ``UNAVAILABLE``, or ConfigurationError."""
        listen = listening(endpoints.listen, f"{self._first.site}.{self._first.machine}")
        access = self._access
        stamps = access.stamps()  # before the files are read: a later change shows
        settings, validity = self._settings(access, _Endpoints(listen, endpoints.connect))
        opened = session(listen, endpoints.connect, settings)
        own = _Session(_Endpoints(listen, endpoints.connect), opened, {}, {}, access, stamps)
        with self._lock:
            is_late = self._closing.is_set()
            if not is_late:
                for each in self._machines.values():
                    self._declare(own, each)
                self._sessions += (own,)
        if is_late:
            close_session(opened)
            return
        if any(endpoint.startswith(ENCRYPTED) for endpoint in (*listen, *endpoints.connect)):
            self._validity = validity

    def _settings(self, access: Access, endpoints: _Endpoints) -> tuple[Settings, Validity]:
        own = access.zenoh.model_copy(update={"connect": endpoints.connect})
        prefixes = (ROOT,) if self._of_hall else tuple(each.prefix for each in self._machines.values())
        return replace(access, zenoh=own).settings(prefixes, endpoints.listen)

    def _declare(self, within: _Session, own: Published) -> None:
        """Declare in a session that a machine is alive, what answers queries about it, and its reports."""
        name = own.site, own.machine
        report = within.opened.declare_publisher(
            REPORT.under(*name),
            encoding=zenoh.Encoding.APPLICATION_JSON,
            congestion_control=zenoh.CongestionControl.DROP,
        )
        within.reports[name] = report
        within.declared[name] = (*self._declared(within.opened, own), report)

    def _declared(self, opened: zenoh.Session, own: Published) -> tuple[Declared, ...]:
        """Declare in a session that a machine is alive, and what answers queries about it."""
        keys = {topic: topic.under(own.site, own.machine) for topic in (REPORT, EVENT, START)}

        def reply(query: zenoh.Query, topic: Topic, kind: str) -> None:
            with self._lock:
                latest = {REPORT: own.latest, START: own.start}.get(topic)
            answer(query, keys[topic], kind, latest, None)

        def take(query: zenoh.Query, topic: Topic, kind: str) -> None:
            if topic is not START and asks_for_past(query):
                self._answers.add(query, partial(answer, key=keys[topic], kind=kind, latest=None, archive=own.archive))
            else:
                self._latest.add(query, partial(reply, topic=topic, kind=kind))

        return (
            *self._commanded(opened, own),
            _queryable(opened, keys[REPORT], partial(take, topic=REPORT, kind="report")),
            _queryable(opened, keys[EVENT], partial(take, topic=EVENT, kind="event")),
            _queryable(opened, keys[START], partial(take, topic=START, kind="start")),
            opened.liveliness().declare_token(ALIVE.under(own.site, own.machine)),
        )

    def _commanded(self, opened: zenoh.Session, own: Published) -> tuple[Declared, ...]:
        """Declare in a session what takes commands about a machine; nothing while nobody may send them."""
        key, tls = COMMAND.under(own.site, own.machine), self._access.zenoh.tls
        if own.decisions is None or tls is None or not self._access.zenoh.access.commands:
            return ()
        from otolith.publishing.commands.desk import CommandDesk  # noqa: PLC0415 - slow to import
        from otolith.publishing.commands.signatures import CommandRefusedError  # noqa: PLC0415 - as above

        desk = own.desk = own.desk or CommandDesk(own.site, own.machine, own.decisions)

        def obey(query: zenoh.Query) -> None:
            access, content = self._access, b"" if query.payload is None else query.payload.to_bytes()
            ca = access.path.parent.absolute() / tls.ca
            with self._lock:
                latest = own.latest
            try:
                query.reply(key, desk.take(content, ca, access.zenoh.access.commands, latest))
            except CommandRefusedError as error:
                query.reply_err(str(error))

        return (_queryable(opened, key, lambda query: self._commands.add(query, obey)),)


def _queryable(opened: zenoh.Session, key: str, take: Callable[[zenoh.Query], None]) -> Declared:
    """Declare a queryable whose queries ``take`` gets in the thread that receives them, so that it waits for nothing.

    Otherwise Zenoh starts a thread for each queryable.
    """
    return opened.declare_queryable(key, zenoh.handlers.Callback(take, indirect=False), complete=True)


def _notices(archive: HistoryWriter | None) -> dict[float, float]:
    """Return when daemons before this one told that a certificate expires, by its end (Unix s), by the history."""
    if archive is None:
        return {}
    try:
        return expiry_notices(archive.reader.events((datetime.now(UTC) - timedelta(days=max(NOTICE_DAYS))).timestamp()))
    except OtolithError:  # an unreadable history must not prevent monitoring
        return {}
