"""Bounded ring buffers between a driver's thread and the main thread: one per signal; every loss is counted."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith_drivers.base import Sample

# Threshold: docs/reference/thresholds-acquisition.md has its origin.
MAX_OBSERVED_AGE = 600.0  # s after which the last value of an observed signal is no longer used
GATHERED = 256  # samples of a signal that are put into its ring together


@dataclass(frozen=True, slots=True)
class RingCounters:
    """Counts of samples since the start."""

    received: int = 0  # Samples with a finite value; the driver counts the others as bad
    overwritten: int = 0  # Samples that were overwritten in a full ring before a window had read them
    unknown: int = 0  # Samples of signals that have no ring


@dataclass(frozen=True, slots=True, eq=False)
class RingState:
    """All of a ring, so that it can be continued."""

    capacity: int
    times: Array  # (n,) s, by their slots
    values: Array  # (n,)
    count: int
    read_up_to: float  # s
    newest: float  # s
    unordered_until: int
    overwritten: int


@dataclass(frozen=True, slots=True, eq=False)
class RingsState:
    """All of the rings of a machine, so that they can be continued."""

    rings: Mapping[str, RingState]  # By signal
    received: int
    unknown: int


class Ring:
    """The last ``capacity`` samples of one signal, in the order of their arrival."""

    def __init__(self, capacity: int) -> None:
        self._times = np.zeros(capacity)
        self._values = np.zeros(capacity)
        self._count = 0
        self._read_up_to = -math.inf
        self._newest = -math.inf
        self._unordered_until = 0  # count up to which a sample may be older than one that came before it
        self._overwritten = 0
        self.new_times: list[float] = []
        """Of the newest samples, which are not yet in the arrays, s: what is added here and to the values is appended.

        Once there are ``GATHERED`` of them, :meth:`gather` is due.
        """
        self.new_values: list[float] = []

    @property
    def overwritten(self) -> int:
        """Samples that were overwritten before a window had read them."""
        if not self._has_room():
            self.gather()
        return self._overwritten

    def _has_room(self) -> bool:
        """Whether the newest samples take the places of read ones only, as nearly always: they need not be gathered."""
        capacity, last = len(self._times), self._count + len(self.new_times) - 1
        if last < capacity or not self.new_times:
            return True
        is_ordered = self._unordered_until <= self._count - capacity
        return bool(last - capacity < self._count and is_ordered and self._times[last % capacity] < self._read_up_to)

    @property
    def state(self) -> RingState:
        """All of the ring, with copies of its samples."""
        self.gather()
        held = min(self._count, len(self._times))
        return RingState(
            len(self._times),
            self._times[:held].copy(),
            self._values[:held].copy(),
            self._count,
            self._read_up_to,
            self._newest,
            self._unordered_until,
            self._overwritten,
        )

    @classmethod
    def of(cls, state: RingState) -> "Ring":
        """Return a ring that continues ``state``."""
        ring = cls(state.capacity)
        held = len(state.times)
        ring._times[:held], ring._values[:held] = state.times, state.values
        ring._count, ring._read_up_to, ring._newest = state.count, state.read_up_to, state.newest
        ring._unordered_until, ring._overwritten = state.unordered_until, state.overwritten
        return ring

    def extend(self, times: Array, values: Array) -> None:
        """Add many samples at once: times (s) and values, NaN where the source had no reading."""
        self.gather()
        self._extend(times, values)

    def gather(self) -> None:
        """Put the newest samples into the arrays: of many at once it takes much less time."""
        if self.new_times:
            times, values = np.array(self.new_times), np.array(self.new_values)
            self.new_times, self.new_values = [], []
            self._extend(times, values)

    def _extend(self, times: Array, values: Array) -> None:
        capacity = len(self._times)
        for first in range(0, len(times), capacity):
            part = slice(first, first + capacity)
            slots = np.arange(self._count, self._count + len(times[part]))
            reused = slots[slots >= capacity] % capacity
            self._overwritten += int(np.count_nonzero(self._times[reused] >= self._read_up_to))
            self._times[slots % capacity] = times[part]
            self._values[slots % capacity] = values[part]
            self._count += len(slots)
            if (times[part] < np.maximum.accumulate(np.maximum(times[part], self._newest))).any():
                self._unordered_until = self._count
            self._newest = max(self._newest, float(times[part].max()))

    def around(self, start: float, end: float, read_until: float) -> tuple[Array, Array]:
        """Return times (s) and values with ``start <= time < end``, sorted by time, and the last finite one before.

        Samples before ``read_until`` (s) are marked as read: if they are overwritten, they are not lost.
        """
        self.gather()
        parts = []
        for times, values in reversed(self._ordered()):
            first, last = times.searchsorted((start, end)).tolist()
            parts.append((times[first:last], values[first:last]))
            if first > 0 and (latest := _last_finite(values[:first])) is not None:
                before = slice(latest, latest + 1)
                parts.append((times[before], values[before]))
                break
        self._read_up_to = max(self._read_up_to, read_until)
        both = (np.concatenate([part[column] for part in reversed(parts)]) for column in (0, 1))
        return next(both), next(both)

    def _ordered(self) -> list[tuple[Array, Array]]:
        """Return all samples, sorted by time: as they are in the ring, before its end and after its beginning."""
        capacity = len(self._times)
        oldest = self._count % capacity if self._count > capacity else 0
        slices = [slice(oldest, min(self._count, capacity)), slice(0, oldest)]
        parts = [(self._times[part], self._values[part]) for part in slices]
        if self._unordered_until > max(self._count - capacity, 0):
            times, values = (np.concatenate(column) for column in zip(*parts, strict=True))
            order = np.argsort(times, kind="stable")
            return [(times[order], values[order])]
        return parts

    def first_time(self) -> float:
        """Return the time of the oldest sample still held, s; infinity if there is none."""
        self.gather()
        return float(self._times[: min(self._count, len(self._times))].min(initial=math.inf))

    def last_time(self) -> float:
        """Return the time of the newest sample, s; minus infinity if there is none."""
        if self.new_times:
            return self.new_times[-1]
        return float(self._times[(self._count - 1) % len(self._times)]) if self._count else -math.inf


def _last_finite(values: Array) -> int | None:
    """Return where the last finite one of ``values`` (n,) is: nearly always at the end, so all are looked at last."""
    if len(values) and math.isfinite(values[-1]):
        return len(values) - 1
    finite = np.flatnonzero(np.isfinite(values))
    return int(finite[-1]) if len(finite) else None


class Rings:
    """The rings of all signals of a machine, guarded by one lock."""

    def __init__(self, signals: Sequence[str], capacity: int, observed: Sequence[str] = ()) -> None:
        """No window waits for the signals in ``observed``: it has their means."""
        self._lock = threading.Lock()
        self._signals, self._observed = tuple(signals), tuple(observed)
        self._rings = {signal: Ring(capacity) for signal in (*signals, *observed)}
        self._received = 0
        self._unknown = 0

    @property
    def state(self) -> RingsState:
        """All of the rings, with copies of their samples."""
        with self._lock:
            return RingsState({name: ring.state for name, ring in self._rings.items()}, self._received, self._unknown)

    def restore(self, state: RingsState) -> None:
        """Continue ``state``, which must have the same signals."""
        with self._lock:
            self._rings = {name: Ring.of(state.rings[name]) for name in self._rings}
            self._received, self._unknown = state.received, state.unknown

    def deliver(self, samples: Sequence[Sample]) -> None:
        """Take the samples of a driver; called from the driver's thread."""
        is_finite, ring_of, received = math.isfinite, self._rings.get, 0
        with self._lock:
            for signal, time, value in samples:
                if (ring := ring_of(signal)) is None:
                    self._unknown += 1
                    continue
                ring.new_times.append(time)
                ring.new_values.append(value)
                received += is_finite(value)
            self._received += received
            for ring in self._rings.values():
                if len(ring.new_times) >= GATHERED:
                    ring.gather()

    def deliver_columns(self, columns: Mapping[str, tuple[Array, Array]]) -> None:
        """Take many samples at once: times (s) and values of each signal, in the order of their arrival."""
        with self._lock:
            for signal, (times, values) in columns.items():
                ring = self._rings.get(signal)
                if ring is None:
                    self._unknown += len(times)
                else:
                    ring.extend(times, values)
                    self._received += int(np.count_nonzero(np.isfinite(values)))

    def around(self, signal: str, start: float, end: float, read_until: float) -> tuple[Array, Array]:
        """Return the result of :meth:`Ring.around` for one signal."""
        with self._lock:
            return self._rings[signal].around(start, end, read_until)

    def observed_means(self, start: float, end: float) -> dict[str, float]:
        """Return the mean from ``start`` to ``end`` (s) of each observed signal, otherwise its last value before.

        A signal without a sample for ``MAX_OBSERVED_AGE`` has none.
        """
        means = {}
        for signal in self._observed:
            times, values = self.around(signal, start, end, end)
            times, values = times[np.isfinite(values)], values[np.isfinite(values)]
            inside = values[times >= start] if len(times) and times[-1] >= start else values[-1:]
            if len(inside) and end - times[-1] <= MAX_OBSERVED_AGE:
                means[signal] = float(inside.mean())
        return means

    def first_times(self) -> dict[str, float]:
        """Return the result of :meth:`Ring.first_time` for every signal."""
        with self._lock:
            return {signal: self._rings[signal].first_time() for signal in self._signals}

    def last_times(self) -> dict[str, float]:
        """Return the result of :meth:`Ring.last_time` for every signal."""
        with self._lock:
            return {signal: self._rings[signal].last_time() for signal in self._signals}

    def counters(self) -> RingCounters:
        """Return the counts since the start."""
        with self._lock:
            overwritten = sum(self._rings[signal].overwritten for signal in self._signals)
            return RingCounters(self._received, overwritten, self._unknown)
