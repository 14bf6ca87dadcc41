"""Figures of performance: right values and intervals, compared with the healthy machine and with limits."""

from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.cli.console import Terminal
from otolith.cli.main import cli
from otolith.cli.operation.live_table import LiveTable
from otolith.health.schema import LANGUAGES, LackDocument, Language, ReportDocument, RequirementDocument, Status
from otolith.health.text import performance_texts, texts_in
from otolith.machine import LIBRARY, LoadedMachine, find_twin, library_twins, load_machine
from otolith.publishing.html_report import html_report
from otolith.simulation.performance import Estimates, ReferenceValues, figures_of
from otolith.storage.history import PERFORMANCE, WINDOW, describe_machine, history_path
from otolith.storage.history_writer import Bounds, HistoryWriter
from otolith.twin.definition import Definition
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.messages import raises_saying

CONFIG = Path(__file__).parents[2] / "config"
MOTOR = find_twin("dc_motor")
Cut = Callable[..., list[tuple[Window, float]]]


def report_of(machine: LoadedMachine, scenario: MotorScenario, windows: Cut, count: int = 14) -> list[ReportDocument]:
    """The reports of the first windows of a motor without faults."""
    state, reports = initial_state("motor", "here", machine.problem, machine.plan), []
    names = machine.problem.base_model.signals
    for window, _ in windows(scenario.model_copy(update={"faults": ()}), count):
        columns = [window.signals.index(name) for name in names]
        read = Window.whole(window.index, window.start, window.sample_period, names, window.values[:, columns])
        state, report = adapt(state, read)
        reports.append(report.document)
    return reports


def window_of(twin: Definition, values: dict[str, Array]) -> Window:
    names = tuple(name for name in twin.signals if name in values)
    return Window.whole(0, 0.0, 0.01, names, np.column_stack([values[name] for name in names]))


def estimates_of(
    twin: Definition, sd: dict[str, float], references: dict[str, ReferenceValues] | None = None
) -> Estimates:
    values = {parameter.name: parameter.nominal for parameter in twin.parameters}
    return Estimates(values, tuple(sd), np.diag(np.square(list(sd.values()))), references or {})


def test_a_mean_over_the_window_is_that_of_its_samples() -> None:
    """The mean of a square is not the square of the mean: the speed of this window swings around zero."""
    omega = 30.0 * np.sin(np.linspace(0.0, 20.0, 200))
    window = window_of(MOTOR, {"omega": omega, "T_load": np.full(200, 0.02)})
    heat, _ = figures_of(MOTOR, estimates_of(MOTOR, {"R_a": 0.1}), window, None)
    p = {parameter.name: parameter.nominal for parameter in MOTOR.parameters}
    expected = float(np.mean(p["R_a"] * ((0.02 + p["D"] * omega) / p["K_t"]) ** 2))
    assert heat.value == pytest.approx(expected, rel=1e-12)
    assert heat.sd == pytest.approx(0.1 / p["R_a"] * expected, rel=1e-9)


def test_the_interval_is_that_of_draws_from_the_posterior() -> None:
    """Both parameters, which are correlated, act on the top speed."""
    sd, correlation = {"R_a": 0.05, "D": 2e-5}, -0.7
    estimates = estimates_of(MOTOR, sd)
    deviations = np.array(list(sd.values()))
    covariance = np.outer(deviations, deviations) * np.array([[1.0, correlation], [correlation, 1.0]])
    window = window_of(MOTOR, {"omega": np.ones(3), "T_load": np.zeros(3)})
    _, top_speed = figures_of(MOTOR, replace(estimates, covariance=covariance), window, None)
    resistance, damping = np.random.default_rng(1).multivariate_normal([6.5, 0.00143], covariance, 40_000).T
    drawn = 0.038 * 24.0 / (resistance * damping + 0.038 * 0.038)
    assert top_speed.value is not None
    assert top_speed.sd is not None
    assert top_speed.value == pytest.approx(float(drawn.mean()), rel=1e-3)
    assert top_speed.sd == pytest.approx(float(drawn.std()), rel=0.03)


def test_the_worst_of_the_limits_is_stated() -> None:
    references = {"R_a": ReferenceValues(6.5, (5.85, 10.725)), "D": ReferenceValues(0.00143, (0.00286,))}
    window = window_of(MOTOR, {"omega": np.full(3, 40.0), "T_load": np.zeros(3)})
    heat, top_speed = figures_of(MOTOR, estimates_of(MOTOR, {"R_a": 0.1, "D": 1e-5}, references), window, None)
    assert (heat.limited, heat.limit) == ("D", 0.00286)  # four times the heat, more than 65 %
    assert heat.at_limit == pytest.approx(4.0 * (heat.healthy or 0.0))
    assert top_speed.limited in {"R_a", "D"}
    assert (top_speed.at_limit or 0.0) < (top_speed.healthy or 0.0)


