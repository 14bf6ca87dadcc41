"""Noise identification: levels of sensor and process noise from windows of a healthy machine.

The initial guess comes from the signals alone. Then the likelihood of the innovations is maximised
(:mod:`otolith.commissioning.likelihood`), which identifies fast process noise. If the windows' estimates still scatter
more than their uncertainties predict (:mod:`otolith.commissioning.consistency`), process noise is inflated.
"""

import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.quality import time_text
from otolith.acquisition.samples import MAD_TO_SD
from otolith.acquisition.window import Array, Mask, Verdict, Window
from otolith.commissioning.consistency import (
    MAX_OUTLYING_SHARE,
    OUTLYING,
    Whiteness,
    changes_of_the_machine,
    consistency_test,
    inflate_process_noise,
    outlyingness,
    regimes,
    sqrt_information,
    whiteness,
)
from otolith.commissioning.input_noise import InputNoise, input_noise
from otolith.commissioning.likelihood import (
    MAX_FIRST_COST,
    Fits,
    FittedWindow,
    Likelihood,
    LikelihoodPoint,
    Progress,
    VarianceParametrisation,
    backward_elimination,
    with_levels,
)
from otolith.discovery.noise_hypothesis import MAX_NOISE_FACTOR
from otolith.estimation.data_checks import DIFFERENCE_ORDER, sample_differences
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.global_search import search_window
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem, out_of_operation
from otolith.twin.definition import Definition

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
PROCESS_DECADES = range(-14, 3)  # searched for the initial process noise, in widths of the state's bounds
OBSERVABLE = np.log(2.0)  # increase of the mean log variance of the innovations: process noise as large as all other
PROCESS_RESOLUTION = 0.125  # decades, of the initial process noise
MIN_RECORDS = DIFFERENCE_ORDER + 1  # of a window
MIN_SENSOR_SHARE = 0.02  # of the noise that a signal shows: floor of the sensor's level
POOR_FIT = 5.0  # cost of the first window's fit beyond which all of the bounds are searched for a better minimum
SMALL_PROCESS_SHARE = 1e-3  # of the observable process noise: where inflation begins if the likelihood found none
MAX_LEFT = 0.5  # of the reduced chi-square that process noise may leave where it cannot make windows consistent
MAX_PLAUSIBLE_FACTOR = 10.0  # on process noise: beyond it, noise is hardly the cause

NEVER_MEASURED = "no window has a sample of it: its level is unchanged"
CONSTANT = "the signal is constant, so its noise cannot be identified: its level is unchanged"
UPPER_BOUND = "upper bound: process noise masks the noise of the sensor, which may be smaller"
NOT_OBSERVABLE = "no output depends on it"
AT_REST = "nothing moves in these windows, so its process noise cannot be identified"
NOT_SIGNIFICANT = "not significant: up to about {:.1g} {} per square root of a second cannot be detected"
NO_WINDOW = "no window can be used: nothing was identified"
EXCLUDED = (
    "windows excluded because they are badly sampled, too short, out of [operation], or the twin does not explain "
    "them: {} of {}"
)
EXCLUDED_AT_REST = "windows excluded because nothing moves in them: {} of {}"
EXCLUDED_OUTLYING = (
    "windows excluded because they do not fit all others: {} of {}, from {}: a standstill, a disturbance or a change "
    "of the machine; the levels do not hold there"
)
CHANGED = "the machine changes at about {}: windows before and after it were compared among themselves only"
ONE_WINDOW = "consistency of windows: not tested, as there is only one window"
NOT_COMPARABLE = "consistency of windows: not tested, as no two windows determine the same parameters"
CONSISTENT = "consistency of windows: they scatter as their uncertainties predict"
INFLATED = "consistency of windows: they scattered more than their uncertainties predict, so process noise was inflated"
ADDED = "consistency of windows: they scattered more than their uncertainties predict, so process noise was added"
PARTLY = (
    "consistency of windows: process noise was enlarged until more of it helped no further, but they still scatter more"
)
NOT_INFLATED = "consistency of windows: they scatter more than their uncertainties predict, but not from process noise"
DOUBTFUL = "; by so much that the machine probably changes between windows, or the twin lacks something"


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """The noise of one output, or the process noise of one state."""

    name: str
    value: float  # Standard deviation in the unit of the output; of a state, in its unit per square root of a second
    sd: float | None = None  # Standard deviation of the value; None if it was not identified
    remark: str = NO_WINDOW  # Why it was not identified, or what limits it; empty if nothing does

    @property
    def is_bound(self) -> bool:
        """Whether the level may be anything below its value: then a percentage says nothing."""
        return self.remark == UPPER_BOUND


