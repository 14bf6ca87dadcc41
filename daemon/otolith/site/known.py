"""What is known of each machine of a site, from the documents that its daemons publish.

It has no clock: each call says what time it is, in s of a clock that only elapses, so that setting the wall clock makes
nobody silent. Anybody may publish anything to a router without access control, so a document counts only if it can be
read, is not too large, and is of the machine that its key names. Invented machines take the place of other invented
ones, not of those that report for longer.
"""

import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum

from otolith.health.limits import Level
from otolith.health.schema import EventDocument, ParameterDocument, ReportDocument
from otolith.publishing.zenoh_session import ALIVE, EVENT, REPORT
from otolith_drivers.config_files import check_name

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_MACHINES = 400
MAX_BYTES = 256 << 10  # of a document
MAX_TOTAL_BYTES = 32 << 20  # of all latest reports
MAX_EVENTS = 50  # of a machine: the last ones
MAX_EVENT_ID = 200  # characters
MAX_EVENT_TEXT = 4000  # characters of each text of an event that is kept
MAX_PARAMETERS = 64  # of a machine that are passed on
MAX_TRENDS = 16  # parameters of a machine of which a curve is kept
MAX_POINTS = 48  # of a curve
MAX_PAUSE = 1800.0  # s between two points of a curve
SILENT_WINDOWS = 3.0  # lengths of a window without a report, and ...
SILENT_SLACK = 5.0  # ... s beside them, until nothing is known of a machine
MAX_WINDOW = 600.0  # s: the longest window by which the silence of a machine is judged
ESTABLISHED = 10  # reports after which a machine keeps its place for as long as FORGET_AFTER
FORGET_AFTER = 604_800.0  # s without a report after which a machine may lose its place
RIVALS = 2  # times that a lower number followed within RIVAL_SPAN, from which two daemons have one name
RIVAL_SPAN = 600.0  # s


NOT_SHOWN = {"setting": "", "formulas": "", "source": "", "reason": None, "comments": None}
"""What of an event no page and no outlet has, and is not kept."""
TEXTS = ("part", "condition", "condition_id", "text", "cause", "advice", "timezone")


class RefusedFor(StrEnum):
    """Why a document was not taken."""

    TOO_LARGE = "too_large"  # Or the id of an event is
    UNREADABLE = "unreadable"  # No document of a version that is known here
    OTHER_NAME = "other_name"  # Of another machine than its key
    NUMBER = "number"  # A report with a lower number than the last one, and none before it in its order
    TOO_MANY = "too_many"  # More machines, or larger reports, than there is room for, or than are expected


@dataclass(slots=True)
class Trace:
    """The values of a parameter: at first each, later fewer, so that they cover up to a day."""

    times: "array[float]" = field(default_factory=lambda: array("d"))
    values: "array[float]" = field(default_factory=lambda: array("d"))
    pause: float = 0.0  # s between two of them, at least

    def add(self, time: float, value: float) -> None:
        """Append a value; drop one of two as soon as there are too many, or the oldest if they cover enough."""
        if self.times and not self.pause <= time - self.times[-1]:
            return
        self.times.append(time)
        self.values.append(value)
        if len(self.times) <= MAX_POINTS:
            return
        if self.pause >= MAX_PAUSE:
            del self.times[0], self.values[0]
            return
        self.pause = min(2.0 * max(self.pause, self.times[-1] - self.times[-2]), MAX_PAUSE)
        self.times, self.values = self.times[::2], self.values[::2]


@dataclass(slots=True)
class KnownMachine:
    """A machine, its latest report, and its last events."""

    site: str
    name: str
    report: ReportDocument | None = None
    heard: float = 0.0  # When its last report came
    is_alive: bool = True  # Whether its daemon runs
    events: dict[str, EventDocument] = field(default_factory=dict)  # By id; the last change of each
    trends: dict[str, Trace] = field(default_factory=dict)  # Of parameters that have a limit
    revision: int = 0  # Another one after each document
    size: int = 0  # Bytes of its report
    reports: int = 0  # That were taken
    is_asked: bool = False  # Whether its daemon was asked for its past
    refused: tuple[int, float] | None = None  # Number of the last report that was refused because of it, and when
    restarts: tuple[float, ...] = ()  # When a lower number followed

    def is_silent(self, now: float) -> bool:
        """Whether nothing is known at present."""
        if self.report is None or not self.is_alive:
            return True
        return now - self.heard > _patience(self.report)

    def has_rival(self, now: float) -> bool:
        """Whether two daemons publish under its name, or one that does not keep its numbers starts again and again."""
        return len(self.restarts) >= RIVALS and now - self.restarts[-RIVALS] <= RIVAL_SPAN

    def state(self, now: float) -> Level:
        """Return its state: that of its report, or NO DATA."""
        if self.report is None or self.report.health is None or self.is_silent(now):
            return Level.NO_DATA
        return self.report.health.state

    @property
    def nearest(self) -> tuple[str, float] | None:
        """The parameter nearest to its limit, and its share of the way from its healthy value to it."""
        if self.report is None:
            return None
        shares = {name: share for name, row in self.report.parameters.items() if (share := share_of(row)) is not None}
        name = max(shares, key=lambda name: shares[name], default=None)
        return None if name is None else (name, shares[name])


