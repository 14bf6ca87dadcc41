"""States and events: from intervals, with hysteresis and persistence, each event raised once and cleared once."""

import pickle
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Verdict
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.decision import Approval
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.events import HealthState, assess
from otolith.health.limits import RELEASE, Level, Limit, MonitoredQuantity
from otolith.health.observations import (
    INTERMITTENT_WINDOWS,
    LOST_AFTER,
    PERSISTENT_WINDOWS,
    RELEASE_WINDOWS,
    UNDECIDED,
)
from otolith.health.schema import (
    ComponentDocument,
    ComponentStatus,
    EventChange,
    EventDocument,
    FindingDocument,
    FindingKind,
    NumberDocument,
    ParameterDocument,
    QualityDocument,
    ReportDocument,
    Severity,
    Status,
    WindowDocument,
)
from otolith.health.text import event_text
from otolith.machine import load_rules
from tests.messages import assert_says
from tests.variants import often

NOMINAL, WATCH, ACT = 6.5, 6.3, 6.0  # ohm
LENGTH = 2.0  # s
RESISTANCE = MonitoredQuantity(
    "winding",
    "armature resistance",
    "ohm",
    NOMINAL,
    (Limit(Level.WATCH, WATCH, True), Limit(Level.ACT, ACT, True), Limit(Level.ACT, 8.0, False)),
)
SHAFT = MonitoredQuantity("shaft", "torque on the shaft", "N*m", 0.0, (Limit(Level.ACT, 0.004, False),))
PLAN = MonitoringPlan({"R_a": RESISTANCE}, {"shaft": SHAFT}, load_rules())


def report(
    index: int,
    value: float | None = NOMINAL,
    sd: float = 0.01,
    *,
    decision: WindowDecision = WindowDecision.LEARNED,
    status: Status = Status.ESTIMATED,
    findings: tuple[FindingDocument, ...] = (),
    components: tuple[ComponentDocument, ...] = (),
    absent: dict[str, str] | None = None,
) -> ReportDocument:
    quality = QualityDocument(verdict=Verdict.GOOD, missing=0.0, longest_gap_s=0.0, jitter_s=0.0, skew_s=0.0)
    start, end = LENGTH * index, LENGTH * (index + 1)
    window = WindowDocument(index=index, start=start, end=end, records=200, quality=quality, absent=absent)
    parameter = ParameterDocument(
        value=value, sd=None if value is None else sd, unit="ohm", nominal=NOMINAL, status=status
    )
    return ReportDocument(
        machine="m",
        site="s",
        twin="dc_motor",
        window=window,
        decision=decision,
        parameters={"R_a": parameter},
        findings=findings,
        components=components,
    )


def assessed(
    reports: Iterable[ReportDocument], state: HealthState | None = None, plan: MonitoringPlan = PLAN
) -> list[ReportDocument]:
    """Assess one report after the other; the state is sent to another process between them."""
    state, documents = state or HealthState(), []
    for document in reports:
        state, after = assess(plan, pickle.loads(pickle.dumps(state)), document)  # noqa: S301 - our own state
        documents.append(ReportDocument.from_json(after.to_json()))
    return documents


def changes(documents: Iterable[ReportDocument]) -> list[tuple[int, EventChange, Level]]:
    return [
        (document.window.index, event.change, event.state)
        for document in documents
        for event in document.events
        if event.change is not None
    ]


def events(document: ReportDocument) -> dict[str, EventDocument]:
    return {event.part: event for event in document.events}


def state_of(document: ReportDocument, part: str) -> Level:
    assert document.health is not None
    return document.health.parts[part].state


@pytest.mark.parametrize("windows", often([1000], [1000, 3000]))
def test_a_healthy_machine_has_no_event(windows: int) -> None:
    """The truth of its estimate is nominal, and the limit four standard deviations away."""
    random = np.random.default_rng(16)
    sd = (NOMINAL - WATCH) / 4.0
    documents = assessed(report(index, NOMINAL + sd * random.standard_normal(), sd) for index in range(windows))
    assert changes(documents) == []
    assert {state_of(document, "winding") for document in documents} == {Level.OK}
    assert documents[-1].health is not None
    assert documents[-1].health.state is Level.OK
    assert documents[-1].health.since == 0.0


