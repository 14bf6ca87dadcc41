"""Warming up is not wear: limits are judged at the reference temperature, or the finding names the temperature."""

from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.ring import MAX_OBSERVED_AGE, Rings
from otolith.acquisition.window import Verdict, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.events import HealthState, assess
from otolith.health.limits import Level, Limit, MonitoredQuantity, coldness_after
from otolith.health.schema import (
    EventDocument,
    ParameterDocument,
    QualityDocument,
    ReportDocument,
    Status,
    WindowDocument,
)
from otolith.health.text import announcements
from otolith.machine import LoadedMachine, find_twin, library_twins, load_machine, load_rules
from otolith.runtime.replay import Replay, open_recorded
from otolith_drivers.base import Sample
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Drift, Step
from otolith_drivers.plant.scenario import load_scenario, simulate
from otolith_drivers.units import limit_values
from tests.conftest import EXAMPLES, SIGNALS, OwnMachine
from tests.messages import assert_says, raises_saying

COPPER, RISE, WINDOWS = 0.00393, 40.0, 60  # 1/K, K
PERIOD, RECORDS = 0.01, 200
ROW = 'R_a = { value = "6.5 ohm", estimate = true, watch = ["-2 %", "+5 %"], act = ["-5 %", "+10 %"]'
MEASURED = ', temperature = "winding_temperature"'


WARMER = {"R_": 105.0, "K_": 60.0, "psi": 80.0}  # K: of copper of thermal class F (IEC 60034-1), ferrite, neodymium


@pytest.mark.parametrize("name", library_twins())
def test_a_warm_healthy_machine_is_within_the_limits_of_its_twin(name: str) -> None:
    """No temperature is measured, and the stated values are those of the cold machine."""
    for parameter in find_twin(name).parameters:
        rise = next((rise for begin, rise in WARMER.items() if parameter.name.startswith(begin)), 0.0)
        assert bool(parameter.temperature_coefficient) == bool(rise), f"{parameter.name} depends on the temperature"
        limits = [
            Limit(level, value, value < parameter.nominal)
            for level, texts in ((Level.WATCH, parameter.watch), (Level.ACT, parameter.act))
            for value in limit_values(texts, parameter.unit, parameter.nominal)
        ]
        quantity = MonitoredQuantity(nominal=parameter.nominal, limits=tuple(limits))
        warm = parameter.nominal * (1.0 + parameter.temperature_coefficient * rise)
        assert quantity.level(warm, 0.0, Level.OK) == (Level.OK, None)


def machine_with(own_machine: OwnMachine, extra: str, signals: str = "") -> LoadedMachine:
    text = own_machine.machine.read_text(encoding="utf-8")
    lines = [f"{ROW}{extra} }}" if line.startswith("R_a = ") else line for line in text.splitlines()]
    text = "\n".join(lines).replace("[signals]", f"[signals]\n{signals}")
    own_machine.machine.write_text(text + "\n", encoding="utf-8")
    return load_machine(own_machine.machine, with_driver=False)


def warming(until: float = RISE) -> tuple[list[Window], list[float]]:
    """Windows of the demo's motor whose winding warms up from 20 °C, with the rise at the end of each, K."""
    rate = 1.0 / 30.0
    final = 6.5 * COPPER * until
    drift = {"kind": "drift", "parameter": "R_a", "start": "0 s", "amount": f"{-final} ohm", "rate": f"{-rate} 1/s"}
    scenario = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(scenario, MotorScenario)
    scenario = scenario.model_copy(update={"faults": (Drift.model_validate(drift),)})
    ticks, windows = simulate(scenario), []
    for index in range(WINDOWS):
        rows = [[tick.measured[name] for name in SIGNALS.values()] for tick in islice(ticks, RECORDS)]
        windows.append(Window.whole(index, index * PERIOD * RECORDS, PERIOD, tuple(SIGNALS), np.array(rows)))
    times = np.arange(WINDOWS) * PERIOD * RECORDS + 1.0
    return windows, (-until * np.expm1(-rate * times)).tolist()


