"""What is known of the machine while hypotheses are open: under each of them, with its probability."""

from dataclasses import replace

from otolith.adaptation.state import AdaptationState
from otolith.discovery.hypotheses import FaultType
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import indices


def possible_posteriors(state: AdaptationState) -> tuple[tuple[float, Posterior], ...]:
    """Return what is known under each open hypothesis, and under the filter, with probabilities; the latter is last.

    If no test is open, that is the filter alone. Else the filter holds if the window that opened the test was wrong. It
    may not have learned from the windows since, so that the null hypothesis gives it the state of the machine.
    """
    test, filtered = state.test, state.posterior
    if test is None:
        return ((1.0, filtered),)
    wrong = test.wrong_probability
    open_ = [
        ((1.0 - wrong) * share, item.posterior) for share, item in zip(test.probabilities, test.hypotheses, strict=True)
    ]
    null = next((item.posterior for item in test.hypotheses if item.type is FaultType.NOTHING), None)
    return (*open_, (wrong, filtered if null is None else _since(filtered, null)))


def _since(filtered: Posterior, later: Posterior) -> Posterior:
    """Return the values of ``filtered`` with the state of the machine, and phases of components, that ``later`` has."""
    problem, prior = filtered.problem, later.prior()
    if problem.free != later.problem.free or later.phase is None:
        return filtered
    for slot, component in enumerate(problem.components):
        if component.periodic:
            phase = indices(problem, slot)[-1]
            filtered = filtered.reset_value(phase, float(prior.mean[phase]), float(prior.sd[phase]))
    return replace(filtered, phase=later.phase)