def _patience(report: ReportDocument) -> float:
    """Return for how long the report after this one may be waited for, s."""
    return SILENT_WINDOWS * min(report.window.end - report.window.start, MAX_WINDOW) + SILENT_SLACK


def share_of(parameter: ParameterDocument) -> float | None:
    """Return how far a value has come from its healthy value to its limit: 1 at it; None if it has none."""
    value = parameter.value if parameter.referred is None else parameter.referred
    healthy = parameter.nominal if parameter.baseline is None else parameter.baseline
    if value is None or parameter.limit is None or parameter.limit == healthy:
        return None
    return (value - healthy) / (parameter.limit - healthy)


def place_of(machine: KnownMachine, state: Level) -> tuple[int, float, str, str]:
    """Return by what machines are ordered. Since when one is at OK is not shown, so that it is no order for people."""
    health = machine.report.health if machine.report else None
    since = health.since if health is not None and state is not Level.OK else 0.0
    return 9 - state.rank, since, _by_number(machine.site), _by_number(machine.name)


def _by_number(name: str) -> str:
    """Return what orders ``press-2`` before ``press-10``."""
    return re.sub(r"\d+", lambda found: found[0].zfill(20), name)


class Knowledge:
    """All machines. It is of one thread at a time."""

    def __init__(self, expected: Iterable[str] = ()) -> None:
        """``expected`` has ``site/machine`` of each machine that is taken, at most :data:`MAX_MACHINES`; empty for all.

        They are known before they are heard, so that one that never reports is seen.
        """
        names = {key: key.partition("/") for key in expected}
        self._machines = {key: KnownMachine(site, name, is_alive=False) for key, (site, _, name) in names.items()}
        self._is_open = not self._machines
        self._bytes = self._revision = 0
        self.refused: Counter[RefusedFor] = Counter()
        self.taken = 0  # Documents
        self.forgotten = 0  # Machines that lost their place

    def __iter__(self) -> Iterator[KnownMachine]:
        return iter(self._machines.values())

    def __len__(self) -> int:
        return len(self._machines)

    def get(self, site: str, name: str) -> KnownMachine | None:
        """Return a machine, None if it is not known."""
        return self._machines.get(f"{site}/{name}")

    def worst_first(self, now: float) -> list[KnownMachine]:
        """Return the machines, the most severe states first, then those that are in it for longest; at OK by name."""
        return sorted(self, key=lambda machine: place_of(machine, machine.state(now)))

    def take(self, key: str, content: bytes, now: float, *, answered: float | None = None) -> KnownMachine | None:
        """Take a document that came under a key, and return its machine if it was taken, or had been before.

        ``answered`` is the Unix time at which an answer came, which may have been published long before.
        """
        if (identity := _identity(key)) is None:
            return None
        site, name, topic = identity
        taken: KnownMachine | RefusedFor = RefusedFor.TOO_LARGE
        if len(content) <= MAX_BYTES:
            try:
                if topic == REPORT.key:
                    taken = self._take_report(site, name, content, now, answered)
                else:
                    taken = self._take_event(site, name, content, now)
            except ValueError:  # ValidationError and UnicodeDecodeError are ValueErrors
                taken = RefusedFor.UNREADABLE
        if isinstance(taken, RefusedFor):
            self.refused[taken] += 1
            return None
        self.taken += 1
        return taken

    def take_alive(self, key: str, now: float, *, is_alive: bool) -> KnownMachine | None:
        """Take that a daemon runs, or does not any more; return its machine if it is known."""
        if (identity := _identity(key)) is None or identity[2] != ALIVE.key:
            return None
        machine = self._machine(*identity[:2], now) if is_alive else self.get(*identity[:2])
        if machine is None:
            self.refused[RefusedFor.TOO_MANY] += is_alive
        elif machine.is_alive is not is_alive:
            machine.is_alive = is_alive
            self._changed(machine)
        return machine

    def _machine(self, site: str, name: str, now: float, size: int = 0) -> KnownMachine | None:
        """Return a machine, a new one if there is room, or room is made, for it and for so many bytes more."""
        known = self.get(site, name)
        if known is None and not self._is_open:
            return None
        while len(self._machines) + (known is None) > MAX_MACHINES or self._bytes + size > MAX_TOTAL_BYTES:
            if not self._forget(now, known):
                return None
        if known is None:
            known = self._machines[f"{site}/{name}"] = KnownMachine(site, name, heard=now)
        return known

    def remove(self, key: str) -> None:
        """Know a machine, by its site and name, no longer."""
        if (machine := self._machines.pop(key, None)) is not None:
            self._bytes -= machine.size

    def _changed(self, machine: KnownMachine) -> None:
        self._revision += 1
        machine.revision = self._revision

    def _forget(self, now: float, keep: KnownMachine | None) -> bool:
        """Make room: forget the machine that matters least; return whether there was one."""
        if not self._is_open:
            return False
        passing = [machine for machine in self if machine is not keep and machine.is_silent(now)
                   and (machine.reports < ESTABLISHED or now - machine.heard > FORGET_AFTER)]  # fmt: skip
        if not passing:
            return False
        least = min(passing, key=lambda machine: (machine.reports >= ESTABLISHED, machine.reports, machine.heard))
        del self._machines[f"{least.site}/{least.name}"]
        self._bytes -= least.size
        self.forgotten += 1
        return True

    def _take_report(
        self, site: str, name: str, content: bytes, now: float, answered: float | None
    ) -> KnownMachine | RefusedFor:
        text = content.decode().replace('"schema"', '"schema_"', 1)
        report = ReportDocument.model_validate_json(text, extra="ignore")  # a later version may write more
        if (report.site, report.machine) != (site, name):
            return RefusedFor.OTHER_NAME
        if any(len(event.id) > MAX_EVENT_ID for event in report.events):
            return RefusedFor.TOO_LARGE
        known, is_past = self.get(site, name), answered is not None
        heard = now if answered is None else now - max(answered - report.window.end, 0.0)
        if known is not None and (step := _step(known, report)) is not None and step <= 0:
            if step == 0 or is_past:
                return known
            before, known.refused = known.refused, (report.sequence or 0, now)
            is_next = before is not None and before[0] < known.refused[0] and now - before[1] <= _patience(report)
            if not is_next:  # one that comes late
                return RefusedFor.NUMBER
            known.refused, known.restarts = None, (*known.restarts, now)[-RIVALS:]  # the numbers go on from there
        machine = self._machine(site, name, now, len(content) - (known.size if known else 0))
        if machine is None:
            return RefusedFor.TOO_MANY
        self._bytes += len(content) - machine.size
        machine.size, machine.reports = len(content), machine.reports + 1
        machine.report, machine.heard, machine.is_alive = report, heard, True
        self._changed(machine)
        for event in report.events:
            _keep(machine, event)
        _end_others(machine, report)
        _follow(machine, report)
        return machine

    def _take_event(self, site: str, name: str, content: bytes, now: float) -> KnownMachine | RefusedFor:
        event = EventDocument.model_validate_json(content, extra="ignore")
        if len(event.id) > MAX_EVENT_ID:
            return RefusedFor.TOO_LARGE
        machine = self._machine(site, name, now)
        if machine is None:
            return RefusedFor.TOO_MANY
        _keep(machine, event)
        if machine.report is not None:
            _end_others(machine, machine.report)
        self._changed(machine)
        return machine