def reports(machine: LoadedMachine, windows: list[Window]) -> list[ReportDocument]:
    state, documents = initial_state("m", "s", machine.problem, machine.plan), []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(report.document)
    return documents


def events(documents: list[ReportDocument]) -> list[EventDocument]:
    return [event for document in documents for event in announcements(document)]


def test_a_motor_that_warms_up_by_40_kelvin_is_no_finding(own_machine: OwnMachine) -> None:
    windows, rises = warming()
    measured = [
        replace(window, observed={"winding_temperature": 293.15 + rise})
        for window, rise in zip(windows, rises, strict=True)
    ]
    documents = reports(machine_with(own_machine, MEASURED), measured)
    assert events(documents) == []
    last = documents[-1].parameters["R_a"]
    assert last.value == pytest.approx(6.5 * (1.0 + COPPER * rises[-1]), rel=0.01)
    assert last.referred == pytest.approx(6.5, rel=0.01)
    assert last.forecast is not None
    assert last.forecast.act is None
    assert documents[-1].window.observed == measured[-1].observed


def test_without_a_temperature_the_finding_names_it(own_machine: OwnMachine) -> None:
    windows, rises = warming()
    (*_, event) = events(reports(machine_with(own_machine, ""), windows))
    assert (event.part, event.state) == ("winding", Level.ACT)
    assert "hotter than at its nominal value or a contact" in event.condition
    kelvin = float(event.text.rpartition("; being ")[2].split()[0])
    assert 0.1 / COPPER < kelvin < max(rises)
    assert "no temperature is measured" in event.text


def test_wear_of_a_warm_winding_is_a_finding(own_machine: OwnMachine) -> None:
    """Turns short out of a winding at 60 °C: the resistance alone is inside its limits."""
    windows, _ = warming(0.0)
    warm = [replace(window, observed={"winding_temperature": 333.15}) for window in windows[:10]]
    (event,) = events(reports(machine_with(own_machine, MEASURED), warm))
    assert (event.part, event.state) == ("winding", Level.ACT)
    assert "(-13.6% at 20 °C)" in event.text


def test_a_temperature_that_fails_is_named_and_no_limit_is_judged_without_it(own_machine: OwnMachine) -> None:
    windows, _ = warming()
    documents = reports(machine_with(own_machine, MEASURED), windows)
    (event,) = events(documents)
    assert (event.part, event.state, event.condition) == ("winding", Level.NO_DATA, "no temperature")
    health = documents[-1].health
    assert health is not None
    assert (health.parts["winding"].state, health.parts["shaft"].state) == (Level.NO_DATA, Level.OK)


def test_a_table_has_the_temperature_as_one_more_column(own_machine: OwnMachine, tmp_path: Path) -> None:
    windows, rises = warming()
    names = (*SIGNALS, "winding_temperature [degC]")
    lines = ["t," + ",".join(names)]
    for window, (before, after) in zip(windows, pairwise([0.0, *rises]), strict=True):
        for record, row in enumerate(window.values):
            slow = f"{20.0 + 0.5 * (before + after):.3f}" if record % 50 == 0 else ""  # slower than the others
            lines.append(f"{window.start + record * PERIOD:.2f}," + ",".join(map(repr, row.tolist())) + f",{slow}")
    data = tmp_path / "warm.csv"
    data.write_text("\n".join(lines), encoding="utf-8")
    machine = machine_with(own_machine, MEASURED)
    with open_recorded(machine, data) as table:
        documents = [report.document for report in Replay(machine, table).reports()]
    assert len(documents) >= WINDOWS - 1
    assert all(document.window.observed for document in documents)
    assert events(documents) == []
    data.write_text("\n".join(line.rpartition(",")[0] for line in lines), encoding="utf-8")
    with open_recorded(machine, data) as table:
        without = [report.document for report in Replay(machine, table).reports()]
    assert {event.condition for event in events(without)} == {"no temperature"}


