"""``otolith init``: from a table, a log or a bus to a machine file that ``otolith check`` accepts."""

import math
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import pytest
from click.testing import CliRunner
from pyarrow import csv, parquet

from otolith.cli.commissioning.draft.assignment import rank
from otolith.cli.commissioning.draft.offers import Offer
from otolith.cli.main import cli
from otolith.machine import find_twin, library_twins, load_machine
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import simulate
from tests.cli.commands import otolith, tables
from tests.conftest import EXAMPLES, OwnMachine
from tests.drivers.logs import frames_of, written
from tests.messages import assert_says, raises_saying
from tests.waiting import PATIENCE

ROWS = 1200
HOSTILE, QUOTED = 'Kanal\x1b[2J"]\x85x = 1', 'Strom"] x = 1 \\'


def german(path: Path, scenario: MotorScenario, heading: str, rows: int = ROWS, encoding: str = "cp1252") -> Path:
    """A log of the motor's voltage, current and speed (1/min) as a German logger writes it."""
    lines = ["Prüfstand Süd;Messung 7", *heading.split("\n")]
    for index, tick in enumerate(islice(simulate(scenario), rows)):
        measured = tick.measured
        speed = measured["RotorSpeed"] * 30.0 / math.pi
        numbers = (0.01 * index, measured["ArmatureVoltage"], measured["ArmatureCurrent"], speed, 21.5)
        lines.append(";".join(f"{number:.4f}".replace(".", ",") for number in numbers) + ";läuft")
    path.write_text("\r\n".join([*lines, ""]), encoding=encoding)
    return path


NO_UNIT_OF_SPEED = "Zeit;U_A in V;I_A in A;Istdrehzahl;Temperatur;Bemerkung"
UNITS_IN_A_LINE = "Zeit;Ankerspannung;Ankerstrom;Drehzahl;Gehäusetemperatur;Bemerkung\ns;V;A;1/min;°C;"
UNITS_IN_THE_HEADER = "Zeit [s];U_A [V];I_A [A];Drehzahl Ist [U/min];Gehäuse [°C];Bemerkung"


@pytest.mark.parametrize("heading", [UNITS_IN_A_LINE, UNITS_IN_THE_HEADER], ids=["line", "header"])
def test_a_german_table_becomes_a_file_that_check_accepts(
    tmp_path: Path, scenario: MotorScenario, heading: str
) -> None:
    data, file = german(tmp_path / "montag.csv", scenario, heading), tmp_path / "antrieb süd.toml"
    text = otolith("init", file, "--csv", data).output
    signals = tables(file)["signals"]
    columns = [cell.partition(" [")[0] for cell in heading.partition("\n")[0].split(";")]
    assert [signals[name]["column"] for name in ("V_a", "i", "omega")] == columns[1:4]
    assert signals["T_load"] == {"unknown": "constant"}
    assert tables(file)["driver"] == {"type": "replay", "file": "montag.csv"}
    assert tables(file)["machine"]["name"] == "antrieb-s-d"
    machine = load_machine(file)
    assert machine.twin.name == "dc_motor"
    assert machine.file.window.sample_period == pytest.approx(0.01)
    levels = (scenario.noise.current, scenario.noise.speed)
    assert machine.problem.noise == pytest.approx(levels, rel=0.25)
    assert otolith("check", "--no-device", file).return_value == 0
    assert otolith("check", file, data).return_value == 0
    assert f"next: otolith commission '{file}' {data} --write" in text.splitlines()


def as_parquet(table: Path) -> Path:
    path = table.with_suffix(".parquet")
    parquet.write_table(csv.read_csv(table), path)
    return path


def as_rows_of_values(table: Path) -> Path:
    """The table with one value per row."""
    path = table.with_name("long.csv")
    header, *rows = [line.split(",") for line in table.read_text().splitlines()]
    cells = [(row[0], name, value) for row in rows for name, value in zip(header[1:], row[1:], strict=True)]
    path.write_text("time,tag,value\n" + "".join(",".join(row) + "\n" for row in cells), encoding="utf-8")
    return path


