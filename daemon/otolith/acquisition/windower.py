"""Cut consecutive windows out of the rings, without gap or overlap between them."""

import math
from dataclasses import replace

import numpy as np

from otolith.acquisition.alignment import AlignedSignal, QualityLimits, align, align_polled, assess_quality
from otolith.acquisition.ring import Rings
from otolith.acquisition.window import Window
from otolith_drivers.base import Sampling

ALIGN = {Sampling.CYCLIC: align, Sampling.POLLED: align_polled}

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
GRACE_PERIOD = 0.1  # s after its end that a window waits for late samples
PUNCTUAL_QUANTILE = 0.1  # of lateness: stands for the samples that the computer's load did not delay
MIN_GAP_LIMIT = 2.5  # sample periods: on a coarse grid a gap of two records alone must not make a window bad


class Windower:
    """Tracks where the next window begins. Times are seconds on the monotonic clock, given by the caller."""

    def __init__(
        self,
        signals: tuple[str, ...],
        records: int,
        sample_period: float,
        limits: QualityLimits,
        sampling: Sampling = Sampling.CYCLIC,
    ) -> None:
        self.signals = signals
        self.records = records
        self.sample_period = sample_period
        self._limits, self._configured_gap = limits, limits.gap
        self._sampling = sampling
        self._start = math.inf
        self._index = 0

    @property
    def length(self) -> float:
        """Length of a window, s."""
        return self.records * self.sample_period

    @property
    def next_end(self) -> float:
        """Time at which the last record of the next window ends, s; infinity before the first window has begun."""
        return self._start + self.length

    def begin(self, rings: Rings, now: float, waited: float) -> bool:
        """Return whether the first window has begun.

        It begins when every signal has a sample, or after ``waited`` >= one window length without.
        """
        if math.isinf(self._start):
            first_times = rings.first_times()
            if all(map(math.isfinite, first_times)):
                self._start = max(first_times)
            elif waited >= self.length:
                self._start = now - self.length
        return math.isfinite(self._start)

    def due(self, rings: Rings, now: float) -> bool:
        """Return whether the next window is complete, or ``GRACE_PERIOD`` has passed since its end.

        Samples only ever arrive late, so a signal is complete when the first sample of the following window is there.
        """
        complete = min(rings.last_times()) >= self.next_end - self.sample_period / 2
        return complete or now >= self.next_end + GRACE_PERIOD

    def cut(self, rings: Rings, unix_offset: float) -> Window:
        """Return the next window; ``unix_offset`` is Unix time minus monotonic time, s."""
        aligned = self._align(rings)
        if self._index == 0:  # the grid was laid through a single sample, which may have been late
            self._start += self._grid_shift(aligned)
            aligned = self._align(rings)
        window = Window(
            index=self._index,
            start=self._start + unix_offset,
            sample_period=self.sample_period,
            signals=self.signals,
            values=np.column_stack([aligned[signal].values for signal in self.signals]),
            missing=np.column_stack([aligned[signal].missing for signal in self.signals]),
            quality=assess_quality(aligned, self.sample_period, self._limits, self._sampling),
        )
        self._index += 1
        self._start = self._start + self.length + self._grid_shift(aligned)
        return window

    def regrid(self, records: int, sample_period: float) -> None:
        """From the next window on, cut ``records`` records, ``sample_period`` s apart."""
        self.records, self.sample_period = records, sample_period
        self._limits = replace(self._limits, gap=max(self._configured_gap, MIN_GAP_LIMIT * sample_period))

    def _align(self, rings: Rings) -> dict[str, AlignedSignal]:
        samples = rings.between(self._start - GRACE_PERIOD, self.next_end + GRACE_PERIOD)
        return {
            signal: ALIGN[self._sampling](*samples[signal], self._start, self.records, self.sample_period)
            for signal in self.signals
        }

    def _grid_shift(self, aligned: dict[str, AlignedSignal]) -> float:
        """Return by how much to move the grid, in s, at most half a sample period.

        The clock of the source drifts against the monotonic clock. The lateness of the two halves of a window gives
        its slope; a straight line through both gives the lateness in the middle of the next window, or of the first
        window itself, which is aligned twice.
        """
        halves = [(len(s.lateness) // 2, s.lateness) for s in aligned.values() if len(s.lateness) > 1]
        if not halves:
            return 0.0
        early = float(np.quantile(np.concatenate([lateness[:half] for half, lateness in halves]), PUNCTUAL_QUANTILE))
        late = float(np.quantile(np.concatenate([lateness[half:] for half, lateness in halves]), PUNCTUAL_QUANTILE))
        shift = late + (1.5 * (late - early) if self._index else 0.5 * (early - late))
        return float(np.clip(shift, -self.sample_period / 2, self.sample_period / 2))