def test_an_observed_signal_has_the_mean_of_the_window_or_the_last_value() -> None:
    rings = Rings(("a",), 100, ("b", "c"))
    rings.deliver([Sample("b", time, value) for time, value in ((1.0, 5.0), (2.5, 1.0), (3.0, 3.0), (4.0, 9.0))])
    assert rings.observed_means(2.0, 4.0) == {"b": 2.0}
    assert rings.observed_means(10.0, 12.0) == {"b": 9.0}
    assert rings.observed_means(10.0, 4.1 + MAX_OBSERVED_AGE) == {}
    assert set(rings.first_times()) == set(rings.last_times()) == {"a"}  # no window waits for them


def test_the_driver_reads_the_temperature(own_machine: OwnMachine) -> None:
    machine_with(own_machine, MEASURED, 'winding_temperature = { signal = "RotorSpeed", unit = "degC" }')
    lines = load_machine(own_machine.machine).driver.describe()
    assert any(line.startswith("winding_temperature [K] from ") for line in lines), lines


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (', temperature = "omega"', "'omega' must be a signal of [signals] beside those of the twin"),
        (f'{MEASURED}, temperature_coefficient = "0 1/K"', "R_a has no temperature_coefficient"),
        (', temperature_coefficient = "3 1/K"', "out of bounds"),
        (', reference_temperature = "20 ohm"', "does not measure"),
    ],
)
def test_a_wrong_temperature_is_refused(own_machine: OwnMachine, extra: str, message: str) -> None:
    with pytest.raises(ConfigurationError) as error:
        machine_with(own_machine, extra)
    assert message in str(error.value)


def test_a_temperature_without_a_signal_is_refused(own_machine: OwnMachine) -> None:
    machine_with(own_machine, MEASURED)
    with raises_saying(ConfigurationError, "winding_temperature (K)", "missing", "[parameters]"):
        load_machine(own_machine.machine)


COPPER_WINDING = MonitoredQuantity(
    "winding",
    "armature resistance",
    "ohm",
    6.5,
    tuple(Limit(level, 6.5 * (1.0 - share), True) for level, share in ((Level.WATCH, 0.02), (Level.ACT, 0.05))),
    temperature_coefficient=COPPER,
)


def judged(resistances: list[tuple[float, float]], quantity: MonitoredQuantity = COPPER_WINDING) -> list[Level]:
    """Return the levels after estimates of a resistance (time in s, value in ohm), without what the cold explains."""
    levels, colder = list[Level](), None
    for time, value in resistances:
        colder = coldness_after(quantity, colder, value, 0.006, (time - 2.0, time))
        levels.append(quantity.level(*quantity.warmed(value, 0.006, colder.kelvin), Level.OK)[0])
    return levels


@pytest.mark.parametrize("kelvin", [5.0, 30.0, 50.0])
def test_a_cold_start_accuses_no_winding(kelvin: float) -> None:
    """A winding warms up from below its nominal temperature, which is not measured."""
    times = np.arange(0.0, 3600.0, 2.0)
    cold = 6.5 * (1.0 - COPPER * kelvin * np.exp(-times / 300.0))
    assert set(judged(list(zip(times.tolist(), cold.tolist(), strict=True)))) == {Level.OK}


def test_a_start_that_is_colder_than_the_range_allows_is_a_finding() -> None:
    narrow = replace(COPPER_WINDING, coldest=10.0)
    assert judged([(0.0, 6.5 * (1.0 - 10.0 * COPPER))], narrow) == [Level.OK]
    assert judged([(0.0, 6.5 * (1.0 - 30.0 * COPPER))], narrow) == [Level.ACT]


def test_what_a_running_machine_loses_within_minutes_is_a_finding() -> None:
    """15 % in 1040 s, as of turns that short out one after another, while a machine runs; in a night it is the hall."""
    times = np.arange(0.0, 1040.0, 2.0)
    values = 6.5 * (1.0 - 0.15 * times / times[-1])
    levels = judged(list(zip(times.tolist(), values.tolist(), strict=True)))
    assert values[levels.index(Level.WATCH)] > 0.97 * 6.5
    assert levels[-1] is Level.ACT
    assert set(judged(list(zip((30.0 * times).tolist(), np.maximum(values, 5.8).tolist(), strict=True)))) == {Level.OK}


