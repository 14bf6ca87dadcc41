"""The demo: on which bus it simulates the machine, and what it calls a wrong estimate."""

from pathlib import Path

import pytest

from otolith.cli.demo import Comparison, transports_of
from otolith.machine import load_machine
from otolith_drivers.errors import ConfigurationError
from tests.conftest import EXAMPLES
from tests.messages import raises_saying


@pytest.mark.parametrize(
    ("name", "transport"),
    [
        ("dc-motor", ["can"]),
        ("dc-motor-modbus", ["modbus-tcp"]),
        ("pump-vfd", ["modbus-rtu"]),
        ("odrive-axis", ["can"]),
        ("dc-motor-two-buses", ["can", "modbus-tcp"]),
    ],
)
def test_the_plant_sends_as_the_machine_file_reads(name: str, transport: list[str]) -> None:
    assert transports_of(load_machine(EXAMPLES / f"{name}.toml", with_driver=False)) == transport


def test_a_machine_without_a_bus_is_refused() -> None:
    path = EXAMPLES / "dc-motor-in-process.toml"
    with raises_saying(ConfigurationError, "dc-motor-in-process.toml", "[driver]", 'type = "plant"'):
        transports_of(load_machine(path, with_driver=False))


def test_a_gateway_for_serial_frames_is_refused(tmp_path: Path) -> None:
    text = (EXAMPLES / "dc-motor-modbus.toml").read_text(encoding="utf-8")
    path = tmp_path / "gateway.toml"
    path.write_text(text.replace("port = 1502", 'framing = "rtu"\nport = 1502'), encoding="utf-8")
    with raises_saying(ConfigurationError, "demo", "CAN", "Modbus"):
        transports_of(load_machine(path, with_driver=False))


@pytest.mark.parametrize(
    ("estimated", "sd", "unknown", "wrong"),
    [
        (6.2383, 0.001, False, False),
        (6.2865, 0.066, True, False),  # held while a busy computer lost windows: its interval contains the truth
        (6.2865, 0.001, False, True),
        (6.2400, 0.066, False, False),
        (None, 0.0, True, False),
    ],
)
def test_an_estimate_is_wrong_only_beyond_its_own_interval(
    estimated: float | None, sd: float, unknown: bool, wrong: bool
) -> None:
    row = Comparison(33, 0.0, "R_a", 6.2383, estimated, sd)
    assert (row.unknown, row.wrong) == (unknown, wrong)
