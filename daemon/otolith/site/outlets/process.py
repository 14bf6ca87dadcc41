"""The process of a daemon that passes its reports on: what a site does, for the machines of this daemon only.

The daemon sends it the tables of its machines and their reports; it answers each message with why outlets fail. It may
be killed at any moment. Machines whose tables are the same share an outlet: a port can be listened on once.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

from otolith.outlet_tables import MachineOutlets
from otolith.site.known import Knowledge, KnownMachine, RefusedFor
from otolith.site.outlets.base import OutletSetup, OutletStatus
from otolith.site.outlets.runner import OutletRunner
from otolith.site.outlets.table import built, configured, stop
from otolith.site.serving.counts import Counts
from otolith_drivers.common.credentials import stamp
from otolith_drivers.config_files import SourceFile
from otolith_drivers.errors import OtolithError

log = logging.getLogger(__name__)

# Threshold: docs/reference/thresholds-site.md has its origin.
MAX_LINES = 50  # lines of the log between two answers
MAX_LINE = 4000  # characters of one
HALF_TRACE = 4000  # characters of the begin of a traceback, and of its end

Key = tuple[str, str, tuple[object, ...]]
"""Name and options of an outlet, and what differs once one of its files is replaced."""
Line = tuple[str, int, str, str]
"""Logger, level, text and traceback, which is empty without a fault."""


class _Part:
    """The machines of one outlet."""

    def __init__(self, whole: Knowledge, members: Iterable[str]) -> None:
        self._whole, self.members = whole, set(members)

    @property
    def refused(self) -> Mapping[RefusedFor, int]:
        """Documents that were refused, by why."""
        return self._whole.refused

    def __iter__(self) -> Iterator[KnownMachine]:
        return (machine for machine in self._whole if f"{machine.site}/{machine.name}" in self.members)


@dataclass(frozen=True, slots=True)
class _KnownPart:
    lock: threading.Lock
    knowledge: _Part
    dropped: Mapping[str, int]
    connected: bool = True  # To the daemon, with which it ends
    hindered: Counts = field(default_factory=Counter)


@dataclass(frozen=True, slots=True)
class _Group:
    """An outlet with the machines that share it."""

    part: _Part
    runner: OutletRunner


@dataclass(slots=True)
class DaemonOutlets:
    """The outlets of the machines of a daemon."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    knowledge: Knowledge = field(default_factory=Knowledge)
    dropped: Counter[str] = field(default_factory=Counter)
    connected: bool = True  # To the daemon, with which it ends
    hindered: Counts = field(default_factory=Counter)
    statuses: list[OutletStatus] = field(default_factory=list)
    _groups: dict[Key, _Group] = field(default_factory=dict)
    _ending: list[OutletRunner] = field(default_factory=list)  # Of outlets that no machine has any more
    _faults: dict[str, list[str]] = field(default_factory=dict)  # Why outlets of a machine cannot be built
    _said: Mapping[str, str] = field(default_factory=dict)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        stop([*self.runners, *self._ending])

    @property
    def runners(self) -> list[OutletRunner]:
        """What runs the outlets."""
        return [group.runner for group in self._groups.values()]

    def take(self, key: str, content: Any) -> None:
        """Take a message about the machine with this site and name: its tables, a report, or whether it is gone.

        With a report comes how many were dropped before it. A machine that is not gone is only served no longer.
        """
        match content:
            case MachineOutlets():
                self._serve(content)
            case bool():
                self._leave(key, is_gone=content)
            case (int(dropped), bytes(report)):
                with self.lock:
                    self.dropped["daemon"] = dropped
                    self.knowledge.take(f"otolith/{key}/report", report, time.monotonic())

    def reasons(self) -> Mapping[str, str] | None:
        """Return why outlets of machines fail, by site and machine; None if nothing has changed."""
        found = {key: list(own) for key, own in self._faults.items() if own}
        for group in self._groups.values():
            status = group.runner.status
            if status.is_tried and not status.is_up:
                for key in group.part.members:
                    found.setdefault(key, []).append(f"{status.name}: {status.reason}")
        own = {key: "; ".join(reasons) for key, reasons in found.items()}
        if own == self._said:
            return None
        self._said = own
        return own

    def _serve(self, machine: MachineOutlets) -> None:
        """Begin with the outlets of a machine, or with those that its file has now."""
        wanted = dict[Key, Any]()
        for name, options in configured(machine.table).items():
            own = _absolute(options, machine.file.parent)
            stamps = tuple(stamp(value) for _, value in own if isinstance(value, Path))
            wanted[name, own.model_dump_json(), stamps] = own
        self._part_with(machine.key, [key for key in self._groups if key not in wanted])
        self._faults[machine.key] = []
        for key, options in wanted.items():
            try:
                self._join(machine, key, options)
            except (OtolithError, OSError) as error:
                reason = f"{key[0]}: {error}"
                log.warning("%s: %s", machine.key, reason)
                self._faults[machine.key].append(reason)

    def _join(self, machine: MachineOutlets, key: Key, options: Any) -> None:
        if (group := self._groups.get(key)) is None:
            known = _KnownPart(self.lock, _Part(self.knowledge, ()), self.dropped, hindered=self.hindered)
            setup = OutletSetup(machine.file.parent, "Otolith", sender=machine.key, known=known, statuses=self.statuses)
            outlet = built(key[0], options, setup, None)
            runner = OutletRunner(self._new_name(key[0]), outlet, known, setup, options.per_hour)
            group = self._groups[key] = _Group(known.knowledge, runner)
            self.statuses.append(runner.status)
            runner.start()
        with self.lock:
            group.part.members.add(machine.key)

    def _new_name(self, kind: str) -> str:
        """Return what no other outlet is called: machines may have several brokers."""
        taken, number = {status.name for status in self.statuses}, 1
        while (name := kind if number == 1 else f"{kind}-{number}") in taken:
            number += 1
        return name

    def _leave(self, key: str, *, is_gone: bool) -> None:
        self._faults.pop(key, None)
        with self.lock:
            if not is_gone:
                self.knowledge.take_alive(f"otolith/{key}/alive", time.monotonic(), is_alive=False)
                return
            self.knowledge.remove(key)
        self._part_with(key, list(self._groups))

    def _part_with(self, machine: str, keys: Sequence[Key]) -> None:
        """Let a machine no longer have these outlets; one that no machine has any more ends."""
        for key in keys:
            group = self._groups[key]
            with self.lock:
                group.part.members.discard(machine)
            group.runner.leave(machine)
            if not group.part.members:
                del self._groups[key]
                self.statuses.remove(group.runner.status)
                group.runner.end()
                self._ending = [runner for runner in (*self._ending, group.runner) if runner.is_running]


