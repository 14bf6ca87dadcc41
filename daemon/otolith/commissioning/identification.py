"""Levels of noise, learned from windows of a healthy machine: of each sensor, and of what strays in the machine.

Twice. First by likelihood (:mod:`otolith.commissioning.likelihood`), which knows what is quick: the levels under which
the innovations are the most likely. Then by what windows say of each other (:mod:`otolith.commissioning.consistency`):
where they scatter more than they claim, process noise is inflated until they do not.

Where the search for levels of noise begins: what the signals themselves tell before any twin is fitted.

What was learned of noise, and the sentences that go with it. Plain.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.commissioning.consistency import consistency_test, inflated, observable_states, root
from otolith.commissioning.likelihood import HIDDEN, Fit, Ladder, Likeliest, Likelihood, Told, fewest, noisy
from otolith.estimation.objective import Objective
from otolith.estimation.particle_swarm import particle_swarm
from otolith.estimation.problem import Problem
from otolith.twin.definition import Definition

ORDER = 4  # of the differences: a signal that a cubic follows over five records is gone
GAIN = np.sqrt(70.0)  # of fourth differences for white noise: the root of 1 + 16 + 36 + 16 + 1
MEDIAN = 0.6745  # of the absolute value of a normal deviate
DECADES = range(-14, 3)  # of process noise, in widths of the state's bounds
FELT = np.log(2.0)  # of an innovation's variance: process noise adds as much as was there
HALVINGS = 3


def sensor_levels(problem: Problem, windows: Sequence[Window]) -> Array:
    """(outputs,) standard deviation of what changes from record to record; 0 where nothing does, NaN without samples.

    An upper estimate if the machine itself is as quick as that.
    """
    return np.array([_rough(entry.name, windows) for entry in problem.twin.outputs])


def _rough(output: str, windows: Sequence[Window]) -> float:
    found = []
    for window in windows:
        missing, values = window.missing_in(output), window.column(output)
        holes = np.convolve(missing, np.ones(ORDER + 1))[ORDER : len(values)] > 0.5
        differences = np.diff(values, ORDER)[~holes] / GAIN
        if len(differences):
            typical = float(np.median(np.abs(differences))) / MEDIAN
            found.append(typical or float(np.std(differences)))
    return float(np.median(found)) if found else float("nan")


def felt_levels(problem: Problem, outputs: Array, window: Window) -> Array:
    """(states,) process noise that doubles the variance of the innovations; NaN where none does.

    With much less, the noise of the sensors (outputs,) hides it.
    """
    states = problem.twin.states
    quiet = np.concatenate([outputs, np.zeros(len(states))])
    least = _uncertainty(problem, quiet, window) + FELT

    def is_felt(index: int, decade: float) -> bool:
        levels = quiet.copy()
        levels[len(outputs) + index] = (states[index].high - states[index].low) * 10.0**decade
        return bool(_uncertainty(problem, levels, window) >= least)

    found = np.full(len(states), np.nan)
    for index, state in enumerate(states):
        decade = next((float(decade) for decade in DECADES if is_felt(index, decade)), None)
        if decade is None:
            continue
        low, high = decade - 1.0, decade
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            low, high = (low, middle) if is_felt(index, middle) else (middle, high)
        found[index] = (state.high - state.low) * 10.0**high
    return found


def _uncertainty(problem: Problem, levels: Array, window: Window) -> float:
    """Mean logarithm of the innovations' variances."""
    objective = Objective(noisy(problem, levels), window, problem.nominal)
    return objective.correction.log_determinant / objective.count