def test_what_a_running_machine_loses_at_once_is_no_cold_and_stays_a_finding() -> None:
    healthy, shorted = [(2.0 * at, 6.5) for at in range(20)], [(40.0 + 2.0 * at, 5.9) for at in range(3600)]
    levels = judged(healthy + shorted)
    assert set(levels[:20]) == {Level.OK}
    assert set(levels[20:]) == {Level.ACT}


@pytest.mark.parametrize(("rest", "expected"), [(10.0, Level.ACT), (600.0, Level.OK), (36_000.0, Level.OK)])
def test_a_rest_explains_as_much_as_it_was_long_enough_for(rest: float, expected: Level) -> None:
    """After a time constant a machine may be colder by 63 % of the range."""
    cold = 6.5 * (1.0 - 30.0 * COPPER)
    assert judged([(0.0, 6.5), (rest, cold)]) == [Level.OK, expected]


@pytest.mark.parametrize("away", [-3600.0, 60.0, 36_000.0])
def test_no_rest_explains_what_was_a_finding_before_it(away: float) -> None:
    """A motor whose turns have shorted out is switched off, also by a computer whose clock is wrong afterwards."""
    healthy, shorted = [(2.0 * at, 6.5) for at in range(20)], [(40.0 + 2.0 * at, 5.9) for at in range(20)]
    after = [(78.0 + away + 2.0 * at, 5.9) for at in range(20)]
    repaired = [(118.0 + away + 2.0 * at, 6.49) for at in range(5)]
    levels = judged(healthy + shorted + after + repaired)
    assert set(levels[20:60]) == {Level.ACT}
    assert set(levels[60:]) == {Level.OK}


def test_a_limit_that_is_passed_in_the_cold_says_so() -> None:
    """The motor has started 10 K colder; then turns short out."""
    cold = 6.5 * (1.0 - 10.0 * COPPER)
    quantity = replace(COPPER_WINDING, limits=COPPER_WINDING.limits[1:])
    plan = MonitoringPlan({"R_a": quantity}, rules=load_rules())
    documents, state = [], HealthState()
    for index in range(20):
        state, document = assess(plan, state, estimated(index, cold if index < 10 else 0.85 * cold))
        documents.append(document)
    (event,) = events(documents)
    assert event.state is Level.ACT
    assert_says(event.text, f"{0.85 * cold:.3f}", "10 K colder")


def estimated(index: int, value: float) -> ReportDocument:
    """Return the report of a window that determines the resistance of the winding."""
    quality = QualityDocument(verdict=Verdict.GOOD, missing=0.0, longest_gap_s=0.0, jitter_s=0.0, skew_s=0.0)
    window = WindowDocument(index=index, start=2.0 * index, end=2.0 * index + 2.0, records=200, quality=quality)
    parameter = ParameterDocument(value=value, sd=0.006, unit="ohm", nominal=6.5, status=Status.ESTIMATED)
    decision = WindowDecision.LEARNED
    parameters = {"R_a": parameter}
    return ReportDocument(machine="m", site="s", twin="t", window=window, decision=decision, parameters=parameters)


def test_a_cold_motor_is_one_hint_with_both_causes(own_machine: OwnMachine) -> None:
    """The demo's motor 30 K colder than at its nominal value."""
    drift = {"kind": "step", "parameter": "R_a", "start": "0 s", "amount": f"{-6.5 * COPPER * 30.0} ohm"}
    scenario = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(scenario, MotorScenario)
    ticks = simulate(scenario.model_copy(update={"faults": (Step.model_validate(drift),)}))
    windows = []
    for index in range(8):
        rows = [[tick.measured[name] for name in SIGNALS.values()] for tick in islice(ticks, RECORDS)]
        windows.append(Window.whole(index, index * PERIOD * RECORDS, PERIOD, tuple(SIGNALS), np.array(rows)))
    documents = reports(machine_with(own_machine, ""), windows)
    (event,) = [event for document in documents for event in document.events if event.change is not None]
    assert (event.state, event.condition_id) == (Level.HINT, "winding-colder")
    assert_says(event.text, "30 K colder", "no temperature is measured")
    assert_says(event.condition, "colder", "short-circuited")
    assert documents[-1].health is not None
    assert documents[-1].health.state is Level.OK
