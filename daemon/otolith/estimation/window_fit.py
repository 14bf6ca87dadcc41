"""Step 2 of the method: from a window to parameters with their uncertainty."""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.arrival_cost import Evidence, MapObjective, Prior, initial_prior
from otolith.estimation.augmented import indices
from otolith.estimation.gauss_newton import FitResult, gauss_newton
from otolith.estimation.information import (
    AccuracyTarget,
    Identifiability,
    Information,
    Outcome,
    ParameterEstimate,
    classify,
    inflation,
    information,
)
from otolith.estimation.objective import EXPLAINED, Objective
from otolith.estimation.particle_swarm import SwarmResult, particle_swarm, scattered
from otolith.estimation.problem import Problem

AT_BOUND = 1e-4  # of the width of the bounds
PARTICLES = 4  # of the swarm, the best first, that the polish starts from
SCATTERED = 12  # starts of the polish all over the bounds
GLANCE = 15  # steps of the polish from each of these, to see which of them is worth more
WORTH = 20_000  # steps of the integrator in a prediction, beyond which fewer starts are tried
SILENT = 0.25  # of the width of the bounds: standard deviation from which on a window says nothing of a parameter
ALONE_STEPS = 12  # of the polish of the window alone, which begins where the window with all before it ended
APART = 5.0  # standard deviations between two results that are not the same
ALIKE = 9.0  # in χ²: what two explanations of a window may differ by and be equally good


@dataclass(frozen=True, slots=True)
class WindowEstimate:
    """What one window says. The traces are (records, outputs) in the units of the twin."""

    parameters: tuple[ParameterEstimate, ...]
    """Of this window alone: about its middle, if they drift."""
    evidence: Evidence
    """Of parameters at its end and their trends, to be weighed with what was known."""
    outcome: Outcome
    cost: float
    """RMSE in units of the noise."""
    count: float
    """Values that were measured."""
    rmse_configured: tuple[float, ...]
    rmse_estimated: tuple[float, ...]
    rmse_completed: tuple[float, ...]
    """With the components; as estimated, where there are none."""
    predicted: Array
    last_state: Array
    """(states,) of the twin at the last record."""
    generations: int
    evaluations: int

    @property
    def chi_square(self) -> float:
        """Of the window alone."""
        return self.cost**2 * self.count


def estimate(
    problem: Problem, window: Window, start: Array, prior: Prior | None = None, *, warm: bool = False
) -> WindowEstimate:
    """Fit the free parameters to ``window``; ``start`` (free parameters,) is where the search begins.

    A swarm finds the valley and Gauss-Newton its floor; a ``warm`` start is taken to lie in the valley, and the swarm
    only looks for a better one if the floor does not explain the window. The same problem, window, start and prior give
    the same estimate, bit for bit.
    """
    return _Fit(problem, window, start, prior or initial_prior(problem)).run(warm=warm)


def refine(problem: Problem, window: Window, start: Array, prior: Prior) -> WindowEstimate:
    """As :func:`estimate`, but in the valley of ``start`` (free parameters,) whatever the window says."""
    return _Fit(problem, window, start, prior).run(warm=True, near=True)


