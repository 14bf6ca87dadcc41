"""Cutting windows out of the rings, one after the other, without a gap or an overlap between them."""

import math
from dataclasses import replace

import numpy as np

from otolith.acquisition.alignment import Aligned, Limits, align, align_polled, judge
from otolith.acquisition.ring import Rings
from otolith.acquisition.window import Window
from otolith_drivers.base import Sampling

ALIGN = {Sampling.CYCLIC: align, Sampling.POLLED: align_polled}
PROMPT = 0.1  # quantile of lateness that stands for samples that nothing held up on their way
GAP_RECORDS = 2.5  # in a row that a coarser grid may lack
GRACE = 0.1  # s; how long after its end a window waits for late samples


class Windower:
    """Knows where the next window begins. Times are seconds on the monotonic clock, given by the caller."""

    def __init__(
        self,
        signals: tuple[str, ...],
        records: int,
        sample_period: float,
        limits: Limits,
        sampling: Sampling = Sampling.CYCLIC,
    ) -> None:
        self.signals = signals
        self.records = records
        self.sample_period = sample_period
        self._limits, self._gap_limit = limits, limits.gap
        self._sampling = sampling
        self._start = math.inf
        self._index = 0

    @property
    def length(self) -> float:
        """Of a window, s."""
        return self.records * self.sample_period

    @property
    def next_end(self) -> float:
        """When the last record of the next window is due (s); infinity before the first has begun."""
        return self._start + self.length

    def begin(self, rings: Rings, now: float, waited: float) -> bool:
        """Whether the first window has begun: when every signal has come, or after ``waited`` s of waiting in vain."""
        if math.isinf(self._start):
            firsts = rings.first_times().values()
            if all(map(math.isfinite, firsts)):
                self._start = max(firsts)
            elif waited >= self.length:
                self._start = now - self.length
        return math.isfinite(self._start)

    def due(self, rings: Rings, now: float) -> bool:
        """Whether the next window is complete, or will not get any better.

        The first sample of the window after it tells that a signal is complete, as samples only ever come late.
        """
        complete = min(rings.last_times().values()) >= self.next_end - self.sample_period / 2
        return complete or now >= self.next_end + GRACE

    def cut(self, rings: Rings, unix_offset: float) -> Window:
        """The next window; ``unix_offset`` is Unix time minus monotonic time, s."""
        aligned = self._align(rings)
        if self._index == 0:  # the grid was laid through one sample, which may have come late
            self._start += self._drift(aligned)
            aligned = self._align(rings)
        start = self._start
        window = Window(
            index=self._index,
            start=start + unix_offset,
            sample_period=self.sample_period,
            signals=self.signals,
            values=np.column_stack([aligned[signal].values for signal in self.signals]),
            missing=np.column_stack([aligned[signal].missing for signal in self.signals]),
            quality=judge(aligned, self.sample_period, self._limits, self._sampling),
        )
        self._index += 1
        self._start = start + self.length + self._drift(aligned)
        return window

    def _align(self, rings: Rings) -> dict[str, Aligned]:
        samples = rings.between(self._start - GRACE, self.next_end + GRACE)
        return {
            signal: ALIGN[self._sampling](*samples[signal], self._start, self.records, self.sample_period)
            for signal in self.signals
        }

    def regrid(self, records: int, sample_period: float) -> None:
        """From the next window on, so many records so far (s) apart; a gap is told only where records are missing."""
        self.records, self.sample_period = records, sample_period
        self._limits = replace(self._limits, gap=max(self._gap_limit, GAP_RECORDS * sample_period))

    def _drift(self, aligned: dict[str, Aligned]) -> float:
        """How far (s) to move the grid so that it meets the next window's samples in their middle.

        The source's clock drifts against ours; the lateness of the two halves of this window tells how fast.
        """
        halves = [(len(found.lateness) // 2, found.lateness) for found in aligned.values() if len(found.lateness) > 1]
        if not halves:
            return 0.0
        early = float(np.quantile(np.concatenate([lateness[:half] for half, lateness in halves]), PROMPT))
        late = float(np.quantile(np.concatenate([lateness[half:] for half, lateness in halves]), PROMPT))
        ahead = late + (1.5 * (late - early) if self._index else 0.5 * (early - late))
        return float(np.clip(ahead, -self.sample_period / 2, self.sample_period / 2))
