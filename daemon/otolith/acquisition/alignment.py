"""Align time-stamped samples to the uniform grid of a window, and assess the quality of the result.

A cyclic source samples on a grid of its own; only the arrival jitters, and a frame can arrive late but never early.
A signal whose period is about the sample period is therefore assigned to slots of the grid: late samples move to
earlier slots, and values are not changed. A signal at another rate is interpolated linearly, and so is a polled
signal, whose times say when each value was true.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array, Mask, Quality, Verdict
from otolith_drivers.base import Sampling

Indices = NDArray[np.int64]

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
CYCLIC_TOLERANCE = 0.3  # share of the sample period by which the period of a signal on the grid may differ from it
MAX_DROPPED_SAMPLES = 20  # surplus samples per window that are dropped; more of them show as jitter
MAX_SURPLUS_SHARE = 0.02  # of the records; more surplus samples than this come from a second sender
MAX_IRREGULARITY = 0.3  # standard deviation of the sampling interval over its mean; a second sender exceeds it
MAX_POLLED_DISTANCE = 0.75  # sample periods from the nearest reading, beyond which a polled record is missing
MAX_INTERVAL = 2.5  # median intervals between two samples, beyond which interpolated records are missing


@dataclass(frozen=True, slots=True)
class QualityLimits:
    """Bounds that the worst signal of a window must keep for the window to be good."""

    missing: float
    """Share of records without a sample, 0 to 1."""
    gap: float
    """Longest time without a sample, s."""
    jitter: float
    """Root mean square lateness, s."""


class AlignedSignal(NamedTuple):
    """One signal on the grid of a window."""

    values: Array
    """(records,) in the unit of the signal; zero where nothing can be interpolated."""
    missing: Mask
    """(records,) true where the value is no measurement."""
    lateness: Array
    """Time of each sample minus that of its slot, s; empty for a signal at another rate than the grid's."""
    surplus: int = 0
    """Samples dropped because the grid had no slot for them."""
    irregularity: float = 0.0
    """Standard deviation of the sampling interval over its mean, for a signal at another rate; otherwise 0."""


def align(times: Array, values: Array, start: float, records: int, period: float) -> AlignedSignal:
    """Return the samples of a cyclic signal (s, value) on the grid ``start + k * period``, ``k < records``.

    Samples that are not finite count as missing. Gaps are interpolated linearly between their ends; at the edges the
    nearest value is repeated. Without any sample all values are zero and missing.
    """
    times, values = _finite_samples(times, values)
    if len(times) > 1 and abs(np.median(np.diff(times)) / period - 1.0) > CYCLIC_TOLERANCE:
        return _align_other_rate(times, values, start, records, period)
    kept, slots = _assign_slots(times, start, period)
    inside = (slots >= 0) & (slots < records)
    surplus = len(times) - len(kept)
    slots, times, values = slots[inside], times[kept][inside], values[kept][inside]
    grid = np.full(records, np.nan)
    grid[slots] = values
    missing = np.isnan(grid)
    if missing.any() and not missing.all():
        present = np.flatnonzero(~missing)
        grid = np.interp(np.arange(records), present, grid[present])
    return AlignedSignal(*_mark_non_finite(grid, missing), times - (start + slots * period), surplus)


def align_polled(times: Array, values: Array, start: float, records: int, period: float) -> AlignedSignal:
    """Return the samples of a polled signal (s, value), interpolated linearly onto the grid of :func:`align`."""
    times, values = _finite_samples(times, values)
    if not len(times):
        return AlignedSignal(np.zeros(records), np.ones(records, dtype=np.bool_), np.zeros(0))
    grid, after = _grid(times, start, records, period)
    distance = np.minimum(np.abs(grid - times[after - 1]), np.abs(grid - times[np.minimum(after, len(times) - 1)]))
    slots = np.rint((times - start) / period)
    inside = (slots >= 0) & (slots < records)
    lateness = (times - (start + slots * period))[inside]
    missing = distance > MAX_POLLED_DISTANCE * period
    return AlignedSignal(*_mark_non_finite(np.interp(grid, times, values), missing), lateness)


def _align_other_rate(times: Array, values: Array, start: float, records: int, period: float) -> AlignedSignal:
    """Interpolate a cyclic signal that is slower or faster than the grid; records in long intervals are missing."""
    grid, after = _grid(times, start, records, period)
    intervals = np.diff(times)
    usual = max(float(np.median(intervals)), period)
    outside = (grid < times[0] - usual) | (grid > times[-1] + usual)
    missing: Mask = (times[after] - times[after - 1] > MAX_INTERVAL * usual) | outside
    mean = intervals.mean()
    irregularity = float(intervals.std() / mean) if len(intervals) > 1 and mean > 0.0 else 0.0
    aligned = _mark_non_finite(np.interp(grid, times, values), missing)
    return AlignedSignal(*aligned, np.zeros(0), irregularity=irregularity)