def test_without_the_signals_there_is_a_reason_and_no_value() -> None:
    missing = window_of(MOTOR, {"omega": np.full(3, np.nan), "T_load": np.zeros(3)})
    heat, top_speed = figures_of(MOTOR, estimates_of(MOTOR, {"R_a": 0.1}), missing, None)
    assert heat.value is None
    assert heat.reason
    assert top_speed.value == pytest.approx(84.924, abs=1e-3)  # its operating point is stated


def test_a_value_that_is_not_finite_is_none() -> None:
    pump = find_twin("pump")
    signals = {"omega": np.full(3, 150.0), "Q": np.zeros(3), "u": np.ones(3), "T_m": np.ones(3)}
    energy = figures_of(pump, estimates_of(pump, {"T_c": 0.1}), window_of(pump, signals), None)[1]
    assert energy.value is None
    assert energy.reason


@pytest.mark.parametrize("name", library_twins())
def test_every_twin_of_the_library_states_what_matters(name: str) -> None:
    """Each figure is finite at ordinary values of the signals, and a parameter that may be estimated acts on it."""
    twin = find_twin(name)
    shown = {output.name for output in twin.outputs}
    values = {item.name: np.full(3, 0.6 * item.low + 0.4 * item.high) for item in twin.inputs}
    values |= {state.name: np.full(3, state.initial or 1.0) for state in twin.states if state.name in shown}
    values |= {output.name: np.ones(3) for output in twin.outputs if output.name not in values}
    free = {parameter.name: 0.01 * parameter.nominal for parameter in twin.parameters if parameter.nominal}
    figures = figures_of(twin, estimates_of(twin, free), window_of(twin, values), None)
    assert figures
    for item in figures:
        assert item.value is not None, item.reason
        assert np.isfinite(item.value)
        assert (item.sd or 0.0) > 0.0


def test_before_a_parameter_is_known_there_is_a_reason_and_no_value() -> None:
    """The motor stands still without voltage, which does not show its resistance."""
    machine, random = load_machine(CONFIG / "dc-motor.toml"), np.random.default_rng(1)
    noise = {"i": 0.005, "omega": 0.02, "V_a": 0.0, "T_load": 0.0}
    still = window_of(MOTOR, {name: sd * random.standard_normal(200) for name, sd in noise.items()})
    _, report = adapt(initial_state("motor", "here", machine.problem, machine.plan), still)
    assert report.document.performance is not None
    heat = report.document.performance["P_Cu"]
    assert heat.value is None
    assert heat.status is Status.UNESTIMATED
    assert "R_a" in heat.reason
    assert performance_texts(heat, texts_in("de"))


def test_the_report_states_them_with_the_published_parameters(scenario: MotorScenario, windows: Cut) -> None:
    *_, last = report_of(load_machine(CONFIG / "dc-motor.toml"), scenario, windows)
    assert last.performance is not None
    heat, resistance = last.performance["P_Cu"], last.parameters["R_a"]
    assert heat.value is not None
    assert heat.sd is not None
    assert resistance.value is not None
    assert resistance.sd is not None
    assert heat.sd / heat.value == pytest.approx(resistance.sd / resistance.value, rel=1e-3)
    assert heat.baseline is not None
    assert heat.value / heat.baseline == pytest.approx(resistance.value / resistance.nominal, rel=1e-6)
    assert heat.at_limit == pytest.approx(1.65 * heat.baseline, rel=1e-6)  # ACT of the winding is 65 % above
    assert (heat.limited, heat.limit_unit) == ("R_a", "ohm")
    assert ReportDocument.from_json(last.to_json()) == last


def test_a_machine_file_states_its_own(tmp_path: Path, scenario: MotorScenario, windows: Cut) -> None:
    """It replaces one of the twin by its name, and adds another."""
    own = """
    [performance]
    P_Cu = { unit = "W", better = "lower", meaning = "heat at 1 A", expression = "R_a*i^2", at = { i = "1000 mA" } }
    loss = { unit = "W", better = "lower", meaning = "loss in the bearing", expression = "D*omega^2" }
    """
    text = (CONFIG / "dc-motor.toml").read_text(encoding="utf-8").replace('dbc = "', f'dbc = "{CONFIG}/')
    path = tmp_path / "machine.toml"
    path.write_text(text + own.replace("    ", ""), encoding="utf-8")
    *_, last = report_of(load_machine(path), scenario, windows)
    assert last.performance is not None
    assert list(last.performance) == ["P_Cu", "omega_max", "loss"]
    assert last.performance["P_Cu"].value == pytest.approx(last.parameters["R_a"].value)
    assert last.performance["P_Cu"].over == "point"


