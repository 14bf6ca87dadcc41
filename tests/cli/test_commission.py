"""``otolith commission``: from a log to a machine file with true values, and of a machine whose daemon runs."""

import os
import tomllib
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from otolith.adaptation.state import ComponentRecord, apply_decisions, initial_state
from otolith.cli.commissioning import commission as commission_module
from otolith.cli.commissioning import noise
from otolith.cli.commissioning.commission import Manner
from otolith.cli.commissioning.noise import HealthyLog, UnusableData
from otolith.cli.main import cli
from otolith.commissioning import own_values
from otolith.commissioning.constancy import ValueChange
from otolith.commissioning.delays import IdentifiedDelays
from otolith.commissioning.identification import AT_REST, CONSTANT, IdentifiedNoise, NoiseLevel
from otolith.commissioning.value_search import OwnValue, OwnValues
from otolith.discovery.decision import AdoptedComponent
from otolith.estimation.problem import Component
from otolith.machine import load_machine
from otolith.runtime.replay import Replay, open_recorded, replay_recorder
from otolith.storage.history import describe_machine, history_directory
from otolith.storage.log_history import log_history
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.grammars.toml_lines import toml_value
from otolith_drivers.plant.dc_motor import MotorScenario, SetPoint
from otolith_drivers.plant.faults import Frozen
from otolith_drivers.plant.scenario import simulate
from tests.cli.commands import otolith, tables
from tests.cli.replays import HEADING, MACHINE
from tests.cli.test_init import UNITS_IN_THE_HEADER, german
from tests.conftest import SIGNALS
from tests.messages import assert_each_says, assert_says, raises_saying

BEGIN = 1_800_000_000.0  # Unix s
WINDOWS, RECORDS, PERIOD = 25, 200, 0.01
OWN = {"R_a": 2.1, "L_a": 0.12, "J": 4e-4, "K_e": 0.11, "K_t": 0.11, "D": 6e-4}


SPAN = ["--since", "2027-01-15T08:00:00+00:00", "--until", "2027-01-15T08:01:00+00:00"]


@pytest.fixture
def other(scenario: MotorScenario) -> MotorScenario:
    """A motor that is far from the example of the twin, without a load."""
    parameters = scenario.parameters.model_copy(update=OWN)
    controller = scenario.controller.model_copy(update={"K_p": 0.15, "K_i": 0.4})
    noise = scenario.noise.model_copy(update={"speed": 0.1})
    update = {"parameters": parameters, "controller": controller, "load": 0.0, "faults": (), "noise": noise}
    points = tuple(
        SetPoint(at=f"{2 * place} s", speed=f"{speed} rad/s") for place, speed in enumerate((20, 60, -30, 80))
    )
    return scenario.model_copy(update={**update, "set_points": points, "repeat_every": 8.0})


@pytest.mark.full
def test_a_german_table_becomes_a_page_without_an_edit(tmp_path: Path, other: MotorScenario) -> None:
    data, file = german(tmp_path / "montag.csv", other, UNITS_IN_THE_HEADER, 6000), tmp_path / "drive.toml"
    result = otolith("init", file, "--csv", data, "--commission")
    page = tmp_path / "drive.html"
    assert f"next: otolith replay {file} {data} --report drive.html" in result.stdout.splitlines()
    machine = load_machine(file)
    values = dict(machine.problem.known) | {row.name: row.nominal for row in machine.problem.free}
    assert {name: values[name] for name in OWN} == pytest.approx(OWN, rel=0.05)
    assert tables(file)["signals"]["V_a"] == {"column": "U_A", "unit": "V"}  # nothing is late
    baselines = store_of(machine).decisions().baselines
    assert baselines["R_a"].value == pytest.approx(OWN["R_a"], rel=0.01)
    summary = otolith("replay", file, data, "--report", page).stdout
    assert_says(summary, "the twin explains 30 of 30", "OK")
    assert "<html" in page.read_text(encoding="utf-8")


def logged(data: Path, scenario: MotorScenario, windows: int = WINDOWS) -> None:
    """Write a log of so many windows."""
    ticks = islice(simulate(scenario), windows * RECORDS)
    rows = [
        ",".join([repr(BEGIN + PERIOD * index), *(repr(float(tick.measured[name])) for name in SIGNALS.values())])
        for index, tick in enumerate(ticks)
    ]
    data.write_text("\n".join([",".join(HEADING), *rows, ""]), encoding="utf-8")