AS_IT_WAS = "; it stays as it was"
NEVER_MEASURED = "no window has a sample of it" + AS_IT_WAS
CONSTANT = "it never changes, so its noise is not to be seen" + AS_IT_WAS
AT_MOST = "no more than that: beside the process noise a better sensor would not be noticed"
UNSEEN = "no output shows it"
AT_REST = "nothing moves in these windows, and what strays in the machine when it runs is not to be seen"
NONE_NEEDED = "the windows are as likely without; about {:.1g} {} per square root of a second could hide"
NO_WINDOW = "no window can be used: nothing was learned"
LEFT_OUT = "windows left out because they are badly sampled, too short or beyond the twin: {} of {}"
RESTING = "windows left out because nothing moves in them: {} of {}"
ALONE = "one window cannot say whether windows agree"
NOTHING_SHARED = "no two windows see the same, so whether they agree is not to be seen"
BY_CHANCE = "windows agree as well as they claim"
INFLATED = "windows scatter more than they claim: process noise was inflated until they agree"
FROM_NOTHING = (
    "windows scatter more than they claim, though none shows process noise by itself: what is measured or driven got as"
    " much of it as makes them agree"
)
HELPLESS = (
    "windows scatter more than they claim, and no process noise makes them agree: it stays as the likelihood says"
)
DOUBTFUL = "; so much is hardly noise: the machine changes from window to window, or the twin lacks something"


@dataclass(frozen=True, slots=True)
class NoiseLevel:
    """The noise of one output, or the process noise of one state."""

    name: str
    value: float
    """Standard deviation in the unit of the output; of a state, in its unit per square root of a second."""
    sd: float | None
    """Standard deviation of the value; none where it was not learned."""
    remark: str
    """In words, why it was not learned or what to know of it; empty if there is nothing to say."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """What windows say of each other, with the likelihood's levels and with those that are handed out."""

    degrees: int
    """How many numbers were compared."""
    before: float | None
    """Reduced chi-square between windows; none where nothing can be compared."""
    after: float | None
    factor: float | None
    """On process noise; none where there was none to inflate."""
    remark: str


@dataclass(frozen=True, slots=True)
class IdentifiedNoise:
    """Levels of noise and how well they are known."""

    outputs: tuple[NoiseLevel, ...]
    states: tuple[NoiseLevel, ...]
    log_likelihood: float | None
    """Before inflation, restricted, up to a constant; none where nothing was learned."""
    consistency: Consistency
    windows: int
    """How many it was learned from."""
    remarks: tuple[str, ...]
    """What else there is to say of the windows."""
    evaluations: int

    def applied(self, problem: Problem) -> Problem:
        """The problem with these levels."""
        return noisy(problem, np.array([entry.value for entry in (*self.outputs, *self.states)]))


def nothing_learned(problem: Problem, remarks: tuple[str, ...]) -> IdentifiedNoise:
    """The levels of the problem, as they were."""
    twin = problem.twin
    strays = problem.process_noise or (0.0,) * len(twin.states)
    sensors = zip(twin.outputs, problem.noise, strict=True)
    states = zip(twin.states, strays, strict=True)
    return IdentifiedNoise(
        outputs=tuple(NoiseLevel(entry.name, level, None, NO_WINDOW) for entry, level in sensors),
        states=tuple(NoiseLevel(entry.name, level, None, NO_WINDOW) for entry, level in states),
        log_likelihood=None,
        consistency=Consistency(0, None, None, None, NO_WINDOW),
        windows=0,
        remarks=remarks,
        evaluations=0,
    )


FEWEST_RECORDS = 5
LOST = 1e6  # cost of a window that the twin cannot follow at all
SURPRISING = 5.0  # cost of the first fit beyond which the swarm looks for a better valley
LITTLE = 1e-3  # of the process noise that is felt: where inflation begins if the likelihood found none
SUSPICIOUS = 10.0  # a factor beyond which the noise is hardly what is wrong


def identify_noise(
    problem: Problem, windows: Sequence[Window], *, seed: int | None = None, told: Told = lambda _: None
) -> IdentifiedNoise:
    """The levels of ``problem`` are what is kept where nothing is learned; its noise of inputs is taken as known.

    ``told`` hears of the progress. The same problem, windows and seed give the same levels, bit for bit.
    """
    seeded = problem if seed is None else replace(problem, seed=seed)
    return _Learning(seeded, told).run(windows)


