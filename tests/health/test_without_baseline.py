"""Limits in percent of a value that is not that of this machine: they are judged once there is a baseline."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from otolith.cli.commissioning.check import lines_without_limits
from otolith.cli.commissioning.commission import written_value
from otolith.discovery.alternatives import WindowDecision
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.events import KNOWN_WINDOWS, HealthState, assess
from otolith.health.limits import Level
from otolith.health.prognosis import Baseline, with_baselines
from otolith.health.schema import (
    FindingDocument,
    FindingKind,
    NumberDocument,
    ParameterDocument,
    PartDocument,
    ReportDocument,
    Severity,
    Status,
)
from otolith.health.text import headline, value_cells
from otolith.machine import LIBRARY, LoadedMachine, load_machine
from otolith_drivers.grammars.toml_lines import toml_value
from tests.health.test_events import report
from tests.health.test_hints import agreeing
from tests.messages import assert_says

EXAMPLE = '[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n'
WITHOUT_LOAD_SENSOR = (
    '[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n[signals]\nT_load = { unknown = "friction" }\n'
)


def machine_of(folder: Path, text: str) -> LoadedMachine:
    path = folder / "machine.toml"
    path.write_text(text, encoding="utf-8")
    return load_machine(path, for_replay=True)


def baselines(values: Mapping[str, float]) -> dict[str, Baseline]:
    return {name: Baseline(value, 1e-3 * value, 100, 0.0) for name, value in values.items()}


def shown(plan: MonitoringPlan, **values: float) -> ReportDocument:
    """The last of the reports of windows in which the parameters have these values; others are not determined."""
    state, document = HealthState(), report(0)
    rows = {
        name: ParameterDocument(
            value=values.get(name), sd=None if name not in values else 1e-3 * values[name], unit=row.unit,
            nominal=row.nominal, status=Status.ESTIMATED if name in values else Status.UNESTIMATED,
        )
        for name, row in plan.parameters.items()
    }  # fmt: skip
    for index in range(5):
        state, document = assess(plan, state, report(index).model_copy(update={"parameters": rows}))
    return document


@pytest.mark.parametrize("name", ["D", "T_load_dry"])
def test_a_friction_that_doubles_is_an_event_of_the_bearing_although_no_sensor_measures_the_load(
    name: str, tmp_path: Path
) -> None:
    plan = machine_of(tmp_path, WITHOUT_LOAD_SENSOR).plan
    healthy = {"R_a": 6.5, "D": 0.004, "T_load_dry": 0.02}
    assert not shown(with_baselines(plan, baselines(healthy)), **healthy).events
    (event,) = shown(with_baselines(plan, baselines(healthy)), **{**healthy, name: 2.05 * healthy[name]}).events
    assert (event.part, event.state) == ("bearing", Level.ACT)
    assert event.condition_id != "limit"


def test_a_value_of_the_motor_is_not_that_of_motor_and_load(tmp_path: Path) -> None:
    """A data sheet of the motor has its friction alone: limits of it would be an alarm on the first day."""
    values = '[parameters]\nD = { value = "0.00143 N*m*s/rad", estimate = true }\n'
    machine = machine_of(tmp_path, WITHOUT_LOAD_SENSOR + values)
    assert not shown(machine.plan, R_a=6.5, D=0.008, T_load_dry=0.02).events
    assert "commission" in machine.plan.parameters["D"].limits_text


def test_limits_that_somebody_wrote_count_at_once(tmp_path: Path) -> None:
    values = '[parameters]\nD = { watch = "0.003 N*m*s/rad", act = "0.006 N*m*s/rad" }\n'
    (event,) = shown(machine_of(tmp_path, WITHOUT_LOAD_SENSOR + values).plan, R_a=6.5, D=0.008).events
    assert event.state is Level.ACT


@pytest.mark.parametrize(
    ("written", "is_said"),
    [
        ('watch = "0.001 N*m*s/rad"', True),
        ('watch = "0.003 N*m*s/rad"', True),
        ('value = "0.002 N*m*s/rad", estimate = true, watch = "0.003 N*m*s/rad"', False),
        ('watch = ["0.001 N*m*s/rad", "0.003 N*m*s/rad"]', False),
    ],
)
def test_the_side_of_a_limit_that_an_example_decides_is_said(written: str, is_said: bool, tmp_path: Path) -> None:
    machine = machine_of(tmp_path, f"{EXAMPLE}[parameters]\nD = {{ {written} }}\n")
    text = machine.plan.parameters["D"].limits_text
    assert ("side" in text) is is_said
    assert ("0.00143" in text or "1.43" in text) is is_said


@pytest.mark.parametrize(
    ("written", "names"), [("", ["T_load"]), ("K_t = { estimate = true, watch = [] }", ["T_load", "K_t"])]
)
def test_what_has_no_limits_is_one_line_with_what_to_write(written: str, names: list[str], tmp_path: Path) -> None:
    text = WITHOUT_LOAD_SENSOR.replace("friction", "constant")
    machine = machine_of(tmp_path, f"{text}[parameters]\n{written}\n")
    (line,) = lines_without_limits(machine)
    assert_says(line, *names, "watch")
    assert not lines_without_limits(machine_of(tmp_path, WITHOUT_LOAD_SENSOR))


@pytest.mark.parametrize("change", [0.6, 1.0, 2.5])
def test_the_example_of_a_twin_is_no_baseline(change: float, tmp_path: Path) -> None:
    """Its values are those of another machine: what is far from them is not known to be wrong, nor to be right."""
    machine = machine_of(tmp_path, '[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n')
    document = shown(machine.plan, R_a=6.5 * change, D=0.00143 * change)
    assert not document.events
    assert document.health is not None
    assert {document.health.state, document.health.parts["bearing"].state} == {Level.NO_DATA}
    assert_says(headline(document.health), "no baseline", "otolith commission")
    assert value_cells(document.parameters["D"])[-1] == ""
    known = with_baselines(machine.plan, baselines({"R_a": 6.5 * change, "D": 0.00143 * change}))
    well = shown(known, R_a=6.5 * change, D=0.00143 * change)
    assert well.health is not None
    assert {part.state for part in well.health.parts.values()} == {Level.OK}
    (event,) = shown(known, R_a=6.5 * change, D=0.00143 * change * 2.1).events
    assert event.state is Level.ACT
    (other,) = (row for name, row in shown(known, R_a=6.5 * change, D=0.00286).parameters.items() if name == "D")
    assert value_cells(other)[-1] == f"{2.0 / change - 1.0:+.2%}".replace("+0.00%", "0.00%")


@pytest.mark.parametrize(
    "written",
    [
        'D = { value = "0.00143 N*m*s/rad", estimate = true }',
        'D = { act = "0.0029 N*m*s/rad" }',
    ],
)
def test_what_the_machine_file_states_is_a_baseline(written: str, tmp_path: Path) -> None:
    text = f'[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n[parameters]\n{written}\n'
    plan = machine_of(tmp_path, text).plan
    (event,) = shown(plan, R_a=6.5, D=0.0032).events
    assert (event.part, event.state) == ("bearing", Level.ACT)
    document = shown(plan, R_a=6.5, D=0.00143)
    assert document.health is not None
    assert document.health.parts["bearing"].state is Level.OK
    assert document.health.parts["winding"].state is Level.NO_DATA


def test_a_percentage_of_an_example_waits_whoever_wrote_it(tmp_path: Path) -> None:
    text = '[machine]\nname = "axis"\n[twin]\nname = "servo_axis"\n[parameters]\nM = { act = ["-10 %", "+10 %"] }\n'
    plan = machine_of(tmp_path, text).plan
    document = shown(plan, M=60.0)
    assert not document.events
    assert value_cells(document.parameters["M"])[-1] == ""
    known = with_baselines(plan, baselines({"M": 60.0}))
    assert not shown(known, M=60.0).events
    (event,) = shown(known, M=70.0).events
    assert event.state is Level.ACT


def test_the_change_from_an_example_is_none_of_the_machine_without_limits_as_well(tmp_path: Path) -> None:
    plan = machine_of(tmp_path, '[machine]\nname = "axis"\n[twin]\nname = "servo_axis"\n').plan
    assert not plan.parameters["M"].has_limits
    assert value_cells(shown(plan, M=60.0).parameters["M"])[-1] == ""


def test_the_values_of_an_own_twin_are_those_of_the_machine(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text((LIBRARY / "dc_motor.toml").read_text(encoding="utf-8"), encoding="utf-8")
    plan = machine_of(tmp_path, '[machine]\nname = "motor"\n[twin]\nfile = "own.toml"\n').plan
    (event,) = shown(plan, R_a=6.5, D=0.0032).events
    assert event.state is Level.ACT


@pytest.mark.parametrize(("written", "level"), [("", Level.HINT), ('J = "11.71 kg*cm^2"', Level.WATCH)])
def test_a_known_value_of_the_example_that_does_not_fit_is_a_hint(written: str, level: Level, tmp_path: Path) -> None:
    """The machine file is to be completed; nothing has happened to the machine."""
    text = f'[machine]\nname = "motor"\n[twin]\nname = "dc_motor"\n[parameters]\n{written}\n'
    number = NumberDocument(value=0.0016, sd=1e-5, low=0.00158, high=0.00162, unit="kg*m^2")
    moved = FindingDocument(
        id="moved", kind=FindingKind.MOVED, subject="J", value=number, severity=Severity.WARNING, condition="",
        text="", since=0.0,
    )  # fmt: skip
    plan, state, document = machine_of(tmp_path, text).plan, HealthState(), report(0)
    for index in range(40):
        state, document = assess(plan, state, report(index, findings=(moved,)))
    (event,) = document.events
    assert event.state is level


def test_what_commissioning_writes_of_motor_and_load_is_judged(tmp_path: Path) -> None:
    """Also by a replay, which has no baseline but the values of the machine file."""
    machine = machine_of(tmp_path, WITHOUT_LOAD_SENSOR)
    row = machine.twin.parameter("D")
    line = toml_value(written_value(machine, row, 0.004, (0.0, 0.016)))
    plan = machine_of(tmp_path, f"{WITHOUT_LOAD_SENSOR}[parameters]\nD = {line}\n").plan
    assert not shown(plan, R_a=6.5, D=0.004).events
    (event,) = shown(plan, R_a=6.5, D=0.0085).events
    assert (event.part, event.state) == ("bearing", Level.ACT)


STATED = "[parameters]\n" + "".join(
    f'{name} = "{value}"\n'
    for name, value in {"L_a": "0.6 H", "J": "12 kg*cm^2", "K_e": "0.04 V*s/rad", "K_t": "0.04 N*m/A"}.items()
)


def parts_of(document: ReportDocument) -> Mapping[str, PartDocument]:
    assert document.health is not None
    return document.health.parts


def after_windows_that_do_not_fit(plan: MonitoringPlan, fitting: int, twice: int = 1) -> ReportDocument:
    """The last report, of windows of which ``fitting`` agree and then, each ``twice``-th, nothing explains."""
    state, document = HealthState(), report(0)
    for index in range(fitting + 24):
        fits = index < fitting or index % twice
        (window,) = agreeing(1, index) if fits else [report(index, decision=WindowDecision.REFUSED)]
        state, document = assess(plan, state, window)
    return document


@pytest.mark.parametrize("twice", [1, 4], ids=["unexplained", "returns"])
@pytest.mark.parametrize(
    ("written", "fitting", "level"),
    [("", 0, Level.HINT), (STATED, 0, Level.WATCH), ("", 2 * KNOWN_WINDOWS, Level.WATCH)],
    ids=["example", "stated", "agreed before"],
)
def test_what_does_not_fit_an_example_from_the_start_is_a_hint(
    written: str, fitting: int, level: Level, twice: int, tmp_path: Path
) -> None:
    """The daemon runs so after 'otolith init', until the machine is commissioned."""
    document = after_windows_that_do_not_fit(machine_of(tmp_path, EXAMPLE + written).plan, fitting, twice)
    (event,) = (item for item in document.events if item.end is None)
    assert event.state is level
    assert all(name in event.setting for name in ("L_a", "J", "K_e", "K_t") if level is Level.HINT)
    assert (Level.WATCH in {part.state for part in parts_of(document).values()}) is (level is Level.WATCH)
