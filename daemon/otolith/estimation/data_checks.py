"""Faulty data are rejected before estimating: bad windows, spikes, frozen or clipped channels, repeated records.

- A **spike** rises and falls within two samples, so the second difference around it reads -1/2, 1, -1/2 at equal steps.
  The kink that a voltage step leaves in a current does not (compare F. R. Hampel, The influence curve and its role in
  robust estimation, Journal of the American Statistical Association 69, 1974). Single spikes count as missing.
- A channel is **frozen** where it keeps one value that its prediction from all other data makes improbable, also with
  the dead band or the edges of its sensor (:mod:`otolith.estimation.sensor_models`). The
  prediction is that of the filter, with its uncertainty: the run counts as missing, and parameters, initial state and
  process noise are free within what is known of them. What a disturbance of one equation explains, as dry friction that
  holds an axis, is no fault of the sensor.
- **Repeated records** are an old image that was read or sent again: every channel repeats bit for bit. Their errors are
  one and the same error, so only the first and the last of a run count; the first alone would be biased in the
  direction of motion. Coarse channels repeat by chance, and dropping those would bias them, so then all records count.
- A channel is **saturated** where its samples pile up at their largest or least value, with noise, while its prediction
  from all other data moves on beyond. This is looked for where a window contradicts the twin. The pile then counts
  as missing; the twin must explain all that is left.

All of them look at measured samples only, each at its own time. A machine file turns each of them off for a signal.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import erf

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.quality import time_text
from otolith.acquisition.samples import MAD_TO_SD, Check
from otolith.acquisition.window import Array, Mask, Verdict, Window, runs_of
from otolith.estimation.evidence import CHANCE, chi_square_limit
from otolith.estimation.objective import MIN_ADC_LEVELS, PENALTY, unmodelled_rounding
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import MIN_RUN, Problem
from otolith.estimation.sensor_models import RENEWED_DISTANCES, distance, is_driven_position, new_readings
from otolith.estimation.window_fit import fit_predicted
from otolith.twin.definition import Definition, Output
from otolith_drivers.units import unit_text

MIN_RECORDS = 5
MAX_RECORDS = 30_000  # that are estimated from: a search for what the twin lacks takes 12 kB for each
MAX_VALUE = 1e12  # magnitude of a value, in the unit of its signal
SPIKE_HEIGHT = 12.0  # times the usual second difference of the channel: least height of a spike
SPIKE_SHAPE = 0.35  # largest distance of the neighbours' share from that of a spike, which is a half at equal steps
MAX_FAULTY_SHARE = 0.05  # share of records above which the channel is rejected
SECOND_DIFFERENCE_SD = np.sqrt(1.5)  # standard deviation of the second difference of unit noise, the root of 3/2
DIFFERENCE_ORDER = 4  # differences of this order remove what a cubic follows over five records
DIFFERENCE_GAIN = np.sqrt(70.0)  # of white noise by these differences: √(1² + 4² + 6² + 4² + 1²)
FROZEN_MOVEMENT = 6.0  # standard deviations that the prediction must move while the channel stands still
FROZEN_STEPS = 2.0  # steps of the converter that it must move beside that
RESOLVED_NOISE = 2.0  # steps of a converter from which on noise can be distinguished from motion over coarse steps
PILE_WIDTH = 7.0  # standard deviations of the noise at a limit: range of a thousand normal values
PILE_ROUNDS = 3  # of estimating this noise from the samples of the pile
MIN_REPEATED_RUN = 10  # records
COARSE_REPEATS = 0.3  # share of the other records in which a coarse sensor repeats its value
COARSE_STEPS = 2.0  # least steps that a coarse sensor usually moves by


Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class FaultySensor:
    """A sensor of which samples are wrong."""

    signal: str
    text: str
    """What is wrong."""
    setting: str
    """What to write into the machine file if the samples are right."""
    advice: str = ""
    """What to do about it."""


@dataclass(frozen=True, slots=True)
class CheckedWindow:
    """A window without faulty records, and the results of the checks."""

    window: Window
    notes: tuple[str, ...] = ()
    """What was left out."""
    bad: tuple[str, ...] = ()
    """Why the sampling or the values make the window unusable."""
    faulty_sensors: tuple[FaultySensor, ...] = ()
    """Which sensors make the window unusable, and why."""

    @property
    def is_usable(self) -> bool:
        """Whether the window may be estimated from."""
        return not self.bad and not self.faulty_sensors


def last_records(window: Window) -> tuple[Window, tuple[str, ...]]:
    """Return the window, or its last records if it has more than memory suffices for, and a note of that."""
    if window.records <= MAX_RECORDS:
        return window, ()
    length = f"{MAX_RECORDS * window.sample_period:g} s"
    note = (
        f"only the last {MAX_RECORDS} of {window.records} records are estimated from, as more need too much memory; "
        f"write at most {length} as length under [window], or a longer sample_period"
    )
    return window.since(window.records - MAX_RECORDS), (note,)


def check_window(window: Window, predicted: Posterior) -> CheckedWindow:
    """Check ``window`` against its prediction, and drop faulty records."""
    problem = predicted.problem
    bad = window.quality.reasons if window.quality.verdict is Verdict.BAD else _unusable_values(window)
    if bad:
        return CheckedWindow(window, bad=bad)
    cleaned, notes, faulty = drop_spikes(window, problem.base_model, problem.noise, _channels(problem, Check.SPIKES))
    faulty = faulty or frozen_channels(predicted, cleaned)
    if faulty:
        return CheckedWindow(cleaned, faulty_sensors=tuple(faulty))
    cleaned, repeated = drop_repeats(cleaned, problem.base_model, _channels(problem, Check.STALE))
    held = frozenset(name for name, sensor in problem.sensors if sensor.holds)
    return CheckedWindow(new_readings(cleaned, held) if held else cleaned, (*notes, *repeated))


def _channels(problem: Problem, check: Check) -> frozenset[str]:
    """Return the signals for which ``check`` is on."""
    return frozenset(name for name in problem.base_model.signals if (name, check) not in problem.unchecked)


def _unusable_values(window: Window) -> tuple[str, ...]:
    if window.records < MIN_RECORDS:
        return (f"{window.records} records are fewer than {MIN_RECORDS}, which a window needs",)
    if not (np.abs(window.values) < MAX_VALUE).all():  # also false for not-a-number
        return (f"a value is not finite or beyond {MAX_VALUE:g}",)
    return ()


def drop_spikes(
    window: Window, twin: Definition, noise: tuple[float, ...], checked: frozenset[str] | None = None
) -> tuple[Window, list[str], list[FaultySensor]]:
    """Return the window with spikes missing, notes, and the channels with too many spikes.

    ``noise`` holds the standard deviations of the outputs. Commands (``zoh`` inputs) may jump. Of the other signals
    those in ``checked`` are looked at, all by default.
    """
    levels = {output.name: level for output, level in zip(twin.outputs, noise, strict=True)}
    levels |= {source.name: 0.0 for source in twin.inputs if source.hold == "foh"}
    values, missing = window.values.copy(), window.missing.copy()
    times = _times(window)
    notes: list[str] = []
    faulty: list[FaultySensor] = []
    for name, level in levels.items():
        if checked is not None and name not in checked:
            continue
        column = window.signals.index(name)
        present = np.flatnonzero(~window.missing[:, column])
        is_even = window.grid.period is not None and len(present) == window.records
        is_spike = spike_records(window.values[present, column], level, None if is_even else times[present])
        count = int(is_spike.sum())
        if count > MAX_FAULTY_SHARE * len(present):
            text = f"{name} spikes in {count} of {len(present)} records"
            faulty.append(FaultySensor(name, text, _turned_off(name, Check.SPIKES)))
        elif count:
            values[:, column] = _bridge(times, values[:, column], present, is_spike)
            missing[present[is_spike], column] = True
            notes.append(f"{name} has {count} spike{'s' if count > 1 else ''}, left out")
    return (replace(window, values=values, missing=missing) if notes else window), notes, faulty


def _times(window: Window) -> Array:
    """Return the times (records,) of the records; on a uniform grid in periods, so that equal steps are exactly so."""
    return np.arange(window.records, dtype=np.float64) if window.grid.period is not None else window.grid.offsets


def _turned_off(name: str, check: Check) -> str:
    """Return how ``check`` is turned off for a signal."""
    others = ", ".join(f'"{other}"' for other in Check if other is not check)
    return f"if these readings are right, write checks = [{others}] under {name} in [signals]"


def spike_records(values: Array, noise: float, times: Array | None = None) -> Mask:
    """Return which of ``values`` (samples,) are spikes above a ``noise`` of that standard deviation.

    ``times`` (samples,) are those of the samples, by default at equal steps. The second difference of a sample is its
    distance from the line through its neighbours. It grows with the curvature of the signal times both steps.
    """
    spikes = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 5:
        return spikes
    share, spread = (0.5, 1.0) if times is None else _lines_through_neighbours(times)
    second = values[1:-1] - (share * values[:-2] + (1.0 - share) * values[2:])
    if float(np.abs(second).max()) <= SPIKE_HEIGHT * SECOND_DIFFERENCE_SD * noise:
        return spikes
    usual = max(MAD_TO_SD * median(np.abs(second)), SECOND_DIFFERENCE_SD * noise)
    usual = max(usual, float(np.finfo(float).eps * np.abs(values).max()))  # of the rounding of numbers
    height = SPIKE_HEIGHT * max(usual, float(np.finfo(float).tiny))
    high = (np.abs(second) > height * spread)[1:-1]
    if not high.any():
        return spikes
    share = np.broadcast_to(share, len(second))
    before, after = 1.0 - share[:-2], share[2:]  # of the spike in the lines through the samples before and after
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = second[:-2] / second[1:-1], second[2:] / second[1:-1]
    shaped = [np.abs(ratio / share + 1.0) < 2.0 * SPIKE_SHAPE for ratio, share in ((first, before), (last, after))]
    highest = (np.abs(first) < 1.0) & (np.abs(last) < 1.0)  # close in time to a spike, a sample seems to be one too
    spikes[2:-2] = high & shaped[0] & shaped[1] & highest
    return spikes


def _lines_through_neighbours(times: Array) -> tuple[Array, Array]:
    """Return the weight of the sample before in the line through both neighbours (samples - 2,), and its error.

    ``times`` (samples,) are those of the samples; the error is relative to that of an ordinary pair of steps.
    """
    steps = np.diff(times)
    product = steps[:-1] * steps[1:]
    return steps[1:] / (steps[:-1] + steps[1:]), np.maximum(product / median(product), 1.0)


def median(values: Array) -> float:
    """Return the median of ``values`` (n,), which are finite, in a tenth of NumPy's time for a short window."""
    half = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, half)[half])
    low, high = np.partition(values, (half - 1, half))[half - 1 : half + 1].tolist()
    return float(0.5 * (low + high))


