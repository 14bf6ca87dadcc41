"""``otolith init`` from a Modbus device, an OPC UA server and an MQTT broker, each a real one."""

import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from asyncua import Client
from click import UsageError

from otolith.cli.commissioning.draft.answers import Answers
from otolith.cli.commissioning.draft.displays import with_displays
from otolith.cli.commissioning.draft.offers import Offer
from otolith.cli.commissioning.draft.writing import period_reason, proposed_period
from otolith.machine import find_twin, load_machine
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.mqtt import MqttOptions
from otolith_drivers.mqtt_probe import ObservedMessages
from otolith_drivers.opcua import connection
from otolith_drivers.opcua.watching import VariableChanges
from otolith_drivers.units import Quantity
from tests.cli.commands import otolith, tables
from tests.conftest import free_port
from tests.drivers.modbus_servers import Words, library_server
from tests.drivers.mqtt_broker import broker_of_this_process, publisher
from tests.drivers.opcua_server import opcua_server
from tests.drivers.registers import registers
from tests.messages import assert_says, raises_saying
from tests.waiting import PATIENCE


@pytest.fixture
def drive() -> Iterator[int]:
    """A drive with voltage (V), current (A) and speed (0.1 rpm) in three registers of 16 bits; the port."""
    moments = count(0.0, 0.02)

    def moving() -> Words:
        time = next(moments)
        numbers = (24.0 + 3.0 * math.sin(time), 300.0 * math.sin(2.0 * time), 9000.0 * math.sin(time))
        return {10 + at: registers(round(number), "int16", "ABCD")[0] for at, number in enumerate(numbers)}

    with library_server(moving(), lambda _: moving()) as port:
        yield port


def test_the_sample_period_is_that_of_renewals_and_not_of_answers(tmp_path: Path) -> None:
    """The device answers within a millisecond, and renews its registers every 100 ms."""
    file, begun = tmp_path / "drive.toml", time.monotonic()
    told = ["--signal", "V_a=10", "--signal", "i=11", "--signal", "omega=12", "--unit", "10=V", "--unit", "11=mA",
            "--unit", "12=rpm", "--twin", "dc_motor"]  # fmt: skip

    def renewed() -> Words:
        return {at: 100 * at + int(10.0 * (time.monotonic() - begun)) for at in (10, 11, 12)}

    with library_server(renewed(), lambda _: renewed()) as port:
        read = ["--modbus", f"127.0.0.1:{port}", "--registers", "10..12"]
        shown = otolith("init", file, *read, "--seconds", 1.5, *told).stdout
        assert tables(file)["window"] == {"length": "20 s", "sample_period": "100 ms"}
        assert_says(shown, "100 ms", "--sample-period")
        assert_says(file.read_text(encoding="utf-8"), "registers change")


def test_a_sample_period_that_nothing_shows_is_said_to_be_assumed() -> None:
    still, moving = Offer("10", None, {}, np.zeros(3)), Offer("11", None, {}, np.zeros(3), 0.1)
    assert (proposed_period([still]), proposed_period([still, moving])) == (0.01, 0.1)
    assert_says(period_reason([still], "known"), "assumed", "move")
    assert period_reason([still, moving], "known") == "known"


@pytest.mark.parametrize(
    ("measured", "period"),
    [(9.99e-3, 0.01), (20.04e-3, 0.02), (1.998e-3, 0.002), (16.67e-3, 0.0167), (33.3e-3, 0.0333), (12.5e-3, 0.0125)],
)
def test_an_interval_that_was_measured_is_the_round_one_that_devices_have(measured: float, period: float) -> None:
    """The end of a window wanders against the samples if its period is a little wrong."""
    assert proposed_period([Offer("n", "rpm", {}, np.array([1.0, 2.0]), measured)]) == period


