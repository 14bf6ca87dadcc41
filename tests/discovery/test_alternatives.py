"""What each row of the table of alternatives promises: a text with its place, and the decision that windows lead to.

A further type of hypothesis needs an example here, and all tests hold for it.
"""

from dataclasses import replace

import pytest

from otolith.discovery.alternatives import (
    ALTERNATIVES,
    DATA_FAULTS,
    UPDATES,
    PosteriorUpdate,
    WindowDecision,
    describe_hypothesis,
)
from otolith.discovery.decision import YOUNG_WINDOWS, decide
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.sequential_test import SequentialTest, WindowCounts
from otolith.estimation.problem import Component, augment
from tests.discovery.test_sequential_test import BARE, COULOMB, hypothesis

OFFSET = Component("sensor of omega", "constant", "t", amplitude=1.0)
NULL = hypothesis(FaultType.NOTHING, BARE).worse_by(60.0, 60.0)
BRUSHES = hypothesis(FaultType.COMPONENT, augment(BARE, [COULOMB]))
MOVED = hypothesis(FaultType.PARAMETER, BARE, R_a=(8.0, 0.01))
LATE = replace(hypothesis(FaultType.TIMING, replace(BARE, delays=(("omega", 0.05),))), delay_information=1e6)
EXAMPLES = {
    FaultType.NOTHING: hypothesis(FaultType.NOTHING, BARE),
    FaultType.PARAMETER: replace(MOVED, hypothesis=replace(MOVED.hypothesis, name="R_a")),
    FaultType.COMPONENT: replace(BRUSHES, hypothesis=replace(BRUSHES.hypothesis, name=COULOMB.key)),
    FaultType.SENSOR: hypothesis(FaultType.SENSOR, augment(BARE, [OFFSET])),
    FaultType.TIMING: LATE,
    FaultType.NOISE: hypothesis(FaultType.NOISE, BARE.with_levels([*BARE.levels[:2], 1.0, *BARE.levels[3:]])),
}


@pytest.fixture(params=FaultType, ids=lambda kind: kind.name.lower())
def example(request: pytest.FixtureRequest) -> TrackedHypothesis:
    """A hypothesis of each type."""
    return EXAMPLES[request.param]


def after(example: TrackedHypothesis, windows: int, learned: int = 20, *, deviance: float = 60.0) -> WindowDecision:
    """The decision after so many windows with the same best hypothesis, and ``deviance`` of the null hypothesis."""
    others = () if example.type is FaultType.NOTHING else (replace(NULL, deviance=deviance, misfit=deviance),)
    counts = WindowCounts(tested=max(windows, 1), leading=windows, since_search=windows)
    return decide(SequentialTest(BARE, (example, *others), 0.0, counts=counts), learned).decision


def test_each_type_has_a_row() -> None:
    assert set(ALTERNATIVES) == set(FaultType) == set(EXAMPLES)


def test_its_text_names_the_place_to_inspect(example: TrackedHypothesis) -> None:
    text = describe_hypothesis(example)
    assert text
    assert all(place in text for place in ALTERNATIVES[example.type].places(example))


def test_its_decision_follows_as_soon_as_enough_windows_agree(example: TrackedHypothesis) -> None:
    row = ALTERNATIVES[example.type]
    assert after(example, row.windows) is row.decision
    if row.windows:
        assert after(example, row.windows - 1) in (WindowDecision.SUSPECTED, WindowDecision.LEARNED)
    if example.type is not FaultType.NOTHING:
        assert after(example, row.windows, deviance=0.0) is WindowDecision.SUSPECTED
        assert after(replace(example, cost=10.0), row.windows) is WindowDecision.REFUSED


def test_few_learned_windows_ask_for_no_fewer_windows(example: TrackedHypothesis) -> None:
    row = ALTERNATIVES[example.type]
    needed = max(row.windows, row.windows_while_young)
    assert after(example, needed, YOUNG_WINDOWS) is row.decision
    assert after(example, max(row.windows, needed - 1), YOUNG_WINDOWS) is (
        row.decision if needed == row.windows else WindowDecision.SUSPECTED
    )


def test_wrong_data_never_change_what_is_known(example: TrackedHypothesis) -> None:
    row = ALTERNATIVES[example.type]
    assert row.is_of_data == (row.decision in DATA_FAULTS)
    assert (UPDATES[row.decision] is PosteriorUpdate.NONE) == row.is_of_data
    unsure = replace(example, inflation=2.0)
    if row.is_of_data:
        assert after(unsure, 20) is WindowDecision.SUSPECTED
