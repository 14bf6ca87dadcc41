"""What could have happened in a window, and how well it explains it.

What explains better is told by evidence (G. Schwarz, Annals of Statistics 6, 1978).

An explanation that is followed from window to window, and what it has learned so far.

What carries no weight: components that are hardly there (the paper's "deactivated"), explanations without content.

A window that was itself wrong, frozen for a part of it, say, may be explained by something that is not seen again.
Quiet windows after it tell for nobody, so evidence alone would never let go of such an explanation.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.candidates import Candidate
from otolith.discovery.phase_tracking import PhaseAdvance, phase_advance, without_slot
from otolith.estimation.arrival_cost import Evidence, MapObjective, Prior, initial_prior
from otolith.estimation.augmented import augment, indices
from otolith.estimation.gauss_newton import FitResult, gauss_newton
from otolith.estimation.imm_filter import ImmPosterior, moment_match, remap_parameters, set_all_modes, update
from otolith.estimation.information import inflation
from otolith.estimation.objective import PENALTY, Objective
from otolith.estimation.problem import Problem

STEPS = 25  # of a polish
HALVINGS = 20  # of amplitudes with which the twin diverges


class FaultType(StrEnum):
    """What kind of explanation it is."""

    NOTHING = "nothing has happened"
    PARAMETER = "parameters have moved"
    COMPONENT = "a component has appeared"
    SENSOR = "a sensor lies"


@dataclass(frozen=True, slots=True)
class FaultHypothesis:
    """What an explanation says has happened."""

    reason: FaultType
    name: str = ""
    """Of parameters, or the keys of components."""
    numbers: int = 0
    """That had to be found."""
    rivals: float = 1.0
    """How many claims of the same reason there are."""

    @property
    def odds(self) -> float:
        """-2 log of how likely it was beforehand: reasons are, and so are the claims of a reason."""
        return 0.0 if self.reason is FaultType.NOTHING else float(2.0 * np.log(3.0 * self.rivals))


@dataclass(frozen=True, slots=True, eq=False)
class FittedHypothesis:
    """One way to explain a window."""

    claim: FaultHypothesis
    problem: Problem
    prior: Prior
    """Of everything that is free in ``problem``, before the window."""
    fit: FitResult
    informed: MapObjective

    @property
    def reason(self) -> FaultType:
        """What kind of explanation it is."""
        return self.claim.reason

    @property
    def name(self) -> str:
        """Of parameters, or the keys of components."""
        return self.claim.name

    @property
    def chi_square(self) -> float:
        """Of the window and of the prior."""
        return self.fit.chi_square

    def deviance(self, records: float, unexplained: float) -> float:
        """-2 log evidence, where even the best leaves ``unexplained`` times the noise (variance)."""
        claim = self.claim
        return float(self.chi_square / unexplained + claim.numbers * np.log(records) + claim.odds)


def residual_variance_factor(chi_squares: Iterable[float], records: float) -> float:
    """How many times the noise (variance) even the best explanation leaves; at least one."""
    return max(min(chi_squares) / records, 1.0)


def extend_prior(prior: Prior, problem: Problem, wider: Problem) -> Prior:
    """What is known of ``problem``, and nothing of the numbers that ``wider`` has in addition."""
    found, more = initial_prior(wider), len(wider.free)
    order = [entry.name for entry in wider.free]
    places = [order.index(entry.name) for entry in problem.free]
    places += [more + place for place in places]
    found.mean[places] = prior.mean
    found.covariance[np.ix_(places, places)] = prior.covariance
    return found


def with_candidate(
    base: Problem, window: Window, prior: Prior, added: Candidate, before: FittedHypothesis | None = None
) -> FittedHypothesis:
    """``base`` with one component more; ``before`` is its own explanation, from where the polish begins."""
    wider = augment(base, [added.component])
    wide = extend_prior(prior, base, wider)
    start = wide.mean.copy()
    if before is not None:
        order = [entry.name for entry in wider.free]
        for value, entry in zip(before.fit.guess, base.free, strict=False):
            start[order.index(entry.name)] = value
    claimed = [entry.key for entry in wider.components]
    numbers = len(wider.free) - len(base.free) + (0 if before is None else before.claim.numbers)
    rivals = added.rivals * (1.0 if before is None else before.claim.rivals)
    reason = FaultType.SENSOR if added.of_sensor else FaultType.COMPONENT
    return fit_hypothesis(FaultHypothesis(reason, " and ".join(claimed), numbers, rivals), wider, window, wide, start)


def fit_hypothesis(
    claim: FaultHypothesis, problem: Problem, window: Window, prior: Prior, start: Array | None = None
) -> FittedHypothesis:
    """How ``problem`` explains ``window``; ``start`` (free parameters, ...) is where the polish begins."""
    free = len(problem.free)
    begin = np.clip((prior.mean if start is None else start)[:free], *problem.bounds)
    objective = Objective(problem, window, begin)
    informed = MapObjective(objective, problem, prior)
    first = objective.guess(begin)[free:]
    amplitudes = [indices(problem, slot)[0] for slot in range(len(problem.components))]
    for _ in range(HALVINGS):  # an amplitude of the linear picture may be too much for the twin itself
        if not amplitudes or objective.cost(np.concatenate([begin, first])[None])[0] < PENALTY:
            break
        begin[amplitudes] *= 0.5
    fit = gauss_newton(informed, informed.guess(begin, first), STEPS)
    return FittedHypothesis(claim, problem, prior, fit, informed)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedHypothesis:
    """One explanation, and what it knows. Plain: it pickles."""

    claim: FaultHypothesis
    problem: Problem
    belief: ImmPosterior
    turned: PhaseAdvance
    deviance: float
    """-2 log evidence of all windows so far, over that of the best."""
    cost: float
    """RMSE over noise that it left of the last window."""
    silent: bool = True
    """Whether what it left of the last window looked like noise."""

    @property
    def reason(self) -> FaultType:
        """What kind of explanation it is."""
        return self.claim.reason


SHARPEST = 1e7  # times what was known: a window that claims to say more says it where the twin all but diverges


def is_usable(claim: FaultHypothesis, belief: ImmPosterior, evidence: Evidence, problem: Problem) -> bool:
    """Whether a belief can be updated by that evidence without losing all digits; that nothing has happened always."""
    if claim.reason is FaultType.NOTHING:
        return True
    deviations = np.sqrt(np.diag(moment_match(belief, problem).covariance))
    return bool((np.abs(evidence.root) * deviations < SHARPEST).all())  # not a number is not smaller either


def begun(
    found: FittedHypothesis, problem: Problem, expected: ImmPosterior, window: Window, deviance: float
) -> TrackedHypothesis | None:
    """After its first window; ``expected`` is what was known of ``problem``, carried to its end.

    Returns:
        None if the window cannot be used with it: its twin all but diverges.
    """
    evidence, last = evidence_of(found)
    belief = set_all_modes(remap_parameters(expected, problem, found.problem), found.prior, found.problem)
    if not is_usable(found.claim, belief, evidence, found.problem):
        return None
    belief = update(belief, evidence, found.problem)
    after = phase_advance(found.problem, window, last)
    return TrackedHypothesis(found.claim, found.problem, belief, after, deviance, cost_of(found))


def evidence_of(found: FittedHypothesis) -> tuple[Evidence, Array]:
    """What the window says, and the state (states,) at its last record."""
    informed, cost = found.informed, cost_of(found)
    grown = inflation(informed.whitened(found.fit), cost)
    return informed.evidence(found.fit, grown), informed.last_state(found.fit)


def cost_of(found: FittedHypothesis) -> float:
    """RMSE over noise that it leaves."""
    return float(np.sqrt(found.informed.chi_square(found.fit) / found.informed.count))


def occam(belief: ImmPosterior, evidence: Evidence, problem: Problem) -> float:
    """How little the hypothesis said beforehand of what the window then said, as -2 log evidence."""
    known = moment_match(belief, problem).covariance
    seen = evidence.root @ known @ evidence.root.T
    return float(np.linalg.slogdet(np.eye(len(seen)) + seen)[1])


NOTICED = 4.0  # standard deviations: nearer to nothing, neither component nor change can be told from it
BETTER = 4.0  # in -2 log evidence, of one window: nearer to nothing, it told for nobody


def prune(found: list[TrackedHypothesis], deviances: list[float]) -> list[TrackedHypothesis]:
    """Without those that say by now that nothing has happened, and explained the window no better than that."""
    at = next((at for at, entry in enumerate(found) if entry.reason is FaultType.NOTHING), None)
    if at is None:
        return found
    calm = found[at]
    return [
        entry
        for entry, deviance in zip(found, deviances, strict=True)
        if entry is calm or deviance < deviances[at] - BETTER or not _says_nothing(entry, calm)
    ]


def pruned(entry: TrackedHypothesis) -> TrackedHypothesis:
    """Without components that do not carry their weight beside others (the paper's "deactivated")."""
    problem = entry.problem
    if len(problem.components) < 2:
        return entry
    carried_by = _weights(problem, entry.belief)
    weakest = int(np.argmin(carried_by))
    if carried_by[weakest] >= NOTICED:
        return entry
    problem, belief, turn = without_slot(problem, entry.belief, entry.turned, weakest)
    claim = entry.claim
    if claim.reason in (FaultType.COMPONENT, FaultType.SENSOR):  # the others are not about what is in the twin
        claim = replace(claim, name=" and ".join(component.key for component in problem.components))
    return replace(entry, claim=claim, problem=problem, belief=belief, turned=turn)


def _weights(problem: Problem, belief: ImmPosterior) -> Array:
    """(components,) amplitudes of the components in the twin of ``problem``, in their standard deviations."""
    known = moment_match(belief, problem)
    deviations = np.sqrt(np.diag(known.covariance))
    amplitudes = [indices(problem, slot)[0] for slot in range(len(problem.components))]
    return np.abs(known.mean[amplitudes]) / deviations[amplitudes]


def _says_nothing(entry: TrackedHypothesis, calm: TrackedHypothesis) -> bool:
    """Whether it is by now no different from ``calm``, in what it has added to the twin and in what it has freed."""
    known, together = ([component.key for component in each.problem.components] for each in (calm, entry))
    if together[: len(known)] != known:  # it says that one has gone
        return False
    more = _weights(entry.problem, entry.belief)[len(known) :]
    return bool((more < NOTICED).all() and (_shifts(entry, calm) < NOTICED).all())


def _shifts(entry: TrackedHypothesis, calm: TrackedHypothesis) -> Array:
    """(parameters,) how far its parameters, those of ``calm``, are from there, in standard deviations."""
    own, other = moment_match(entry.belief, entry.problem), moment_match(calm.belief, calm.problem)
    expected = {name: (value, 0.0) for name, value in calm.problem.known}
    for at, parameter in enumerate(calm.problem.free):
        expected[parameter.name] = float(other.mean[at]), float(other.covariance[at, at])
    found = []
    for at, parameter in enumerate(entry.problem.free):
        if parameter.name in expected:  # else of a component that it has added
            value, variance = expected[parameter.name]
            found.append(abs(own.mean[at] - value) / np.sqrt(own.covariance[at, at] + variance))
    return np.array(found)