def test_registers_that_are_told_become_a_file_whose_signals_come(drive: int, tmp_path: Path) -> None:
    file, target = tmp_path / "drive.toml", f"127.0.0.1:{drive}"
    told = ["--signal", "V_a=10", "--signal", "i=11", "--signal", "omega=12", "--unit", "10=V", "--unit", "11=mA",
            "--unit", "12=rpm", "--scale", "12=0.1"]  # fmt: skip
    otolith("init", file, "--modbus", target, "--registers", "10..12", "--seconds", 1.5, *told)
    assert tables(file)["driver"]["host"] == "127.0.0.1"
    assert tables(file)["twin"]["name"] == "dc_motor", "the one with these signals, although registers fit others too"
    assert tables(file)["signals"]["omega"] == {"register": 12, "type": "int16", "unit": "rpm", "scale": 0.1}
    assert tables(file)["signals"]["T_load"] == {"unknown": "constant"}
    assert otolith("check", file).return_value == 0
    with raises_saying(ConfigurationError, "--signal", "--unit"):
        otolith("init", tmp_path / "other.toml", "--modbus", target, "--registers", "10..12", "--seconds", 1.5)


def test_values_off_the_display_say_which_register_is_what(tmp_path: Path) -> None:
    """Of a drive without a manual that runs at a steady speed: a voltage in 0.1 V, a current in mA, a speed in rpm."""
    moments = count()

    def steady() -> Words:
        ripple = (-1.0) ** next(moments)
        numbers = (241.0 + ripple, 2310.0 - 2 * ripple, 1449.0 + ripple, 377.0 + ripple)
        return {10 + at: registers(round(number), "int16", "ABCD")[0] for at, number in enumerate(numbers)}

    file = tmp_path / "drive.toml"
    with library_server(steady(), lambda _: steady()) as port:
        read = ["--modbus", f"127.0.0.1:{port}", "--registers", "10..13", "--seconds", 1.5]
        shown = ["--display", "V_a=24,1 V", "--display", "i=2.31A", "--display", "omega=1450 rpm"]
        otolith("init", file, *read, *shown)
        assert otolith("check", file).return_value == 0
        for wrong, words in {
            "omega=8000 rpm": ("omega", "8000", "--registers"),
            "omega=1450 V": ("omega", "V"),
            "omega=0 rpm": ("omega", "zero"),
            "omega=fast": ("omega", "fast", "number"),
            "omega=1450": ("omega", "unit", "rad/s"),
            "speed=1450 rpm": ("speed",),
        }.items():
            with raises_saying(ConfigurationError, *words):
                otolith("init", tmp_path / "other.toml", *read, *shown[:4], "--display", wrong)
    signals = tables(file)["signals"]
    assert tables(file)["twin"]["name"] == "dc_motor"
    assert signals["V_a"] == {"register": 10, "type": "int16", "unit": "V", "scale": 0.1}
    assert signals["i"] == {"register": 11, "type": "int16", "unit": "A", "scale": 0.001}
    assert signals["omega"] == {"register": 12, "type": "int16", "unit": "rpm", "scale": 1.0}


