"""Discovery: what is found of a component that the twin lacks, told from what else could have happened."""

import math
from collections.abc import Callable
from dataclasses import replace

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
from otolith.discovery.adopted import Approval
from otolith.discovery.decision import WindowDecision
from otolith.discovery.hypotheses import FaultType
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith.twin.augmentation import sites, sources

TWIN = find_twin("dc_motor")
Torque = Callable[[float, float, float, float, float, float], float]


def problem(*names: str) -> Problem:
    free = tuple(entry for entry in TWIN.parameters if entry.name in names)
    known = tuple((entry.name, entry.nominal) for entry in TWIN.parameters if entry.name not in names)
    return Problem(TWIN, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))


def lived(kind: str, seconds: float, faults: Faults, seed: int = 3) -> list[Window]:
    return windows(simulate_motor(kind, seconds, faults, seed))


def run(state: AdaptationState, record: list[Window]) -> tuple[AdaptationState, list[ReportDocument]]:
    found = []
    for window in record:
        state, report = adapt(state, window)
        found.append(report.document)
    return state, found


def begun(*names: str) -> AdaptationState:
    return initial_state("motor", "here", problem(*names))


@pytest.mark.parametrize("order", [1.0, 2.0])
def test_a_term_of_the_shaft_is_found_with_its_order_while_the_speed_changes(order: float) -> None:
    def torque(t: float, angle: float, *_: float) -> float:
        return 0.004 * math.sin(order * angle + 1.0)

    _, documents = run(begun("R_a", "D"), lived("sweep", 20, Faults(torque=torque, since=5.0)))
    assert [document.decision for document in documents[:2]] == [WindowDecision.LEARNED] * 2
    (found,) = documents[-1].components
    assert (found.site, found.family, found.input) == ("shaft", "periodic", "angle(omega)")
    assert found.values["order"].value == pytest.approx(order, abs=0.01)
    assert found.values["amplitude"].low < 0.004 < found.values["amplitude"].high
    assert found.onset == pytest.approx(5.0, abs=0.3)
    assert documents[-1].model == "DT''"
    suspicion = next(document for document in documents if document.explanations)
    assert suspicion.decision is WindowDecision.SUSPECTED


def test_a_fixed_frequency_is_found_as_one_and_its_phase_stays_coherent() -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t)

    state, documents = run(begun("R_a", "D"), lived("steps", 30, Faults(torque=torque, since=5.0)))
    (found,) = documents[-1].components
    assert (found.family, found.input) == ("periodic", "t")
    frequency, amplitude = found.values["frequency"], found.values["amplitude"]
    assert frequency.value == pytest.approx(10.0, rel=2e-4)
    assert frequency.sd < 0.002  # one window alone knows it to 0.01
    assert amplitude.value == pytest.approx(5.0 * J, rel=0.01)
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.001)
    assert documents[-1].fit is not None
    assert documents[-1].fit.rmse_completed is not None
    assert documents[-1].fit.rmse_completed["omega"] < 0.1 * documents[-1].fit.rmse_estimated["omega"]
    assert state.test is None


def test_coulomb_friction_is_told_from_what_looks_like_it() -> None:
    def torque(*moment: float) -> float:
        return -0.004 * float(np.sign(moment[-1]))

    _, documents = run(begun("R_a", "D"), lived("reversing", 16, Faults(torque=torque, since=5.0)))
    (found,) = documents[-1].components
    assert (found.family, found.input) == ("Coulomb", "omega")
    assert (found.conditions, found.domain) == ("dry friction", "inputs that change their sign")
    assert found.values["amplitude"].value == pytest.approx(-0.004, rel=0.02)


def test_what_cannot_be_told_apart_is_named_together_and_nothing_is_taken_over() -> None:
    """A constant torque, and an offset of the load sensor: the same to everybody who hears both signals."""
    state, documents = run(begun("R_a", "D"), lived("steps", 24, Faults(torque=lambda *_: 0.003, since=6.5)))
    last = documents[-1]
    assert last.decision is WindowDecision.SUSPECTED
    texts = [(entry.reason, entry.text) for entry in last.explanations]
    assert any(reason is FaultType.SENSOR and "T_load" in text for reason, text in texts)
    assert any(reason is FaultType.COMPONENT and text.startswith("shaft: 0.00") for reason, text in texts)
    shares = [entry.probability for entry in last.explanations]
    assert shares == sorted(shares, reverse=True)
    assert 0.99 < sum(shares) <= 1.0  # nothing else is as likely as to be worth a word
    assert shares[-1] > 0.01
    assert not last.components
    assert last.parameters["R_a"].status is Status.HELD
    assert last.findings[-1].advice
    assert state.problem.components == ()