def _bridge(times: Array, values: Array, present: Indices, spikes: Mask) -> Array:
    """Return ``values`` (records,) with lines over ``spikes`` (present,), between the ``present`` samples beside."""
    kept = present[~spikes]
    bridged = values.copy()
    after = np.searchsorted(kept, present[spikes])
    for right in np.unique(after):
        left = kept[right - 1] if right else -1
        gap = np.arange(left + 1, kept[right] if right < len(kept) else len(values))
        bridged[gap] = np.interp(times[gap], times[kept], values[kept])
    return bridged


@dataclass(frozen=True, slots=True, eq=False)
class _Channel:
    """The samples of a sensor in a window, beside the prediction of the window."""

    predicted: Posterior
    window: Window
    output: Output

    @property
    def name(self) -> str:
        return self.output.name

    @property
    def index(self) -> int:
        return [output.name for output in self.predicted.problem.twin.outputs].index(self.name)

    @property
    def values(self) -> Array:
        """(records,)."""
        return self.window.column(self.name)

    @property
    def present(self) -> Indices:
        """(samples,) records with a sample."""
        return np.flatnonzero(~self.window.missing_in(self.name))

    def within(self, band: float, prediction: Array, runs: list[Indices]) -> "_Channel":
        """Return the channel with the values of ``runs`` nearest to ``prediction`` (records,) within the dead band."""
        values, column = self.window.values.copy(), self.window.signals.index(self.name)
        for run in runs:
            values[run, column] = np.clip(prediction[run], values[run, column] - band, values[run, column] + band)
        return replace(self, window=replace(self.window, values=values))

    def without(self, records: Indices) -> Window:
        """Return the window with the signal missing in ``records``."""
        missing = self.window.missing.copy()
        missing[records, self.window.signals.index(self.name)] = True
        return replace(self.window, missing=missing)