@pytest.mark.parametrize("details", [False, True])
def test_findings_of_the_replay_are_counted_or_printed(
    details: bool, tmp_path: Path, scenario: MotorScenario, capsys: pytest.CaptureFixture[str]
) -> None:
    """The current freezes at 6 s."""
    file, data = tmp_path / "machine.toml", tmp_path / "samples.csv"
    file.write_text(MACHINE.read_text(encoding="utf-8"), encoding="utf-8")
    frozen = Frozen.model_validate({"kind": "frozen", "start": "6 s", "signal": "ArmatureCurrent"})
    logged(data, scenario.model_copy(update={"faults": (frozen,)}), 14)
    machine = load_machine(file, with_driver=False)
    commission_module._replayed(machine, HealthyLog((data,)), Manner(lambda: None, details=details))
    said = [line for line in capsys.readouterr().err.splitlines() if "window" in line]
    if details:
        assert len(said) > 1
    else:
        assert_each_says(said, ("14", "--details"))


@pytest.fixture
def ran(tmp_path: Path, scenario: MotorScenario) -> Path:
    """The file of a machine with state, history and recording of a daemon that ran for ``WINDOWS`` windows."""
    file, data = tmp_path / "machine.toml", tmp_path / "samples.csv"
    text = MACHINE.read_text(encoding="utf-8")
    file.write_text(text, encoding="utf-8")
    logged(data, scenario.model_copy(update={"faults": ()}))
    machine = load_machine(file, with_driver=False)
    names = machine.file.machine
    folder = machine.recording_folder
    folder.mkdir(parents=True)
    recording = folder / f"{names.site}.{names.name}-20270115T080000-1.rrd"
    with (
        open_recorded(machine, data) as recorded,
        log_history(history_directory(), names.site, names.name) as history,
        replay_recorder(recording, machine.recorded(recorded.sampling)) as record,
    ):
        run = Replay(machine, recorded)
        for report in run.reports():
            record(report)
            history.add(report.document)
        history.describe(describe_machine(machine.twin, machine.plan))
    os.utime(recording, (BEGIN + 60.0, BEGIN + 60.0))
    store = store_of(machine)
    with store.locked():
        store.save(run.state)
    return file


def test_a_running_machine_gets_a_baseline_and_keeps_what_it_has_learned(ran: Path) -> None:
    machine = load_machine(ran, with_driver=False)
    store = store_of(machine)
    learned, text = store.components_path.read_bytes(), ran.read_text(encoding="utf-8")
    span = ["--since", "2027-01-15T08:00:00+00:00", "--until", "2027-01-15T08:00:49+00:00"]
    with store.locked():  # as a daemon that runs holds it
        result = otolith("commission", ran, *span, "--windows", "4")
    assert {"noise", "process_noise"} <= tomllib.loads(result.stdout).keys()
    baseline = store.decisions().baselines["R_a"]
    assert baseline.value == pytest.approx(6.5, rel=0.01)
    assert baseline.windows == WINDOWS - 1  # the last one ends later
    assert store.components_path.read_bytes() == learned
    assert ran.read_text(encoding="utf-8") == text
    state = initial_state("m", "s", machine.problem, machine.plan)
    assert apply_decisions(state, store.decisions()).plan.parameters["R_a"].nominal == baseline.value


def test_a_running_machine_gets_noise_into_its_file(ran: Path) -> None:
    result = otolith("commission", ran, *SPAN, "--windows", "4", "--write")
    assert_says(result.stderr, str(ran), "[noise]", "[process_noise]")
    assert float(str(tables(ran)["noise"]["i"]).split()[0]) == pytest.approx(0.005, rel=0.2)
    load_machine(ran, with_driver=False)