def _step(known: KnownMachine, report: ReportDocument) -> int | None:
    """Return by how much the number of a report is higher than the last one; None without numbers."""
    before = known.report.sequence if known.report else None
    return None if before is None or report.sequence is None else report.sequence - before


def _end_others(machine: KnownMachine, report: ReportDocument) -> None:
    """End the events that a report does not have, if no report said when they ended."""
    open_ids = {event.id for event in report.events}
    for key, event in machine.events.items():
        if event.end is None and key not in open_ids and event.start < report.window.end:
            machine.events[key] = event.model_copy(update={"end": max(event.since, report.window.start)})


def _follow(machine: KnownMachine, report: ReportDocument) -> None:
    """Append the values of a report to the curves."""
    for name, row in report.parameters.items():
        value = row.value if row.referred is None else row.referred
        has_room = name in machine.trends or len(machine.trends) < MAX_TRENDS
        if row.limit is not None and value is not None and has_room:
            machine.trends.setdefault(name, Trace()).add(report.window.end, value)


def _keep(machine: KnownMachine, event: EventDocument) -> None:
    """Keep an event, unless a later change of it is known; of too many, drop the oldest, those that are over first."""
    known = machine.events.get(event.id)
    if known and known.sequence is not None and event.sequence is not None and event.sequence < known.sequence:
        return
    events = machine.events
    events[event.id] = _shortened(event)
    while len(events) > MAX_EVENTS:
        del events[min(events, key=lambda key: (events[key].end is None, events[key].start))]


def _shortened(event: EventDocument) -> EventDocument:
    """Return what is kept of an event, so that the events of all machines have room."""
    notes = {name: note.model_copy(update={"by": note.by[:MAX_EVENT_ID], "text": note.text[:MAX_EVENT_TEXT]})
             for name in ("acknowledged", "shelved") if (note := getattr(event, name)) is not None}  # fmt: skip
    texts = {name: text[:MAX_EVENT_TEXT] for name in TEXTS if (text := getattr(event, name))}
    evidence = event.evidence.model_copy(update={"unit": event.evidence.unit[:MAX_EVENT_ID]})
    return event.model_copy(update={**NOT_SHOWN, **texts, **notes, "evidence": evidence})


def _identity(key: str) -> tuple[str, str, str] | None:
    """Return site, machine and topic of a key; None for one that no daemon has."""
    parts = key.split("/")
    if len(parts) != 4 or parts[0] != "otolith" or parts[3] not in {REPORT.key, EVENT.key, ALIVE.key}:
        return None
    try:
        return check_name(parts[1]), check_name(parts[2]), parts[3]
    except ValueError:
        return None