def _checked_channels(predicted: Posterior, window: Window) -> Iterator[_Channel]:
    """Return the sensors that the machine file lets be checked for frozen readings."""
    outputs, unchecked = predicted.problem.base_model.outputs, predicted.problem.unchecked
    return (_Channel(predicted, window, each) for each in outputs if (each.name, Check.FROZEN) not in unchecked)


def frozen_channels(predicted: Posterior, window: Window) -> list[FaultySensor]:
    """Return the channels that keep a value which their prediction makes improbable."""
    faulty = []
    for channel in _checked_channels(predicted, window):
        present = channel.present
        runs = _constant_runs(channel.values, present)
        is_long = _samples_in(runs) > MAX_FAULTY_SHARE * len(present)
        if is_long and (run := _frozen_run(channel, runs)) is not None:
            setting = _turned_off(channel.name, Check.FROZEN)
            faulty.append(FaultySensor(channel.name, _frozen_sentence(channel, run), setting))
    return faulty


def without_saturated(predicted: Posterior, window: Window) -> tuple[Window, FaultySensor] | None:
    """Return ``window``, which contradicts the twin, without the samples at the limits of a sensor, which is named.

    None if such samples are not the cause.
    """
    without = (_without_piles(channel) for channel in _checked_channels(predicted, window))
    return next((rest for rest in without if rest is not None), None)