def test_a_component_that_goes_away_fades() -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t) if t < 18.0 else 0.0

    state, documents = run(begun("R_a", "D"), lived("steps", 44, Faults(torque=torque, since=3.0)))
    assert any(document.components for document in documents)
    assert WindowDecision.FADED in {document.decision for document in documents}
    assert state.problem.components == ()
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


@pytest.mark.parametrize("operation", ["steps", "constant", "sweep", "reversing"])
def test_a_healthy_machine_grows_nothing(operation: str) -> None:
    state, documents = run(begun("R_a", "D"), lived(operation, 60, Faults(), seed=11))
    assert not any(document.components for document in documents)
    assert sum(document.decision is not WindowDecision.LEARNED for document in documents) == 0
    assert state.adopted == ()


def test_a_machine_with_an_unbalance_is_restored_after_a_restart_and_obeys_the_specialist() -> None:
    def torque(t: float, angle: float, *_: float) -> float:
        return 0.004 * math.sin(angle)

    record = lived("sweep", 40, Faults(torque=torque, since=1.0))
    state, documents = run(begun("R_a", "D"), record[:10])
    (found,) = documents[-1].components
    assert documents[-1].findings
    again = restore_components(begun("R_a", "D"), component_records(state))
    again, documents = run(again, record[12:16])  # some time has passed, and nobody has counted turns
    assert {document.decision for document in documents} == {WindowDecision.LEARNED}
    assert documents[-1].components[0].values["amplitude"].value == pytest.approx(0.004, rel=0.03)

    approved = apply_decisions(again, OperatorDecisions(approved=frozenset({found.id})))
    _, documents = run(approved, record[16:17])
    assert documents[0].components[0].approval is Approval.APPROVED
    assert not documents[0].findings

    rejected = apply_decisions(again, OperatorDecisions(rejected=frozenset({found.id})))
    assert rejected.problem.components == ()
    _, documents = run(rejected, record[16:20])
    assert all(entry.id != found.id for document in documents for entry in document.components)

    forgotten = apply_decisions(again, OperatorDecisions(forgotten={found.id: 1e6}))
    assert forgotten.problem.components == ()
    _, documents = run(forgotten, record[16:20])
    assert documents[-1].components[0].id == found.id


def test_discovery_can_be_switched_off() -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t)

    quiet = initial_state("motor", "here", replace(problem("R_a", "D"), discover=False))
    _, documents = run(quiet, lived("steps", 14, Faults(torque=torque, since=4.0)))
    assert not any(document.components for document in documents)
    assert documents[-1].decision is not WindowDecision.LEARNED


@pytest.mark.parametrize(("operation", "order", "amplitude"), [("steps", 3.0, 0.001), ("sweep", 1.0, 0.0003)])
def test_what_is_not_to_be_looked_for_starts_no_search(operation: str, order: float, amplitude: float) -> None:
    def torque(t: float, angle: float, *_: float) -> float:
        return amplitude * math.sin(order * angle + 1.0)

    record = lived(operation, 20, Faults(torque=torque, since=4.0))
    _, free = run(begun("R_a", "D"), record)
    assert any(document.cost.searched for document in free)
    periodic = frozenset(
        f"{site.name}/periodic/{source.name}" for site in sites(TWIN) for source in sources(TWIN) if source.name
    )
    for state in (
        apply_decisions(begun("R_a", "D"), OperatorDecisions(rejected=periodic)),
        initial_state("motor", "here", replace(problem("R_a", "D"), excluded=periodic)),
    ):
        _, documents = run(state, record)
        assert not any(document.cost.searched for document in documents)
        assert not any(document.components for document in documents)


def patched(*resistances: float) -> list[Window]:
    """Ten healthy windows, then one of another motor for each of ``resistances`` (ohm)."""
    record = lived("steps", 20 + 2 * len(resistances), Faults())
    for place, resistance in enumerate(resistances, start=10):
        other = lived("steps", 20 + 2 * len(resistances), Faults(resistance=resistance))[place]
        record[place] = replace(record[place], values=other.values)
    return record


def test_one_wrong_window_changes_nothing_but_confidence() -> None:
    before, _ = run(begun("R_a"), patched(6.5)[:10])
    state, documents = run(begun("R_a"), patched(4.0, 6.5, 6.5))
    assert documents[10].decision is WindowDecision.SUSPECTED
    assert documents[11].decision is WindowDecision.LEARNED
    assert documents[11].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)
    assert state.posterior.belief.variance_ratio > before.posterior.belief.variance_ratio