@pytest.mark.parametrize(("sd", "expected"), [(0.05, True), (0.052, False)])
def test_act_needs_a_probability_of_97_5_percent(sd: float, expected: bool) -> None:
    """The value is 0.1 ohm beyond the limit: 1.96 standard deviations are the bound."""
    documents = assessed(report(index, ACT - 0.1, sd) for index in range(5))
    assert (state_of(documents[-1], "winding") is Level.ACT) == expected
    if expected:
        probability = events(documents[-1])["winding"].evidence.probability
        assert probability == pytest.approx(0.97725, abs=1e-4)


def test_an_event_is_raised_changed_and_cleared_once() -> None:
    values = [*np.linspace(6.5, 5.8, 60), *[5.8] * 10, *np.linspace(5.8, 6.5, 60), *[6.5] * 5]
    documents = assessed(report(index, float(value)) for index, value in enumerate(values))
    assert [item[1:] for item in changes(documents)] == [
        (EventChange.RAISED, Level.WATCH),
        (EventChange.CHANGED, Level.ACT),
        (EventChange.CHANGED, Level.WATCH),
        (EventChange.CLEARED, Level.WATCH),
    ]
    assert len({event.id for document in documents for event in document.events}) == 1
    cleared = next(event for document in documents for event in document.events if event.end is not None)
    assert cleared.start < cleared.since < cleared.end  # type: ignore[operator]  # it has an end
    assert documents[-1].events == ()
    assert state_of(documents[-1], "winding") is Level.OK


def test_a_state_begins_with_the_first_window_that_showed_it() -> None:
    documents = assessed(report(index, 6.5 if index < 10 else 5.8) for index in range(20))
    assert changes(documents) == [(10 + PERSISTENT_WINDOWS - 1, EventChange.RAISED, Level.ACT)]
    event = events(documents[-1])["winding"]
    assert event.since == event.start == 10 * LENGTH
    assert event.evidence.windows == (10, 19)
    assert documents[-1].health is not None
    assert documents[-1].health.parts["winding"].since == documents[-1].health.since == 10 * LENGTH


def test_fewer_windows_than_must_agree_change_nothing() -> None:
    beyond = {10, 11, 14, 20, 21}
    documents = assessed(report(index, 5.8 if index in beyond else 6.5) for index in range(30))
    assert changes(documents) == []


def test_a_value_that_wanders_around_its_limit_is_one_event() -> None:
    """Hysteresis: 97.5 % on either side, and a tenth of the distance to the nominal value."""
    random = np.random.default_rng(3)
    values = ACT + 0.5 * RELEASE * (NOMINAL - ACT) * np.sign(random.standard_normal(500))
    documents = assessed(report(index, float(value), 0.002) for index, value in enumerate(values))
    raised = [item for item in changes(documents) if item[2] is Level.ACT]
    assert len(raised) == 1
    assert state_of(documents[-1], "winding") is Level.ACT


def test_a_value_back_inside_its_limit_is_not_said_to_be_beyond_it() -> None:
    """An event lasts until its value is clearly inside; meanwhile its text is true."""
    documents = assessed(report(index, WATCH + (0.005 if index > 5 else -0.1)) for index in range(12))
    before, after = (events(document)["winding"] for document in (documents[5], documents[-1]))
    assert (before.state, after.state) == (Level.WATCH, Level.WATCH)
    assert ", below its limit 6.3 Ω" in before.text
    assert ", still near its limit 6.3 Ω" in after.text
    assert "beyond" in event_text(before)
    assert "beyond" not in event_text(after)


@pytest.mark.parametrize("status", [Status.HELD, Status.INVALID])
def test_a_window_that_determines_nothing_leaves_the_state(status: Status) -> None:
    raised = [report(index, 5.8) for index in range(5)]
    silent = [report(index, 6.5, status=status) for index in range(5, 15)]
    assert len(changes(assessed([*raised, *silent]))) == 1
    assert changes(assessed(report(index, 5.8, status=status) for index in range(10))) == []