def _without_piles(channel: _Channel) -> tuple[Window, FaultySensor] | None:
    """Return the window without the samples at the limits of a sensor if the twin explains all others, or None.

    At a limit the prediction moves further than the samples spread. Where a machine has changed, both settle. Samples
    that are noisier than stated are at no limit if the twin with their noise explains them.
    """
    problem, values = channel.predicted.problem, channel.values
    noise = problem.noise[channel.index]
    piles = [(side, *_pile(side * values, channel.present, noise)) for side in (1.0, -1.0)]
    piled = np.unique([record for _, runs, _ in piles for run in runs for record in run]).astype(np.int64)
    if len(piled) in (0, len(channel.present)):  # a steady sensor shows no limit
        return None
    others = fit_predicted(channel.predicted, problem, channel.without(piled))
    if not others.is_explained:
        return None
    prediction, least = others.predict()[0][:, channel.index], FROZEN_MOVEMENT * noise
    runs = [
        run
        for side, pile, _ in piles
        for run in pile
        if np.median(side * (prediction - values)[run]) > least
        and np.ptp(prediction[run]) > max(least, np.ptp(values[run]))
    ]
    if not runs:
        return None
    records = np.concatenate(runs)
    reduced, expected = channel.without(records), chi_square_limit(len(records))
    noisier = _with_noise(problem, channel.index, max(level for _, _, level in piles))
    is_probable = _are_probable(channel, noisier, runs, reduced, expected)
    return None if is_probable else (reduced, _clipped_sensor(channel, runs))


def _clipped_sensor(channel: _Channel, runs: list[Indices]) -> FaultySensor:
    """Return the finding that a sensor is clipped in ``runs``."""
    window, name = channel.window, channel.name
    limit = float(np.median(channel.values[runs[0]]))
    when = time_text(window.start + window.ahead + float(window.grid.offsets[runs[0][0]]))
    text = (
        f"{name} is clipped at {limit:.4g} {unit_text(channel.output.unit)} from {when}: "
        f"{_samples_in(runs)} of {window.records} records do not count"
    )
    return FaultySensor(name, text, _turned_off(name, Check.FROZEN), "look at the range of the sensor")


def _pile(values: Array, present: Indices, noise: float) -> tuple[list[Indices], float]:
    """Return the records of each long run within the range of the noise below the largest of ``values`` (records,).

    Only the records ``present`` count. The noise of the values in these runs, at least ``noise``, is returned as well.
    """
    samples, deviation = values[present], noise
    if len(samples) < MIN_RUN:
        return [], noise
    second = np.abs(np.convolve(np.pad(samples, 1, mode="edge"), (-0.5, 1.0, -0.5), mode="valid"))
    top, high = samples.max(), samples >= samples.max() - PILE_WIDTH * noise
    for _ in range(PILE_ROUNDS):
        deviation = max(noise, MAD_TO_SD * median(second[high]) / SECOND_DIFFERENCE_SD)
        high = samples >= top - PILE_WIDTH * deviation
    long = [present[first:end] for first, end in runs_of(high) if end - first >= MIN_RUN]
    return long, deviation if long else noise


