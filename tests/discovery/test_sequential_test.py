"""The sequential test: which hypotheses are pruned, and which evidence a hypothesis cannot use."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.discovery.alternatives import ACCEPTED, WindowDecision
from otolith.discovery.decision import AdoptedComponent, count_fading, decide
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, TrackedHypothesis
from otolith.discovery.same_statement import prune, without_insignificant
from otolith.discovery.sequential_test import (
    MAX_OPEN_WINDOWS,
    FilterEvidence,
    SequentialTest,
    WindowCounts,
    is_usable,
    join,
)
from otolith.estimation.evidence import LogEvidence
from otolith.estimation.information import Evidence, Prior
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Component, Problem, amplitude_indices, augment
from otolith.machine import find_twin

TWIN = find_twin("dc_motor")
R_A, J = TWIN.parameter("R_a"), TWIN.parameter("J")
KNOWN = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter is not R_A)
BARE = Problem(TWIN, KNOWN, (R_A,), (0.005, 0.02))
PERIODIC = Component("shaft", "periodic", "t", 0.004, 10.0, 1.0, 20.0)
COULOMB = Component("shaft", "Coulomb", "omega", -0.003, 0.1, 0.0, 0.1, 1.0)


def hypothesis(kind: FaultType, problem: Problem, **certain: tuple[float, float]) -> TrackedHypothesis:
    """A hypothesis with the given (value, standard deviation) of the ``certain`` parameters."""
    values = [
        certain.get(parameter.name, (parameter.nominal, 1e-3 * abs(parameter.nominal))) for parameter in problem.free
    ]
    mean = np.array([value for value, _ in values] + [0.0] * len(values))
    deviations = np.array([sd for _, sd in values] + [1e-9] * len(values))
    posterior = Posterior.initial(problem).set_prior(Prior(mean, np.diag(deviations**2)))
    posterior = replace(posterior, phase=PhaseAdvance(0.0, 2.0, ()))
    return TrackedHypothesis(FaultHypothesis(kind, kind.value), posterior, 0.0, 0.0, 1.0)


def test_hypotheses_equal_to_the_null_hypothesis_are_pruned() -> None:
    null = hypothesis(FaultType.NOTHING, BARE)
    augmented = augment(BARE, [PERIODIC])
    amplitude = augmented.free[1].name
    insignificant = hypothesis(FaultType.COMPONENT, augmented, **{amplitude: (1e-6, 1e-5)})
    significant = hypothesis(FaultType.COMPONENT, augmented, **{amplitude: (4e-3, 1e-5)})
    wider = replace(BARE, free=(R_A, J), known=tuple(pair for pair in KNOWN if pair[0] != "J"))
    unchanged = hypothesis(FaultType.PARAMETER, wider)
    changed = hypothesis(FaultType.PARAMETER, wider, J=(1.1 * J.nominal, 0.01 * J.nominal))
    no_evidence = [0.0] * 5
    assert prune([null, insignificant, significant, unchanged, changed], no_evidence) == [null, significant, changed]
    assert prune([null, insignificant], [30.0, 0.0]) == [null, insignificant]  # its evidence prevents pruning


def test_hypothesis_of_a_removed_component_is_not_pruned() -> None:
    both, one = augment(BARE, [PERIODIC, COULOMB]), augment(BARE, [COULOMB])
    null, removed = hypothesis(FaultType.NOTHING, both), hypothesis(FaultType.PARAMETER, one)
    assert prune([null, removed], [0.0, 0.0]) == [null, removed]


def test_a_delay_that_loses_an_insignificant_component_is_still_known() -> None:
    """Its parameters move with the delay; those of the component are no longer among them."""
    both = replace(augment(BARE, [PERIODIC, COULOMB]), delays=(("omega", 0.02),))
    amplitudes = (both.free[index].name for index in amplitude_indices(both))
    certain = dict(zip(amplitudes, [(1e-6, 1e-5), (-3e-3, 1e-5)], strict=True))
    shifts = tuple((free.label, 10.0) for free in both.free)
    late = replace(hypothesis(FaultType.TIMING, both, **certain), delay_sds=(1e-3,), shift_by_delay=shifts)
    fewer = without_insignificant(late)
    assert [item.family for item in fewer.problem.components] == ["Coulomb"]
    before = hypothesis(FaultType.TIMING, fewer.problem, **certain).posterior.prior()
    assert np.diag(fewer.known(BARE).covariance)[0] == pytest.approx(before.covariance[0, 0] + 1e-4, rel=1e-6)


@pytest.mark.parametrize("sharpness", [1e20, float("inf"), float("nan")])
def test_evidence_of_a_diverging_twin_is_not_used(sharpness: float) -> None:
    def evidence(size: float) -> Evidence:
        return Evidence(np.array([6.5, 0.0]), np.full((2, 2), size), np.zeros(2))

    predicted = Posterior.initial(BARE)
    changed = FaultHypothesis(FaultType.PARAMETER, "R_a")
    assert is_usable(changed, predicted, evidence(1.0))
    assert not is_usable(changed, predicted, evidence(sharpness))


@pytest.mark.parametrize("ended", [True, False])
def test_what_opened_a_test_has_ended_where_the_filter_alone_explains_a_window(ended: bool) -> None:
    """Otherwise new hypotheses would compete with the filter as it was while the fault lasted."""
    null, moved = hypothesis(FaultType.NOTHING, BARE), hypothesis(FaultType.PARAMETER, BARE)
    wrong = hypothesis(FaultType.SENSOR, augment(BARE, [PERIODIC]))
    wrong = replace(wrong, cost=5.0, is_explained=False)
    old = SequentialTest(BARE, (wrong, null.worse_by(60.0, 60.0)), 0.0, LogEvidence(9000.0), WindowCounts(tested=15))
    others = (null, moved.worse_by(5.0, 0.0)) if ended else (moved, null.worse_by(15.0, 15.0))
    fresh = SequentialTest(BARE, others, 30.0, LogEvidence(400.0))
    joined = join(old, fresh)
    assert joined.best.type is (FaultType.NOTHING if ended else FaultType.PARAMETER)
    assert (joined is fresh) == ended


@pytest.mark.parametrize(("inflation", "named"), [(1.2, True), (1.8, False)])
def test_a_sensor_is_named_only_if_no_structure_is_left(inflation: float, named: bool) -> None:
    """Its error may follow a part of what the machine does and the twin lacks, up to 1.2 times the noise."""
    null = hypothesis(FaultType.NOTHING, BARE).worse_by(60.0, 60.0)
    problem = augment(BARE, [Component("sensor of omega", "linear", "omega", 0.25)])
    sensor = replace(hypothesis(FaultType.SENSOR, problem), cost=1.2, inflation=inflation)
    test = SequentialTest(BARE, (sensor, null), 0.0, counts=WindowCounts(5, 5, 5))
    assert decide(test, learned=10).decision is (WindowDecision.SENSOR if named else WindowDecision.SUSPECTED)


def of_moved(kind: FaultType, value: float, inflation: float = 1.0) -> SequentialTest:
    """A test that an inertia of ``value`` leads, by a hypothesis of this type."""
    wider = replace(BARE, free=(R_A, J), known=tuple(pair for pair in KNOWN if pair[0] != "J"))
    null = hypothesis(FaultType.NOTHING, wider).worse_by(60.0, 60.0)
    moved = replace(hypothesis(kind, wider, J=(value, 0.01 * J.nominal)), inflation=inflation)
    return SequentialTest(wider, (moved, null), 0.0, counts=WindowCounts(5, 5, 5))


@pytest.mark.parametrize("kind", [FaultType.PARAMETER, FaultType.NOISE])
@pytest.mark.parametrize(("value", "accepted"), [(1.3 * J.nominal, True), (-J.nominal, False), (J.low / 5.0, False)])
def test_no_hypothesis_with_a_negative_mass_is_accepted(kind: FaultType, value: float, *, accepted: bool) -> None:
    """At a constant speed nothing shows a mass, and linear updates may make it negative."""
    outcome = decide(of_moved(kind, value), learned=10)
    assert (outcome.decision in ACCEPTED) == accepted
    assert accepted or outcome.decision is WindowDecision.SUSPECTED


@pytest.mark.parametrize(("inflation", "accepted"), [(1.2, True), (1.8, False)])
def test_a_sudden_change_is_accepted_only_if_no_structure_is_left(inflation: float, *, accepted: bool) -> None:
    outcome = decide(of_moved(FaultType.PARAMETER, 1.3 * J.nominal, inflation), learned=10)
    assert (outcome.decision is WindowDecision.STEPPED) == accepted


@pytest.mark.parametrize(
    ("leading", "is_explained", "accepted"),
    [(MAX_OPEN_WINDOWS - 1, True, False), (MAX_OPEN_WINDOWS, True, True), (MAX_OPEN_WINDOWS, False, False)],
)
def test_what_the_twin_always_leaves_does_not_hold_up_a_sudden_change_for_ever(
    leading: int, *, is_explained: bool, accepted: bool
) -> None:
    """Slow errors of sensors, within their noise, leave the same structure in every window of a healthy machine too."""
    test = of_moved(FaultType.PARAMETER, 1.3 * J.nominal, inflation=1.8)
    (best, null), counts = test.hypotheses, replace(test.counts, leading=leading)
    outcome = decide(replace(test, hypotheses=(replace(best, is_explained=is_explained), null), counts=counts), 10)
    assert (outcome.decision is WindowDecision.STEPPED) == accepted


def evidence_after(*differences: float) -> FilterEvidence:
    """Evidence about the filter after windows in which its χ² exceeds the best by so many variance factors."""
    evidence, best = FilterEvidence(), LogEvidence(400.0, discount=2.0)
    for difference in differences:
        evidence = evidence.after(400.0 + 2.0 * difference, best)
    return evidence


@pytest.mark.parametrize(
    ("differences", "against", "supporting"),
    [
        ((1e6,), False, False),  # no window decides alone
        ((1e6, 1e6), True, False),
        ((1e6, 1e6, 0.0), False, False),  # windows that say nothing take the evidence against it away
        ((9.0,) * 30, False, False),  # weak evidence in each of many windows is that of a filter that lags
        ((-6.0,), False, False),
        ((-6.0, -6.0), False, True),
        ((-6.0, -6.0, *(0.0,) * 30), False, True),  # and leave the evidence for it
    ],
)
def test_windows_after_the_first_are_evidence_about_the_filter(
    differences: tuple[float, ...], against: bool, supporting: bool
) -> None:
    evidence = evidence_after(*differences)
    assert (evidence.is_against, evidence.is_for) == (against, supporting)
    assert (evidence.probability > 0.5) == (sum(differences) < 0.0)


@pytest.mark.parametrize(("rate", "fades"), [(1.355, True), (0.001, False)])
def test_what_dies_away_fades_by_the_effect_that_it_has_now(rate: float, *, fades: bool) -> None:
    """Seen for ever after a coast-down: 0.066·exp(−1.355·t); its amplitude is that of its onset."""
    component = Component("shaft", "negative exponential", "t", 0.066, rate, 1e-4, 10.0)
    problem = augment(BARE, [component])
    certain = dict(zip((free.name for free in problem.free[1:]), [(0.066, 1e-4), (rate, 1e-4)], strict=False))
    posterior = hypothesis(FaultType.COMPONENT, problem, **certain).posterior
    posterior = replace(posterior, belief=replace(posterior.belief, end=10.0))
    (counted,) = count_fading((AdoptedComponent(component, 0.0),), posterior)
    assert (counted.fading == 1) == fades


def test_a_component_that_leaves_structure_does_not_lead() -> None:
    component, other = (hypothesis(kind, BARE) for kind in (FaultType.COMPONENT, FaultType.SENSOR))
    counts = WindowCounts().after(component, component, is_resolved=True)
    assert (counts.leading, counts.since_search, counts.resolved) == (2, 2, 3)
    assert counts.after(component, replace(component, inflation=1.8), is_resolved=True).leading == 0
    changed = counts.after(component, other, is_resolved=False)
    assert (changed.leading, changed.since_search, changed.resolved) == (1, 3, 0)