def test_windows_that_contradict_each_other_never_become_a_step() -> None:
    _, documents = run(begun("R_a"), patched(4.5, 8.5, 4.0, 9.0, 5.0))
    assert {document.decision for document in documents[10:]} <= {WindowDecision.SUSPECTED, WindowDecision.REFUSED}
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.01)


def two_terms(*moment: float) -> float:
    return 0.004 * math.sin(moment[1]) - 0.003 * float(np.sign(moment[-1]))


def test_what_stays_keeps_its_numbers_when_another_leaves() -> None:
    state, _ = run(begun("R_a", "D"), lived("reversing", 24, Faults(torque=two_terms, since=3.0)))
    before = {entry.adopted.component.key: entry.values[0] for entry in component_records(state)}
    assert len(before) == 2
    first = state.problem.components[0].key
    after = apply_decisions(state, OperatorDecisions(rejected=frozenset({first})))
    (left,) = component_records(after)
    assert left.adopted.component.key != first
    assert left.values[0] == pytest.approx(before[left.adopted.component.key], rel=1e-6)


@pytest.mark.parametrize("jump", [-1e6, 1e5, 1e9])
def test_a_clock_that_is_set_costs_the_phase_and_nothing_else(jump: float) -> None:
    def torque(t: float, *_: float) -> float:
        return 5.0 * J * math.sin(10.0 * t)

    record = lived("steps", 36, Faults(torque=torque, since=3.0))
    state, documents = run(begun("R_a", "D"), record[:10])
    assert documents[-1].components
    later = [replace(window, start=window.start + jump) for window in record[10:]]
    _, documents = run(state, later)
    assert {document.decision for document in documents} == {WindowDecision.LEARNED}
    assert documents[-1].components[0].values["frequency"].value == pytest.approx(10.0, rel=1e-3)
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


def test_of_several_components_one_that_goes_away_leaves_and_the_others_stay() -> None:
    def torque(*moment: float) -> float:
        return two_terms(*moment) + (0.01 * math.sin(25.0 * moment[0]) if 6.0 < moment[0] < 14.0 else 0.0)

    state, _ = run(begun("R_a", "D"), lived("reversing", 24, Faults(torque=two_terms, since=3.0)))
    two = {entry.key for entry in state.problem.components}
    assert len(two) == 2
    state, documents = run(
        restore_components(begun("R_a", "D"), component_records(state)), lived("reversing", 24, Faults(torque=torque))
    )
    most = max(documents, key=lambda document: len(document.components))
    assert len(most.components) == 3
    assert {entry.id for entry in documents[-1].components} == two
    assert {entry.component.key for entry in state.adopted} == two
    assert WindowDecision.FADED in {
        document.decision for document in documents[7:9]
    }  # it went in the last moment of the seventh
    assert {document.decision for document in documents[9:]} == {WindowDecision.LEARNED}
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)


def test_a_twin_that_is_full_goes_on() -> None:
    """Three components are in it: what comes then is said to be more than can be explained, and teaches nothing."""
    state, _ = run(begun("R_a", "D"), lived("reversing", 24, Faults(torque=two_terms, since=3.0)))
    entry = state.adopted[0]
    third = replace(entry, component=replace(entry.component, site="winding", family="linear", source="V_a"))
    keeping = (
        *component_records(state),
        replace(component_records(state)[0], adopted=third, values=(1e-6,), deviations=(1e-3,)),
    )
    full = restore_components(begun("R_a", "D"), keeping)
    three = [component.key for component in full.problem.components]
    assert len(three) == 3

    def more(*moment: float) -> float:
        return two_terms(*moment) + (0.01 * math.sin(25.0 * moment[0]) if moment[0] < 8.0 else 0.0)

    _, documents = run(full, lived("reversing", 20, Faults(torque=more)))
    for document in documents[:4]:
        assert document.decision is WindowDecision.REFUSED
        assert [entry.id for entry in document.components] == three
        assert document.parameters["R_a"].status in (Status.UNESTIMATED, Status.INVALID)
        assert document.decision.value in document.parameters["R_a"].reason
        names = [entry.text for entry in document.explanations if entry.reason is FaultType.PARAMETER]
        assert not any(component in name.split(" and ") for name in names for component in three)
    assert WindowDecision.REFUSED not in {document.decision for document in documents[4:]}
    assert {document.decision for document in documents[-3:]} == {WindowDecision.LEARNED}
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.5, rel=0.002)
    assert len(documents[-1].components) == 2  # the third one was never there