def _constant_runs(values: Array, present: Indices) -> list[Indices]:
    """Return the records of each run of one and the same value that is long enough, among the ``present`` ones."""
    ends = np.flatnonzero(np.diff(values[present]) != 0.0) + 1
    if len(present) - len(ends) < MIN_RUN:
        return []
    edges = np.concatenate([[0], ends, [len(present)]])
    long = np.flatnonzero(np.diff(edges) >= MIN_RUN)
    return [present[edges[run] : edges[run + 1]] for run in long]


def _samples_in(runs: list[Indices]) -> int:
    return sum(len(run) for run in runs)


@dataclass(frozen=True, slots=True, eq=False)
class _FrozenRun:
    """The longest of the runs in which a channel is frozen."""

    records: Indices
    excess: float
    """How far the prediction is above the value of the runs: the median over all of them."""


def _frozen_run(channel: _Channel, runs: list[Indices]) -> _FrozenRun | None:
    """Return the longest of the ``runs`` in which a channel is frozen, or None if it is not.

    It is frozen if the prediction moves while the channel does not, and either the noise is lacking that it shows at
    other times, or the twin does not explain the readings. A machine that dry friction holds at rest may look alike:
    then no disturbance of a state may explain them either.
    """
    problem, at = channel.predicted.problem, channel.index
    values, noise = channel.values[channel.present], problem.noise[at]
    reduced = channel.without(np.concatenate([run[1:] for run in runs]))
    step, lacking = unmodelled_rounding(values, noise, problem.steps[at] if problem.steps else 0.0)
    sensor = problem.sensor(channel.name)
    if (held := sensor.step(values, noise)) > step:
        step, lacking = held, max(lacking, held**2 / 12.0)
    if lacking:
        problem = _with_noise(problem, at, float(np.sqrt(noise**2 + lacking)))
    prediction = fit_predicted(channel.predicted, problem, reduced).predict()[0][:, at]
    movement = FROZEN_MOVEMENT * noise + FROZEN_STEPS * step
    moving = [run for run in runs if np.ptp(prediction[run[0] : run[-1] + 1]) > movement]  # false for not-a-number
    if sensor.renewed:
        least, times = RENEWED_DISTANCES * sensor.renewed, channel.window.grid.offsets
        moving = [run for run in moving if distance(prediction, times, run) > least]
    if _samples_in(moving) <= MAX_FAULTY_SHARE * len(values):
        return None
    rounding = _samples_in(runs) * 0.25 * step**2 / (noise**2 + step**2 / 12.0)
    if sensor.dead_band:
        within = channel.within(sensor.dead_band, prediction, moving)
        if _is_probable(within, channel.predicted.problem, reduced, 0.0):
            return None
    elif sensor.holds or held or not _lacks_noise(channel, runs):
        if _are_probable(channel, problem, moving, reduced, rounding):
            return None
    elif is_driven_position(problem.base_model, channel.name) and _is_probable(channel, problem, reduced, rounding):
        return None  # the twin itself explains a machine that stands
    excess = np.concatenate([prediction[run] - channel.values[run] for run in moving])
    return _FrozenRun(max(moving, key=len), float(np.median(excess)))


def _with_noise(problem: Problem, index: int, noise: float) -> Problem:
    """Return the problem with ``noise`` of the output at ``index``."""
    return replace(problem, noise=(*problem.noise[:index], noise, *problem.noise[index + 1 :]))


def _are_probable(channel: _Channel, problem: Problem, runs: list[Indices], reduced: Window, rounding: float) -> bool:
    """Whether the readings that ``reduced`` lacks are probable, for the machine as it is or one held at rest."""
    at_rest = _disturbances(problem, channel.window) if _may_rest(channel, problem, runs) else ()
    return any(_is_probable(channel, each, reduced, rounding) for each in (problem, *at_rest))