def _is_usable(window: Window) -> bool:
    return (
        window.quality.verdict is Verdict.GOOD
        and window.records >= FEWEST_RECORDS
        and bool(np.isfinite(window.values).all())
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Ground:
    """What the search stands on."""

    shown: Array
    """(outputs,) what the signals show of their noise; 0 if one never changes, NaN if it is never measured."""
    felt: Array
    """(states,) process noise that the innovations feel; NaN if they feel none."""
    fits: list[Fit]
    moving: bool


class _Learning:
    """Step by step."""

    def __init__(self, problem: Problem, told: Told) -> None:
        self._problem, self._told = problem, told
        self._likelihood = Likelihood(problem)
        self._outputs = len(problem.twin.outputs)
        self._remarks: list[str] = []

    def run(self, windows: Sequence[Window]) -> IdentifiedNoise:
        ground = self._ground(windows)
        if ground is None:
            return nothing_learned(self._problem, tuple(self._remarks))
        sensors = self._sensors(ground.shown)
        ladder = Ladder(
            base=np.concatenate([sensors, np.nan_to_num(ground.felt)]),
            least=np.concatenate([np.where(ground.shown > 0.0, HIDDEN, 1.0) * sensors, np.zeros(len(ground.felt))]),
            sought=np.concatenate([ground.shown > 0.0, np.isfinite(ground.felt) & ground.moving]),
        )
        found = fewest(self._likelihood, ladder, ground.fits, self._told)
        consistency, levels = self._consistent(ground, found)
        return IdentifiedNoise(
            outputs=self._sensor_levels(ground, ladder, found),
            states=self._state_levels(ground, found, levels, consistency),
            log_likelihood=-0.5 * found.unlikelihood,
            consistency=consistency,
            windows=len(ground.fits),
            remarks=tuple(self._remarks),
            evaluations=self._likelihood.evaluations,
        )

    def _sensors(self, shown: Array) -> Array:
        """(outputs,) where the search begins, and what stays where nothing is shown."""
        return np.where(shown > 0.0, shown, self._problem.noise)

    def _ground(self, windows: Sequence[Window]) -> _Ground | None:
        usable = [window for window in windows if _is_usable(window)]
        fits: list[Fit] = []
        shown, felt = np.zeros(0), np.zeros(0)
        if usable:
            shown = sensor_levels(self._problem, usable)
            sensors = self._sensors(shown)
            felt = felt_levels(self._problem, sensors, _liveliest(self._problem.twin, usable, sensors))
            first = self._first_fits(np.concatenate([sensors, np.nan_to_num(felt)]), usable)
            fits = [fit for fit in first if fit.cost < LOST]
        if len(fits) < len(windows):
            self._remarks.append(LEFT_OUT.format(len(windows) - len(fits), len(windows)))
        if not fits:
            return None
        moving = [fit for fit in fits if len(root(fit, self._likelihood.width))]
        if 0 < len(moving) < len(fits):
            self._remarks.append(RESTING.format(len(fits) - len(moving), len(windows)))
        return _Ground(shown, felt, moving or fits, bool(moving))

    def _first_fits(self, levels: Array, windows: Sequence[Window]) -> list[Fit]:
        """Each from the nominal values and from where the window before came to rest."""
        fits: list[Fit] = []
        starts = [self._problem.nominal]
        for index, window in enumerate(windows):
            self._told(f"window {index + 1} of {len(windows)}")
            fit = self._likelihood.fit(levels, window, starts)
            if not fits and fit.cost > SURPRISING:
                objective = Objective(noisy(self._problem, levels), window, self._problem.nominal)
                searched = particle_swarm(objective, self._problem.swarm, self._problem.nominal, self._problem.seed)
                fit = self._likelihood.fit(levels, window, [*starts, searched.places[0]])
            fits.append(fit)
            starts = [self._problem.nominal, fit.guess[: len(self._problem.free)]]
        return fits

    def _consistent(self, ground: _Ground, found: Likeliest) -> tuple[Consistency, Array]:
        """What windows say of each other, and the levels (outputs + states,) under which they agree."""
        before = consistency_test(found.fits, self._likelihood.width)
        if not before.degrees:
            remark = ALONE if len(found.fits) == 1 else NOTHING_SHARED
            return Consistency(0, None, None, None, remark), found.levels
        if before.by_chance:
            return Consistency(before.degrees, before.reduced, before.reduced, 1.0, BY_CHANCE), found.levels
        strays = found.levels.copy()
        strays[: self._outputs] = 0.0
        from_nothing = not strays.any()
        if from_nothing:
            strays[self._outputs :] = np.where(
                observable_states(self._problem.twin), LITTLE * np.nan_to_num(ground.felt), 0.0
            )
        sensors = np.where(np.arange(len(strays)) < self._outputs, found.levels, 0.0)
        self._told(f"windows scatter {before.reduced:.3g} times more than they claim")
        result = inflated(self._likelihood, lambda factor: sensors + factor * strays, found.fits)
        after = result.reached
        if not after.degrees or not after.by_chance:
            return Consistency(before.degrees, before.reduced, before.reduced, None, HELPLESS), found.levels
        remark = FROM_NOTHING if from_nothing else INFLATED
        if not from_nothing and result.factor > SUSPICIOUS:
            remark += DOUBTFUL
        factor = None if from_nothing else result.factor
        told = Consistency(before.degrees, before.reduced, after.reduced, factor, remark)
        return told, sensors + result.factor * strays

    def _sensor_levels(self, ground: _Ground, ladder: Ladder, found: Likeliest) -> tuple[NoiseLevel, ...]:
        levels = []
        for index, (entry, shown) in enumerate(zip(self._problem.twin.outputs, ground.shown, strict=True)):
            value, sd = float(found.levels[index]), float(found.deviations[index])
            if np.isnan(shown):
                levels.append(NoiseLevel(entry.name, value, None, NEVER_MEASURED))
            elif not shown:
                levels.append(NoiseLevel(entry.name, value, None, CONSTANT))
            else:
                levels.append(NoiseLevel(entry.name, value, sd, AT_MOST if value <= sd + ladder.least[index] else ""))
        return tuple(levels)

    def _state_levels(
        self, ground: _Ground, found: Likeliest, levels: Array, consistency: Consistency
    ) -> tuple[NoiseLevel, ...]:
        """The uncertainty of what was inflated is also that of the factor."""
        states = []
        for index, (entry, felt) in enumerate(zip(self._problem.twin.states, ground.felt, strict=True)):
            place = self._outputs + index
            value, likely, sd = float(levels[place]), float(found.levels[place]), float(found.deviations[place])
            if np.isnan(felt):
                states.append(NoiseLevel(entry.name, 0.0, None, UNSEEN))
            elif not ground.moving:
                states.append(NoiseLevel(entry.name, 0.0, None, AT_REST))
            elif not value:
                states.append(NoiseLevel(entry.name, 0.0, sd, NONE_NEEDED.format(sd, entry.unit)))
            else:
                own = sd / likely if likely else 0.0
                of_factor = 0.0 if value == likely else 1.0 / np.sqrt(2.0 * consistency.degrees)
                states.append(NoiseLevel(entry.name, value, value * float(np.hypot(own, of_factor)), ""))
        return tuple(states)


def _liveliest(twin: Definition, windows: Sequence[Window], sensors: Array) -> Window:
    """In which the outputs move the most, measured by their noise."""
    names = [entry.name for entry in twin.outputs]

    def moved(window: Window) -> float:
        columns = (window.column(name) for name in names)
        return float(sum(np.ptp(column) / noise for column, noise in zip(columns, sensors, strict=True)))

    return max(windows, key=moved)


def with_noise(problem: Problem, learned: IdentifiedNoise) -> Problem:
    """The problem with the noise levels that were learned."""
    outputs = {level.name: level.value for level in learned.outputs}
    states = {level.name: level.value for level in learned.states}
    return replace(
        problem,
        noise=tuple(outputs[entry.name] for entry in problem.twin.outputs),
        process_noise=tuple(states[entry.name] for entry in problem.twin.states),
    )
