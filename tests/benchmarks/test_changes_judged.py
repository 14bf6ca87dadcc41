"""The benchmark of changes: how it judges what reports state, and the random cases that it draws."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.changes import calibration, classes, healthy, reports, steps
from benchmarks.changes.machines import DC_MOTOR, twin_of
from benchmarks.changes.observe import Case, Observed, Published, Stated, coverage
from benchmarks.changes.plants import HEALTHY, generator, simulate

from otolith.discovery.alternatives import WindowDecision

PUMP_TRIAL = next(trial for trial in classes.trials(0, 2) if trial.pair == "k_v / gain of u")
SUSPECTED, AMBIGUOUS = WindowDecision.SUSPECTED, WindowDecision.AMBIGUOUS


def published(low: float | None, high: float | None) -> Published:
    return Published("estimated", None, low, high, 1.0)


def window(decision: WindowDecision, *stated: Stated, **parameters: Published) -> Observed:
    return Observed(decision, stated, (), parameters, 1.0)


def stated(**probabilities: float) -> list[Stated]:
    texts = {
        "k_v": Stated("PARAMETER", "h_0, k_v", 0.0),
        "h_0": Stated("PARAMETER", "h_0", 0.0),
        "u": Stated("SENSOR", "u reads wrong by +9.5%", 0.0),
        "T_m": Stated("SENSOR", "T_m reads wrong by +9.5%", 0.0),
        "head": Stated("COMPONENT", "head: -0.12", 0.0),
    }
    return [replace(texts[name], probability=share) for name, share in probabilities.items()]


@pytest.mark.parametrize(
    ("decision", "hypotheses", "right"),
    [
        (SUSPECTED, stated(k_v=0.5, u=0.5), True),
        (SUSPECTED, stated(k_v=0.9, u=0.1), False),
        (SUSPECTED, stated(h_0=0.5, u=0.5), False),
        (SUSPECTED, stated(k_v=0.1, u=0.1, head=0.8), False),
        (AMBIGUOUS, stated(k_v=0.9, u=0.1), True),
        (AMBIGUOUS, stated(k_v=0.2, u=0.5, head=0.3), True),
        (AMBIGUOUS, stated(k_v=0.5, T_m=0.5), False),
        (AMBIGUOUS, stated(k_v=0.5, head=0.5), False),
        (AMBIGUOUS, stated(h_0=0.5, u=0.5), False),
        (AMBIGUOUS, stated(k_v=0.1, u=0.1, head=0.8), False),
        (AMBIGUOUS, stated(u=1.0), False),
        (AMBIGUOUS, [], False),
    ],
)
def test_a_class_is_right_if_the_last_window_states_its_members(
    decision: WindowDecision, hypotheses: list[Stated], right: bool
) -> None:
    outcome = classes.judge(PUMP_TRIAL, [window(SUSPECTED), window(decision, *hypotheses)])
    assert outcome.right is right
    assert outcome.first == (2 if right else None)


@pytest.mark.parametrize("verdict", sorted(classes.VERDICTS))
def test_a_class_is_wrong_after_any_verdict(verdict: WindowDecision) -> None:
    members = stated(k_v=0.5, u=0.5)
    outcome = classes.judge(PUMP_TRIAL, [window(verdict), window(AMBIGUOUS, *members)])
    assert not outcome.right
    assert outcome.verdict == verdict.name


@pytest.mark.parametrize(
    ("decisions", "right"),
    [
        ((SUSPECTED, WindowDecision.SENSOR), True),
        ((SUSPECTED,) * classes.VERDICT_WINDOWS + (WindowDecision.SENSOR,), False),
        ((WindowDecision.STEPPED, WindowDecision.SENSOR), False),
        ((SUSPECTED, AMBIGUOUS), False),
    ],
)
def test_a_change_that_the_data_show_needs_its_verdict_in_time(
    decisions: tuple[WindowDecision, ...], right: bool
) -> None:
    trial = replace(PUMP_TRIAL, members=PUMP_TRIAL.members[1:])
    assert classes.judge(trial, [window(own, *stated(u=0.9)) for own in decisions]).right is right


def test_a_verdict_of_another_sensor_is_wrong() -> None:
    trial = replace(PUMP_TRIAL, members=PUMP_TRIAL.members[1:])
    assert not classes.judge(trial, [window(WindowDecision.SENSOR, *stated(u=0.1, T_m=0.9))]).right


HELD, MISSED, NONE = published(0.9, 1.1), published(1.1, 1.2), published(None, None)


@pytest.mark.parametrize(
    ("intervals", "share", "held", "met"),
    [
        ([HELD] * 20, 1.0, 1.0, True),
        ([HELD] * 19 + [NONE], 0.95, 1.0, True),
        ([HELD] * 18 + [NONE] * 2, 0.9, 1.0, False),
        ([HELD] * 18 + [MISSED] * 2, 1.0, 0.9, False),
        ([HELD] * 9 + [MISSED, *[NONE] * 10], 0.5, 0.9, False),
        ([NONE] * 20, 0.0, None, False),
    ],
)
def test_windows_without_an_interval_do_not_count_as_held(
    intervals: list[Published], share: float, held: float | None, met: bool
) -> None:
    """The same in all commands: a step and a class miss their targets, and a healthy case states the same share."""
    own = coverage(intervals)
    assert own.published == pytest.approx(share)
    assert own.held == (held if held is None else pytest.approx(held))
    step = next(step for step in steps.steps(0, 1) if step.case.name == "dc_motor: R_a +20%")
    run = [window(WindowDecision.LEARNED)] * (steps.FROM_WINDOW - 1)
    run += [window(WindowDecision.LEARNED, R_a=interval) for interval in intervals]
    document = steps.summarise(step, [run])
    assert (document["held"], document["published"], document["met"]) == (own.held, own.published, met)
    trial = replace(PUMP_TRIAL, agreed=("R_a",))
    members = stated(k_v=0.5, u=0.5)
    class_run = [window(AMBIGUOUS, *members, R_a=interval) for interval in intervals]
    assert classes.summarise(trial, [class_run]).met is met
    assert healthy.summarise(step.case, [class_run])["held"] == {"R_a": own.held}


@pytest.mark.parametrize(
    ("hypotheses", "met"),
    [
        *((stated(u=0.5, k_v=0.5), True), (stated(u=0.6, k_v=0.4), False), (stated(u=0.4, k_v=0.6), True)),
        ([*stated(u=0.5, k_v=0.47), Stated("PARAMETER", "h_0, k_v", 0.03)], True),
        ([*stated(u=0.5, k_v=0.30), Stated("COMPONENT", "pipe: 0.1·Q Pa", 0.2)], False),
    ],
)
def test_a_step_must_not_make_a_sensor_the_most_probable_hypothesis(hypotheses: list[Stated], met: bool) -> None:
    step = next(step for step in steps.steps(0, 4) if step.case.name == "dc_motor: R_a +20%")
    document = steps.summarise(step, [[window(SUSPECTED, *hypotheses, R_a=HELD)] * 4])
    assert (document["sensor"], document["met"]) == (0.0 if met else 1.0, met)


def result(*pairs: tuple[float, bool], kind: str = "gain", right: bool = True) -> calibration.Result:
    return calibration.Result("", kind, "SENSOR", pairs, right, "")


def test_hypotheses_are_sorted_into_bins_of_probability() -> None:
    results = [result((1.0, True), (0.96, False)), result((0.1, False), (0.2, True), (0.95, True))]
    rows = [(own["low"], own["count"], own["right"]) for own in calibration.table(results)]
    assert rows == [(0.0, 1, 0.0), (0.2, 1, 1.0), (0.95, 3, pytest.approx(2 / 3))]
    assert calibration.table(results)[-1]["probability"] == pytest.approx((1.0 + 0.96 + 0.95) / 3)


@pytest.mark.parametrize(
    ("pairs", "met"),
    [
        ([(0.99, True)] * 9 + [(0.99, False)], True),
        ([(0.95, True)] * 8 + [(0.95, False)], False),
        ([(0.94, False)] * 10, True),
        ([], True),
    ],
)
def test_nine_of_ten_hypotheses_that_are_stated_as_sure_must_be_right(
    pairs: list[tuple[float, bool]], met: bool
) -> None:
    assert calibration.met([result(*pairs)]) is met


def test_the_most_probable_hypotheses_are_counted_by_kind_and_decision() -> None:
    rows = calibration.decisions([result(), result(right=False), result(kind="offset")])
    assert [(own["kind"], own["count"], own["right"]) for own in rows] == [("gain", 2, 0.5), ("offset", 1, 1.0)]


@pytest.mark.parametrize(
    ("kind", "place", "right", "wrong"),
    [
        ("parameter", "J", Stated("PARAMETER", "D, J", 1.0), Stated("PARAMETER", "D", 1.0)),
        ("parameter", "J", Stated("PARAMETER", "J", 1.0), Stated("PARAMETER", "J_m", 1.0)),
        ("component", "shaft", Stated("COMPONENT", "shaft: 1", 1.0), Stated("COMPONENT", "winding: 1", 1.0)),
        ("component", "shaft", Stated("COMPONENT", "shaft/linear/i", 1.0), Stated("SENSOR", "shaft: 1", 1.0)),
        ("gain", "i", Stated("SENSOR", "i reads wrong by +9%", 1.0), Stated("SENSOR", "omega reads wrong by +9%", 1.0)),
        ("offset", "i", Stated("SENSOR", "i reads wrong by +1 A", 1.0), Stated("PARAMETER", "i", 1.0)),
        ("nothing", "", Stated("NOTHING", "nothing", 1.0), Stated("PARAMETER", "J", 1.0)),
    ],
)
def test_a_hypothesis_is_right_if_it_names_type_and_place(kind: str, place: str, right: Stated, wrong: Stated) -> None:
    drawn = calibration.Drawn(kind, place, Case("", DC_MOTOR, HEALTHY))
    assert drawn.is_right(right)
    assert not drawn.is_right(wrong)


@cache
def drawn_case(number: int) -> calibration.Drawn:
    return calibration.draw(number, 1)


def moved_by(drawn: calibration.Drawn) -> float:
    """Root mean square by which a component moves the most affected output, over its noise."""
    plant, records = drawn.case.plant, calibration.PROBE_WINDOWS * drawn.case.plant.records
    right, changed = (
        simulate(plant, [generator(0, plant.name, 0)], records, own, own, 0) for own in (HEALTHY, drawn.case.after)
    )
    outputs = twin_of(plant).outputs
    return max(float(np.sqrt(np.mean((changed[own.name] - right[own.name]) ** 2))) / own.noise for own in outputs)


@pytest.mark.full
def test_drawn_cases_are_reproducible_and_of_all_kinds() -> None:
    drawn = [drawn_case(number) for number in range(40)]
    assert calibration.draw(5, 1) == drawn[5]
    assert calibration.draw(5, 2) != drawn[5]
    assert {own.kind for own in drawn} == set(calibration.KINDS)
    low, high = calibration.SHARE
    for own in drawn:
        after, quiet, loud = own.case.after, *calibration.NOISE
        assert quiet <= own.case.noise <= loud
        fields = (after.gains, after.offsets, after.parameters, after.terms)
        changed = dict(zip(("gain", "offset", "parameter", "component"), map(list, fields), strict=True))
        expected = {} if own.kind == "nothing" else {own.kind: [own.place]}
        assert {kind: names for kind, names in changed.items() if names} == expected
        if own.kind == "gain":
            assert low <= abs(after.gains[own.place] - 1.0) <= high
        elif own.kind == "parameter":
            assert low <= abs(after.parameters[own.place] / own.case.plant.parameters[own.place] - 1.0) <= high
        elif own.kind == "offset":
            shown = calibration.probe(own.case.plant.name)[own.place]
            assert low <= abs(after.offsets[own.place]) / float(np.sqrt(np.mean(shown**2))) <= high


def test_a_drawn_component_moves_an_output_by_as_much_as_drawn() -> None:
    """Exactly, if the machine were linear."""
    moved = [moved_by(own) for own in map(drawn_case, range(20)) if own.kind == "component"]
    low, high = calibration.EFFECT
    assert 0.3 * low <= min(moved) <= max(moved) <= 3.0 * high
    assert max(moved) > 3.0 * min(moved)


def test_reports_are_the_same_only_bit_for_bit() -> None:
    before = [{"decision": "learned", "fit": {"cost": 1.0, "notes": ["a"]}}]
    assert reports.compare(before, before) == reports.Difference(0.0, "", ())
    near = reports.compare([{"decision": "learned", "fit": {"cost": 1.0 + 1e-9, "notes": ["a"]}}], before)
    assert near.is_close
    assert near.largest > 0.0
    assert near.place == "/0/fit/cost"
    far = [{"decision": "learned", "fit": {"cost": 1.1, "notes": ["a"]}}]
    other = [{"decision": "learned", "fit": {"cost": 1.0, "notes": ["a", "b"]}}]
    assert not any(reports.compare(own, before).is_close for own in (far, other, [], [{"decision": "learned"}]))
    assert reports.fingerprint(far) != reports.fingerprint(before) == reports.fingerprint([{**before[0]}])