def test_a_part_without_a_value_has_no_data() -> None:
    documents = assessed(report(index, None, status=Status.UNESTIMATED) for index in range(3))
    assert state_of(documents[-1], "winding") is Level.NO_DATA
    assert documents[-1].health is not None
    assert documents[-1].health.state is Level.NO_DATA
    assert documents[-1].health.parts["winding"].reason == "not determined yet: R_a"


def test_windows_with_unusable_values_state_why() -> None:
    parameter = report(0, 6.5).parameters["R_a"].model_copy(update={"reason": "a value is not finite"})
    bad = [
        report(index, 6.5, decision=WindowDecision.BAD).model_copy(update={"parameters": {"R_a": parameter}})
        for index in range(4)
    ]
    assert events(assessed(bad)[-1])["bus"].text == "a value is not finite"


def test_bad_windows_are_no_data_and_hide_no_fault() -> None:
    raised = [report(index, 5.8) for index in range(5)]
    bad = [report(index, 5.8, decision=WindowDecision.BAD, status=Status.HELD) for index in range(5, 12)]
    documents = assessed([*raised, *bad, *[report(index, 5.8) for index in range(12, 20)]])
    assert [item[0] for item in changes(documents)] == [2, 7, 14]
    during = documents[11]
    assert (state_of(during, "bus"), state_of(during, "winding")) == (Level.NO_DATA, Level.ACT)
    assert state_of(during, "shaft") is Level.NO_DATA
    assert during.health is not None
    assert during.health.state is Level.ACT
    assert state_of(documents[-1], "bus") is Level.OK


def test_an_absent_source_is_an_event_of_the_bus_while_windows_stay_good() -> None:
    gone = {"encoder": "source 'encoder' (omega) is down: connection refused"}
    healthy = [report(index) for index in range(3)]
    down = [report(index, absent=gone) for index in range(3, 8)]
    back = [report(index, status=Status.HELD) for index in range(8, 12)]
    documents = assessed([*healthy, *down, *back])
    assert changes(documents) == [(5, EventChange.RAISED, Level.WATCH), (10, EventChange.CLEARED, Level.WATCH)]
    (event,) = documents[7].events
    assert (event.part, event.text) == ("bus", gone["encoder"])
    assert "a source gives no samples" in event.condition
    assert event.start == 3 * LENGTH
    assert [state_of(documents[7], part) for part in ("bus", "winding")] == [Level.WATCH, Level.OK]
    assert documents[7].health is not None
    assert documents[7].health.state is Level.WATCH


def test_without_usable_data_an_absent_source_is_no_data() -> None:
    bad = [report(index, decision=WindowDecision.BAD, absent={"drive": "source 'drive' is down"}) for index in range(4)]
    last = assessed(bad)[-1]
    assert last.health is not None
    assert last.health.state is Level.NO_DATA
    assert "a source gives no samples" in last.health.reason


def finding(kind: FindingKind, subject: str, since: float) -> FindingDocument:
    return FindingDocument(
        id=f"{kind}/{subject}",
        kind=kind,
        subject=subject,
        severity=Severity.FAULT,
        condition="c",
        text="i is frozen",
        since=since,
    )


def test_a_frozen_sensor_is_an_event() -> None:
    frozen = [finding(FindingKind.SENSOR, "i", index * LENGTH) for index in range(20)]  # each window has its own
    wrong = [
        report(index, status=Status.HELD, decision=WindowDecision.SENSOR, findings=(frozen[index],))
        for index in range(10, 20)
    ]
    healthy = [report(index) for index in range(10)], [report(index) for index in range(20, 30)]
    documents = assessed([*healthy[0], *wrong, *healthy[1]])
    assert [item[1] for item in changes(documents)] == [EventChange.RAISED, EventChange.CLEARED]
    event = events(documents[15])["sensors"]
    assert (event.start, event.text) == (20.0, "i is frozen")
    assert event.advice
    assert state_of(documents[-1], "sensors") is Level.OK


def test_a_machine_at_rest_does_not_clear_the_event_of_a_sensor() -> None:
    frozen = finding(FindingKind.SENSOR, "i", 0.0)
    wrong = [
        report(index, status=Status.HELD, decision=WindowDecision.SENSOR, findings=(frozen,)) for index in range(5)
    ]
    rest = [report(index, status=Status.HELD) for index in range(5, 15)]
    assert len(changes(assessed([*wrong, *rest]))) == 1