@dataclass(frozen=True, slots=True)
class Consistency:
    """The consistency test with maximum-likelihood levels, and with those that are returned."""

    degrees: int = 0  # Degrees of freedom; 0 if nothing can be compared, and the numbers below are None
    before: float | None = None  # Reduced chi-square of the windows
    after: float | None = None
    factor: float | None = None  # On process noise; None if there was none to inflate
    remark: str = NO_WINDOW


@dataclass(frozen=True, slots=True)
class IdentifiedNoise:
    """Noise levels and their uncertainties."""

    outputs: tuple[NoiseLevel, ...]
    states: tuple[NoiseLevel, ...]
    remarks: tuple[str, ...]  # About windows that were not used
    consistency: Consistency = Consistency()
    before_inflation: tuple[float, ...] = ()
    """Levels of outputs and states before inflation; empty if nothing was identified."""
    whiteness: tuple[Whiteness, ...] = ()  # Of the innovations before inflation, by output
    whiteness_after: tuple[Whiteness, ...] = ()  # With the levels that are returned, if process noise was inflated
    log_likelihood: float | None = None
    """Restricted, before inflation, up to a constant; None if nothing was identified."""
    windows: int = 0  # How many were used
    evaluations: int = 0  # Linearisations of a window, for all its fits
    inputs: tuple[InputNoise, ...] = ()  # Of inputs whose samples show what may be noise
    changes: tuple[float, ...] = ()  # Starts of the windows from which on the machine is another than before

    def applied(self, problem: Problem) -> Problem:
        """The problem with these levels."""
        levels = np.array([level.value for level in (*self.outputs, *self.states)])
        wider = replace(with_levels(problem, levels), open_loop=problem.open_loop)
        return replace(wider, input_noise=_input_levels(problem, self.inputs)) if self.inputs else wider


def identify_noise(problem: Problem, windows: Sequence[Window], progress: Progress = lambda _: None) -> IdentifiedNoise:
    """Noise levels of ``problem`` from ``windows``; deterministic.

    A level that cannot be identified is unchanged. Process noise is identified again beside the noise of inputs, which
    it contained. ``progress`` is called with a line of text from time to time.
    """
    identified = _identify(problem, windows, progress)
    if not any(source.is_significant for source in identified.inputs):
        return identified
    progress("beside the noise of " + ", ".join(source.name for source in identified.inputs if source.is_significant))
    beside = _identify(replace(problem, input_noise=_input_levels(problem, identified.inputs)), windows, progress)
    before, after = identified.log_likelihood, beside.log_likelihood
    is_as_likely = before is not None and after is not None and after >= before - DECISIVE
    return replace(beside, inputs=identified.inputs) if is_as_likely else replace(identified, inputs=())


def _input_levels(problem: Problem, inputs: Sequence[InputNoise]) -> tuple[float, ...]:
    """Return the noise of each input of ``problem``: as identified where it is significant, else as it was."""
    stated = problem.levels[: len(problem.base_model.inputs)]
    shown = {source.name: source.level for source in inputs if source.is_significant}
    return tuple(shown.get(own.name, level) for own, level in zip(problem.base_model.inputs, stated, strict=True))


def _shown_input_noise(problem: Problem, fits: Fits) -> Iterator[InputNoise]:
    """Yield what the fitted windows show of the noise of each input that changes from sample to sample."""
    windows = [fit.window for fit in fits]
    for source in problem.base_model.inputs:
        if (shown := sample_noise(source.name, windows)) > 0.0:
            noise = input_noise(fits, source, shown, problem.seed)
            if noise is not None:
                yield noise