@pytest.mark.parametrize("moment", [0.0, 0.1, 0.3, 0.45, 0.6, 0.95])
def test_values_of_one_moment_are_found_while_the_machine_moves(
    moment: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """A voltage in 0.1 V, a current in mA, a speed in 0.1 rpm, and a count of seconds that passes the voltage."""
    phase = np.linspace(0.0, 2.0 * math.pi, 1000)
    values = {
        "10": 240.0 + 40.0 * np.sin(phase), "11": 2310.0 + 400.0 * np.sin(phase - 0.5),
        "12": 14500.0 + 3000.0 * np.sin(phase - 1.0), "13": 225.0 + 5.0 * phase,
    }  # fmt: skip
    offers = [Offer(name, None, {}, np.round(row)) for name, row in values.items()]
    volts, amperes, rpm = (float(np.interp(moment, phase / phase[-1], values[name])) for name in ("10", "11", "12"))
    shown = Answers(
        displays={"V_a": f"{volts / 10:.1f} V", "i": f"{amperes / 1e3:.2f} A", "omega": f"{rpm / 10:.0f} rpm"}
    )
    found = with_displays(shown, offers, [find_twin("dc_motor")])
    assert dict(found.signals) == {"V_a": "10", "i": "11", "omega": "12"}
    assert {name: float(scale) for name, scale in found.scales.items()} == {"10": 0.1, "11": 1e-3, "12": 0.1}
    assert found.units["12"] == "rpm"
    for apart in ({"V_a": "28 V", "i": "1.91 A", "omega": "1750 rpm"}, {"V_a": "28.8 V"}):  # the last is 3 % too much
        with raises_saying(ConfigurationError, "--display", "--seconds", "200", "280"):
            displays = {"i": "2.61 A", "omega": "1602 rpm", **apart}
            with_displays(replace(shown, displays=displays), offers, [find_twin("dc_motor")])


@pytest.mark.parametrize("held", [{"10": 241.0, "11": 2310.0}, {}], ids=len)
def test_a_displayed_value_without_a_register_is_named(held: dict[str, float]) -> None:
    shown = Answers(displays={"V_a": "24.1 V", "i": "2.31 A", "omega": "1450 rpm"})
    offers = [Offer(name, None, {}, np.full(3, value)) for name, value in held.items()]
    registers = [f"{name}: {value:g}" for name, value in held.items()]
    lost = ["omega=1450 rpm", *([] if held else ["V_a=24.1 V", "i=2.31 A"])]
    with raises_saying(ConfigurationError, *lost, *registers, "--registers"):
        with_displays(shown, offers, [find_twin("dc_motor")])


@pytest.mark.parametrize(
    ("held", "unit", "scale"),
    [(1450.0, "rpm", "1"), (1518.0, "rad/s", "0.1"), (2417.0, "turn/s", "0.01")],
    ids=["as displayed", "in rad/s", "in turns a second"],
)
def test_a_register_may_hold_another_usual_unit_than_the_display_shows(held: float, unit: str, scale: str) -> None:
    """1450 rpm are 151.8 rad/s."""
    shown = Answers(displays={"V_a": "24.1 V", "i": "2.31 A", "omega": "1450 rpm"})
    offers = [
        Offer(name, None, {}, np.full(3, value)) for name, value in {"10": 241.0, "11": 2310.0, "12": held}.items()
    ]
    found = with_displays(shown, offers, [find_twin("dc_motor")])
    assert (found.signals["omega"], found.units["12"], found.scales["12"]) == ("12", unit, scale)


@pytest.mark.parametrize(
    ("held", "unit", "scale", "other"),
    [
        (1500.0, "rpm", "1", "rad/s"),  # the drive has sped up by 3.4 % since, or holds 150 rad/s: 1.2 % less
        (1518.0, "rad/s", "0.1", "rpm"),  # exact, but a drive may also speed up by 4.7 %
        (1450.0, "rpm", "1", None),
        (2417.0, "turn/s", "0.01", None),
    ],
)
def test_both_units_are_named_where_both_fit(
    held: float, unit: str, scale: str, other: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    offers = [Offer(name, None, {}, np.full(3, value)) for name, value in (("10", 241.0), ("11", 2310.0), ("12", held))]
    shown = Answers(displays={"V_a": "24.1 V", "i": "2.31 A", "omega": "1450 rpm"})
    found = with_displays(shown, offers, [find_twin("dc_motor")])
    assert (found.units["12"], found.scales["12"]) == (unit, scale)
    remarks = [line for line in capsys.readouterr().out.splitlines() if "--unit" in line]
    assert len(remarks) == (other is not None)
    for remark in remarks:
        assert_says(remark, "omega", f"--unit 12={other}", "--scale 12=")


@pytest.mark.parametrize("held", [1450.0, 1500.0, 1518.0])
def test_a_unit_that_was_told_gives_the_scale(held: float, capsys: pytest.CaptureFixture[str]) -> None:
    """1450 rpm are 151.8 rad/s."""
    offers = [Offer(name, None, {}, np.full(3, value)) for name, value in (("10", 241.0), ("11", 2310.0), ("12", held))]
    displays = {"V_a": "24.1 V", "i": "2.31 A", "omega": "1450 rpm"}
    found = with_displays(Answers(displays=displays, units={"12": "rad/s"}), offers, [find_twin("dc_motor")])
    assert (found.signals["omega"], found.units["12"], found.scales["12"]) == ("12", "rad/s", "0.1")
    assert "!" not in capsys.readouterr().out
    for wrong in ("turn/s", "A"):
        with raises_saying(ConfigurationError, "omega=1450 rpm"):
            with_displays(Answers(displays=displays, units={"12": wrong}), offers, [find_twin("dc_motor")])


def test_variables_of_a_server_find_the_twin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    browsed = []

    async def counted(client: Client, most: int) -> list[connection.Variable]:
        browsed.append(client)
        return await browse(client, most)

    browse = connection.browse
    monkeypatch.setattr(connection, "browse", counted)
    variables = {"ArmatureVoltage": (12.0, "V"), "ArmatureCurrent": (0.5, "A"), "RotorSpeed": (900.0, "rpm"),
                 "CabinetTemperature": (30.0, "°C")}  # fmt: skip
    port, file = free_port(socket.SOCK_STREAM), tmp_path / "plc.toml"
    with opcua_server(port, variables):
        otolith(
            "init", file, "--opcua", f"opc.tcp://127.0.0.1:{port}/motor", "--seconds", 0.5, "--driver", "stamps=server"
        )
        assert otolith("check", file).return_value == 0
    assert len(browsed) == 1  # which costs a server several requests for each variable
    read = tables(file)
    assert read["driver"]["stamps"] == "server"
    period = Quantity("s")(read["window"]["sample_period"])
    assert period != pytest.approx(0.05)  # which is only that of the messages
    assert {name: table.get("node") for name, table in read["signals"].items()} == {
        "V_a": "nsu=urn:motor;s=ArmatureVoltage", "i": "nsu=urn:motor;s=ArmatureCurrent",
        "omega": "nsu=urn:motor;s=RotorSpeed", "T_load": None,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("steps", "interval"),
    [([0.02] * 20, 0.02), ([0.02, 0.02, 0.02, 0.0, 0.3, 0.02, 0.02, 0.02, 0.02, 0.02], 0.02), ([0.02] * 7, None)],
    ids=["regular", "a pause, and one time twice", "too few"],
)
def test_the_sample_period_of_a_server_is_that_with_which_its_variables_change(
    steps: list[float], interval: float | None
) -> None:
    """The interval of the subscription is that of its messages, which says nothing of the variables."""
    changes = VariableChanges(np.cumsum([1.8e9, *steps]).tolist(), [0.0] * (len(steps) + 1))
    assert changes.interval == (None if interval is None else pytest.approx(interval, rel=1e-3))


def test_messages_of_a_broker_find_the_twin(tmp_path: Path) -> None:
    port, file, ended = broker_of_this_process(), tmp_path / "cell.toml", threading.Event()
    with publisher(port) as client:

        def publish() -> None:
            for number in count():
                if ended.wait(0.02):
                    return
                wave = math.sin(0.05 * number)
                client.publish("cell/drive", json.dumps({"armature": {"voltage_V": 12.0 + wave, "current_A": wave}}))
                client.publish("cell/speed_rpm", f"{900.0 + 100.0 * wave:.3f}")

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            otolith("init", file, "--mqtt", f"127.0.0.1:{port}", "--topics", "cell/#", "--seconds", 2)
            assert otolith("check", file).return_value == 0
        finally:
            ended.set()
            thread.join()
    signals = tables(file)["signals"]
    assert signals["V_a"] == {"topic": "cell/drive", "field": "armature.voltage_V", "unit": "V"}
    assert signals["omega"] == {"topic": "cell/speed_rpm", "unit": "rpm"}
    load_machine(file)


def test_a_source_that_is_not_there_leaves_no_file(tmp_path: Path) -> None:
    for kind, target in (
        ("--modbus", "127.0.0.1:{}"),
        ("--opcua", "opc.tcp://127.0.0.1:{}"),
        ("--mqtt", "127.0.0.1:{}"),
    ):
        port = free_port(socket.SOCK_STREAM)
        with pytest.raises(DeviceError, match=str(port)):
            otolith("init", tmp_path / "new.toml", kind, target.format(port), "--seconds", 0.3)
    assert list(tmp_path.glob("*.toml")) == []


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--twin", "dc_motr"), ("dc_motor",)),
        (("--twin", "dc_motor", "--signal", "speed=103"), ("--signal", "speed")),
        (("--signal", "omga=103"), ("--signal", "omga", "omega")),
        (("--unknown", "T_load=steady"), ("--unknown", "steady", "constant", "friction")),
        (("--unknown", "omega=constant"), ("--unknown", "omega", "T_load")),
        (("--unit", "103=rqm"), ("--unit", "103", "rqm")),
        (("--twin", "dc_motor", "--signal", "omega=103", "--unit", "103=V"), ("omega", "103", "V", "rad/s")),
        (("--scale", "103=fast"), ("--scale", "103", "fast")),
        (("--scale", "103=0"), ("--scale", "103", "0")),
        (("--noise", "omga=1 rpm"), ("--noise", "omga", "omega")),
        (("--noise", "omega=1 V"), ("--noise", "omega", "V", "rad/s")),
        (("--display", "omga=1450 rpm"), ("--display", "omga", "omega")),
        (("--twin", "dc_motor", "--display", "omega=1450"), ("--display", "omega", "unit", "rad/s")),
        (("--sample-period", "10"), ("--sample-period", "10", "s")),
        (("--window", "2 days"), ("--window", "2 days")),
        (("--name", "my drive"), ("--name", "my drive")),
        (("--site", "hall 3"), ("--site", "hall 3")),
        (("--signal", "omega=speed"), ("--signal", "omega", "speed", "register")),
        (("--signal", "omega=64"), ("--signal", "omega", "64", "0 to 63", "--registers")),
        (("--commission",), ("--commission", "--csv")),
    ],
    ids=" ".join,
)
def test_a_wrong_option_is_told_before_the_bus_is_read(
    option: tuple[str, ...], words: tuple[str, ...], tmp_path: Path
) -> None:
    """Nothing listens at the port, so that a command that reads first fails for another reason."""
    target = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    with pytest.raises((ConfigurationError, UsageError)) as caught:
        otolith("init", tmp_path / "new.toml", "--modbus", target, *option)
    assert_says(str(caught.value), *words)