def unbalance(
    amplitude: float,
    status: ComponentStatus = ComponentStatus.ADOPTED,
    approval: Approval = Approval.OPEN,
    source: str = "angle(omega)",
) -> ComponentDocument:
    inner = {"order": (1.0, 1e-4, "1")} if source == "angle(omega)" else {"frequency": (15.0, 0.1, "rad/s")}
    numbers = {"amplitude": (amplitude, 1e-5, "N*m"), **inner, "phase": (0.3, 0.01, "rad")}
    return ComponentDocument(
        id=f"shaft/periodic/{source}",
        site="shaft",
        meaning="torque on the shaft",
        mode="additive",
        family="periodic",
        input=source,
        equation="4.7e-3·sin(1·θ)",
        values={
            name: NumberDocument(value=value, sd=sd, low=value - 2 * sd, high=value + 2 * sd, unit=unit)
            for name, (value, sd, unit) in numbers.items()
        },
        conditions="unbalanced shaft",
        domain="",
        status=status,
        approval=approval,
        probability=0.99,
        onset=7.0,
    )


def undecided(
    index: int, decision: WindowDecision, kind: FindingKind = FindingKind.CLASS, **more: object
) -> ReportDocument:
    keys = {"id": "x", "kind": kind, "severity": Severity.WARNING, "condition": "", "text": "either", "since": 0.0}
    return report(index, decision=decision, findings=(FindingDocument.model_validate({**keys, **more}),))


def test_a_class_is_an_event_once_a_test_has_had_time_to_decide() -> None:
    windows = [undecided(index, WindowDecision.AMBIGUOUS) for index in range(UNDECIDED.rise)]
    assert changes(assessed(windows[:-1])) == []
    assert changes(assessed(windows)) == [(UNDECIDED.rise - 1, EventChange.RAISED, Level.WATCH)]


def test_a_window_with_one_leading_hypothesis_interrupts_a_class() -> None:
    windows = [undecided(index, WindowDecision.AMBIGUOUS) for index in range(4 * UNDECIDED.rise)]
    for index in range(2, len(windows), UNDECIDED.rise):
        windows[index] = report(index, decision=WindowDecision.SUSPECTED)
    assert changes(assessed(windows)) == []


def test_a_class_that_shows_only_while_the_machine_moves_is_cleared_once() -> None:
    moving = [undecided(index, WindowDecision.AMBIGUOUS) for index in range(60)]
    for start in (10, 25, 40):
        moving[start : start + 10] = [report(index) for index in range(start, start + 10)]
    quiet = [report(index) for index in range(60, 60 + RELEASE_WINDOWS)]
    documents = assessed([*moving, *quiet])
    last = quiet[-1].window.index
    assert [item[:2] for item in changes(documents)] == [(7, EventChange.RAISED), (last, EventChange.CLEARED)]


@pytest.mark.parametrize(("value", "expected"), [(0.034, [Level.ACT]), (0.0372, [])])
def test_a_known_parameter_that_has_moved_is_judged_by_the_limits_of_the_twin(
    value: float, expected: list[Level]
) -> None:
    number = NumberDocument(value=value, sd=1e-5, low=value, high=value, unit="N*m/A")
    limits = (Limit(Level.WATCH, 0.0361, True), Limit(Level.ACT, 0.0342, True))
    known = {"K_t": MonitoredQuantity("magnets", "torque constant", "N*m/A", 0.038, limits)}
    moved = [
        undecided(index, WindowDecision.SUSPECTED, FindingKind.MOVED, subject="K_t", value=number) for index in range(9)
    ]
    documents = assessed(moved, plan=replace(PLAN, known=known))
    assert [item[2] for item in changes(documents)] == expected
    if expected:
        event = events(documents[-1])["magnets"]
        assert "34.000 ± 0.020 mN·m/A (-10.5%), stated as 38 mN·m/A" in event.text
        assert_says(event.condition, "magnetic field", "dropped")