class _Fit:
    """One window's fit, step by step."""

    def __init__(self, problem: Problem, window: Window, start: Array, prior: Prior) -> None:
        self._problem, self._window = problem, window
        self._objective = Objective(problem, window, start)
        self._informed = MapObjective(self._objective, problem, prior)
        self._generations = self._evaluations = 0
        first = self._objective.guess(start)
        self._fit = self._polish(self._informed.guess(start, first[len(start) :]))
        self._alone = self._window_alone()
        self._told = self._tell()

    def run(self, *, warm: bool, near: bool = False) -> WindowEstimate:
        outcome = Outcome.CONTINUED
        unexplained = self._cost() > EXPLAINED and not near
        if unexplained or not (warm or self._says_nothing()):
            outcome = self._search()
        elif not warm:
            outcome = Outcome.NOTHING_TO_FIND
        if not self._fit.converged and not self._alone.converged:
            outcome = Outcome.UNFINISHED
        return self._result(outcome)

    def _polish(self, guess: Array) -> FitResult:
        found = gauss_newton(self._informed, guess)
        self._evaluations += found.evaluations
        return found

    def _cost(self) -> float:
        """Of the window alone, with what explains it best."""
        best = min(self._alone.chi_square, self._informed.chi_square(self._fit))
        return float(np.sqrt(best / self._objective.count))

    def _still(self, fit: FitResult) -> Array:
        """A guess of the window alone: the parameters at its end, taken to hold throughout."""
        free = self._objective.free
        return np.concatenate([fit.guess[:free], fit.guess[2 * free :]])

    def _window_alone(self) -> FitResult:
        found = gauss_newton(self._objective, self._still(self._fit), ALONE_STEPS)
        self._evaluations += found.evaluations
        return found

    def _tell(self) -> Information:
        """What the window alone can know."""
        objective, alone = self._objective, self._alone
        return information(alone.jacobian, objective.high - objective.low, self._inflation())

    def _inflation(self) -> float:
        """By what standard deviations grow with what is left unexplained."""
        objective, alone = self._objective, self._alone
        residuals = alone.residuals.reshape(objective.measured.shape)
        return inflation(residuals, float(np.sqrt(alone.chi_square / objective.count)))

    def _says_nothing(self) -> bool:
        reach = self._told.sd[: self._objective.free]
        return not bool((reach < SILENT * (self._objective.high - self._objective.low)[: len(reach)]).any())

    def _search(self) -> Outcome:
        problem, objective, known = self._problem, self._objective, self._fit
        free = objective.free
        searched = particle_swarm(objective, problem.swarm, known.guess[:free], seed=problem.seed + self._window.index)
        self._generations = searched.generations
        self._evaluations += searched.evaluations
        found = self._best_of(searched)
        # Gain and substeps were made for parameters that may have been far off.
        better = min(found, known, key=lambda fit: fit.chi_square)
        objective.centre(better.guess[:free], better.guess[2 * free :])
        found, known = self._polish(found.guess), self._polish(known.guess)
        apart = np.abs(found.guess - known.guess)[:free] > APART * self._told.sd[:free]
        self._fit = min(known, found, key=lambda fit: fit.chi_square)
        self._alone = self._window_alone()
        self._told = self._tell()
        if not apart.any():
            return Outcome.AGREED
        if abs(found.chi_square - known.chi_square) <= ALIKE * max(self._cost(), 1.0) ** 2:
            return Outcome.AMBIGUOUS
        return Outcome.SWARM_WAS_BETTER if self._fit is found else Outcome.POLISH_WAS_BETTER

    def _best_of(self, searched: SwarmResult) -> FitResult:
        """The polished best of where the swarm came to rest and of starts all over the bounds.

        A swarm looks at parameters alone, from the first record on; where an initial state is not measured, or the
        valley is narrow, it rests on a slope that only the polish goes down.
        """
        objective, problem = self._objective, self._problem
        count = min(SCATTERED, SCATTERED * WORTH // max(objective.work, 1))
        spread = scattered(*problem.bounds, count, problem.seed + self._window.index)
        starts = (*searched.places[: PARTICLES if count else 1], *spread)
        polished = [gauss_newton(objective, objective.guess(start), GLANCE) for start in starts]
        self._evaluations += sum(found.evaluations for found in polished)
        best = min(polished, key=lambda found: found.chi_square)
        free = objective.free
        return self._polish(self._informed.guess(best.guess[:free], best.guess[free:]))

    def _result(self, outcome: Outcome) -> WindowEstimate:
        objective, problem = self._objective, self._problem
        configured = objective.predict(objective.guess(self._bare(problem.nominal))[None])[0]
        predicted, last_state = objective.followed(self._fit.guess)
        estimated = objective.followed(self._bare(self._fit.guess))[0] if problem.components else predicted
        return WindowEstimate(
            parameters=self._parameters(outcome),
            evidence=self._informed.evidence(self._fit, self._inflation()),
            outcome=outcome,
            cost=self._cost(),
            count=objective.count,
            rmse_configured=tuple(map(float, objective.rmse(configured))),
            rmse_estimated=tuple(map(float, objective.rmse(estimated))),
            rmse_completed=tuple(map(float, objective.rmse(predicted))),
            predicted=predicted,
            last_state=last_state,
            generations=self._generations,
            evaluations=self._evaluations,
        )

    def _bare(self, guess: Array) -> Array:
        """A guess without components: their amplitudes are zero."""
        problem, bare = self._problem, guess.copy()
        bare[[indices(problem, slot)[0] for slot in range(len(problem.components))]] = 0.0
        return bare

    def _parameters(self, outcome: Outcome) -> tuple[ParameterEstimate, ...]:
        objective, guess = self._objective, self._alone.guess
        width = objective.high - objective.low
        at_bound = (guess <= objective.low + AT_BOUND * width) | (guess >= objective.high - AT_BOUND * width)
        found = []
        allowed = self._problem.determined_within * self._problem.scale
        for index, entry in enumerate(self._problem.free):
            wanted = AccuracyTarget(float(allowed[index]), entry.unit, bool(at_bound[index]))
            verdict, reason = classify(self._told, index, objective.names, wanted)
            if outcome is Outcome.AMBIGUOUS and verdict is Identifiability.DETERMINED:
                verdict, reason = Identifiability.WEAK, outcome.value
            found.append(
                ParameterEstimate(entry.name, float(guess[index]), float(self._told.sd[index]), verdict, reason)
            )
        return tuple(found)
