"""What is told, and how often: each change of an event or of silence once, and no more than a limit per hour.

It has no clock: ``now`` is in s of one that only elapses. How long ago an event changed is judged by the clock of its
daemon, so that setting a wall clock, here or there, hides no event.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice

from otolith.health.limits import Level
from otolith.health.schema import EventDocument, EvidenceDocument, Language
from otolith.health.text import report_in, texts_in
from otolith.site.known import KnownMachine
from otolith.site.outlets.base import Notice, Told
from otolith.site.words import words_in

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MISSED = 600.0  # s before the start of the site: changes of that time are told, too
MAX_REMEMBERED = 20_000  # events; those that a machine still has are among them
HOUR = 3600.0  # s
LASTING = 60.0  # s of silence, and of being heard again, until it is told


class Notices:
    """Finds what has changed. Told again are events that changed shortly before the start, as nothing is stored."""

    def __init__(self, started: float) -> None:
        self._started = started
        self._told: dict[tuple[str, str, str], Level | None] = {}  # State by site, machine and event; None once cleared

    def take(self, machines: Iterable[KnownMachine], now: float) -> list[Notice]:
        """Return what has not been told, the oldest first."""
        own = tuple(machines)
        found = sorted(self._of(own, now), key=lambda notice: notice.event.end or notice.event.since)
        if (excess := len(self._told) - MAX_REMEMBERED) > 0:
            known = {_key(machine, event) for machine in own for event in machine.events.values()}
            for key in list(islice((key for key in self._told if key not in known), excess)):
                del self._told[key]
        return found

    def _of(self, machines: Iterable[KnownMachine], now: float) -> Iterator[Notice]:
        for machine in machines:
            if machine.report is None:  # its events come before it
                continue
            said = machine.report.window.end - MISSED - (now - self._started) + (now - machine.heard)
            for event in machine.events.values():
                key = _key(machine, event)
                state = None if event.end is not None else event.state
                is_new, before = key not in self._told, self._told.get(key)
                if not is_new and before is state:
                    continue
                if event.is_hint or event.shelved is not None:
                    continue
                self._told[key] = state
                told = _told(before, state, is_new=is_new)
                if told is not None and (not is_new or _changed(event) >= said):
                    yield Notice(machine.site, machine.name, told, event)


def _key(machine: KnownMachine, event: EventDocument) -> tuple[str, str, str]:
    return machine.site, machine.name, event.id


def _changed(event: EventDocument) -> float:
    return event.since if event.end is None else event.end


def _told(before: Level | None, state: Level | None, *, is_new: bool) -> Told | None:
    """Return what the step from one state to another is; None if it was raised and cleared before it was seen."""
    if state is None:
        return None if is_new else Told.CLEARED
    if before is None:
        return Told.RAISED
    return Told.WORSE if state.rank > before.rank else Told.BETTER


class Silences:
    """Finds machines of which no reports come, or only that they are not served; and when they come again.

    Each is told once it lasts.
    """

    def __init__(self) -> None:
        self._since: dict[tuple[str, str], float] = {}  # When a machine became other than what was told of it
        self._told: dict[tuple[str, str], EventDocument] = {}  # Those of which is told that they are silent

    def take(
        self, machines: Iterable[KnownMachine], now: float, wall: float, language: Language | None
    ) -> list[Notice]:
        """Return what has not been told, in a language, by default that of each machine; ``wall`` is Unix time."""
        own = {(machine.site, machine.name): machine for machine in machines}
        for known in (self._since, self._told):
            for key in known.keys() - own.keys():
                del known[key]
        return [notice for key, machine in own.items() if (notice := self._of(key, machine, now, wall, language))]

    def _of(
        self, key: tuple[str, str], machine: KnownMachine, now: float, wall: float, language: Language | None
    ) -> Notice | None:
        told = self._told.get(key)
        report = machine.report
        is_left_out = report is not None and report.is_left_out
        if (is_left_out or machine.is_silent(now)) is (told is not None):
            self._since.pop(key, None)
        elif now - self._since.setdefault(key, now) >= LASTING:
            heard = report.window.end if report else wall - LASTING
            del self._since[key]
            if told is not None:
                del self._told[key]
                return Notice(*key, Told.CLEARED, told.model_copy(update={"end": heard}))
            self._told[key] = _silence(heard, machine, language)
            return Notice(*key, Told.RAISED, self._told[key])
        return None


def _silence(since: float, machine: KnownMachine, language: Language | None) -> EventDocument:
    """Return the silence of a machine as an event."""
    report = None if machine.report is None else report_in(machine.report, language)
    health = report.health if report else None
    language = language or (health.language if health else "en")
    words, advice = words_in(language), texts_in(language)("check_daemon")
    condition, text = words["silence"], words["silence_text"]
    if report is not None and health is not None and report.is_left_out:
        condition, text, advice, since = words["left_out"], health.reason, words["left_out_advice"], health.since
    return EventDocument(
        id=f"silent@{since:.3f}", part="", state=Level.NO_DATA, start=since, since=since, condition=condition,
        text=text, advice=advice, language=language,
        timezone=health.timezone if health else None,
        evidence=EvidenceDocument(windows=(0, 0)),
    )  # fmt: skip


class RateLimit:
    """Lets through at most so many notices in any hour; the others are counted, and the most severe go first.

    Silences have half of them, so that a link that is cut leaves room for what machines report.
    """

    def __init__(self, per_hour: int) -> None:
        self._per_hour = per_hour
        self._passed: deque[float] = deque()
        self.withheld = 0

    def passes(self, notices: Iterable[Notice], now: float) -> list[Notice]:
        """Return those that may be told, in their order."""
        while self._passed and self._passed[0] <= now - HOUR:
            self._passed.popleft()
        own = list(notices)
        ranked = sorted(range(len(own)), key=lambda index: -own[index].event.state.rank)
        chosen = list[int]()
        for index in ranked:
            is_silence = own[index].event.state is Level.NO_DATA
            room = (self._per_hour + 1) // 2 if is_silence else self._per_hour
            if len(self._passed) < room:
                self._passed.append(now)
                chosen.append(index)
        self.withheld += len(own) - len(chosen)
        return [own[index] for index in sorted(chosen)]