def test_a_component_beyond_its_limit_is_an_event_since_its_onset() -> None:
    documents = assessed(report(index, components=(unbalance(0.005),)) for index in range(10, 20))
    assert changes(documents) == [(12, EventChange.RAISED, Level.ACT)]
    event = events(documents[-1])["shaft"]
    assert event.start == 7.0
    assert "unbalance" in event.condition
    assert event.evidence.limit == 0.004


@pytest.mark.parametrize(
    "component",
    [
        unbalance(0.003),
        unbalance(0.005, ComponentStatus.FADING),
        unbalance(0.005, approval=Approval.APPROVED),
    ],
    ids=["small", "fading", "approved"],
)
def test_a_component_that_is_small_fades_or_is_approved_is_no_event(component: ComponentDocument) -> None:
    assert changes(assessed(report(index, components=(component,)) for index in range(20))) == []


def test_a_sine_of_time_that_proves_to_be_one_of_the_angle_is_the_same_event() -> None:
    """A constant speed does not distinguish the two, so the first diagnosis is a class."""
    of_time = [report(index, components=(unbalance(0.005, source="t"),)) for index in range(8)]
    of_angle = [report(index, components=(unbalance(0.005),)) for index in range(9, 15)]
    documents = assessed([*of_time, report(8), *of_angle])
    agreed = 9 + PERSISTENT_WINDOWS - 1
    assert [item[:2] for item in changes(documents)] == [(2, EventChange.RAISED), (agreed, EventChange.CHANGED)]
    first, last = events(documents[5])["shaft"], events(documents[-1])["shaft"]
    assert first.id == last.id
    assert_says(first.condition, "unsteadiness", "unbalanced", "misaligned shaft")
    assert "run at another speed" in first.advice
    assert last.condition == "unbalanced shaft"


def test_another_condition_of_fewer_windows_than_must_agree_leaves_the_event_as_it_is() -> None:
    sources = ["angle(omega)"] * 6 + ["t"] * (PERSISTENT_WINDOWS - 1) + ["angle(omega)"] * 3
    documents = assessed(
        report(index, components=(unbalance(0.005, source=source),)) for index, source in enumerate(sources)
    )
    assert [item[1] for item in changes(documents)] == [EventChange.RAISED]
    assert {document.events[0].condition for document in documents[2:]} == {"unbalanced shaft"}


def test_a_component_that_fades_clears_its_event() -> None:
    present = [report(index, components=(unbalance(0.005),)) for index in range(6)]
    fading = [report(index, components=(unbalance(0.001, ComponentStatus.FADING),)) for index in range(6, 9)]
    documents = assessed([*present, *fading, *[report(index) for index in range(9, 12)]])
    assert [item[1] for item in changes(documents)] == [EventChange.RAISED, EventChange.CLEARED]


def test_a_value_that_never_was_inside_may_be_a_wrong_nominal_value() -> None:
    beyond = assessed(report(index, 5.8) for index in range(5))[-1]
    assert events(beyond)["winding"].condition.startswith("a nominal value that does not fit")
    was_inside = assessed(report(index, 6.5 if index < 3 else 5.8) for index in range(9))[-1]
    assert_says(events(was_inside)["winding"].condition, "short circuit", "winding")


def test_the_values_distinguish_a_sudden_change_from_a_slow_one() -> None:
    step = [report(index) for index in range(5)]
    step += [report(5, 5.8, decision=WindowDecision.STEPPED), *[report(index, 5.8) for index in range(6, 12)]]
    slow = [report(index, max(6.5 - 0.02 * index, 5.8)) for index in range(60)]
    causes = [events(assessed(reports)[-1])["winding"].cause for reports in (step, slow)]
    assert_says(causes[0], "insulation", "at once")
    assert causes[1].startswith("the insulation between turns fails slowly")


