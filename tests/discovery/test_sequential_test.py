"""The sequential test: which hypotheses are pruned, and which evidence a hypothesis cannot use."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.discovery.hypotheses import FaultHypothesis, FaultType, TrackedHypothesis, is_usable, prune
from otolith.estimation.arrival_cost import Evidence, Prior
from otolith.estimation.augmented import augment
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Component, Problem
from otolith.machine import find_twin

TWIN = find_twin("dc_motor")
R_A, J = TWIN.parameter("R_a"), TWIN.parameter("J")
KNOWN = tuple((entry.name, entry.nominal) for entry in TWIN.parameters if entry is not R_A)
BARE = Problem(TWIN, KNOWN, (R_A,), (0.005, 0.02))
SHAKING = Component("shaft", "periodic", "t", 0.004, 10.0, 1.0, 20.0)
RUBBING = Component("shaft", "Coulomb", "omega", -0.003)


def hypothesis(kind: FaultType, problem: Problem, **certain: tuple[float, float]) -> TrackedHypothesis:
    """Of which some values are certain: (value, standard deviation) by name."""
    values = [certain.get(entry.name, (entry.nominal, 1e-3 * abs(entry.nominal))) for entry in problem.free]
    mean = np.array([value for value, _ in values] + [0.0] * len(values))
    deviations = np.array([sd for _, sd in values] + [1e-9] * len(values))
    posterior = Posterior.initial(problem).set_prior(Prior(mean, np.diag(deviations**2)))
    posterior = replace(posterior, phase=PhaseAdvance(0.0, 2.0, ()))
    return TrackedHypothesis(FaultHypothesis(kind, kind.value), posterior, 0.0, 1.0)


def test_hypotheses_equal_to_the_null_hypothesis_are_pruned() -> None:
    calm = hypothesis(FaultType.NOTHING, BARE)
    shaken = augment(BARE, [SHAKING])
    amplitude = shaken.free[1].name
    idle = hypothesis(FaultType.COMPONENT, shaken, **{amplitude: (1e-6, 1e-5)})
    there = hypothesis(FaultType.COMPONENT, shaken, **{amplitude: (4e-3, 1e-5)})
    wider = replace(BARE, free=(R_A, J), known=tuple(pair for pair in KNOWN if pair[0] != "J"))
    still = hypothesis(FaultType.PARAMETER, wider)
    moved = hypothesis(FaultType.PARAMETER, wider, J=(1.1 * J.nominal, 0.01 * J.nominal))
    neutral = [0.0] * 5
    assert prune([calm, idle, there, still, moved], neutral) == [calm, there, moved]
    assert prune([calm, idle], [30.0, 0.0]) == [calm, idle]  # it explained the window, little as is known of it


def test_a_component_that_is_gone_is_not_pruned() -> None:
    both, one = augment(BARE, [SHAKING, RUBBING]), augment(BARE, [RUBBING])
    calm, gone = hypothesis(FaultType.NOTHING, both), hypothesis(FaultType.PARAMETER, one)
    assert prune([calm, gone], [0.0, 0.0]) == [calm, gone]


@pytest.mark.parametrize("sharpness", [1e20, float("inf"), float("nan")])
def test_evidence_of_a_diverging_twin_is_not_used(sharpness: float) -> None:
    def evidence(size: float) -> Evidence:
        return Evidence(np.array([6.5, 0.0]), np.full((2, 2), size), np.zeros(2))

    predicted = Posterior.initial(BARE)
    moved = FaultHypothesis(FaultType.PARAMETER, "R_a")
    assert is_usable(moved, predicted, evidence(1.0))
    assert not is_usable(moved, predicted, evidence(sharpness))