@pytest.mark.parametrize("stated", ["", '[process_noise]\nomega = "0.5 rad/s^1.5"\n'], ids=["none", "a level"])
@pytest.mark.parametrize("has_sensors", [True, False], ids=["at rest", "and constant"])
def test_levels_that_a_record_does_not_determine_stay_as_they_are(
    tmp_path: Path, stated: str, *, has_sensors: bool
) -> None:
    """Nothing moves in the record: it shows no process noise, and perhaps not even that of a sensor."""
    file = tmp_path / "machine.toml"
    file.write_text(f"{MACHINE.read_text(encoding='utf-8')}\n{stated}", encoding="utf-8")
    machine, before = load_machine(file, with_driver=False), tables(file)
    sd, remark = (1e-4, "") if has_sensors else (None, CONSTANT)
    outputs = tuple(NoiseLevel(name, 0.006, sd, remark) for name in ("i", "omega"))
    states = tuple(NoiseLevel(name, 0.0, None, AT_REST) for name in ("i", "omega"))
    identified = IdentifiedNoise(outputs, states, (), windows=5)
    written = commission_module._with_noise_and_delays(machine, identified, IdentifiedDelays(()))
    assert written.problem.process_noise == machine.problem.process_noise
    noise = {"i": "0.006 A", "omega": "0.006 rad/s"} if has_sensors else {}
    assert tables(file) == before | {"noise": before["noise"] | noise}