@pytest.mark.parametrize("decision", [WindowDecision.STEPPED, WindowDecision.TIMING, WindowDecision.LEARNED])
def test_a_sudden_change_has_one_advice_whatever_updates_the_values_after_it(decision: WindowDecision) -> None:
    """Windows contradicted what was known; while it is also open which signal is late, none is said to be a step."""
    later = WindowDecision.LEARNED if decision is WindowDecision.STEPPED else decision
    reports = [report(index) for index in range(5)]
    reports += [report(index, None, decision=WindowDecision.SUSPECTED, status=Status.HELD) for index in (5, 6)]
    reports += [report(7, 5.8, decision=decision), *(report(index, 5.8, decision=later) for index in range(8, 20))]
    documents = assessed(reports)
    assert [change for _, change, _ in changes(documents)] == [EventChange.RAISED]
    assert "winding-turns-step" in events(documents[-1])["winding"].condition_id


def of_length(document: ReportDocument, seconds: float) -> ReportDocument:
    index = document.window.index
    window = document.window.model_copy(update={"start": seconds * index, "end": seconds * (index + 1)})
    return document.model_copy(update={"window": window})


def falling(hours: float, share: float, quantity: MonitoredQuantity = RESISTANCE) -> list[ReportDocument]:
    """A resistance that falls by ``share`` of the way to WATCH, within 50 windows over ``hours``."""
    random, step = np.random.default_rng(3), hours * 3600.0 / 50
    way = share * (WATCH - NOMINAL) * (1.0 if quantity is RESISTANCE else -1.0)
    documents = []
    for index in range(50):
        one = report(index, NOMINAL + way * index / 50 + 0.002 * random.standard_normal(), 0.002)
        documents.append(of_length(one, step))
    return documents


def test_a_trend_is_an_event_before_the_limit_is_reached() -> None:
    documents = assessed(falling(6.0, 0.9))
    (raised,) = [event for document in documents for event in document.events if event.change is EventChange.RAISED]
    assert (raised.part, raised.state) == ("winding", Level.WATCH)
    assert_says(raised.condition, "parameter", "on its way to a limit")
    assert "reaches WATCH in" in raised.text
    assert state_of(documents[-1], "winding") is Level.WATCH


def test_a_trend_becomes_the_event_of_the_limit() -> None:
    documents = assessed(falling(6.0, 2.0))
    assert {event.id.partition("/")[0] for event in documents[-1].events if event.end is None} == {"limit"}
    assert {event.id.partition("/")[0] for document in documents for event in document.events} == {"trend", "limit"}


def test_a_trend_of_minutes_is_no_event() -> None:
    assert changes(assessed(falling(0.5, 0.9))) == []


@pytest.mark.parametrize(("temperature", "expected"), [("", 0), ("winding", 1)])
def test_a_trend_that_warming_may_explain_is_no_event_without_a_temperature(temperature: str, expected: int) -> None:
    limits = (Limit(Level.WATCH, NOMINAL + (NOMINAL - WATCH), False),)
    copper = replace(RESISTANCE, limits=limits, temperature_coefficient=0.00393, temperature=temperature)
    documents = falling(6.0, 0.9, copper)
    for at, document in enumerate(documents):
        window = document.window.model_copy(update={"observed": {"winding": 293.15}})
        documents[at] = document.model_copy(update={"window": window})
    announced = changes(assessed(documents, plan=replace(PLAN, parameters={"R_a": copper})))
    assert len(announced) == expected


def lost(index: int, *, others: bool = True) -> ReportDocument:
    held = ParameterDocument(
        value=6.5, sd=2.0, unit="ohm", nominal=NOMINAL, status=Status.HELD, reason="no current", advice="a step of V_a",
        progress=0.4,
    )  # fmt: skip
    one = report(index)
    known = {"D": one.parameters["R_a"]} if others else {}
    return one.model_copy(update={"parameters": {"R_a": held, **known}})


def test_a_parameter_that_is_no_longer_determined_is_an_event_after_an_hour() -> None:
    windows = [report(index) if index < 5 or index >= 100 else lost(index) for index in range(105)]
    documents = assessed(of_length(window, 60.0) for window in windows)
    raised, cleared = (event for document in documents for event in document.events if event.change is not None)
    assert (raised.part, raised.state, raised.condition_id) == ("winding", Level.NO_DATA, "lost")
    assert "no current" in raised.text
    assert raised.advice.endswith("; a step of V_a")
    assert raised.evidence.windows[1] * 60.0 == pytest.approx(300.0 + LOST_AFTER, abs=240.0)
    assert (cleared.change, cleared.id) == (EventChange.CLEARED, raised.id)