def _is_probable(channel: _Channel, problem: Problem, reduced: Window, rounding: float) -> bool:
    """Whether the readings that ``reduced`` lacks are probable given all others.

    The least χ² of prior and window grows by their normalised innovation squared if they are added, whose covariance
    has the uncertainty of parameters, initial state, process noise, sensor and quantisation. Equal readings have no
    noise: they count as one for each unknown, and ``rounding`` is the most that quantisation adds. If the twin does not
    explain the other readings, its errors are larger by as much.
    """
    predicted = channel.predicted
    others = fit_predicted(predicted, problem, reduced)
    if not others.chi_square < PENALTY:
        return True  # a twin that diverges predicts nothing
    unknowns = len(problem.free) + len(problem.twin.states)
    limit = others.chi_square + others.discount * (chi_square_limit(unknowns) + rounding)
    starts = (others.parameters, predicted.start())  # either may lead into a local minimum
    chi_squares = (fit_predicted(predicted, problem, channel.window, start).chi_square for start in starts)
    return any(chi_square <= limit or not chi_square < PENALTY for chi_square in chi_squares)


def _may_rest(channel: _Channel, problem: Problem, runs: list[Indices]) -> bool:
    """Whether a machine at rest could give the ``runs``: a position rests anywhere, a state of its own only at zero."""
    states = [state.name for state in problem.base_model.states]
    rate = dict(problem.base_model.equations).get(f"der({channel.name})", "").strip()
    if channel.name not in states or rate in states:
        return True
    return any(abs(channel.values[run[0]]) <= FROZEN_MOVEMENT * problem.noise[channel.index] for run in runs)


def _lacks_noise(channel: _Channel, runs: list[Indices]) -> bool:
    """Whether the noise of a sensor, as far as it shows outside the ``runs``, makes these improbable even at rest.

    Noise of standard deviation s stays within a step of the converter with a probability of at most erf(step / (√8 s)).
    A speed may be exactly zero at rest, as some sensors have a dead band there.
    """
    values, present = channel.values, channel.present
    outside = ~np.isin(present, np.concatenate(runs))
    samples = values[present]
    second = samples[1:-1] - 0.5 * (samples[:-2] + samples[2:])
    second = second[outside[:-2] & outside[1:-1] & outside[2:]]
    levels = np.unique(samples)
    if len(second) < MIN_RUN or len(levels) < MIN_ADC_LEVELS:
        return False
    step, stated = float(np.diff(levels).min()), channel.predicted.problem.noise[channel.index]
    deviation = min(stated, MAD_TO_SD * float(np.median(np.abs(second))) / SECOND_DIFFERENCE_SD)
    if deviation < RESOLVED_NOISE * step:
        return False
    count = _samples_in([run for run in runs if values[run[0]] != 0.0])
    return erf(step / (np.sqrt(8.0) * deviation)) ** count < CHANCE


def _disturbances(problem: Problem, window: Window) -> Iterator[Problem]:
    """Return the problem with each state in turn disturbed at will, except states that only sum up another one.

    A force that no sensor shows enters the derivative of a speed, but nothing enters that of a position: it is the
    speed.
    """
    twin = problem.base_model
    equations, names = dict(twin.equations), [state.name for state in twin.states]
    noise = problem.process_noise or (0.0,) * len(names)
    for index, state in enumerate(twin.states):
        if equations[f"der({state.name})"].strip() not in names:
            free = (state.high - state.low) / np.sqrt(window.sample_period)
            changed = (*noise[:index], float(free), *noise[index + 1 :])
            yield replace(problem, process_noise=changed, open_loop=False)


def _frozen_sentence(channel: _Channel, run: _FrozenRun) -> str:
    """Return which channel is frozen, at which value, and for how much of the window."""
    window, times = channel.window, channel.window.grid.offsets[run.records]
    values, value = channel.values[channel.present], float(channel.values[run.records[0]])
    is_at_end = (value == values.max() and run.excess > 0.0) or (value == values.min() and run.excess < 0.0)
    kind = "clipped" if np.ptp(values) > 0.0 and is_at_end else "frozen"
    length, count = f"{times[-1] - times[0]:.4g} s", len(run.records)
    when = f"for {length} ({count} samples) from {time_text(window.start + window.ahead + float(times[0]))}"
    if count == len(channel.present):  # it may be so for longer: the finding has the time of the first window
        when = f"throughout the window of {length} ({count} samples)"
    shown = f"{value:.6g} {unit_text(channel.output.unit)}"
    return f"{channel.name} is {kind} at {shown} {when} although the twin predicts changes"


