"""From time-stamped samples to a uniform grid. Pure: times come in as arguments.

A cyclic source samples on a grid of its own; what jitters is the arrival. So a signal that comes at about the sample
period is not interpolated: each sample is given to the slot of the grid it was taken in, late arrivals to the slots
before (a frame can come late, never early). Interpolation is for signals that come at another rate, and for those
that were read by asking: of these every time is that at which the value was true, whatever request it came with.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array, Mask, Quality, Verdict
from otolith_drivers.base import Sampling

MOST_EXTRA = 20  # samples too many in a window that are told from a burst
EXTRA_LIMIT = 0.02  # share of records
IRREGULAR_LIMIT = 0.3
POLLED_REACH = 0.75  # periods from the nearest reading, beyond which a record of a polled signal is missing
CYCLIC_TOLERANCE = 0.3  # a source whose median period is this close to the grid's is taken to be on it


@dataclass(frozen=True, slots=True)
class Limits:
    """What a window may lack and still be good."""

    missing: float = 0.05
    """Share of records of the worst signal."""
    gap: float = 0.05
    """s, of the worst signal."""
    jitter: float = 0.005
    """s, of the worst signal."""


Indices = NDArray[np.int64]


class Aligned(NamedTuple):
    """One signal on the grid."""

    values: Array
    missing: Mask
    lateness: Array
    """s between each sample and its slot; empty if there was none, or if it was interpolated."""
    extra: int = 0
    """Samples that were one too many for the grid."""
    irregular: float = 0.0
    """Of an interpolated signal: standard deviation of its sampling interval over the mean."""


def align(times: Array, values: Array, start: float, records: int, period: float) -> Aligned:
    """Samples (s, value) on the grid ``start + k * period``, ``k < records``.

    Samples that are not finite count as missing. Gaps are bridged by the straight line between their ends, at the
    edges by the nearest value; without any sample the values are zero and all missing.
    """
    finite = np.isfinite(values)
    times, values = times[finite], values[finite]
    if len(times) > 1 and not _cyclic(times, period):
        return _interpolated(times, values, start, records, period)
    kept, slots = _slots(times, start, period)
    inside = (slots >= 0) & (slots < records)
    extra = len(times) - len(kept)
    slots, times, values = slots[inside], times[kept][inside], values[kept][inside]
    grid = np.full(records, np.nan)
    grid[slots] = values
    missing = np.isnan(grid)
    return Aligned(*_finite(_bridged(grid, missing), missing), times - (start + slots * period), extra)


def _cyclic(times: Array, period: float) -> bool:
    return bool(abs(np.median(np.diff(times)) / period - 1.0) <= CYCLIC_TOLERANCE)


def _slots(times: Array, start: float, period: float) -> tuple[Indices, Indices]:
    """Which samples are kept, and the slot of each: the nearest, pushed back where several came in a burst.

    A push that runs into no gap on its way back means a sample too many, not a stall: the one closest to its
    predecessor goes. A source that sends far too many keeps the push, and its lateness tells.
    """
    kept = np.arange(len(times))
    for spare in range(MOST_EXTRA, -1, -1):
        order = np.arange(len(kept))
        nearest = np.rint((times[kept] - start) / period).astype(np.int64)
        slots = np.minimum.accumulate((nearest - order)[::-1])[::-1] + order
        pushed = nearest > slots
        if not len(kept) or not pushed[0] or not spare:
            break
        reach = len(pushed) if pushed.all() else int(np.argmin(pushed))
        surplus = int(np.argmin(np.diff(times[kept][: reach + 1]))) + 1 if reach > 0 and len(kept) > 1 else 0
        kept = np.delete(kept, surplus)
    return kept, slots


def align_polled(times: Array, values: Array, start: float, records: int, period: float) -> Aligned:
    """The same of a signal whose times say when its values were true: straight lines between them, at the grid."""
    finite = np.isfinite(values)
    times, values = times[finite], values[finite]
    if not len(times):
        return Aligned(np.zeros(records), np.ones(records, dtype=np.bool_), np.zeros(0))
    grid = start + period * np.arange(records)
    after = np.clip(np.searchsorted(times, grid), 1, max(len(times) - 1, 1))
    nearest = np.minimum(np.abs(grid - times[after - 1]), np.abs(grid - times[np.minimum(after, len(times) - 1)]))
    slots = np.rint((times - start) / period)
    inside = (slots >= 0) & (slots < records)
    lateness = (times - (start + slots * period))[inside]
    return Aligned(*_finite(np.interp(grid, times, values), nearest > POLLED_REACH * period), lateness)


def _interpolated(times: Array, values: Array, start: float, records: int, period: float) -> Aligned:
    """A signal slower or faster than the grid: straight lines between samples, missing where they are too far apart."""
    grid = start + period * np.arange(records)
    usual = max(float(np.median(np.diff(times))), period)
    after = np.clip(np.searchsorted(times, grid), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    outside = (grid < times[0] - usual) | (grid > times[-1] + usual)
    missing: Mask = (gap > 2.5 * usual) | outside
    steps = np.diff(times)
    irregular = float(steps.std() / steps.mean()) if len(steps) > 1 and steps.mean() > 0.0 else 0.0
    return Aligned(*_finite(np.interp(grid, times, values), missing), np.zeros(0), irregular=irregular)


def _bridged(grid: Array, missing: Mask) -> Array:
    if missing.all():
        return np.zeros(len(grid))
    if not missing.any():
        return grid
    known = np.flatnonzero(~missing)
    return np.interp(np.arange(len(grid)), known, grid[known])


def _jitter(lateness: Array, *, centred: bool) -> float:
    """Root mean square (s), about the median if ``centred``."""
    if not len(lateness):
        return 0.0
    return float(np.sqrt(np.mean((lateness - np.median(lateness) * centred) ** 2)))


def _finite(values: Array, missing: Mask) -> tuple[Array, Mask]:
    """A line between two absurd values can overflow: such a record is missing."""
    absurd = ~np.isfinite(values)
    return np.where(absurd, 0.0, values), missing | absurd


def judge(
    aligned: Mapping[str, Aligned], period: float, limits: Limits, sampling: Sampling = Sampling.CYCLIC
) -> Quality:
    """The quality of a window from its signals."""
    missing = {signal: float(found.missing.mean()) for signal, found in aligned.items()}
    gaps = {signal: _longest_run(found.missing) * period for signal, found in aligned.items()}
    polled = sampling is Sampling.POLLED  # whose requests follow one another: what is the same each time is no jitter
    jitters = {signal: _jitter(found.lateness, centred=polled) for signal, found in aligned.items()}
    offsets = [float(np.median(found.lateness)) for found in aligned.values() if len(found.lateness)]
    reasons = _silent(missing) or [
        *_over(missing, limits.missing, lambda signal, share: f"{share:.0%} of {signal} is missing"),
        *_over(gaps, limits.gap, lambda signal, gap: f"{signal} has a gap of {gap * 1e3:.0f} ms"),
        *_over(
            {signal: found.extra / max(len(found.values), 1) for signal, found in aligned.items()},
            EXTRA_LIMIT,
            lambda signal, _: f"{signal} comes more often than it should: do two nodes send it?",
        ),
        *_over(
            {signal: found.irregular for signal, found in aligned.items()},
            IRREGULAR_LIMIT,
            lambda signal, _: f"{signal} comes at irregular intervals: do two nodes send it?",
        ),
        *_over(jitters, limits.jitter, lambda signal, jitter: f"{signal} arrives with {jitter * 1e3:.1f} ms of jitter"),
    ]
    return Quality(
        verdict=Verdict.BAD if reasons else Verdict.GOOD,
        missing=max(missing.values()),
        longest_gap=max(gaps.values()),
        jitter=max(jitters.values()),
        skew=max(offsets) - min(offsets) if offsets else 0.0,
        reasons=tuple(reasons),
    )


def _silent(missing: Mapping[str, float]) -> list[str]:
    silent = [signal for signal, share in missing.items() if share == 1.0]
    return [f"no samples of {', '.join(silent)}"] if silent else []


def _over(found: Mapping[str, float], limit: float, sentence: Callable[[str, float], str]) -> list[str]:
    worst = max(found, key=lambda signal: found[signal])
    return [sentence(worst, found[worst])] if found[worst] > limit else []


def _longest_run(mask: Mask) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate(([False], mask, [False])).astype(np.int8)))
    return int((edges[1::2] - edges[::2]).max()) if len(edges) else 0
