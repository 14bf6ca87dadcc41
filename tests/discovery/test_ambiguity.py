"""Classes of hypotheses that the data cannot distinguish: equal probabilities, and intervals that hold all members."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.sequential_test import interchangeable, mixture, probabilities, without_duplicates
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Component, augment
from tests.discovery.test_sequential_test import BARE, PERIODIC, hypothesis

OFFSET = Component("sensor of i", "constant", "t", amplitude=0.01)
NULL = replace(hypothesis(FaultType.NOTHING, BARE), deviance=60.0, misfit=60.0)


def stated(
    kind: FaultType, deviance: float, misfit: float, added: int, component: Component | None = None
) -> TrackedHypothesis:
    item = hypothesis(kind, BARE if component is None else augment(BARE, [component]), R_a=(7.0, 0.01))
    return replace(item, deviance=deviance, misfit=misfit, hypothesis=replace(item.hypothesis, added=added))


def shares_of(hypotheses: Sequence[TrackedHypothesis]) -> list[float]:
    return probabilities(hypotheses, interchangeable(hypotheses))


def test_a_sensor_and_several_moved_parameters_that_explain_the_same_are_equally_probable() -> None:
    """The number of values of a hypothesis and its prior weight do not decide."""
    moved, sensor = stated(FaultType.PARAMETER, 20.0, 0.0, 3), stated(FaultType.SENSOR, 0.0, 1.0, 1, OFFSET)
    assert shares_of([sensor, moved, NULL]) == pytest.approx([0.5, 0.5, 0.0], abs=1e-6)
    assert interchangeable([sensor, moved, NULL]) == [[0], [1]]


def test_fewer_values_do_not_decide_against_a_better_fit() -> None:
    """Seen on a motor without a current sensor: "omega reads wrong by +15 %" although K, J and T_c had moved."""
    moved, sensor = stated(FaultType.PARAMETER, 4.0, 0.0, 3), stated(FaultType.SENSOR, 0.0, 11.0, 1, OFFSET)
    assert shares_of([sensor, moved, NULL]) == pytest.approx([0.5, 0.5, 0.0], abs=1e-6)


def test_data_decide_between_a_sensor_and_moved_parameters() -> None:
    moved, sensor = stated(FaultType.PARAMETER, 0.0, 0.0, 3), stated(FaultType.SENSOR, 15.0, 15.0, 1, OFFSET)
    assert shares_of([moved, sensor, NULL])[0] > 0.99
    assert interchangeable([moved, sensor, NULL]) == [[0]]


def test_a_component_with_more_values_needs_evidence() -> None:
    moved, component = stated(FaultType.PARAMETER, 0.0, 1.0, 1), stated(FaultType.COMPONENT, 12.0, 0.0, 3, PERIODIC)
    assert shares_of([moved, component, NULL])[0] > 0.99


def test_variants_of_one_hypothesis_share_its_probability() -> None:
    several = [stated(FaultType.PARAMETER, 0.0, 0.0, 1), stated(FaultType.PARAMETER, 1.0, 0.0, 2)]
    sensor = stated(FaultType.SENSOR, 9.0, 3.0, 1, OFFSET)
    members = (*several, sensor, NULL)
    shares = shares_of(members)
    assert shares[0] + shares[1] == pytest.approx(0.5, abs=1e-6)
    assert shares[0] / shares[1] == pytest.approx(np.exp(0.5))
    assert without_duplicates(members, interchangeable(members)) == (several[0], sensor, NULL)


@pytest.mark.parametrize("wrong", [0.5, 0.0])
def test_the_mixture_holds_the_values_of_all_members(wrong: float) -> None:
    """What was known before the test is a member: the window that opened it may be wrong."""
    moved, sensor = stated(FaultType.PARAMETER, 0.0, 0.0, 1), stated(FaultType.SENSOR, 0.0, 0.0, 1, OFFSET)
    before = hypothesis(FaultType.NOTHING, BARE, R_a=(6.0, 0.01)).posterior.prior()
    known = mixture([moved, sensor], [0.5, 0.5], BARE, before, wrong)
    sd = float(np.sqrt(known.covariance[0, 0]))
    expected = (6.5, np.hypot(0.5, 0.01)) if wrong else (7.0, 0.01)
    assert (known.mean[0], sd) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("share", "is_inside"), [(0.06, True), (0.04, False)])
def test_the_interval_of_the_mixture_contains_those_of_probable_members(share: float, *, is_inside: bool) -> None:
    near = stated(FaultType.PARAMETER, 0.0, 0.0, 1)
    far = hypothesis(FaultType.PARAMETER, BARE, R_a=(8.0, 0.01))
    known = mixture([near, far], [1.0 - share, share], BARE, near.posterior.prior(), wrong=0.0)
    reach = QUANTILE * np.sqrt(known.covariance[0, 0])
    assert (known.mean[0] + reach >= 8.0 + QUANTILE * 0.01 - 1e-9) == is_inside