def test_a_port_that_is_closed_is_told_at_once(tmp_path: Path) -> None:
    """And not after the time for which it would listen."""
    for kind, target in (
        ("--modbus", "127.0.0.1:{}"),
        ("--opcua", "opc.tcp://127.0.0.1:{}"),
        ("--mqtt", "127.0.0.1:{}"),
    ):
        port, begun = free_port(socket.SOCK_STREAM), time.monotonic()
        with pytest.raises(DeviceError, match=str(port)):
            otolith("init", tmp_path / "new.toml", kind, target.format(port), "--seconds", 3600)
        assert time.monotonic() - begun < PATIENCE, kind


def test_messages_of_any_kind_are_bounded_and_give_no_number_that_a_field_cannot_name() -> None:
    messages = ObservedMessages(MqttOptions(host="broker"))
    deep = "[" * 100_000
    payloads = [
        b"\xff\xfe",
        b"",
        deep.encode(),
        b'{"a": {"b.c": 1, "b": {"c": 2}}}',
        b"[1, true, null]",
        b"NaN",
        b"1e999",
    ]
    for number, payload in enumerate(payloads):
        messages.take(f"topic/{number}", payload, float(number), retained=False)
    messages.take("old", b"5", 9.0, retained=True)
    for number in range(3000):
        messages.take(f"many/{number}", b"1", 10.0, retained=False)
    assert len(messages.numbers) == 2000
    assert messages.left_out > 0
    assert ("old", None) not in messages.numbers
    assert messages.numbers["topic/4", "[0]"].values == [1.0]
