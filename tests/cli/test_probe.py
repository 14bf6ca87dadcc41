"""``otolith probe`` on a Modbus server and a CAN bus: its lines can be used in a machine file as they are."""

import json
import math
import re
import signal
import socket
import subprocess
import sys
import termios
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from otolith.cli.main import cli
from otolith_drivers.base import Signal
from otolith_drivers.canbus.driver import Options as CanOptions
from otolith_drivers.canbus.driver import Source as CanSource
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.modbus.driver import Options, Source
from otolith_drivers.modbus.options import Order, TypeName, register_signal
from tests.conftest import OwnMachine, free_port
from tests.drivers.modbus_servers import Behaviour, Words, library_server, odd_server
from tests.drivers.registers import registers
from tests.drivers.serial_devices import serial_device
from tests.messages import raises_saying
from tests.waiting import PATIENCE, wait_for

ROOT = Path(__file__).parents[2]
MOVING: list[tuple[int, TypeName, Order, Callable[[float, float], float]]] = [
    (0, "float32", "CDAB", lambda time, noise: 24.0 + 0.01 * noise),
    (2, "int16", "ABCD", lambda time, noise: round(1500.0 + 4.0 * noise)),
    (3, "int32", "CDAB", lambda time, noise: round(1e6 * math.sin(3.0 * time) + 300.0 * noise)),
    (5, "float64", "CDAB", lambda time, noise: 400.0 + 0.1 * noise),
    (9, "float32", "CDAB", lambda time, noise: 30.0 * math.sin(4.0 * time) + 0.01 * noise),
]
STILL = {11: 0x0237, 12: 0x41BC, 100: 5, 101: 6}


def probe(*arguments: str | Path | float) -> Result:
    return CliRunner().invoke(cli, ["probe", *map(str, arguments)], standalone_mode=False, catch_exceptions=False)


def lines_of(text: str, start: str) -> list[str]:
    return [line for line in text.splitlines() if line.startswith(start)]


@pytest.fixture
def drive() -> Iterator[int]:
    """A drive with numbers of all types in one order; the port. Its time passes by requests, however fast they come."""
    random, moments = np.random.default_rng(3), count(0.0, 0.01)

    def moving() -> Words:
        words: Words = {}
        moment = next(moments)
        for address, kind, order, number in MOVING:
            value = number(moment, random.standard_normal())
            words |= {address + at: word for at, word in enumerate(registers(value, kind, order))}
        return words

    with library_server(moving() | STILL, lambda at: moving() if at < 100 else {}) as port:
        yield port