@pytest.mark.parametrize("form", [as_parquet, as_rows_of_values])
def test_a_table_of_another_form_becomes_a_machine_file(
    form: Callable[[Path], Path], tmp_path: Path, scenario: MotorScenario
) -> None:
    lines = ["t,U,I,n"]
    for index, tick in enumerate(islice(simulate(scenario), 300)):
        measured = [tick.measured[name] for name in ("ArmatureVoltage", "ArmatureCurrent", "RotorSpeed")]
        lines.append(",".join(f"{number:.4f}" for number in (0.01 * index, *measured)))
    table, file = tmp_path / "monday.csv", tmp_path / "drive.toml"
    table.write_text("\n".join(lines) + "\n", encoding="utf-8")
    units = [part for unit in ("U=V", "I=A", "n=rad/s") for part in ("--unit", unit)]
    otolith("init", file, "--csv", form(table), "--twin", "dc_motor_coulomb", *units)
    assert tables(file)["driver"]["file"] == form(table).name
    assert {source["column"] for source in tables(file)["signals"].values() if "column" in source} == {"U", "I", "n"}


def test_a_text_in_blocks_is_refused_with_what_helps(tmp_path: Path) -> None:
    data = tmp_path / "trace.csv"
    data.write_text("[key]; [value]\n0.Variable; GVL.a\n0.Data;\n; 0; 1.5\n; 2; 2.5\n", encoding="utf-8")
    with raises_saying(ConfigurationError, "trace.csv", "CODESYS", "replay.md"):
        otolith("init", tmp_path / "new.toml", "--csv", data)


def test_a_speed_without_a_unit_is_in_that_of_drives_and_marked(tmp_path: Path, scenario: MotorScenario) -> None:
    data, file = german(tmp_path / "montag.csv", scenario, NO_UNIT_OF_SPEED), tmp_path / "drive.toml"
    text = otolith("init", file, "--csv", data).output
    assert tables(file)["signals"]["omega"] == {"column": "Istdrehzahl", "unit": "1/min"}
    assert tables(file)["signals"]["i"] == {"column": "I_A in A", "unit": "A"}
    assert_says(text, "--unit Istdrehzahl=UNIT")


def test_a_table_with_date_and_time_apart_becomes_a_file(tmp_path: Path, scenario: MotorScenario) -> None:
    data = german(tmp_path / "montag.csv", scenario, "Uhrzeit;U_A [V];I_A [A];Drehzahl [1/min];Temp;Datum")
    lines = data.read_text(encoding="cp1252").split("\n")
    for number, line in enumerate(lines):
        if line.endswith("läuft"):
            seconds, *rest, _ = line.split(";")
            lines[number] = ";".join([f"06:00:{float(seconds.replace(',', '.')):06.3f}", *rest, "23.11.2026"])
    data.write_text("\n".join(lines), encoding="cp1252")
    text = otolith("init", tmp_path / "drive.toml", "--csv", data).output
    assert_says(text, f"{ROWS} rows in {0.01 * (ROWS - 1):.6g} s")


def test_a_database_and_a_log_become_a_file_that_check_accepts(tmp_path: Path, scenario: MotorScenario) -> None:
    log, file = written(tmp_path, frames_of(scenario, ROWS), ".log"), tmp_path / "drive.toml"
    otolith("init", file, "--dbc", EXAMPLES / "dc-motor.dbc", "--log", log, "--channel", "can1")
    assert {name: row["signal"] for name, row in tables(file)["signals"].items()} == {
        "V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed",
    }  # fmt: skip
    assert tables(file)["driver"] == {"type": "can", "channel": "can1", "dbc": str(EXAMPLES / "dc-motor.dbc")}
    assert otolith("check", file, log).return_value == 0


def test_a_database_alone_gives_proposals_that_are_marked(tmp_path: Path) -> None:
    file = tmp_path / "drive.toml"
    text = otolith("init", file, "--dbc", EXAMPLES / "dc-motor.dbc", "--no-bus", "--channel", "can3").output
    signals = tables(file)["signals"]
    assert {name: row["signal"] for name, row in signals.items()} == {
        "V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed",
    }  # fmt: skip
    assert tables(file)["driver"]["channel"] == "can3"
    assert tables(file)["window"]["sample_period"] == "10 ms"  # the cycle time of the database
    lines = [line for line in file.read_text(encoding="utf-8").splitlines() if "signal = " in line]
    assert all("confirm" in line for line in lines)
    assert_says(text, "otolith check", "--last")
    result = CliRunner().invoke(cli, ["init", str(tmp_path / "new.toml"), "--csv", "x.csv", "--no-bus"])
    assert result.exit_code == 2