def test_what_was_found_with_other_values_is_not_asked_about(ran: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the values of an example it may explain nothing but them; approved, it would stay."""

    def nothing(*_: object) -> None:
        raise UnusableData("no window can be used")

    with_limits(ran)
    found(monkeypatch, 6.6)
    monkeypatch.setattr(noise, "identified_record", nothing)
    store = store_of(load_machine(ran, with_driver=False))
    component = Component("shaft", "linear", "V_a", amplitude=0.0968)
    record = ComponentRecord(AdoptedComponent(component, 0.0), (0.0968,), (0.002,))
    monkeypatch.setattr(type(store), "components", lambda _: (record,))
    result = otolith("commission", ran, *SPAN, "--windows", "4", "--write", "--yes")
    assert_says(result.stderr, component.key, "values before")
    assert not store.decisions().approved | store.decisions().rejected


@pytest.mark.parametrize("by_hand", [False, True], ids=["written", "by hand"])
def test_a_baseline_of_new_values_is_none_for_a_daemon_that_has_the_old_ones(
    ran: Path, by_hand: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With other known values the same machine has another resistance and friction."""

    def nothing(*_: object) -> None:
        raise UnusableData("no window can be used")

    monkeypatch.setattr(noise, "identified_record", nothing)
    running = load_machine(ran, with_driver=False)
    assert dict(running.problem.known)["L_a"] == pytest.approx(0.673)
    text = ran.read_text(encoding="utf-8")
    if by_hand:
        ran.write_text(text.replace("[parameters]", '[parameters]\nL_a = "0.7 H"'), encoding="utf-8")
    else:
        values = OwnValues((OwnValue("L_a", 0.7, 0.01),), {}, 1.0, 4, {"omega": 1.0}, 1.0)
        monkeypatch.setattr(own_values, "own_values", lambda *_, **__: values)
    result = otolith("commission", ran, *SPAN, "--windows", "4", *([] if by_hand else ["--write"]))
    assert dict(load_machine(ran, with_driver=False).problem.known)["L_a"] == pytest.approx(0.7)
    last = result.stderr.splitlines()[-1]
    assert_says(last, "next:", f"otolith run {ran}")
    assert "next window" not in result.stderr
    decisions = store_of(running).decisions()
    state = apply_decisions(initial_state("m", "s", running.problem, running.plan), decisions)
    assert state.plan.parameters == running.plan.parameters
    started = load_machine(ran, with_driver=False)
    state = apply_decisions(initial_state("m", "s", started.problem, started.plan), decisions)
    assert state.plan.parameters["R_a"].has_baseline


LIMITS = {"watch": ["-10 %", "+10 %"], "act": ["-20 %", "+20 %"], "low": "4 ohm"}


def with_limits(file: Path) -> str:
    """Give a person's limits in place of the value of R_a."""
    text = file.read_text(encoding="utf-8")
    text = text.replace('{ value = "6.5 ohm", estimate = true }', toml_value(LIMITS))
    file.write_text(text, encoding="utf-8")
    return text


def found(monkeypatch: pytest.MonkeyPatch, value: float, share: float = 1.0, faults: tuple[str, ...] = ()) -> None:
    """Let the data show ``value`` for R_a, and a ``share`` of the variance of the speed."""
    values = OwnValues((OwnValue("R_a", value, 0.01),), {}, 1.0, 4, {"omega": share}, 1.0, faults=faults)
    monkeypatch.setattr(own_values, "own_values", lambda *_, **__: values)


def test_values_that_are_written_leave_the_limits_of_a_person(ran: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(*_: object) -> None:
        raise UnusableData("no window can be used")

    with_limits(ran)
    found(monkeypatch, 6.6)
    monkeypatch.setattr(noise, "identified_record", nothing)
    result = otolith("commission", ran, *SPAN, "--windows", "4", "--write")
    stated = {"value": "6.6 ohm", "estimate": True, "high": "26.4 ohm"} | LIMITS
    assert tables(ran)["parameters"]["R_a"] == stated
    assert "values, noise and delays are as they were" not in result.stderr
    assert_says(result.stderr, "noise and delays are as they were: no window can be used", "started again")


@pytest.mark.parametrize(
    ("shown", "words"),
    [
        ((3.0, 1.0), ("parameters.R_a", "3 ohm", "4", "low")),
        ((6.6, 0.5), ("dc_motor", "omega", "50%", "90%", "[signals]", "'otolith twin list'")),
        (
            (6.6, 1.0, ("other sign of T_load",)),
            ("no value is written", "other sign of T_load", "[signals]", "'otolith twin list'"),
        ),
    ],
    ids=["outside the bounds of the file", "not described by the twin", "a contradiction"],
)
def test_values_that_cannot_be_taken_end_it(
    shown: tuple[Any, ...], words: tuple[str, ...], ran: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = with_limits(ran)
    found(monkeypatch, *shown)
    with raises_saying(ConfigurationError, *words):
        otolith("commission", ran, *SPAN, "--windows", "4", "--write")
    assert ran.read_text(encoding="utf-8") == text
    assert store_of(load_machine(ran, with_driver=False)).decisions().baselines == {}


@pytest.mark.parametrize("faults", [(), ("other sign of T_load",)], ids=["alone", "beside a wrong sign"])
def test_a_record_of_two_states_of_the_machine_gives_no_values(
    faults: tuple[str, ...], ran: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = with_limits(ran)
    step = ValueChange("R_a", 6.5, 0.01, 7.4, 0.02, since=BEGIN + 34.0, until=BEGIN + 32.0)
    values = OwnValues((OwnValue("R_a", 6.9, 0.01),), {}, 1.0, 12, {"omega": 1.0}, 1.0, faults=faults, changes=(step,))
    monkeypatch.setattr(own_values, "own_values", lambda *_, **__: values)
    with raises_saying(ConfigurationError, "R_a", "6.5", "7.4", "08:00:32", "08:00:34", *faults):
        otolith("commission", ran, *SPAN, "--windows", "4", "--write")
    assert ran.read_text(encoding="utf-8") == text


def test_a_drift_is_written_and_told_at_both_ends(ran: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_limits(ran)
    drift = ValueChange("R_a", 6.4, 0.01, 6.8, 0.02, None, None)
    values = OwnValues((OwnValue("R_a", 6.6, 0.01),), {}, 1.0, 12, {"omega": 1.0}, 1.0, changes=(drift,))
    monkeypatch.setattr(own_values, "own_values", lambda *_, **__: values)
    result = otolith("commission", ran, *SPAN, "--windows", "4", "--write")
    assert tables(ran)["parameters"]["R_a"]["value"] == "6.6 ohm"
    assert_says(result.stderr, "R_a", "6.4", "6.8")


def test_a_time_without_estimates_gives_no_baseline(ran: Path) -> None:
    with raises_saying(ConfigurationError, "R_a", "20"):
        otolith("commission", ran, "--since", "2027-01-16T08:00:00+00:00", "--until", "2027-01-16T09:00:00+00:00")
    assert store_of(load_machine(ran, with_driver=False)).decisions().baselines == {}


@pytest.mark.parametrize(
    "arguments",
    [[], ["healthy.csv", "--last", "2h"], ["--last", "1h", "--since", "2h"], ["--since", "1h", "--until", "2h"]],
    ids=" ".join,
)
def test_which_data_are_healthy_must_be_told(arguments: list[str]) -> None:
    result = CliRunner().invoke(cli, ["commission", str(MACHINE), *arguments])
    assert result.exit_code == 2


def test_data_that_are_read_again_warn_once(capsys: pytest.CaptureFixture[str]) -> None:
    machine, data = load_machine(MACHINE, with_driver=False), HealthyLog((Path("monday.csv"),))
    for later in ("", "two bad rows"):
        noise.warn_once(machine, data, filter(None, ["one gap", later]))
    assert_each_says(capsys.readouterr().err.splitlines(), ("monday.csv", "one gap"), ("monday.csv", "two bad rows"))
