"""What could have happened in a window, and how well it explains it.

What explains better is told by evidence (G. Schwarz, Annals of Statistics 6, 1978).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.completion import completed, places
from otolith.adaptation.objective import HOPELESS, Objective
from otolith.adaptation.polish import Polished, polish
from otolith.adaptation.prior import Informed, Prior, vague
from otolith.adaptation.problem import Problem
from otolith.adaptation.screening import Candidate

STEPS = 25  # of a polish
HALVINGS = 20  # of amplitudes with which the twin diverges


class Reason(StrEnum):
    """What kind of explanation it is."""

    NOTHING = "nothing has happened"
    PARAMETER = "parameters have moved"
    COMPONENT = "a component has appeared"
    SENSOR = "a sensor lies"


@dataclass(frozen=True, slots=True)
class Claim:
    """What an explanation says has happened."""

    reason: Reason
    name: str = ""
    """Of parameters, or the keys of components."""
    numbers: int = 0
    """That had to be found."""
    rivals: float = 1.0
    """How many claims of the same reason there are."""

    @property
    def odds(self) -> float:
        """-2 log of how likely it was beforehand: reasons are, and so are the claims of a reason."""
        return 0.0 if self.reason is Reason.NOTHING else float(2.0 * np.log(3.0 * self.rivals))


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """One way to explain a window."""

    claim: Claim
    problem: Problem
    prior: Prior
    """Of everything that is free in ``problem``, before the window."""
    fit: Polished
    informed: Informed

    @property
    def reason(self) -> Reason:
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


def unexplained(chi_squares: Iterable[float], records: float) -> float:
    """How many times the noise (variance) even the best explanation leaves; at least one."""
    return max(min(chi_squares) / records, 1.0)


def extended(prior: Prior, problem: Problem, wider: Problem) -> Prior:
    """What is known of ``problem``, and nothing of the numbers that ``wider`` has in addition."""
    found, more = vague(wider), len(wider.free)
    order = [entry.name for entry in wider.free]
    places = [order.index(entry.name) for entry in problem.free]
    places += [more + place for place in places]
    found.mean[places] = prior.mean
    found.covariance[np.ix_(places, places)] = prior.covariance
    return found


def with_candidate(
    base: Problem, window: Window, prior: Prior, added: Candidate, before: Explanation | None = None
) -> Explanation:
    """``base`` with one component more; ``before`` is its own explanation, from where the polish begins."""
    wider = completed(base, [added.component])
    wide = extended(prior, base, wider)
    start = wide.mean.copy()
    if before is not None:
        order = [entry.name for entry in wider.free]
        for value, entry in zip(before.fit.guess, base.free, strict=False):
            start[order.index(entry.name)] = value
    claimed = [entry.key for entry in wider.components]
    numbers = len(wider.free) - len(base.free) + (0 if before is None else before.claim.numbers)
    rivals = added.rivals * (1.0 if before is None else before.claim.rivals)
    reason = Reason.SENSOR if added.of_sensor else Reason.COMPONENT
    return explanation(Claim(reason, " and ".join(claimed), numbers, rivals), wider, window, wide, start)


def explanation(
    claim: Claim, problem: Problem, window: Window, prior: Prior, start: Array | None = None
) -> Explanation:
    """How ``problem`` explains ``window``; ``start`` (free parameters, ...) is where the polish begins."""
    free = len(problem.free)
    begin = np.clip((prior.mean if start is None else start)[:free], *problem.bounds)
    objective = Objective(problem, window, begin)
    informed = Informed(objective, problem, prior)
    first = objective.guess(begin)[free:]
    amplitudes = [places(problem, slot)[0] for slot in range(len(problem.components))]
    for _ in range(HALVINGS):  # an amplitude of the linear picture may be too much for the twin itself
        if not amplitudes or objective.cost(np.concatenate([begin, first])[None])[0] < HOPELESS:
            break
        begin[amplitudes] *= 0.5
    fit = polish(informed, informed.guess(begin, first), STEPS)
    return Explanation(claim, problem, prior, fit, informed)
