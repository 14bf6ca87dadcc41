"""Bounded ring buffers between a driver's thread and the service's: one per signal, every loss counted."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith_drivers.base import Sample


@dataclass(frozen=True, slots=True)
class RingCounters:
    """What has passed through the rings since the start."""

    received: int = 0
    """Readings; a sample without one was counted by its driver."""
    overwritten: int = 0
    """Samples that fell out of a full ring before a window took them."""
    unknown: int = 0
    """Samples of signals that nobody asked for."""


class Ring:
    """The last ``capacity`` samples of one signal, in the order of their arrival."""

    def __init__(self, capacity: int) -> None:
        self._times = np.zeros(capacity)
        self._values = np.zeros(capacity)
        self._count = 0
        self._read_up_to = -math.inf
        self.overwritten = 0

    def append(self, time: float, value: float) -> None:
        """Add a sample; ``time`` in s, ``value`` not a number where the source had no reading."""
        place = self._count % len(self._times)
        if self._count >= len(self._times) and self._times[place] > self._read_up_to:
            self.overwritten += 1
        self._times[place] = time
        self._values[place] = value
        self._count += 1

    def extend(self, times: Array, values: Array) -> None:
        """The same as :meth:`append` for each sample (s, value), at once."""
        capacity = len(self._times)
        for begun in range(0, len(times), capacity):
            part = slice(begun, begun + capacity)
            places = np.arange(self._count, self._count + len(times[part]))
            full = places[places >= capacity] % capacity
            self.overwritten += int(np.count_nonzero(self._times[full] > self._read_up_to))
            self._times[places % capacity] = times[part]
            self._values[places % capacity] = values[part]
            self._count += len(places)

    def between(self, start: float, end: float) -> tuple[Array, Array]:
        """Times (s) and values of the samples with ``start <= time < end``, by time; they count as read."""
        kept = min(self._count, len(self._times))
        order = np.argsort(self._times[:kept], kind="stable")
        times, values = self._times[:kept][order], self._values[:kept][order]
        chosen = (times >= start) & (times < end)
        self._read_up_to = max(self._read_up_to, end)
        return times[chosen], values[chosen]

    @property
    def last_time(self) -> float:
        """Of the newest sample (s); minus infinity before the first."""
        return float(self._times[(self._count - 1) % len(self._times)]) if self._count else -math.inf

    @property
    def first_time(self) -> float:
        """Of the oldest sample still held (s); infinity before the first."""
        kept = min(self._count, len(self._times))
        return float(self._times[:kept].min()) if kept else math.inf


class Rings:
    """The rings of all signals of a machine, behind one lock."""

    def __init__(self, signals: Sequence[str], capacity: int) -> None:
        self._lock = threading.Lock()
        self._rings = {signal: Ring(capacity) for signal in signals}
        self._received = 0
        self._unknown = 0

    def deliver(self, samples: Sequence[Sample]) -> None:
        """Take the samples of a driver; called from its thread."""
        with self._lock:
            for sample in samples:
                ring = self._rings.get(sample.signal)
                if ring is None:
                    self._unknown += 1
                else:
                    ring.append(sample.time, sample.value)
                    self._received += math.isfinite(sample.value)

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

    def between(self, start: float, end: float) -> dict[str, tuple[Array, Array]]:
        """See :meth:`Ring.between`, for every signal."""
        with self._lock:
            return {signal: ring.between(start, end) for signal, ring in self._rings.items()}

    def first_times(self) -> dict[str, float]:
        """Of the oldest sample of each signal (s); infinity for a signal never seen."""
        with self._lock:
            return {signal: ring.first_time for signal, ring in self._rings.items()}

    def last_times(self) -> dict[str, float]:
        """Of the newest sample of each signal (s); minus infinity for a signal never seen."""
        with self._lock:
            return {signal: ring.last_time for signal, ring in self._rings.items()}

    def counters(self) -> RingCounters:
        """What has passed so far."""
        with self._lock:
            overwritten = sum(ring.overwritten for ring in self._rings.values())
            return RingCounters(self._received, overwritten, self._unknown)
