"""Sensor checks: faulty data are rejected before estimating, and healthy data are accepted."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.data_checks import spike_records
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument, Status
from otolith.machine import find_twin
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Step
from tests.variants import often, often_rows

Cut = Callable[..., list[tuple[Window, float]]]
Change = Callable[[Array], Array]

TWIN = find_twin("dc_motor")
HEALTHY, SICK = 14, 4  # windows


def problem(*names: str) -> Problem:
    free = tuple(parameter for parameter in TWIN.parameters if parameter.name in names)
    known = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter.name not in names)
    return Problem(TWIN, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))


def run(state: AdaptationState, windows: list[Window]) -> tuple[AdaptationState, list[ReportDocument]]:
    documents = []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(report.document)
    return state, documents


def changed(window: Window, signal: str, change: Change) -> Window:
    values = window.values.copy()
    column = window.signals.index(signal)
    values[:, column] = change(values[:, column])
    return replace(window, values=values)


@pytest.fixture
def quiet(scenario: MotorScenario) -> MotorScenario:
    return scenario.model_copy(update={"faults": ()})


def assert_true(documents: list[ReportDocument], text: str) -> None:
    """Check that no interval is off the truth, and that every reason contains ``text``.

    A frozen or clipped channel has no information, so values are held. A gain or offset is estimated as well, and the
    window goes on to determine the parameters.
    """
    for document in documents:
        for name, parameter in document.parameters.items():
            assert text in parameter.reason
            assert parameter.status in (Status.ESTIMATED, Status.HELD, Status.INVALID)
            assert parameter.status is not Status.ESTIMATED or " reads" in text
            assert parameter.value == pytest.approx(TRUE[name], abs=DEVIATIONS * (parameter.sd or 0.0))


FAULTS: dict[str, tuple[str, str, Change]] = {
    "frozen current": ("i", "i is frozen", lambda values: np.full(len(values), values[0])),
    "frozen half-way": ("omega", "omega is", lambda values: np.where(np.arange(200) < 90, values, values[90])),
    "clipped speed": ("omega", "omega is clipped", lambda values: np.minimum(values, np.quantile(values, 0.6))),
    "spiking current": ("i", "i spikes", lambda values: values + 3.0 * (np.arange(200) % 15 == 7)),
    "gain of the current": ("i", "i reads", lambda values: 1.05 * values),
    "gain of the speed": ("omega", "omega reads", lambda values: 0.95 * values),
}


@pytest.mark.parametrize("names", [("R_a",), ("R_a", "D")], ids="-".join)
@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_sensor_does_not_update_the_posterior(
    quiet: MotorScenario, windows: Cut, fault: str, names: tuple[str, ...]
) -> None:
    signal, text, change = FAULTS[fault]
    record = [window for window, _ in windows(quiet, 14)]
    state, _ = run(initial_state("motor", "here", problem(*names)), record[:10])
    faulty = changed(record[10], signal, change)  # the set-point has just doubled, so that all states change
    after, documents = run(state, [faulty])
    assert_true(documents, text)
    assert documents[0].decision is WindowDecision.SENSOR
    assert after.posterior is state.posterior


TRUE = {"R_a": 6.5, "D": 0.00143}  # Ω, N·m·s/rad
DEVIATIONS = 4.0  # standard deviations: several hundred values are compared
LASTING = ("gain of the current", ("R_a", "D"))
LASTING_FAULTS: dict[str, tuple[str, Change]] = {
    "gain of the current": ("i", lambda values: 1.05 * values),
    "offset of the current": ("i", lambda values: values + 0.05),
    "gain of the speed": ("omega", lambda values: 1.05 * values),
}


@pytest.mark.parametrize(
    ("fault", "names"),
    often_rows([LASTING], [*((fault, ("R_a",)) for fault in LASTING_FAULTS), LASTING]),
    ids=str,
)
def test_lasting_sensor_fault_is_never_a_parameter_step(
    quiet: MotorScenario, windows: Cut, fault: str, names: tuple[str, ...]
) -> None:
    """The set-point rises and falls for 90 s. Every report names the faulty sensor."""
    signal, change = LASTING_FAULTS[fault]
    record = [window for window, _ in windows(quiet, 55)]
    state, _ = run(initial_state("motor", "here", problem(*names)), record[:10])
    _, documents = run(state, [changed(window, signal, change) for window in record[10:]])
    assert {document.decision for document in documents} == {WindowDecision.SENSOR}
    assert all(f"{signal} reads" in document.parameters["R_a"].reason for document in documents)
    resistance = documents[-1].parameters["R_a"]
    assert resistance.status is Status.ESTIMATED
    assert resistance.value == pytest.approx(TRUE["R_a"], abs=DEVIATIONS * (resistance.sd or 0.0))


@pytest.mark.parametrize("names", [("R_a",), ("R_a", "D"), ("R_a", "D", "J")], ids="-".join)
@pytest.mark.parametrize("moment", often([30.9], [30.0, 30.9, 41.1]))
def test_resistance_step_is_tracked_within_three_windows(
    quiet: MotorScenario, windows: Cut, names: tuple[str, ...], moment: float
) -> None:
    fault = Step.model_validate({"kind": "step", "parameter": "R_a", "start": f"{moment} s", "amount": "-0.65 ohm"})
    record = windows(quiet.model_copy(update={"faults": (fault,)}), 24)
    _, documents = run(initial_state("motor", "here", problem(*names)), [window for window, _ in record])
    first = int(moment / 2.0)  # the window that contains the step
    for document in documents[10:first]:
        assert document.decision is WindowDecision.LEARNED
    tracked = documents[first + 2].parameters["R_a"]
    assert tracked.status is Status.ESTIMATED
    assert tracked.low is not None
    assert tracked.high is not None
    assert tracked.value == pytest.approx(5.85, rel=0.005)
    for document in documents[first + 3 :]:
        assert document.parameters["R_a"].value == pytest.approx(5.85, rel=0.005)


def test_spikes_are_excluded_and_other_records_are_used(quiet: MotorScenario, windows: Cut) -> None:
    record = [window for window, _ in windows(quiet, 11)]
    state, _ = run(initial_state("motor", "here", problem("R_a")), record[:10])

    def spike(values: Array) -> Array:
        values[[40, 120]] += [2.0, -5.0]
        return values

    _, (document,) = run(state, [changed(record[10], "i", spike)])
    resistance = document.parameters["R_a"]
    assert resistance.status is Status.ESTIMATED
    assert "2 spikes" in resistance.reason
    assert resistance.value == pytest.approx(6.5, rel=0.005)


def test_noise_steps_and_kinks_are_not_spikes() -> None:
    random = np.random.default_rng(8)
    time = 0.01 * np.arange(400)
    curves = [
        random.normal(size=400),
        np.where(time > 2.0, 5.0, 0.0) + 0.01 * random.normal(size=400),
        np.maximum(time - 2.0, 0.0) * 50.0 + 0.01 * random.normal(size=400),
        np.exp(-5.0 * np.maximum(time - 2.0, 0.0)) * (time > 2.0),
        np.zeros(400),
        np.rint(3.0 * np.sin(4.0 * time)),
    ]
    for curve in curves:
        assert not spike_records(curve, 0.01).any()


def test_healthy_machine_has_no_sensor_fault(quiet: MotorScenario, windows: Cut) -> None:
    """Ten minutes of rest and motion with rising and falling set-points."""
    state, documents = run(
        initial_state("motor", "here", problem("R_a", "D")), [window for window, _ in windows(quiet, 300)]
    )
    assert {document.decision for document in documents} == {WindowDecision.LEARNED}
    assert state.contradictions == 0