def test_a_bus_without_a_torque_sensor_becomes_a_file_whose_signals_come(own_machine: OwnMachine) -> None:
    lines = own_machine.dbc.read_text(encoding="utf-8").splitlines(keepends=True)
    database = own_machine.machine.parent / "without-torque.dbc"
    database.write_text("".join(line for line in lines if "LoadTorque" not in line), encoding="utf-8")
    file = own_machine.machine.with_name("drive.toml")
    bus = ["--interface", "udp_multicast", "--channel", own_machine.group, "--port", own_machine.port]
    command = [sys.executable, "-m", "otolith", "plant", str(own_machine.scenario)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        try:
            deadline = time.monotonic() + PATIENCE
            while otolith("probe", "can", *bus, "--seconds", 0.3).return_value and time.monotonic() < deadline:
                assert process.poll() is None
            otolith("init", file, "--dbc", database, *bus, "--seconds", 2)
            assert tables(file)["signals"]["T_load"] == {"unknown": "constant"}
            assert otolith("check", file).return_value == 0
        finally:
            process.terminate()


def test_no_file_is_overwritten_without_being_told(tmp_path: Path, scenario: MotorScenario) -> None:
    data, file = german(tmp_path / "montag.csv", scenario, UNITS_IN_A_LINE, 300), tmp_path / "mine.toml"
    file.write_text("mine", encoding="utf-8")
    result = CliRunner().invoke(cli, ["init", str(file), "--csv", str(data)])
    assert result.exit_code == 2
    assert_says(result.output, "mine.toml", "--force")
    assert file.read_text(encoding="utf-8") == "mine"
    otolith("init", file, "--csv", data, "--force")
    load_machine(file)


def test_a_refused_answer_leaves_no_file(tmp_path: Path, scenario: MotorScenario) -> None:
    data, file = german(tmp_path / "montag.csv", scenario, UNITS_IN_A_LINE, 300), tmp_path / "new.toml"
    for answers, words in {
        ("--noise", "i=5 V"): ("--noise i", "V"),
        ("--signal", "i=Drehzahl"): ("i", "Drehzahl", "1/min"),
        ("--signal", "i=Anker"): ("Anker", "Ankerstrom"),
        ("--signal", "j=Ankerstrom"): ("--signal j", "'j'"),
        ("--unit", "Drehzahl=furlong/moon"): ("Drehzahl", "furlong/moon"),
        ("--unknown", "T_load=steady"): ("T_load", "steady", "constant", "friction"),
        ("--twin", "pmsm"): ("pmsm", "i_q", "--signal"),
        ("--sample-period", "fast"): ("--sample-period", "fast"),
        ("--window", "2 V"): ("--window", "V", "s"),
        ("--name", "winch 1"): ("--name", "winch 1"),
        ("--scale", "Drehzal=2"): ("Drehzal", "Drehzahl"),
        ("--scale", "Kanal=1=2"): ("'Kanal=1'",),
        ("--noise", "j=5 mA"): ("--noise", "j"),
    }.items():
        with raises_saying(ConfigurationError, *words):
            otolith("init", file, "--csv", data, *answers)
    assert list(tmp_path.glob("*.toml")) == []
    assert list(tmp_path.glob(".*")) == []


def test_every_answer_is_also_an_option(tmp_path: Path, scenario: MotorScenario) -> None:
    heading = "t;Kanal 1;Kanal 2;Kanal 3;Kanal 4;Bemerkung"
    data, file = german(tmp_path / "montag.csv", scenario, heading), tmp_path / "drive.toml"
    otolith("init", file, "--csv", data, "--twin", "dc_motor_coulomb", "--name", "winch", "--site", "hall-2",
            "--signal", "V_a=Kanal 1", "--signal", "i=Kanal 2", "--signal", "omega=Kanal 3", "--unknown",
            "T_load=slow", "--unit", "Kanal 3=1/min", "--noise", "i=5 mA", "--noise", "V_a=10 mV", "--sample-period",
            "20 ms", "--window", "3 s")  # fmt: skip
    read = tables(file)
    assert read["machine"] == {"name": "winch", "site": "hall-2"}
    assert read["signals"]["omega"] == {"column": "Kanal 3", "unit": "1/min"}
    assert read["signals"]["T_load"] == {"unknown": "slow"}
    assert (read["noise"]["i"], read["noise"]["V_a"]) == ("5 mA", "10 mV")
    assert read["window"] == {"length": "3 s", "sample_period": "20 ms"}
    load_machine(file)


def test_it_asks_for_each_answer_and_again_for_a_wrong_one(tmp_path: Path, scenario: MotorScenario) -> None:
    heading = "t;Spannung;Strom;Drehzahl;Temperatur;Bemerkung"
    data, file = german(tmp_path / "montag.csv", scenario, heading), tmp_path / "drive.toml"
    answers = ["dc_moter", "dc_motor", "", "", "friction", "", "", "Drehzahl", "V", "1/min", "", "1 s", "winch", ""]
    text = otolith("init", file, "--csv", data, "--ask", answers="\n".join(answers)).output
    assert_says(text, "did you mean 'dc_motor'?", "next: otolith commission")
    read = tables(file)
    assert read["signals"]["T_load"] == {"unknown": "friction"}
    assert read["signals"]["omega"] == {"column": "Drehzahl", "unit": "1/min"}
    assert (read["window"]["length"], read["machine"]["name"]) == ("1 s", "winch")


def test_names_from_outside_control_neither_terminal_nor_file(tmp_path: Path, scenario: MotorScenario) -> None:
    heading = f"t;Spannung [V];{QUOTED} [A];Drehzahl [1/min];{HOSTILE} [°C];Bemerkung"
    data = german(tmp_path / "montag.csv", scenario, heading, encoding="utf-8")
    file = tmp_path / "drive.toml"
    text = otolith("init", file, "--csv", data).output
    assert "\x1b" not in text
    assert "\x85" not in text
    written_text = file.read_text(encoding="utf-8")
    assert not {"\x1b", "\x85"} & set(written_text)
    assert tables(file)["signals"]["i"] == {"column": QUOTED, "unit": "A"}
    assert set(tables(file)) == {
        "machine", "driver", "signals", "twin", "parameters", "noise", "window",
    }  # fmt: skip


def test_without_a_source_it_says_which_there_are(tmp_path: Path) -> None:
    result = CliRunner().invoke(cli, ["init", str(tmp_path / "new.toml"), "--no-ask"])
    assert result.exit_code == 2
    assert_says(result.output, "--csv", "--dbc")


CASES: dict[str, dict[str, str | None]] = {
    "dc_motor": {"Ankerspannung": "V", "Ankerstrom": "A", "Sollstrom": "A", "Drehzahl": "1/min"},
    "fan": {"Drehmoment Lüfter": "N*m", "Drehzahl": "rpm", "Drehzahl Soll": "rpm"},
    "pump": {"Drehmoment": "N*m", "Drossel": "%", "Drehzahl": "rpm", "Durchfluss": "m^3/h", "Druck": "bar"},
    "two_mass": {"MotorTorque": "Nm", "LoadTorque": "Nm", "MotorSpeed": "rpm", "LoadSpeed": "rpm"},
    "servo_axis": {"Force": "N", "Position": "mm"},
    "dc_motor, no units": {"motor_current": None, "bus_voltage": None, "motor_voltage": None, "motor_velocity": None,
                           "setpoint_velocity": None, "temp": None},
    "hydraulic_actuator": {"ValveArea": "mm^2", "LoadForce": "N", "PistonPosition": "mm", "SystemPressure": "bar"},
    "induction_motor": {"flux current": "A", "torque current": "A", "Drehzahl": "rpm", "Ausgangsfrequenz": "Hz",
                        "Ausgangsspannung": "V"},
}  # fmt: skip
RIGHT = {
    "dc_motor": {"V_a": "Ankerspannung", "i": "Ankerstrom", "omega": "Drehzahl"},
    "fan": {"T_m": "Drehmoment Lüfter", "omega": "Drehzahl"},
    "pump": {"T_m": "Drehmoment", "u": "Drossel", "omega": "Drehzahl", "Q": "Durchfluss", "p": "Druck"},
    "two_mass": {"T_m": "MotorTorque", "T_load": "LoadTorque", "omega_m": "MotorSpeed", "omega_l": "LoadSpeed"},
    "servo_axis": {"F": "Force", "x": "Position"},
    "dc_motor, no units": {"V_a": "motor_voltage", "i": "motor_current", "omega": "motor_velocity"},
    "hydraulic_actuator": {"A_valve": "ValveArea", "F_load": "LoadForce", "x": "PistonPosition",
                           "p": "SystemPressure"},
    "induction_motor": {"i_d": "flux current", "i_q": "torque current", "omega": "Drehzahl",
                        "f_s": "Ausgangsfrequenz", "v_s": "Ausgangsspannung"},
}  # fmt: skip


@pytest.mark.parametrize("expected", CASES)
def test_names_and_units_find_the_twin_and_its_signals(expected: str) -> None:
    offers = [Offer(name, unit, {}) for name, unit in CASES[expected].items()]
    best = rank([find_twin(name) for name in library_twins()], offers)[0]
    assert best.fits
    assert {name: pair.offer.name for name, pair in best.pairs.items()} == RIGHT[expected]
    assert best.twin.name.removesuffix("_directional") == expected.partition(",")[0]