def _grid(times: Array, start: float, records: int, period: float) -> tuple[Array, Indices]:
    """Return the times of the grid, and for each the index of the first later sample, as far as there is one."""
    grid = start + period * np.arange(records, dtype=np.float64)
    return grid, np.clip(np.searchsorted(times, grid), 1, max(len(times) - 1, 1))


def _finite_samples(times: Array, values: Array) -> tuple[Array, Array]:
    finite = np.isfinite(values)
    return times[finite], values[finite]


def _assign_slots(times: Array, start: float, period: float) -> tuple[Indices, Indices]:
    """Return the indices of the samples to keep, and the slot of each.

    A sample takes the nearest slot, or an earlier one where several came in a burst. If the samples of a burst find no
    free slot before them, one sample is surplus: the one closest to its predecessor is dropped. After
    ``MAX_DROPPED_SAMPLES`` dropped samples the rest keep their late slots.
    """
    kept = np.arange(len(times))
    for droppable in range(MAX_DROPPED_SAMPLES, -1, -1):
        order = np.arange(len(kept))
        nearest = np.rint((times[kept] - start) / period).astype(np.int64)
        slots = np.minimum.accumulate((nearest - order)[::-1])[::-1] + order
        moved = nearest > slots
        if not len(kept) or not moved[0] or not droppable:
            break
        burst = len(moved) if moved.all() else int(np.argmin(moved))
        surplus = int(np.argmin(np.diff(times[kept][: burst + 1]))) + 1 if burst > 0 and len(kept) > 1 else 0
        kept = np.delete(kept, surplus)
    return kept, slots


def _mark_non_finite(values: Array, missing: Mask) -> tuple[Array, Mask]:
    """Replace values that are not finite by missing zeros: interpolation between huge values can overflow."""
    invalid = ~np.isfinite(values)
    return np.where(invalid, 0.0, values), missing | invalid


def assess_quality(
    aligned: Mapping[str, AlignedSignal], period: float, limits: QualityLimits, sampling: Sampling = Sampling.CYCLIC
) -> Quality:
    """Return the quality of a window from its signals; ``period`` is the sample period, s."""
    missing = {name: float(signal.missing.mean()) for name, signal in aligned.items()}
    gaps = {name: _longest_run(signal.missing) * period for name, signal in aligned.items()}
    # The offset of a polled signal is its place in the round of requests, the same in each round: no jitter.
    centred = sampling is Sampling.POLLED
    jitters = {name: _jitter(signal.lateness, centred=centred) for name, signal in aligned.items()}
    surplus = {name: signal.surplus / max(len(signal.values), 1) for name, signal in aligned.items()}
    irregularity = {name: signal.irregularity for name, signal in aligned.items()}
    offsets = [float(np.median(signal.lateness)) for signal in aligned.values() if len(signal.lateness)]
    checks = (
        (missing, limits.missing, 1.0, "{1:.0%} of {0} is missing"),
        (gaps, limits.gap, 1e3, "{0} has a gap of {1:.0f} ms"),
        (surplus, MAX_SURPLUS_SHARE, 1.0, "{0} comes more often than it should: do two nodes send it?"),
        (irregularity, MAX_IRREGULARITY, 1.0, "{0} comes at irregular intervals: do two nodes send it?"),
        (jitters, limits.jitter, 1e3, "{0} arrives with {1:.1f} ms of jitter"),
    )
    silent = [name for name, share in missing.items() if share == 1.0]
    reasons = [f"no samples of {', '.join(silent)}"] if silent else []
    for values, limit, scale, text in () if silent else checks:
        worst = max(values, key=values.__getitem__)
        if values[worst] > limit:
            reasons.append(text.format(worst, scale * values[worst]))
    return Quality(
        verdict=Verdict.BAD if reasons else Verdict.GOOD,
        missing=max(missing.values()),
        longest_gap=max(gaps.values()),
        jitter=max(jitters.values()),
        skew=max(offsets) - min(offsets) if offsets else 0.0,
        reasons=tuple(reasons),
    )


def _jitter(lateness: Array, *, centred: bool) -> float:
    """Return the root mean square lateness in seconds, about its median if ``centred``."""
    if not len(lateness):
        return 0.0
    return float(np.sqrt(np.mean((lateness - np.median(lateness) * centred) ** 2)))


def _longest_run(mask: Mask) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0
