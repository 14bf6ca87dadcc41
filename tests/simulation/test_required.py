"""Required values of figures of performance: whether they are kept, and from when on no longer."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.events import HealthState, assess
from otolith.health.labels import TimeLabels
from otolith.health.schema import LANGUAGES, PerformanceDocument, ReportDocument
from otolith.health.status import publish_performance
from otolith.health.text import performance_texts, texts_in
from otolith.machine import LoadedMachine, find_twin, load_machine
from otolith.simulation.performance import ReferenceValues, figures_of
from otolith_drivers.errors import ConfigurationError
from tests.health.test_events import LENGTH, report
from tests.messages import assert_says
from tests.simulation.test_performance import CONFIG, MOTOR, estimates_of, window_of

STILL = {"omega": np.ones(3), "T_load": np.zeros(3)}
RATE = 0.25 / 240.0  # ohm/s: of a winding that becomes warmer or worse


def top_speed(resistance: float, damping: float = 0.00143) -> float:
    return 0.038 * 24.0 / (resistance * damping + 0.038 * 0.038)


def machine_with(tmp_path: Path, own: str) -> LoadedMachine:
    text = (CONFIG / "dc-motor.toml").read_text(encoding="utf-8").replace('dbc = "', f'dbc = "{CONFIG}/')
    path = tmp_path / "machine.toml"
    path.write_text(f"{text}\n[performance]\n{own}\n", encoding="utf-8")
    return load_machine(path)


def test_the_values_between_which_it_is_kept_are_those_of_the_equation() -> None:
    twin = replace(MOTOR, performance=tuple(replace(row, required=80.0) for row in MOTOR.performance[1:]))
    (figure,) = figures_of(twin, estimates_of(twin, {"R_a": 0.1, "D": 1e-5}), window_of(twin, STILL), None)
    low, high = figure.kept["R_a"]
    assert low is None
    assert high == pytest.approx((0.038 * 24.0 / 80.0 - 0.038 * 0.038) / 0.00143, rel=1e-5)
    low, high = figure.kept["D"]
    assert low is None
    assert high == pytest.approx((0.038 * 24.0 / 80.0 - 0.038 * 0.038) / 6.5, rel=1e-4)


def test_on_the_way_to_a_bound_that_is_infinite_no_value_is_looked_for() -> None:
    free = tuple(replace(row, low=-np.inf, high=np.inf) for row in MOTOR.parameters)
    figures = tuple(replace(row, required=80.0) for row in MOTOR.performance[1:])
    twin = replace(MOTOR, name="unbounded", parameters=free, performance=figures)
    (figure,) = figures_of(twin, estimates_of(twin, {"R_a": 0.1}), window_of(twin, STILL), None)
    assert figure.value is not None
    assert not figure.kept


def test_what_is_not_kept_now_has_no_such_values() -> None:
    twin = replace(MOTOR, performance=tuple(replace(row, required=90.0) for row in MOTOR.performance[1:]))
    (figure,) = figures_of(twin, estimates_of(twin, {"R_a": 0.1}), window_of(twin, STILL), None)
    assert not figure.kept


def test_a_machine_file_requires_a_value_of_a_figure_of_its_twin(tmp_path: Path) -> None:
    """All other keys stay those of the twin; the value may have another unit."""
    twin = machine_with(tmp_path, 'omega_max = { required = "800 rpm" }').twin
    own, known = (next(row for row in each.performance if row.name == "omega_max") for each in (twin, MOTOR))
    assert own.required == pytest.approx(800.0 * 2.0 * np.pi / 60.0)
    assert replace(own, required=None) == known


@pytest.mark.parametrize(
    ("own", "needles"),
    [
        ('omega_max = { required = "80 m/s" }', ("omega_max.required", "m/s", "rad/s")),
        ("omega_max = { required = true }", ("omega_max.required", "number")),
        ("omega_mx = { required = 80 }", ("omega_mx", "unit", "omega_max")),
        ('loss = { unit = "W", better = "lower", meaning = "loss", required = 3 }', ("loss", "expression")),
        ('omega_max = { required = "nan rad/s" }', ("omega_max.required",)),
        ("omega_max = { required = inf }", ("omega_max.required", "inf")),
    ],
)
def test_a_wrong_one_is_named(tmp_path: Path, own: str, needles: tuple[str, ...]) -> None:
    with pytest.raises(ConfigurationError) as caught:
        machine_with(tmp_path, own)
    assert_says(str(caught.value), *needles)


def degrading(machine: LoadedMachine, count: int, begin: float = 6.5) -> Iterator[ReportDocument]:
    """The reports of a winding whose resistance rises by :data:`RATE`, each with an error of 0.01 ohm."""
    state, random = HealthState(), np.random.default_rng(1)
    for index in range(count):
        true = begin + RATE * LENGTH * index
        document = report(index, true + 0.01 * random.standard_normal())
        value = document.parameters["R_a"].value or 0.0
        estimates = estimates_of(machine.twin, {"R_a": 0.01}, {"R_a": ReferenceValues(6.5, (10.725,))})
        estimates = replace(estimates, values={**estimates.values, "R_a": value})
        figures = figures_of(machine.twin, estimates, window_of(machine.twin, STILL), None)
        published = publish_performance(figures, document.parameters)
        state, after = assess(machine.plan, state, document.model_copy(update={"performance": published}))
        yield ReportDocument.from_json(after.to_json())


def figure_of(document: ReportDocument) -> PerformanceDocument:
    assert document.performance is not None
    return document.performance["omega_max"]


@pytest.mark.parametrize("limits", ["", "R_a"])
def test_the_report_says_from_when_on_it_is_not_kept(tmp_path: Path, limits: str) -> None:
    """Also for a parameter without limits, of which there is no other forecast."""
    machine = machine_with(tmp_path, 'omega_max = { required = "80 rad/s" }')
    if not limits:
        quantity = replace(machine.plan.parameters["R_a"], limits=(), waiting=())
        machine = replace(machine, plan=replace(machine.plan, parameters={"R_a": quantity}))
    *_, last = degrading(machine, 120)
    figure = figure_of(last)
    required = figure.requirement
    assert required is not None
    assert (required.value, required.met, required.met_at_baseline) == (80.0, True, True)
    assert required.met_at_limit is False
    assert required.lacks is not None
    assert required.lacks.parameter == "R_a"
    threshold = (0.038 * 24.0 / 80.0 - 0.038 * 0.038) / 0.00143
    assert required.lacks.limit == pytest.approx(threshold, rel=1e-4)
    true = (threshold - 6.5) / RATE
    assert required.lacks.low <= true <= (required.lacks.high or np.inf)
    assert required.lacks.at == pytest.approx(true, rel=0.2)
    labelled = TimeLabels(((0.0, 1.7e9),)).of_report(last)
    shifted = figure_of(labelled).requirement
    assert shifted is not None
    assert shifted.lacks is not None
    assert shifted.lacks.at == pytest.approx(required.lacks.at + 1.7e9)
    for language in LANGUAGES:
        *_, line = performance_texts(figure_of(labelled), texts_in(language), "UTC")
        assert "R_a" in line
        assert "2023-11-1" in line


def test_a_figure_that_is_not_kept_says_so_and_has_no_date(tmp_path: Path) -> None:
    machine = machine_with(tmp_path, 'omega_max = { required = "84.924 rad/s" }')
    first, *_, last = degrading(machine, 60, begin=7.0)
    for document in (first, last):
        required = figure_of(document).requirement
        assert required is not None
        assert required.met is False
        assert required.lacks is None
    assert figure_of(last).value == pytest.approx(top_speed(7.0 + RATE * LENGTH * 59), rel=1e-3)


def test_while_the_interval_holds_the_required_value_it_is_open(tmp_path: Path) -> None:
    machine = machine_with(tmp_path, f"omega_max = {{ required = {top_speed(6.5)} }}")
    (first,) = degrading(machine, 1)
    required = figure_of(first).requirement
    assert required is not None
    assert required.met is None
    for language in LANGUAGES:
        assert len(performance_texts(figure_of(first), texts_in(language))) == 4


def test_without_a_trend_there_is_a_reason_and_no_date(tmp_path: Path) -> None:
    machine = machine_with(tmp_path, 'omega_max = { required = "80 rad/s" }')
    (first,) = degrading(machine, 1)
    required = figure_of(first).requirement
    assert required is not None
    assert required.met is True
    assert required.lacks is None
    assert required.reason.startswith("R_a: ")
    assert required.kept is not None
    assert required.kept["R_a"].high == pytest.approx((0.038 * 24.0 / 80.0 - 0.038 * 0.038) / 0.00143, rel=1e-4)


def test_before_the_parameter_is_known_nothing_is_said_of_it(tmp_path: Path) -> None:
    """The motor stands still without voltage, which does not show its resistance."""
    machine, random = machine_with(tmp_path, "P_Cu = { required = 3 }"), np.random.default_rng(1)
    noise = {"i": 0.005, "omega": 0.02, "V_a": 0.0, "T_load": 0.0}
    still = window_of(machine.twin, {name: sd * random.standard_normal(200) for name, sd in noise.items()})
    _, after = adapt(initial_state("motor", "here", machine.problem, machine.plan), still)
    assert after.document.performance is not None
    required = after.document.performance["P_Cu"].requirement
    assert required is not None
    assert (required.value, required.met, required.met_at_limit, required.lacks) == (3.0, None, None, None)


def test_a_twin_of_the_library_may_require_a_value() -> None:
    """The servo axis must reach 0.3 m/s: the friction at which it does not is that of the equation."""
    axis = find_twin("servo_axis")
    own = [replace(row, required=0.3) for row in axis.performance if row.name == "v_max"]
    twin = replace(axis, performance=tuple(own))
    values = {parameter.name: parameter.nominal for parameter in twin.parameters}
    window = window_of(twin, {name: np.ones(3) for name in twin.signals})
    (figure,) = figures_of(twin, estimates_of(twin, {"F_v": 0.01 * values["F_v"]}), window, None)
    _, high = figure.kept["F_v"]
    assert high == pytest.approx((100.0 - values["F_c"] - abs(values["offset"])) / 0.3, rel=1e-4)
