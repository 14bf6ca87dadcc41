"""Limits in percent of a value that is not that of this machine: they are judged once there is a baseline."""

from collections.abc import Mapping
from pathlib import Path

import pytest

from otolith.cli.commissioning.check import lines_without_limits
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.events import HealthState, assess
from otolith.health.limits import Level
from otolith.health.prognosis import Baseline, with_baselines
from otolith.health.schema import ParameterDocument, ReportDocument, Status
from otolith.machine import LoadedMachine, load_machine
from tests.health.test_events import report
from tests.messages import assert_says

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
    ("written", "names"), [("", ["T_load"]), ("K_t = { estimate = true, watch = [] }", ["T_load", "K_t"])]
)
def test_what_has_no_limits_is_one_line_with_what_to_write(written: str, names: list[str], tmp_path: Path) -> None:
    text = WITHOUT_LOAD_SENSOR.replace("friction", "constant")
    machine = machine_of(tmp_path, f"{text}[parameters]\n{written}\n")
    (line,) = lines_without_limits(machine)
    assert_says(line, *names, "watch")
    assert not lines_without_limits(machine_of(tmp_path, WITHOUT_LOAD_SENSOR))
