"""Discovery: components that the twin lacks are identified, and distinguished from other causes."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.discovery.motor import Faults, J, simulate_motor, windows

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import (
    AdaptationState,
    OperatorDecisions,
    apply_decisions,
    component_records,
    initial_state,
    restore_components,
)
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.decision import Approval
from otolith.discovery.hypotheses import FaultType
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.health.text import undecided_text
from otolith.machine import find_twin
from otolith.twin.components import sites, sources
from tests.variants import often

TWIN = find_twin("dc_motor")
Torque = Callable[[float, float, float, float, float, float], float]


def problem(*names: str) -> Problem:
    free = tuple(parameter for parameter in TWIN.parameters if parameter.name in names)
    known = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter.name not in names)
    return Problem(TWIN, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))


def simulated(kind: str, seconds: float, faults: Faults, seed: int = 3) -> list[Window]:
    return windows(simulate_motor(kind, seconds, faults, seed))


def run(state: AdaptationState, record: list[Window]) -> tuple[AdaptationState, list[ReportDocument]]:
    documents = []
    for window in record:
        state, report = adapt(state, window)
        documents.append(report.document)
    return state, documents


def initial(*names: str) -> AdaptationState:
    return initial_state("motor", "here", problem(*names))


@pytest.mark.parametrize("order", often([2.0], [1.0, 2.0]))
def test_shaft_order_is_identified_while_the_speed_changes(order: float) -> None:
    def torque(t: float, angle: float, *_: float) -> float:
        return 0.004 * math.sin(order * angle + 1.0)

    _, documents = run(initial("R_a", "D"), simulated("sweep", 20, Faults(torque=torque, since=5.0)))
    assert [document.decision for document in documents[:2]] == [WindowDecision.LEARNED] * 2
    (component,) = documents[-1].components
    assert (component.site, component.family, component.input) == ("shaft", "periodic", "angle(omega)")
    assert component.values["order"].value == pytest.approx(order, abs=0.01)
    assert component.values["amplitude"].low < 0.004 < component.values["amplitude"].high
    assert component.onset == pytest.approx(5.0, abs=0.3)
    assert documents[-1].model == "DT''"
    suspected = next(document for document in documents if document.explanations)
    assert suspected.decision is WindowDecision.SUSPECTED
    told = [undecided_text(document) for document in documents]
    assert any(text.startswith(("new torque on the shaft since", "something has changed since")) for text in told)
    assert not any("sin(" in text for text in told)
    assert told[-1] == ""


def test_fixed_frequency_and_coherent_phase_are_identified() -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t)

    state, documents = run(initial("R_a", "D"), simulated("steps", 30, Faults(torque=torque, since=5.0)))
    (component,) = documents[-1].components
    assert (component.family, component.input) == ("periodic", "t")
    frequency, amplitude = component.values["frequency"], component.values["amplitude"]
    assert frequency.value == pytest.approx(10.0, rel=2e-4)
    assert frequency.sd < 0.002  # one window alone gives 0.01
    assert amplitude.value == pytest.approx(5.0 * J, rel=0.01)
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.001)
    assert documents[-1].fit is not None
    assert documents[-1].fit.rmse_completed is not None
    assert documents[-1].fit.rmse_completed["omega"] < 0.1 * documents[-1].fit.rmse_estimated["omega"]
    assert state.test is None


def test_coulomb_friction_is_selected_over_similar_forms() -> None:
    def torque(*moment: float) -> float:
        return -0.004 * float(np.sign(moment[-1]))

    _, documents = run(initial("R_a", "D"), simulated("reversing", 16, Faults(torque=torque, since=5.0)))
    (component,) = documents[-1].components
    assert (component.family, component.input) == ("Coulomb", "omega")
    assert (component.conditions, component.domain) == ("dry friction", "inputs that change their sign")
    assert component.values["amplitude"].value == pytest.approx(-0.004, rel=0.02)


def test_indistinguishable_hypotheses_are_not_adopted() -> None:
    """A constant torque and an offset of the load sensor have the same effect on all signals."""
    state, documents = run(initial("R_a", "D"), simulated("steps", 24, Faults(torque=lambda *_: 0.003, since=6.5)))
    last = documents[-1]
    assert last.decision is WindowDecision.AMBIGUOUS
    texts = [(hypothesis.reason, hypothesis.text) for hypothesis in last.explanations]
    assert any(fault_type is FaultType.SENSOR and "T_load" in text for fault_type, text in texts)
    assert any(fault_type is FaultType.COMPONENT and text.startswith("shaft: 0.00") for fault_type, text in texts)
    shares = [hypothesis.probability for hypothesis in last.explanations]
    assert shares == pytest.approx([0.5, 0.5], abs=1e-3)
    assert 0.99 < sum(shares) <= 1.0  # other hypotheses are too unlikely to be reported
    assert not last.components
    resistance = last.parameters["R_a"]
    assert resistance.status is Status.ESTIMATED  # both explanations give it the same value
    assert resistance.value == pytest.approx(6.5, abs=3.3 * (resistance.sd or 0.0))
    assert last.findings[-1].advice
    assert state.problem.components == ()


def test_component_that_disappears_is_removed() -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t) if t < 18.0 else 0.0

    state, documents = run(initial("R_a", "D"), simulated("steps", 44, Faults(torque=torque, since=3.0)))
    assert any(document.components for document in documents)
    assert WindowDecision.FADED in {document.decision for document in documents}
    assert state.problem.components == ()
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


@pytest.mark.parametrize("operation", often(["steps", "reversing"], ["steps", "constant", "sweep", "reversing"]))
def test_healthy_machine_adopts_no_component(operation: str) -> None:
    state, documents = run(initial("R_a", "D"), simulated(operation, 60, Faults(), seed=11))
    assert not any(document.components for document in documents)
    assert sum(document.decision is not WindowDecision.LEARNED for document in documents) == 0
    assert state.adopted == ()


def test_restored_component_follows_operator_decisions() -> None:
    def torque(t: float, angle: float, *_: float) -> float:
        return 0.004 * math.sin(angle)

    record = simulated("sweep", 40, Faults(torque=torque, since=1.0))
    state, documents = run(initial("R_a", "D"), record[:10])
    (component,) = documents[-1].components
    assert documents[-1].findings
    restored = restore_components(initial("R_a", "D"), component_records(state))
    restored, documents = run(restored, record[12:16])  # a pause: the shaft angle is unknown
    assert {document.decision for document in documents} == {WindowDecision.LEARNED}
    assert documents[-1].components[0].values["amplitude"].value == pytest.approx(0.004, rel=0.03)

    approved = apply_decisions(restored, OperatorDecisions(approved=frozenset({component.id})))
    _, documents = run(approved, record[16:17])
    assert documents[0].components[0].approval is Approval.APPROVED
    assert not documents[0].findings

    rejected = apply_decisions(restored, OperatorDecisions(rejected=frozenset({component.id})))
    assert rejected.problem.components == ()
    _, documents = run(rejected, record[16:20])
    assert all(other.id != component.id for document in documents for other in document.components)

    forgotten = apply_decisions(restored, OperatorDecisions(forgotten={component.id: 1e6}))
    assert forgotten.problem.components == ()
    _, documents = run(forgotten, record[16:20])
    assert documents[-1].components[0].id == component.id


def test_discovery_can_be_switched_off() -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t)

    quiet = initial_state("motor", "here", replace(problem("R_a", "D"), discover=False))
    _, documents = run(quiet, simulated("steps", 14, Faults(torque=torque, since=4.0)))
    assert not any(document.components for document in documents)
    assert documents[-1].decision is not WindowDecision.LEARNED


@pytest.mark.parametrize(("operation", "order", "amplitude"), [("steps", 3.0, 0.001), ("sweep", 1.0, 0.0003)])
def test_excluded_components_start_no_search(operation: str, order: float, amplitude: float) -> None:
    def torque(t: float, angle: float, *_: float) -> float:
        return amplitude * math.sin(order * angle + 1.0)

    record = simulated(operation, 20, Faults(torque=torque, since=4.0))
    _, free = run(initial("R_a", "D"), record)
    assert any(document.cost.searched for document in free)
    periodic = frozenset(
        f"{site.name}/periodic/{source.name}" for site in sites(TWIN) for source in sources(TWIN) if source.name
    )
    for state in (
        apply_decisions(initial("R_a", "D"), OperatorDecisions(rejected=periodic)),
        initial_state("motor", "here", replace(problem("R_a", "D"), excluded=periodic)),
    ):
        _, documents = run(state, record)
        assert not any(document.cost.searched for document in documents)
        assert not any(document.components for document in documents)


def with_other_motors(*resistances: float) -> list[Window]:
    """Ten healthy windows, then one of another motor for each of ``resistances`` (ohm)."""
    record = simulated("steps", 20 + 2 * len(resistances), Faults())
    for place, resistance in enumerate(resistances, start=10):
        other = simulated("steps", 20 + 2 * len(resistances), Faults(resistance=resistance))[place]
        record[place] = replace(record[place], values=other.values)
    return record


def test_one_wrong_window_only_raises_the_variance_ratio() -> None:
    before, _ = run(initial("R_a"), with_other_motors(6.5)[:10])
    state, documents = run(initial("R_a"), with_other_motors(4.0, 6.5, 6.5))
    assert documents[10].decision is WindowDecision.SUSPECTED
    assert documents[11].decision is WindowDecision.LEARNED
    assert documents[11].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)
    assert state.posterior.belief.variance_ratio > before.posterior.belief.variance_ratio


def test_contradictory_windows_are_not_a_parameter_step() -> None:
    """Each may show a change that the next one contradicts: the value before stays within the interval."""
    state, documents = run(initial("R_a"), with_other_motors(4.5, 8.5, 4.0, 9.0, 5.0))
    assert {document.decision for document in documents[10:]} <= {WindowDecision.SUSPECTED, WindowDecision.REFUSED}
    assert state.posterior.prior().mean[0] == pytest.approx(6.5, rel=0.01)
    for document in documents[10:]:
        known = document.parameters["R_a"]
        assert known.status is not Status.ESTIMATED
        assert known.low is not None
        assert known.high is not None
        assert known.low <= 6.5 <= known.high


def two_terms(*moment: float) -> float:
    return 0.004 * math.sin(moment[1]) - 0.003 * float(np.sign(moment[-1]))


@cache
def with_two_terms() -> AdaptationState:
    """The state after both terms were adopted."""
    return run(initial("R_a", "D"), simulated("reversing", 24, Faults(torque=two_terms, since=3.0)))[0]


@pytest.mark.full
def test_remaining_component_keeps_its_values() -> None:
    state = with_two_terms()
    before = {record.adopted.component.key: record.values[0] for record in component_records(state)}
    assert len(before) == 2
    first = state.problem.components[0].key
    after = apply_decisions(state, OperatorDecisions(rejected=frozenset({first})))
    (remaining,) = component_records(after)
    assert remaining.adopted.component.key != first
    assert remaining.values[0] == pytest.approx(before[remaining.adopted.component.key], rel=1e-6)


@pytest.mark.parametrize("jump", [-1e6, 1e5, 1e9])
def test_clock_jump_resets_only_the_phase(jump: float) -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t)

    record = simulated("steps", 36, Faults(torque=torque, since=3.0))
    state, documents = run(initial("R_a", "D"), record[:10])
    assert documents[-1].components
    later = [replace(window, start=window.start + jump) for window in record[10:]]
    _, documents = run(state, later)
    assert {document.decision for document in documents} == {WindowDecision.LEARNED}
    assert documents[-1].components[0].values["frequency"].value == pytest.approx(10.0, rel=1e-3)
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


@pytest.mark.full
def test_one_of_three_components_disappears_and_two_remain() -> None:
    def torque(*moment: float) -> float:
        return two_terms(*moment) + (0.01 * math.sin(25.0 * moment[0]) if 6.0 < moment[0] < 14.0 else 0.0)

    state = with_two_terms()
    remaining = {component.key for component in state.problem.components}
    assert len(remaining) == 2
    state, documents = run(
        restore_components(initial("R_a", "D"), component_records(state)),
        simulated("reversing", 24, Faults(torque=torque)),
    )
    most = max(documents, key=lambda document: len(document.components))
    assert len(most.components) == 3
    assert {component.id for component in documents[-1].components} == remaining
    assert {adopted.component.key for adopted in state.adopted} == remaining
    assert WindowDecision.FADED in {
        document.decision for document in documents[7:9]
    }  # the component disappears at 14 s, the end of window 6
    assert {document.decision for document in documents[9:]} == {WindowDecision.LEARNED}
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


@pytest.mark.full
def test_search_refuses_a_fourth_component() -> None:
    """The twin has three components, its limit. Windows with a fourth are refused and do not update the posterior."""
    state = with_two_terms()
    adopted = state.adopted[0]
    third = replace(adopted, component=replace(adopted.component, site="winding", family="linear", source="V_a"))
    keeping = (
        *component_records(state),
        replace(component_records(state)[0], adopted=third, values=(1e-6,), deviations=(1e-3,)),
    )
    full = restore_components(initial("R_a", "D"), keeping)
    three = [component.key for component in full.problem.components]
    assert len(three) == 3

    def more(*moment: float) -> float:
        return two_terms(*moment) + (0.01 * math.sin(25.0 * moment[0]) if moment[0] < 4.0 else 0.0)

    _, documents = run(full, simulated("reversing", 16, Faults(torque=more)))
    for document in documents[:2]:
        assert document.decision is WindowDecision.REFUSED
        assert [component.id for component in document.components] == three
        assert document.parameters["R_a"].status in (Status.UNESTIMATED, Status.INVALID)
        assert document.decision.value in document.parameters["R_a"].reason
        names = [hypothesis.text for hypothesis in document.explanations if hypothesis.reason is FaultType.PARAMETER]
        assert not any(component in name.split(" and ") for name in names for component in three)
    assert WindowDecision.REFUSED not in {document.decision for document in documents[2:]}
    assert {document.decision for document in documents[-3:]} == {WindowDecision.LEARNED}
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)
    assert len(documents[-1].components) == 2  # the restored third component does not exist in the plant
