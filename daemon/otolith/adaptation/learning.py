"""Levels of noise, learned from windows of a healthy machine: of each sensor, and of what strays in the machine.

Twice. First by likelihood (:mod:`otolith.adaptation.likelihood`), which knows what is quick: the levels under which
the innovations are the most likely. Then by what windows say of each other (:mod:`otolith.adaptation.agreement`): where
they scatter more than they claim, process noise is inflated until they do not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation import learned as say
from otolith.adaptation.agreement import agreement, inflated, root, touched
from otolith.adaptation.learned import Consistency, LearnedNoise, Level, nothing_learned
from otolith.adaptation.likelihood import Fit, Likelihood, noisy
from otolith.adaptation.objective import Objective
from otolith.adaptation.problem import Problem
from otolith.adaptation.roughness import felt_levels, sensor_levels
from otolith.adaptation.scoring import HIDDEN, Ladder, Likeliest, Told, fewest
from otolith.adaptation.swarm import search
from otolith.twin.definition import Definition

FEWEST_RECORDS = 5
LOST = 1e6  # cost of a window that the twin cannot follow at all
SURPRISING = 5.0  # cost of the first fit beyond which the swarm looks for a better valley
LITTLE = 1e-3  # of the process noise that is felt: where inflation begins if the likelihood found none
SUSPICIOUS = 10.0  # a factor beyond which the noise is hardly what is wrong


def learn_noise(
    problem: Problem, windows: Sequence[Window], *, seed: int | None = None, told: Told = lambda _: None
) -> LearnedNoise:
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

    def run(self, windows: Sequence[Window]) -> LearnedNoise:
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
        return LearnedNoise(
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
            self._remarks.append(say.LEFT_OUT.format(len(windows) - len(fits), len(windows)))
        if not fits:
            return None
        moving = [fit for fit in fits if len(root(fit, self._likelihood.width))]
        if 0 < len(moving) < len(fits):
            self._remarks.append(say.RESTING.format(len(fits) - len(moving), len(windows)))
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
                searched = search(objective, self._problem.swarm, self._problem.nominal, self._problem.seed)
                fit = self._likelihood.fit(levels, window, [*starts, searched.places[0]])
            fits.append(fit)
            starts = [self._problem.nominal, fit.guess[: len(self._problem.free)]]
        return fits

    def _consistent(self, ground: _Ground, found: Likeliest) -> tuple[Consistency, Array]:
        """What windows say of each other, and the levels (outputs + states,) under which they agree."""
        before = agreement(found.fits, self._likelihood.width)
        if not before.degrees:
            remark = say.ALONE if len(found.fits) == 1 else say.NOTHING_SHARED
            return Consistency(0, None, None, None, remark), found.levels
        if before.by_chance:
            return Consistency(before.degrees, before.reduced, before.reduced, 1.0, say.BY_CHANCE), found.levels
        strays = found.levels.copy()
        strays[: self._outputs] = 0.0
        from_nothing = not strays.any()
        if from_nothing:
            strays[self._outputs :] = np.where(touched(self._problem.twin), LITTLE * np.nan_to_num(ground.felt), 0.0)
        sensors = np.where(np.arange(len(strays)) < self._outputs, found.levels, 0.0)
        self._told(f"windows scatter {before.reduced:.3g} times more than they claim")
        result = inflated(self._likelihood, lambda factor: sensors + factor * strays, found.fits)
        after = result.reached
        if not after.degrees or not after.by_chance:
            return Consistency(before.degrees, before.reduced, before.reduced, None, say.HELPLESS), found.levels
        remark = say.FROM_NOTHING if from_nothing else say.INFLATED
        if not from_nothing and result.factor > SUSPICIOUS:
            remark += say.DOUBTFUL
        factor = None if from_nothing else result.factor
        told = Consistency(before.degrees, before.reduced, after.reduced, factor, remark)
        return told, sensors + result.factor * strays

    def _sensor_levels(self, ground: _Ground, ladder: Ladder, found: Likeliest) -> tuple[Level, ...]:
        levels = []
        for index, (entry, shown) in enumerate(zip(self._problem.twin.outputs, ground.shown, strict=True)):
            value, sd = float(found.levels[index]), float(found.deviations[index])
            if np.isnan(shown):
                levels.append(Level(entry.name, value, None, say.NEVER_MEASURED))
            elif not shown:
                levels.append(Level(entry.name, value, None, say.CONSTANT))
            else:
                levels.append(Level(entry.name, value, sd, say.AT_MOST if value <= sd + ladder.least[index] else ""))
        return tuple(levels)

    def _state_levels(
        self, ground: _Ground, found: Likeliest, levels: Array, consistency: Consistency
    ) -> tuple[Level, ...]:
        """The uncertainty of what was inflated is also that of the factor."""
        states = []
        for index, (entry, felt) in enumerate(zip(self._problem.twin.states, ground.felt, strict=True)):
            place = self._outputs + index
            value, likely, sd = float(levels[place]), float(found.levels[place]), float(found.deviations[place])
            if np.isnan(felt):
                states.append(Level(entry.name, 0.0, None, say.UNSEEN))
            elif not ground.moving:
                states.append(Level(entry.name, 0.0, None, say.AT_REST))
            elif not value:
                states.append(Level(entry.name, 0.0, sd, say.NONE_NEEDED.format(sd, entry.unit)))
            else:
                own = sd / likely if likely else 0.0
                of_factor = 0.0 if value == likely else 1.0 / np.sqrt(2.0 * consistency.degrees)
                states.append(Level(entry.name, value, value * float(np.hypot(own, of_factor)), ""))
        return tuple(states)


def _liveliest(twin: Definition, windows: Sequence[Window], sensors: Array) -> Window:
    """In which the outputs move the most, measured by their noise."""
    names = [entry.name for entry in twin.outputs]

    def moved(window: Window) -> float:
        columns = (window.column(name) for name in names)
        return float(sum(np.ptp(column) / noise for column, noise in zip(columns, sensors, strict=True)))

    return max(windows, key=moved)