def _identify(problem: Problem, windows: Sequence[Window], progress: Progress) -> IdentifiedNoise:
    """Return the noise levels of outputs and states, given that of inputs."""
    likelihood = Likelihood(problem)
    guess = _initial_guess(likelihood, windows, progress)
    twin = problem.base_model
    if not guess.fits:
        sensors, process = problem.noise, problem.process_noise or (0.0,) * len(twin.states)
        outputs = (NoiseLevel(output.name, level) for output, level in zip(twin.outputs, sensors, strict=True))
        states = (NoiseLevel(state.name, level) for state, level in zip(twin.states, process, strict=True))
        return IdentifiedNoise(tuple(outputs), tuple(states), guess.remarks)
    best = backward_elimination(guess.variances, guess.fits, progress)
    guess, best, made = _without_outlying(guess, best, progress)
    consistency = made.consistency
    return IdentifiedNoise(
        outputs=tuple(_output_levels(twin, guess, best)),
        states=tuple(_state_levels(twin, guess, best, made.levels, consistency.degrees)),
        remarks=guess.remarks,
        consistency=consistency,
        before_inflation=tuple(best.levels.tolist()),
        whiteness=whiteness(best.fits),
        whiteness_after=whiteness(made.inflated) if made.inflated else (),
        log_likelihood=-0.5 * best.deviance,
        windows=len(guess.fits),
        evaluations=likelihood.evaluations,
        inputs=tuple(_shown_input_noise(problem, best.fits)),
        changes=made.changes,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _InitialGuess:
    """Where the search begins."""

    signal_noise: Array  # (outputs,) what the signals show; 0 if one is constant, NaN if it is never measured
    process: Array  # (states,) process noise that is just observable; NaN if none is
    variances: VarianceParametrisation  # All levels that can be identified are free
    fits: list[FittedWindow]  # The windows that are used; none if none can be
    remarks: tuple[str, ...]


def _initial_guess(likelihood: Likelihood, windows: Sequence[Window], progress: Progress) -> _InitialGuess:
    """Windows at rest are used only if all are; then process noise is not free."""
    problem, remarks = likelihood.problem, []
    usable = usable_windows(problem, windows)
    levels = _initial_levels(problem, usable)
    shown, process = levels.signal_noise > 0.0, levels.process
    fits = [fit for fit in _first_fits(likelihood, levels.values, usable, progress) if fit.cost < MAX_FIRST_COST]
    if len(fits) < len(windows):
        remarks.append(EXCLUDED.format(len(windows) - len(fits), len(windows)))
    moving = [fit for fit in fits if len(sqrt_information(fit, likelihood.width))]
    if 0 < len(moving) < len(fits):
        remarks.append(EXCLUDED_AT_REST.format(len(fits) - len(moving), len(windows)))
    variances = VarianceParametrisation(
        likelihood,
        initial=levels.values,
        floor=np.concatenate([np.where(shown, MIN_SENSOR_SHARE, 1.0) * levels.sensors, np.zeros(len(process))]),
        free=np.concatenate([shown, np.isfinite(process) & bool(moving)]),
    )
    return _InitialGuess(levels.signal_noise, process, variances, moving or fits, tuple(remarks))


def _first_fits(
    likelihood: Likelihood, levels: Array, windows: Sequence[Window], progress: Progress
) -> list[FittedWindow]:
    """Each window starts from the nominal values and from the parameters of the window before."""
    problem, fits = likelihood.problem, list[FittedWindow]()
    starts = [problem.nominal]
    for index, window in enumerate(windows):
        progress(f"window {index + 1} of {len(windows)}")
        fit = likelihood.fit(levels, window, starts)
        if not fits and fit.cost > POOR_FIT:
            random = np.random.default_rng(problem.seed)
            minimum = search_window(with_levels(problem, levels), window, problem.nominal, random)
            fit = likelihood.fit(levels, window, [*starts, minimum.parameters])
        fits.append(fit)
        starts = [problem.nominal, fit.guess[: len(problem.free)]]
    return fits


@dataclass(frozen=True, slots=True, eq=False)
class _ConsistentLevels:
    """What the consistency test leads to."""

    changes: tuple[float, ...]
    consistency: Consistency
    levels: Array  # (outputs + states,), inflated if necessary
    inflated: Fits = ()  # The windows fitted with inflated levels; none if they are not


def _without_outlying(
    guess: _InitialGuess, best: LikelihoodPoint, progress: Progress
) -> tuple[_InitialGuess, LikelihoodPoint, _ConsistentLevels]:
    """Return the arguments without the few windows that no noise of the others explains, and their consistent levels.

    One window in which the machine sticks, or somebody touches it, would otherwise be explained by process noise. That
    noise would be too large for the other windows.
    """
    width, starts = guess.variances.likelihood.width, list[float]()
    changes = changes_of_the_machine(best.fits, width)
    made = _make_consistent(guess, best, changes, progress)
    limit = int(MAX_OUTLYING_SHARE * len(guess.fits))
    while len(starts) < limit:
        parts = regimes(best.fits, changes)
        scores = [outlyingness(part, index, width) for part in parts for index in range(len(part))]
        index = int(np.argmax(scores))
        if made.consistency.factor == 1.0 and scores[index] < OUTLYING:
            break
        start = best.fits[index].window.start
        progress(f"without the window at {time_text(start)}")
        trial = _without_window(guess, best, index, changes, progress)
        if trial is None:
            break
        guess, best, made = trial
        starts.append(start)
    remarks = list(guess.remarks)
    if starts:
        remarks.append(EXCLUDED_OUTLYING.format(len(starts), len(starts) + len(guess.fits), _times(starts)))
    if changes:
        remarks.append(CHANGED.format(_times(changes)))
    return replace(guess, remarks=tuple(remarks)), best, made


def _times(starts: Sequence[float]) -> str:
    return ", ".join(map(time_text, sorted(starts)))


def _without_window(
    guess: _InitialGuess, best: LikelihoodPoint, index: int, changes: tuple[float, ...], progress: Progress
) -> tuple[_InitialGuess, LikelihoodPoint, _ConsistentLevels] | None:
    """Return what the other windows give without window ``index``; None if their noise explains it as well."""
    likelihood = guess.variances.likelihood
    # From the first fits, as those at levels that this window made too large may be at another minimum.
    first = [*guess.fits[:index], *guess.fits[index + 1 :]]
    others = backward_elimination(guess.variances, first, progress)
    made = _make_consistent(guess, others, changes, progress)
    regime = next(part for part in regimes(best.fits, changes) if best.fits[index] in part)
    starts = {fit.window.start for fit in regime}
    near = (fit for fit in others.fits if fit.window.start in starts)
    fits = likelihood.refit(made.levels, [best.fits[index], *near])
    if outlyingness(fits, 0, likelihood.width) < OUTLYING:
        return None
    return replace(guess, fits=first), others, made


def _make_consistent(
    guess: _InitialGuess, best: LikelihoodPoint, changes: tuple[float, ...], progress: Progress
) -> _ConsistentLevels:
    """Test whether the windows between ``changes`` agree, and inflate the process noise if they do not."""
    likelihood, outputs = guess.variances.likelihood, len(guess.signal_noise)
    before = consistency_test(best.fits, likelihood.width, changes)
    if not before.degrees:
        remark = ONE_WINDOW if len(best.fits) == 1 else NOT_COMPARABLE
        return _ConsistentLevels(changes, Consistency(remark=remark), best.levels)
    if before.passed:
        consistency = Consistency(before.degrees, before.reduced, before.reduced, 1.0, CONSISTENT)
        return _ConsistentLevels(changes, consistency, best.levels)
    sensors, process = best.levels.copy(), best.levels.copy()
    sensors[outputs:], process[:outputs] = 0.0, 0.0
    added = not process.any()
    if added:
        small = SMALL_PROCESS_SHARE * np.nan_to_num(guess.process)
        process[outputs:] = np.where(observable_states(likelihood.problem.base_model), small, 0.0)
    progress(f"reduced chi-square of the windows: {before.reduced:.3g}")
    factor, after, inflated = inflate_process_noise(
        likelihood, lambda factor: sensors + factor * process, best.fits, changes
    )
    if not after.degrees or (not after.passed and after.reduced > MAX_LEFT * before.reduced):
        consistency = Consistency(before.degrees, before.reduced, before.reduced, None, NOT_INFLATED)
        return _ConsistentLevels(changes, consistency, best.levels)
    remark = (ADDED if added else INFLATED) if after.passed else PARTLY
    if not added and factor > MAX_PLAUSIBLE_FACTOR:
        remark += DOUBTFUL
    consistency = Consistency(before.degrees, before.reduced, after.reduced, None if added else factor, remark)
    return _ConsistentLevels(changes, consistency, sensors + factor * process, inflated)


def _output_levels(twin: Definition, guess: _InitialGuess, best: LikelihoodPoint) -> Iterator[NoiseLevel]:
    columns = (column.tolist() for column in (guess.signal_noise, best.levels, best.sd, guess.variances.floor))
    for output, shown, value, sd, floor in zip(twin.outputs, *columns, strict=False):
        if shown > 0.0:
            yield NoiseLevel(output.name, value, sd, UPPER_BOUND if value <= sd + floor else "")
        else:
            yield NoiseLevel(output.name, value, None, NEVER_MEASURED if np.isnan(shown) else CONSTANT)


def _state_levels(
    twin: Definition, guess: _InitialGuess, best: LikelihoodPoint, levels: Array, degrees: int
) -> Iterator[NoiseLevel]:
    """The uncertainty of an inflated level includes that of the factor, from a chi-square of so many ``degrees``."""
    columns = (column[len(twin.outputs) :].tolist() for column in (guess.variances.free, levels, best.levels, best.sd))
    for state, observable, free, value, most_probable, sd in zip(twin.states, guess.process, *columns, strict=True):
        if not free:
            yield NoiseLevel(state.name, 0.0, None, NOT_OBSERVABLE if np.isnan(observable) else AT_REST)
        elif not value:
            yield NoiseLevel(state.name, 0.0, sd, NOT_SIGNIFICANT.format(sd, state.unit))
        else:
            own = sd / most_probable if most_probable else 0.0
            of_factor = 0.0 if value == most_probable else 1.0 / np.sqrt(2.0 * degrees)
            yield NoiseLevel(state.name, value, value * float(np.hypot(own, of_factor)), "")


def explains_no_window(problem: Problem, noise: IdentifiedNoise, window: Window) -> bool:
    """Return whether the sensors alone are too noisy for the levels of ``problem``, with its process noise.

    Then no hypothesis is accepted in any window, not even that a sensor is noisier than stated.
    """
    objective = Objective(problem, window, problem.nominal)
    variances = objective.present * np.array([level.value for level in noise.outputs]) ** 2
    ratio = np.einsum("rop,rp->", objective.whitening**2, variances) / objective.count
    return bool(ratio > MAX_NOISE_FACTOR**2)


def with_initial_noise(problem: Problem, windows: Sequence[Window]) -> Problem:
    """The problem with the sensor noise that the signals show, and process noise that is just observable beside it."""
    usable = usable_windows(problem, windows)
    return with_levels(problem, _initial_levels(problem, usable).values) if usable else problem


@dataclass(frozen=True, slots=True, eq=False)
class _InitialLevels:
    """Noise levels that the signals show, before any fit."""

    signal_noise: Array  # (outputs,) what the signals show; 0 if one is constant, NaN if it is never measured
    sensors: Array  # (outputs,) the same, or the level of the problem where the signals show none
    process: Array  # (states,) process noise that is just observable; NaN if none is

    @property
    def values(self) -> Array:
        """(outputs + states,) all levels; zero where no process noise is observable."""
        return np.concatenate([self.sensors, np.nan_to_num(self.process)])


def _initial_levels(problem: Problem, usable: Sequence[Window]) -> _InitialLevels:
    signal_noise = np.array([sample_noise(output.name, usable) for output in problem.base_model.outputs])
    sensors = np.where(signal_noise > 0.0, signal_noise, problem.noise)
    process = np.full(len(problem.base_model.states), np.nan)
    if usable:
        process = _observable_process_noise(problem, sensors, _most_excited(problem, usable, sensors))
    return _InitialLevels(signal_noise, sensors, process)


def usable_windows(problem: Problem, windows: Sequence[Window]) -> list[Window]:
    """Return the windows that are well sampled and complete, and in which the equations hold."""
    return [window for window in windows if _is_usable(problem, window)]


def _is_usable(problem: Problem, window: Window) -> bool:
    samples = max(int((~window.missing_in(output.name)).sum()) for output in problem.base_model.outputs)
    sampled = window.quality.verdict is Verdict.GOOD and samples >= MIN_RECORDS
    complete = bool((np.isfinite(window.values) | window.missing).all())
    return sampled and complete and not out_of_operation(problem.base_model, window).any()


def sample_noise(output: str, windows: Sequence[Window]) -> float:
    """Standard deviation of the changes from sample to sample; 0 for a constant signal, NaN without samples.

    Windows in which the signal rests on one step of its converter show nothing of the noise in the others.
    """
    deviations = []
    for window in windows:
        differences = sample_differences(output, window)
        if len(differences):
            robust = MAD_TO_SD * float(np.median(np.abs(differences)))
            deviations.append(robust or float(np.std(differences)))
    return float(np.median(list(filter(None, deviations)) or [0.0])) if deviations else float("nan")


def _observable_process_noise(problem: Problem, sensors: Array, window: Window) -> Array:
    """(states,) process noise that doubles the variance of innovations due to ``sensors``; NaN where none does."""
    states = problem.base_model.states
    without = np.concatenate([sensors, np.zeros(len(states))])
    threshold = _log_variance(problem, without, window) + OBSERVABLE

    def smallest(index: int, width: float) -> float:
        def is_observable(decade: float) -> bool:
            levels = without.copy()
            levels[len(sensors) + index] = width * 10.0**decade
            return bool(_log_variance(problem, levels, window) >= threshold)

        decade = next(filter(is_observable, PROCESS_DECADES), None)
        if decade is None:
            return float("nan")
        finer = decade - np.arange(1.0, 0.0, -PROCESS_RESOLUTION) + PROCESS_RESOLUTION
        return float(width * 10.0 ** finer[bisect_left(finer, True, hi=len(finer) - 1, key=is_observable)])

    return np.array([smallest(index, state.high - state.low) for index, state in enumerate(states)])


def _log_variance(problem: Problem, levels: Array, window: Window) -> float:
    """Mean logarithm of the innovations' variances."""
    objective = Objective(with_levels(problem, levels), window, problem.nominal)
    return objective.spread / objective.count


def _most_excited(problem: Problem, windows: Sequence[Window], sensors: Array) -> Window:
    """The window in which the outputs move the most, in units of their noise."""
    names = [output.name for output in problem.base_model.outputs]

    def movement(window: Window) -> float:
        signals = (window.column(name)[~window.missing_in(name)] for name in names)
        moved = np.array([np.ptp(values) if len(values) else 0.0 for values in signals])
        return float((moved / sensors).sum())

    return max(windows, key=movement)


def observable_states(twin: Definition) -> Mask:
    """(states,) the states in an output's equation, and those whose derivative depends on an input directly."""
    outputs = (dict(twin.equations).get(output.name, output.name) for output in twin.outputs)
    shown = set().union(*(_names(twin, expression) for expression in outputs))
    driven = {state for signal in twin.inputs for state in driven_states(twin, signal.name)}
    return np.array([state.name in shown | driven for state in twin.states])


def driven_states(twin: Definition, signal: str) -> tuple[str, ...]:
    """Return the states whose derivative depends on an input directly."""
    equations = dict(twin.equations)
    return tuple(state.name for state in twin.states if signal in _names(twin, equations[f"der({state.name})"]))


def _names(twin: Definition, expression: str) -> set[str]:
    """Return the names that an expression has, with those of the definitions that it uses."""
    definitions = {name: text for name, text, _ in twin.definitions}
    direct = set(re.findall(r"[A-Za-z_]\w*", expression))
    return direct.union(*(_names(twin, definitions[name]) for name in direct & definitions.keys()))
