"""Records of a window from the samples of all signals, each sample at its own time.

If every sample lies on the grid, so do the records; an output without a sample is missing there. Otherwise the window
has a record at its start and at the time of every sample. Outputs are never interpolated: an interpolated value is no
measurement. Inputs are bridged (:mod:`otolith.acquisition.bridging`).
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from otolith.acquisition.bridging import (
    BridgedInput,
    InputKind,
    InputSamples,
    LostIntervals,
    OtherSamples,
    bridge,
    kind_of,
    lost_samples,
)
from otolith.acquisition.samples import (
    EARLY,
    Check,
    Indices,
    Interval,
    Series,
    SignalPlan,
    interval_of,
    lies_on_grid,
    stale_repeats,
)
from otolith.acquisition.window import Array, BridgeError, GridSpan, Mask, TimeGrid

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
SAME_TIME = 1e-6  # s below which two samples belong to one record
NO_OTHERS = OtherSamples(np.zeros(0), Interval(np.inf, np.inf))
MAX_LOST_RECORDS = 4  # records of the grid: more lost instants of an input than that get no records


@dataclass(frozen=True, slots=True, eq=False)
class Records:
    """The records of a window; see :class:`otolith.acquisition.window.Window`."""

    grid: TimeGrid
    values: Array
    missing: Mask
    bridge_error: BridgeError | None
    stale: int  # Repeats of a register in the window that were skipped
    held: frozenset[str]  # Commands that are recorded only when they change
    unknown: frozenset[str]  # Inputs that have no sample before the end of the window
    ambiguous: Mapping[str, float] = field(default_factory=dict)  # Share of samples with time but not value of another


def without_stale(series: Mapping[str, Series], plans: Mapping[str, SignalPlan], start: float) -> dict[str, Series]:
    """Return the samples without repeats of a register that was not renewed; a command repeats what it holds.

    The first of those before ``start`` (s) may be a repeat as well, of a reading that is not among them.
    """
    kept = dict(series)
    for name, samples in series.items():
        if plans[name].hold != "zoh" and Check.STALE in plans[name].checks:
            stale = stale_repeats(samples.values)
            stale[:1] |= stale.any() and samples.times[0] < start
            kept[name] = Series(samples.times[~stale], samples.values[~stale]) if stale.any() else samples
    return kept


def make_records(series: Mapping[str, Series], plans: Mapping[str, SignalPlan], span: GridSpan) -> Records:
    """Return the records of a window.

    ``series`` has the samples in the window and those around it, as far as they are known: a command needs the sample
    before, a measured input also the one after.
    """
    start, period = span.start, span.period
    early = EARLY * period
    fresh = without_stale(series, plans, start - early)
    inside = {name: samples.within(start - early, span.end - early) for name, samples in fresh.items()}
    whole = (samples.within(start - early, span.end - early) for samples in series.values())
    stale = sum(len(samples.times) for samples in whole) - sum(len(samples.times) for samples in inside.values())
    on_grid = all(lies_on_grid(samples.times, start, period) for samples in inside.values())
    kinds = {
        name: kind_of(plan, fresh[name].values)
        for name, plan in plans.items()
        if plan.hold is not None and len(fresh[name].times)
    }
    incomplete = [
        name
        for name, kind in kinds.items()
        if kind is InputKind.POLLED or not on_grid or len(inside[name].times) != span.records
    ]
    intervals = {name: interval_of(samples.times) for name, samples in fresh.items()} if incomplete else {}
    lost = {
        name: lost_samples(
            fresh[name],
            kinds[name],
            intervals[name],
            _others(name, fresh, intervals) if kinds[name] is InputKind.ON_CHANGE else NO_OTHERS,
        )
        for name in incomplete
    }
    grid = (
        TimeGrid.uniform(span.records, period)
        if on_grid
        else _own_times(fresh, kinds, lost.values(), span, start - early)
    )
    values, missing = np.zeros((grid.records, len(plans))), np.ones((grid.records, len(plans)), dtype=np.bool_)
    bridged: dict[int, BridgedInput] = {}
    for column, (name, plan) in enumerate(plans.items()):
        at = _records_of(inside[name].times - start, grid, period)
        missing[at, column] = False
        values[at, column] = inside[name].values
        if name in lost:
            samples = InputSamples(fresh[name], kinds[name], plan.noise, intervals[name], lost[name])
            bridged[column] = bridge(samples, start + grid.offsets, grid.steps)
            values[:, column] = np.where(missing[:, column], bridged[column].values, values[:, column])
            values[at, column] += bridged[column].error.expected_change[at]
        elif len(at) < grid.records:
            values[:, column] = np.where(
                missing[:, column], _filled(fresh[name], start + grid.offsets), values[:, column]
            )
    held = frozenset(name for name in incomplete if kinds[name] is InputKind.ON_CHANGE)
    unknown = frozenset(
        name
        for name, plan in plans.items()
        if plan.hold is not None and not (fresh[name].times[:1] < span.end - early).any()
    )
    return Records(grid, values, missing, _bridge_error(bridged, values.shape), stale, held, unknown)


def _others(name: str, series: Mapping[str, Series], intervals: Mapping[str, Interval]) -> OtherSamples:
    """Return the samples of all signals but one."""
    names = [other for other in series if other != name]
    times = np.unique(np.concatenate([np.zeros(0), *(series[other].times for other in names)]))
    most_often = min(
        (intervals[other] for other in names), key=lambda item: item.usual, default=Interval(np.inf, np.inf)
    )
    return OtherSamples(times, most_often)


def _own_times(
    series: Mapping[str, Series],
    kinds: Mapping[str, InputKind],
    lost: Iterable[LostIntervals],
    span: GridSpan,
    begin: float,
) -> TimeGrid:
    """Return the grid of all times from ``begin`` (s) on at which something is measured or an input may change.

    A polled command may change after a reading that the next one differs from.
    """
    times = [np.array([span.start])]
    for name, samples in series.items():
        first, last = np.searchsorted(samples.times, (begin, begin + span.length))
        changed = np.ones(len(samples.times), dtype=np.bool_)
        if kinds.get(name, InputKind.LINE) is not InputKind.LINE:
            changed[1:] = np.diff(samples.values) != 0.0
            if kinds[name] is InputKind.POLLED:
                changed[:-1] |= changed[1:]
        times.append(samples.times[first:last][changed[first:last]])
    times += [intervals.instants(span.start, span.end, MAX_LOST_RECORDS * span.records) for intervals in lost]
    offsets = np.maximum(np.sort(np.concatenate(times)) - span.start, 0.0)
    apart = np.concatenate([[True], np.diff(offsets) > SAME_TIME])
    return TimeGrid.at(offsets[apart], span.length)


def _records_of(offsets: Array, grid: TimeGrid, period: float) -> Indices:
    """Return the record of each sample at ``offsets`` (n,), s after the start: the nearest one."""
    if grid.period is not None:
        return np.clip(np.rint(offsets / period).astype(np.int64), 0, grid.records - 1)
    after = np.clip(np.searchsorted(grid.offsets, offsets), 0, grid.records - 1)
    before = np.maximum(after - 1, 0)
    nearer = offsets - grid.offsets[before] < grid.offsets[after] - offsets
    return np.where(nearer, before, after)


def _filled(samples: Series, times: Array) -> Array:
    """Return values for display at ``times``; none of them is a measurement."""
    if not len(samples.times):
        return np.zeros(len(times))
    with np.errstate(over="ignore", invalid="ignore"):
        filled = np.interp(times, samples.times, samples.values)
    return np.where(np.isfinite(filled), filled, 0.0)


def _bridge_error(bridged: Mapping[int, BridgedInput], shape: tuple[int, ...]) -> BridgeError | None:
    if not bridged:
        return None
    error = BridgeError(np.ones(shape), np.zeros(shape), np.zeros(shape), np.zeros(shape))
    for column, item in bridged.items():
        error.noise_ratio[:, column] = item.error.noise_ratio
        error.variance[:, column] = item.error.variance
        error.held_variance[:, column] = item.error.held_variance
        error.expected_change[:, column] = item.error.expected_change
    return error
