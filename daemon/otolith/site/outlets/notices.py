"""Which events are told, and how often: each change once, and no more than a limit per hour. It has no clock."""

from collections import deque
from collections.abc import Iterable, Iterator
from itertools import islice

from otolith.health.limits import Level
from otolith.health.schema import EventDocument
from otolith.site.known import KnownMachine
from otolith.site.outlets.base import Notice, Told

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MISSED = 600.0  # s before the start of the site: changes of that time are told, too
MAX_REMEMBERED = 20_000  # events; those that a machine still has are among them
HOUR = 3600.0  # s


class Notices:
    """Finds what has changed. Told again are events that changed shortly before the start, as nothing is stored."""

    def __init__(self, started: float) -> None:
        self._from = started - MISSED
        self._told: dict[tuple[str, str, str], Level | None] = {}  # State by site, machine and event; None once cleared

    def take(self, machines: Iterable[KnownMachine]) -> list[Notice]:
        """Return what has not been told, the oldest first."""
        own = tuple(machines)
        found = sorted(self._of(own), key=lambda notice: notice.event.end or notice.event.since)
        if (excess := len(self._told) - MAX_REMEMBERED) > 0:
            known = {_key(machine, event) for machine in own for event in machine.events.values()}
            for key in list(islice((key for key in self._told if key not in known), excess)):
                del self._told[key]
        return found

    def _of(self, machines: Iterable[KnownMachine]) -> Iterator[Notice]:
        for machine in machines:
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
                if told is not None and (not is_new or _changed(event) >= self._from):
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


class RateLimit:
    """Lets through at most so many notices in any hour; the others are counted, and the most severe go first."""

    def __init__(self, per_hour: int) -> None:
        self._per_hour = per_hour
        self._passed: deque[float] = deque()
        self.withheld = 0

    def passes(self, notices: Iterable[Notice], now: float) -> list[Notice]:
        """Return those that may be told, in their order."""
        while self._passed and self._passed[0] <= now - HOUR:
            self._passed.popleft()
        own = list(notices)
        room = max(self._per_hour - len(self._passed), 0)
        ranked = sorted(range(len(own)), key=lambda index: -own[index].event.state.rank)[:room]
        self._passed.extend([now] * len(ranked))
        self.withheld += len(own) - len(ranked)
        return [own[index] for index in sorted(ranked)]