def test_a_machine_without_a_load_sensor_has_a_reason_or_a_value(
    tmp_path: Path, scenario: MotorScenario, windows: Cut
) -> None:
    text = (CONFIG / "dc-motor.toml").read_text(encoding="utf-8").replace('dbc = "', f'dbc = "{CONFIG}/')
    text = text.replace('T_load = { signal = "LoadTorque" }', 'T_load = { unknown = "slow" }')
    text = "\n".join(line for line in text.splitlines() if not line.startswith("T_load = ") or "unknown" in line)
    path = tmp_path / "machine.toml"
    path.write_text(text, encoding="utf-8")
    *_, last = report_of(load_machine(path), scenario, windows, 6)
    assert last.performance is not None
    assert last.performance["P_Cu"].value is None
    assert "T_load" in last.performance["P_Cu"].reason


@pytest.mark.parametrize("language", LANGUAGES)
def test_history_page_and_live_table_have_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scenario: MotorScenario, windows: Cut, language: Language
) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    machine = load_machine(CONFIG / "dc-motor.toml")
    *_, last = report_of(machine, scenario, windows)
    figures = last.performance
    assert figures is not None
    assert last.health is not None
    last = last.model_copy(update={"health": last.health.model_copy(update={"language": language})})
    lacks = LackDocument(parameter="D", unit="N*m*s/rad", limit=0.002, at=9e5, low=8e5, high=1e6)
    required = RequirementDocument(value=80.0, met=True, lacks=lacks)
    figures["omega_max"] = figures["omega_max"].model_copy(update={"requirement": required})
    writer = HistoryWriter(history_path("here", "motor"), Bounds(20_000_000, 3650, 24))
    numbers, _ = writer.open(last.window.start)
    writer.description = describe_machine(machine.twin, machine.plan)
    writer.add(numbers.number(last))
    writer._write_waiting()
    writer._close()
    reader, name = writer.reader, f"{PERFORMANCE}P_Cu"
    (sample,) = reader.samples(WINDOW, 0.0, (name,))
    assert sample.last == pytest.approx(figures["P_Cu"].value)
    page = html_report(reader, reader.samples(WINDOW, 0.0), "window", 0.0, last.window.end)
    table, output = LiveTable(lambda: "", details=True), StringIO()
    table.add(last.to_json())
    Terminal(file=output, width=1000).print(table)
    shown = output.getvalue()
    texts = texts_in(language)
    assert texts("performance") in page
    for figure in figures.values():
        assert texts.translated(figure.meaning) in page
        assert texts.translated(figure.meaning) in shown
        assert len(performance_texts(figure, texts)) == 3 + (figure.requirement is not None)
    assert all(texts("met", required="@").partition("@")[0] in text for text in (page, shown))
    assert name not in page
    assert "V_a = 24 V" in page  # the operating point has units
    asked = ["history", "motor", "--since", "1970-01-01", "--every", "window"]
    printed = CliRunner().invoke(cli, asked, env={"COLUMNS": "120"})
    assert PERFORMANCE not in printed.output
    change = {row: "%" in line for row in figures for line in printed.output.splitlines() if row in line}
    assert change == {row: figure.over == "point" for row, figure in figures.items()}


def test_a_fault_of_a_machine_file_is_named(tmp_path: Path) -> None:
    text = (CONFIG / "dc-motor.toml").read_text(encoding="utf-8").replace('dbc = "', f'dbc = "{CONFIG}/')
    wrong = '\n[performance]\n"x y" = { unit = "W", better = "lower", meaning = "heat", expression = "R_a*i^2" }\n'
    path = tmp_path / "machine.toml"
    path.write_text(text + wrong, encoding="utf-8")
    with pytest.raises(ConfigurationError, match="x y"):
        load_machine(path)


@pytest.mark.parametrize(
    ("keys", "required"),
    [
        ('unit = "kW"', 0.03),
        ('unit = "kW", required = 2', 2.0),
        ('unit = "W"', 30.0),
        ('meaning = "heat"', 30.0),
        ('unit = "V", expression = "R_a*i", required = 3', 3.0),
    ],
)
def test_what_the_twin_requires_is_the_same_in_another_unit(tmp_path: Path, keys: str, required: float) -> None:
    heat = load_machine(_with_required(tmp_path, keys), with_driver=False).twin.performance[0]
    assert heat.required == pytest.approx(required, rel=1e-12)


def test_what_the_twin_requires_is_not_taken_for_another_quantity(tmp_path: Path) -> None:
    path = _with_required(tmp_path, 'unit = "V", expression = "R_a*i"')
    with raises_saying(ConfigurationError, f"{path}:6", "performance.P_Cu", "30 W", "V", "required"):
        load_machine(path, with_driver=False)


def _with_required(folder: Path, keys: str) -> Path:
    """A machine file with keys of a figure for which its twin requires 30 W."""
    text = (LIBRARY / "dc_motor.toml").read_text(encoding="utf-8")
    (folder / "twin.toml").write_text(text.replace("P_Cu = {", "P_Cu = { required = 30,"), encoding="utf-8")
    own = f'[machine]\nname = "m"\n[twin]\nfile = "twin.toml"\n[performance]\nP_Cu = {{ {keys} }}\n'
    (folder / "machine.toml").write_text(own, encoding="utf-8")
    return folder / "machine.toml"
