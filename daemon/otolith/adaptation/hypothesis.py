"""An explanation that is followed from window to window, and what it has learned so far."""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.claims import Claim, Explanation, Reason
from otolith.adaptation.fusion import Belief, overall, rebased, updated, with_prior
from otolith.adaptation.information import inflation
from otolith.adaptation.prior import Evidence
from otolith.adaptation.problem import Problem
from otolith.adaptation.tracking import Turned, turned


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One explanation, and what it knows. Plain: it pickles."""

    claim: Claim
    problem: Problem
    belief: Belief
    turned: Turned
    deviance: float
    """-2 log evidence of all windows so far, over that of the best."""
    cost: float
    """RMSE over noise that it left of the last window."""
    silent: bool = True
    """Whether what it left of the last window looked like noise."""

    @property
    def reason(self) -> Reason:
        """What kind of explanation it is."""
        return self.claim.reason


SHARPEST = 1e7  # times what was known: a window that claims to say more says it where the twin all but diverges


def is_usable(claim: Claim, belief: Belief, evidence: Evidence, problem: Problem) -> bool:
    """Whether a belief can be updated by that evidence without losing all digits; that nothing has happened always."""
    if claim.reason is Reason.NOTHING:
        return True
    deviations = np.sqrt(np.diag(overall(belief, problem).covariance))
    return bool((np.abs(evidence.root) * deviations < SHARPEST).all())  # not a number is not smaller either


def begun(found: Explanation, problem: Problem, expected: Belief, window: Window, deviance: float) -> Hypothesis | None:
    """After its first window; ``expected`` is what was known of ``problem``, carried to its end.

    Returns:
        None if the window cannot be used with it: its twin all but diverges.
    """
    evidence, last = evidence_of(found)
    belief = with_prior(rebased(expected, problem, found.problem), found.prior, found.problem)
    if not is_usable(found.claim, belief, evidence, found.problem):
        return None
    belief = updated(belief, evidence, found.problem)
    after = turned(found.problem, window, last)
    return Hypothesis(found.claim, found.problem, belief, after, deviance, cost_of(found))


def evidence_of(found: Explanation) -> tuple[Evidence, Array]:
    """What the window says, and the state (states,) at its last record."""
    informed, cost = found.informed, cost_of(found)
    grown = inflation(informed.whitened(found.fit), cost)
    return informed.evidence(found.fit, grown), informed.last_state(found.fit)


def cost_of(found: Explanation) -> float:
    """RMSE over noise that it leaves."""
    return float(np.sqrt(found.informed.chi_square(found.fit) / found.informed.count))


def occam(belief: Belief, evidence: Evidence, problem: Problem) -> float:
    """How little the hypothesis said beforehand of what the window then said, as -2 log evidence."""
    known = overall(belief, problem).covariance
    seen = evidence.root @ known @ evidence.root.T
    return float(np.linalg.slogdet(np.eye(len(seen)) + seen)[1])