def test_a_machine_at_rest_has_not_lost_a_parameter() -> None:
    windows = [report(index) if index < 5 else lost(index, others=False) for index in range(100)]
    assert changes(assessed(of_length(window, 60.0) for window in windows)) == []


def test_a_machine_that_starts_after_a_night_has_not_lost_what_it_determines_later() -> None:
    evening = [of_length(report(index), 60.0) for index in range(5)]
    night = [of_length(lost(index, others=False), 60.0) for index in range(5, 300)]
    morning = [of_length(lost(index), 60.0) for index in range(1000, 1010)]
    assert changes(assessed([*evening, *night, *morning])) == []


SENSOR = FindingDocument(
    id="sensor/i",
    kind=FindingKind.SENSOR,
    subject="i",
    severity=Severity.FAULT,
    condition="a sensor is wrong",
    text="i is frozen at 3 A",
    since=0.0,
)


def sensor_reports(faulty: Iterable[bool]) -> list[ReportDocument]:
    return [
        report(index, decision=WindowDecision.SENSOR, status=Status.HELD, findings=(SENSOR,))
        if is_faulty
        else report(index)
        for index, is_faulty in enumerate(faulty)
    ]


@pytest.mark.parametrize("every", [2, 3, 4, 5])
def test_a_sensor_with_a_loose_contact_is_one_event(every: int) -> None:
    """It is faulty in one of some windows, and works between them; then it is mended."""
    broken, healthy = 60, 3 * INTERMITTENT_WINDOWS
    documents = assessed(sensor_reports([index < broken and index % every == 0 for index in range(broken + healthy)]))
    (raised, _, level), (cleared, change, _) = changes(documents)
    assert (raised, level) == (2 * every, Level.ACT)
    assert change is EventChange.CLEARED
    assert cleared == broken - every + INTERMITTENT_WINDOWS
    assert {event.start for document in documents for event in document.events} == {0.0}
    (event,) = documents[cleared].events
    assert event.end == LENGTH * (broken - every + 1)  # since the first window without the fault


def test_a_rare_fault_of_a_sensor_is_no_event() -> None:
    documents = assessed(sensor_reports([index % INTERMITTENT_WINDOWS == 0 for index in range(100)]))
    assert changes(documents) == []


def test_a_sensor_that_was_wrong_without_a_break_is_cleared_after_three_windows() -> None:
    documents = assessed(sensor_reports([10 <= index < 20 for index in range(40)]))
    assert [(index, change) for index, change, _ in changes(documents)] == [
        (9 + PERSISTENT_WINDOWS, EventChange.RAISED),
        (19 + PERSISTENT_WINDOWS, EventChange.CLEARED),
    ]


@pytest.mark.parametrize("decision", [WindowDecision.STEPPED, WindowDecision.DISCOVERED])
def test_a_class_of_causes_is_cleared_when_it_is_decided(decision: WindowDecision) -> None:
    finding = SENSOR.model_copy(
        update={"id": "undecided", "kind": FindingKind.CLASS, "subject": "", "text": "R_a or V_a"}
    )
    open_windows = [
        report(index, decision=WindowDecision.AMBIGUOUS, status=Status.HELD, findings=(finding,)) for index in range(15)
    ]
    decided = report(15, decision=decision, status=Status.HELD)
    documents = assessed([*open_windows, decided, *(report(index) for index in range(16, 20))])
    assert [(index, change) for index, change, _ in changes(documents)] == [
        (UNDECIDED.rise - 1, EventChange.RAISED),
        (15, EventChange.CLEARED),
    ]


def test_a_later_step_of_another_parameter_does_not_make_a_sudden_change_a_slow_one() -> None:
    reports = [
        report(0),
        report(1),
        report(2, 5.9, decision=WindowDecision.STEPPED),
        *(report(index, 5.9) for index in range(3, 8)),
    ]
    reports += [report(8, 5.9001, decision=WindowDecision.STEPPED), *(report(index, 5.9) for index in range(9, 14))]
    documents = assessed(reports)
    assert len(changes(documents)) == 1
    assert "winding-turns-step" in events(documents[-1])["winding"].condition_id