class IdleComputer:
    """The time of a probe that is never kept waiting: it passes only while the probe sleeps."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        return self._now

    def perf_counter(self) -> float:
        return time.perf_counter()

    def sleep(self, seconds: float) -> None:
        self._now += seconds


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """A probe makes as many readings as on an idle computer, however busy this one is."""
    monkeypatch.setattr("otolith_drivers.modbus.probe.time", IdleComputer())


@pytest.mark.usefixtures("idle")
def test_inferred_registers_become_lines_that_the_driver_reads(drive: int) -> None:
    result = probe("modbus", f"127.0.0.1:{drive}", "--registers", "0..110", "--seconds", 3)
    text = result.stdout
    assert result.return_value == 0
    assert "registers 0 to 12 and 100 to 101 can be read" in text
    assert "registers 13 to 99 and 102 to 110 refused: illegal data address" in text
    assert re.search(r"13 registers in one request: [\d.]+ ms, 99 of 100 within", text)
    assert "# registers 11 to 12 and 100 to 101: cannot be told" in text
    driver = tomllib.loads(text[text.index("[driver]") : text.index("[signals]")])["driver"]
    assert driver.pop("type") == "modbus"
    options = Options.model_validate(driver)
    assert (options.host, options.port, options.device) == ("127.0.0.1", drive, 1)
    items = set()
    for line in lines_of(text, "NAME"):
        keys = tomllib.loads(line)["NAME"] | {"unit": "V"}
        item = register_signal(Signal("s", "V", Source.model_validate(keys)), options)
        items.add((item.address, item.kind, item.order))
    assert items == {(address, kind, order) for address, kind, order, _ in MOVING}
    assert re.search(r"register = 0, .*# 2[34]\.\d+ now, between 23\.9\d* and 24\.0\d*", text)


@pytest.mark.usefixtures("idle")
def test_a_single_register_is_shown_in_every_type_and_order(drive: int) -> None:
    text = probe("modbus", f"127.0.0.1:{drive}", "--registers", "5", "--seconds", 2).stdout
    assert len(lines_of(text, "float64")) == len(lines_of(text, "int32")) == 4
    (right,) = [line for line in lines_of(text, "float64") if "*" in line]
    assert right.split()[1] == "CDAB"
    assert len(lines_of(text, "NAME")) == 1


@pytest.mark.usefixtures("idle")
def test_json_of_a_device(drive: int) -> None:
    arguments = ("--registers", "1..14", "--first-address", "1", "--seconds", "3", "--json")
    document = json.loads(probe("modbus", f"127.0.0.1:{drive}", *arguments).stdout)
    assert document["readable"] == [[1, 13]]
    assert document["refused"] == {"14": "illegal data address"}
    inferred = {number["register"]: number["type"] for number in document["numbers"] if number["verdict"] == "certain"}
    assert inferred[1] == "float32"
    assert document["registers"][2]["values"]["int16"] == pytest.approx(1500, abs=30)
    assert 0.0 < document["speed"][0]["median_s"] < 1.0
    assert "first_address = 1" in document["lines"]


def test_a_narrow_terminal_gets_several_tables(drive: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("otolith.cli.commissioning.probe_view.PLAIN_WIDTH", 80)
    text = probe("modbus", f"127.0.0.1:{drive}", "--registers", "0..10", "--seconds", 0.2, "--wide").stdout
    tables = text[: text.index("[driver]")]
    assert all(len(line) <= 80 or "*" in line[:2] for line in tables.splitlines()[5:])
    assert len(lines_of(tables, "register")) >= 4


def test_refused_registers_are_exit_code_one(drive: int) -> None:
    result = probe("modbus", f"127.0.0.1:{drive}", "--registers", "0x32..0x3C")
    assert result.return_value == 1
    assert "--table input" in result.stdout


def test_a_missing_device_is_one_line_with_cause_and_advice() -> None:
    port = free_port(socket.SOCK_STREAM)
    with raises_saying(DeviceError, f"127.0.0.1:{port}", "Connection refused", "HOST:PORT"):
        probe("modbus", f"127.0.0.1:{port}")
    with raises_saying(DeviceError, "/dev/ttyNONE", "No such file", "serial adapters"):
        probe("modbus", "/dev/ttyNONE")


@pytest.mark.parametrize(
    "arguments",
    [
        ("http://plc",),
        ("plc:99999",),
        ("plc", "--registers", "9..3"),
        ("plc", "--registers", "0..5000"),
        ("plc", "--registers", "x"),
        ("plc", "--registers", "0xFFFFF"),
        ("plc", "--registers", "0..3", "--first-address", "1"),
        ("plc", "--device", "1..9"),
    ],
)
def test_an_invalid_option_is_a_usage_error(arguments: tuple[str, ...]) -> None:
    assert CliRunner().invoke(cli, ["probe", "modbus", *arguments]).exit_code == 2


def test_a_scan_lists_the_devices_that_answer() -> None:
    port = free_port(socket.SOCK_STREAM)
    behaviour = Behaviour({}, silent=lambda device: device not in (2, 5), refuse=lambda device, *_: {5: 2}.get(device))
    with odd_server(behaviour, port):
        result = probe("modbus", f"127.0.0.1:{port}", "--scan", "--device", "1..6", "--timeout", "0.2")
        assert result.stdout.splitlines() == [
            f"Modbus TCP 127.0.0.1:{port}: 2 of 6 devices answer",
            "device 2",
            "device 5 (that register is refused: illegal data address)",
        ]
        nothing = probe("modbus", f"127.0.0.1:{port}", "--scan", "--device", "3..4", "--timeout", "0.2")
        assert nothing.return_value == 1


def refuse(*_: object) -> None:
    raise termios.error(22, "Invalid argument")


def test_a_serial_line_is_scanned_and_read(monkeypatch: pytest.MonkeyPatch) -> None:
    with serial_device({3: 1234}, 5) as port:

        def is_found() -> bool:
            """Whether the device answered in time, which it may not on a busy computer."""
            scanned = probe("modbus", port, "--scan", "--device", "3..6", "--timeout", "0.2", "--parity", "N")
            return scanned.stdout.splitlines()[1:] == ["device 5"]

        wait_for(is_found)
        text = probe("modbus", port, "--device", "5", "--registers", "0..9", "--seconds", 0.2, "--parity", "N").stdout
        assert re.search(r"^3 +04D2 +1234 ", text, re.MULTILINE)
        driver = tomllib.loads(text[text.index("[driver]") : text.index("[signals]")])["driver"]
        assert (driver["serial"], driver["baudrate"], driver["parity"], driver["device"]) == (port, 19200, "N", 5)
        with raises_saying(DeviceError, "device 4", "0.2 s", "baud rate", "parity"):
            probe("modbus", port, "--device", "4", "--timeout", "0.2", "--parity", "N")
        monkeypatch.setattr("termios.tcsetattr", refuse)
        with pytest.raises(DeviceError, match=r"the port refuses these settings: .*--parity"):
            probe("modbus", port, "--parity", "E")


@pytest.fixture
def plant(own_machine: OwnMachine) -> Iterator[OwnMachine]:
    """The simulated motor in a process of its own, sending frames."""
    command = [sys.executable, "-m", "otolith", "plant", str(own_machine.scenario)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        deadline = time.monotonic() + PATIENCE
        while probe("can", *bus_of(own_machine), "--seconds", 0.3).return_value and time.monotonic() < deadline:
            assert process.poll() is None
        yield own_machine
        process.send_signal(signal.SIGTERM)


def bus_of(machine: OwnMachine) -> list[str]:
    return ["--interface", "udp_multicast", "--channel", machine.group, "--port", str(machine.port)]


def test_frames_and_signals_of_a_bus_with_its_database(plant: OwnMachine) -> None:
    result = probe("can", *bus_of(plant), "--database", plant.dbc, "--seconds", 2)
    text = result.stdout
    assert result.return_value == 0
    assert re.search(r"^0x181 .* 8 +\d+ +\d.*MotorElectrical", text, re.MULTILINE)
    assert "not in the database" not in text
    driver = tomllib.loads(text[text.index("[driver]") : text.index("[signals]")])["driver"]
    assert driver.pop("type") == "can"
    assert CanOptions.model_validate(driver).port == plant.port
    names = [CanSource.model_validate(tomllib.loads(line)["NAME"]).signal for line in lines_of(text, "NAME")]
    assert names == ["ArmatureVoltage", "ArmatureCurrent", "RotorSpeed", "LoadTorque"]
    assert re.search(r'signal = "RotorSpeed" \}  # rad/s, -?[\d.]+ now', text)


def test_fields_are_inferred_without_a_database(plant: OwnMachine) -> None:
    text = probe("can", *bus_of(plant), "--seconds", 4).stdout
    fields = [tomllib.loads(line)["NAME"] for line in lines_of(text, "NAME")]
    places = {(field["id"], field["start"], field["length"], field["byte_order"]) for field in fields}
    assert {("0x181", 0, 16, "little"), ("0x281", 0, 16, "little")} <= places
    assert not {start for _, start, _, _ in places} - {0, 16}, "neither padding nor counters"
    assert "TPDO 1 of node 1, if CANopen" in text


def test_json_of_a_bus(plant: OwnMachine) -> None:
    documents: list[Any] = []

    def is_on_time() -> bool:
        """Whether plant and probe ran as often as they should; a busy computer delays them."""
        printed = probe("can", *bus_of(plant), "--database", plant.dbc, "--seconds", 1, "--json").stdout
        documents.append(json.loads(printed))
        rates = [frame["rate_hz"] for frame in documents[-1]["frames"]]
        return len(rates) == 2 and rates == pytest.approx([100.0, 100.0], rel=0.3)

    wait_for(is_on_time)
    assert {frame["id"]: frame["message"] for frame in documents[-1]["frames"]} == {
        "0x181": "MotorElectrical",
        "0x281": "MotorMechanical",
    }
    assert {signal["signal"] for signal in documents[-1]["signals"]} >= {"RotorSpeed", "LoadTorque"}


def test_a_silent_bus_is_exit_code_one_with_advice(own_machine: OwnMachine) -> None:
    result = probe("can", *bus_of(own_machine), "--seconds", 0.2)
    assert result.return_value == 1
    assert "nothing was received" in result.stdout
    assert "--channel can0" in result.stdout


def test_a_missing_bus_and_an_invalid_channel_are_errors() -> None:
    with pytest.raises(DeviceError, match="can9 cannot be opened"):
        probe("can", "--channel", "can9")
    with pytest.raises(ConfigurationError, match="udp_multicast takes a group"):
        probe("can", "--interface", "udp_multicast", "--channel", "can0")
    with pytest.raises(ConfigurationError, match=r"nothing\.dbc: cannot be read"):
        probe("can", "--database", "nothing.dbc")


def interrupted(arguments: Sequence[str], ready: Callable[[], bool]) -> "subprocess.CompletedProcess[str]":
    """The command, ended by Ctrl-C when it listens to signals and the rest is ``ready``."""
    command = [sys.executable, "-m", "otolith", "probe", *arguments, "--seconds", "60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        deadline = time.monotonic() + PATIENCE
        while not (_takes_signals(process.pid) and ready()) and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE)
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


def _takes_signals(pid: int) -> bool:
    """Whether the process has a handler of its own for SIGTERM."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    caught = re.search(r"SigCgt:\s*([0-9a-f]+)", status)
    return caught is not None and bool(int(caught[1], 16) >> (signal.SIGTERM - 1) & 1)


def test_ctrl_c_ends_listening_with_the_frames_so_far(own_machine: OwnMachine) -> None:
    done = interrupted(["can", *bus_of(own_machine)], lambda: True)
    assert (done.returncode, done.stderr) == (130, "")
    assert "only listening" in done.stdout


def test_ctrl_c_ends_reading_with_the_values_so_far() -> None:
    behaviour, port = Behaviour({0: 7}), free_port(socket.SOCK_STREAM)
    with odd_server(behaviour, port):
        done = interrupted(["modbus", f"127.0.0.1:{port}", "--registers", "0..3"], lambda: len(behaviour.asked) > 3)
    assert (done.returncode, done.stderr) == (130, "")
    assert "[signals]" in done.stdout


def test_no_probe_can_send() -> None:
    paths = [path for root in ("drivers", "daemon") for path in (ROOT / root).glob("**/probe*.py")]
    assert len(paths) >= 4
    for path in paths:
        text = path.read_text(encoding="utf-8")
        assert ".send" not in text, path
        assert ".write" not in text, path