def places(machine: MachineOutlets, file: SourceFile) -> dict[str, str]:
    """Return where the outlets of a machine pass on to, or are read, by their names.

    Raises:
        ConfigurationError: a file that one names cannot be used.
        ServiceError: a library is missing.
    """
    setup, found = OutletSetup(machine.file.parent, "Otolith", known=DaemonOutlets()), dict[str, str]()
    for name, options in configured(machine.table).items():
        built(name, options, setup, file).close()
        found[name] = options.place
    return found


def _absolute(options: Any, folder: Path) -> Any:
    """Return options whose files are named from the root."""
    files = {name: folder.absolute() / value for name, value in options if isinstance(value, Path)}
    return options.model_copy(update=files)


class KeptLines(logging.Handler):
    """Keeps lines of the log until they are sent to the daemon."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self._kept: deque[Line] = deque(maxlen=MAX_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a line."""
        trace = logging.Formatter().formatException(record.exc_info) if record.exc_info else ""
        if len(trace) > 2 * HALF_TRACE:
            trace = f"{trace[:HALF_TRACE]}\n...\n{trace[-HALF_TRACE:]}"
        self._kept.append((record.name, record.levelno, record.getMessage()[:MAX_LINE], trace))

    def taken(self) -> tuple[Line, ...]:
        """Return what was kept since the last call."""
        return tuple(self._kept.popleft() for _ in range(len(self._kept)))


def main(connection: Connection, first: Sequence[tuple[str, Any]]) -> None:
    """Pass on what the daemon sends until it ends; the ``first`` messages are not answered."""
    lines = KeptLines()
    logging.getLogger("otolith").addHandler(lines)
    logging.getLogger("otolith").setLevel(logging.INFO)
    logging.getLogger().setLevel(logging.ERROR)  # libraries tell of each connection that fails
    with DaemonOutlets() as outlets:
        for message in first:
            outlets.take(*message)
        while (message := connection.recv()) is not None:
            outlets.take(*message)
            connection.send((outlets.reasons(), lines.taken()))