def drop_repeats(window: Window, twin: Definition, checked: frozenset[str] | None = None) -> tuple[Window, list[str]]:
    """Return the window with the outputs of repeated records missing, and notes.

    Only outputs in ``checked`` become missing, all by default.
    """
    sensors = {output.name for output in twin.outputs}
    outputs = np.array([name in sensors for name in window.signals])
    dropped = outputs if checked is None else outputs & np.array([name in checked for name in window.signals])
    repeated = repeated_records(window, outputs)
    count = int(repeated.sum())
    if not count or not dropped.any():
        return window, []
    note = f"{count} of {window.records} records repeat the one before in every signal, bit for bit, and do not count"
    return replace(window, missing=window.missing | (repeated[:, None] & dropped)), [note]


def repeated_records(window: Window, outputs: Mask) -> Mask:
    """Return which records (records,) lie inside a long run of repeats; ``outputs`` (signals,) marks the sensors.

    An image of the machine has a sample of every sensor. Other records are no images: they end a run if they show that
    a signal has changed, and do not count in it otherwise. If all are repeats, the window shows one image, and its
    errors are those of one record: that in the middle counts.
    """
    changes = np.abs(np.diff(_last_samples(window, outputs), axis=0))
    same = (changes == 0.0).all(axis=1)
    if not same.any():
        return np.zeros(window.records, dtype=np.bool_)
    images = np.logical_not(window.missing[:, outputs].any(axis=1))
    repeated = np.zeros(window.records, dtype=np.bool_)
    elsewhere = np.ones(len(changes), dtype=np.bool_)
    for first, last in runs_of(same):
        run = first + np.flatnonzero(images[first : last + 1])
        if len(run) > MIN_REPEATED_RUN:
            repeated[run[1:-1] if len(run) < images.sum() else np.delete(run, len(run) // 2)] = True
            elsewhere[first:last] = False
    if repeated.any() and _are_coarse(changes[elsewhere][:, outputs]):
        repeated[:] = False
    return repeated


def _last_samples(window: Window, outputs: Mask) -> Array:
    """Return the values, with that of the last sample where an output is missing, or of the first one before."""
    values = window.values.copy()
    for column in np.flatnonzero(outputs & window.missing.any(axis=0)):
        present = np.flatnonzero(~window.missing[:, column])
        if len(present):
            last = np.searchsorted(present, np.arange(window.records), side="right") - 1
            values[:, column] = values[present[np.maximum(last, 0)], column]
    return values


def _are_coarse(changes: Array) -> bool:
    """Whether sensors with ``changes`` (records, sensors) outside the runs repeat their values by chance."""
    if not len(changes):
        return False
    steps = [column[column > 0.0] for column in changes.T]
    small = all(not len(column) or float(np.median(column)) <= COARSE_STEPS * float(column.min()) for column in steps)
    return small or bool((changes == 0.0).mean(axis=0).max() > COARSE_REPEATS)


def sample_differences(signal: str, window: Window) -> Array:
    """Return the differences of neighbouring samples, without what a cubic follows; of the noise's standard deviation.

    At times that are not uniform they are divided differences (J. Stoer, R. Bulirsch, Introduction to Numerical
    Analysis, section 2.1.3), normalised to the same gain for white noise.
    """
    present, values = ~window.missing_in(signal), window.column(signal)
    if window.grid.period is not None and present.all():
        return np.asarray(np.diff(values, DIFFERENCE_ORDER) / DIFFERENCE_GAIN)
    values, times = values[present], window.grid.offsets[present]
    if len(values) <= DIFFERENCE_ORDER:
        return np.zeros(0)
    neighbours = np.lib.stride_tricks.sliding_window_view(times, DIFFERENCE_ORDER + 1)
    spacings = neighbours[:, :, None] - neighbours[:, None, :] + np.eye(DIFFERENCE_ORDER + 1)
    weights = 1.0 / (spacings / np.ptp(neighbours, axis=1)[:, None, None]).prod(axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    around = np.lib.stride_tricks.sliding_window_view(values, DIFFERENCE_ORDER + 1)
    return np.asarray((weights * (around - around[:, :1])).sum(axis=1))  # exactly zero if all five are equal
