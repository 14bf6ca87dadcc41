"""``otolith plant``: one per bus, clean end, errors in one line."""

import json
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import can
import pytest

from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.database import load_dbc
from tests.conftest import EXAMPLES, OwnMachine
from tests.messages import assert_says
from tests.waiting import PATIENCE

PLANT = [sys.executable, "-m", "otolith", "plant"]


def test_a_second_plant_on_the_same_bus_is_refused(own_machine: OwnMachine) -> None:
    first = subprocess.Popen([*PLANT, str(own_machine.scenario)], stderr=subprocess.PIPE, text=True)
    assert first.stderr is not None
    assert "frames of dc-motor.dbc" in first.stderr.readline()
    with open_bus(BusOptions(interface="udp_multicast", channel=own_machine.group, port=own_machine.port)) as bus:
        assert bus.recv(PATIENCE) is not None  # the plant sends after it has listened for other nodes
    second = subprocess.run(
        [*PLANT, str(own_machine.scenario)], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    first.terminate()
    assert first.wait(timeout=PATIENCE) == 0
    first.stderr.close()
    assert second.returncode == 2
    assert "another node already sends frame" in second.stderr


def test_the_plant_keeps_its_rate_and_ends_after_duration(own_machine: OwnMachine) -> None:
    command = [*PLANT, str(own_machine.scenario), "--duration", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0
    assert "200 frames in 1.0 s of simulated time, 0 stalls" in done.stderr


def test_ctrl_c_ends_the_plant_with_code_130(own_machine: OwnMachine) -> None:
    process = subprocess.Popen([*PLANT, str(own_machine.scenario)], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "Traceback" not in errors


FAULTS = """
[[faults]]
kind = "dropouts"
share = 0.2
start = "0 s"
until = "1 s"

[[faults]]
kind = "gone"
start = "0.9 s"
until = "1.2 s"

[[faults]]
kind = "garbage"
share = 0.1
start = "0 s"
"""


def test_every_withheld_frame_is_counted(own_machine: OwnMachine, tmp_path: Path) -> None:
    """Alive counters advance during a fault, so a listener can count too; garbage frames are counted apart."""
    own_machine.scenario.write_text(own_machine.scenario.read_text(encoding="utf-8") + FAULTS, encoding="utf-8")
    command = [*PLANT, str(own_machine.scenario), "--duration", "2", "--summary", str(tmp_path / "summary.json")]
    received: list[can.Message] = []
    with open_bus(BusOptions(interface="udp_multicast", channel=own_machine.group, port=own_machine.port)) as bus:
        node = subprocess.Popen(command, stderr=subprocess.DEVNULL)
        while (frame := bus.recv(0.2)) is not None or node.poll() is None:
            received += [frame] if frame is not None else []
    assert node.wait(timeout=PATIENCE) == 0
    done = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    dropouts, gone, garbage = done["faults"]
    assert len(received) == done["frames"] + garbage["ticks"]
    assert done["ticks"] == 200
    assert done["frames"] + dropouts["withheld"] + gone["withheld"] == 2 * done["ticks"]
    assert gone["ticks"] == 30
    counts = [frame.data[7] for frame in received if frame.arbitration_id == 385]
    skipped = sum((after - before) % 256 - 1 for before, after in pairwise(counts))
    assert skipped + counts[0] == (dropouts["withheld"] + gone["withheld"]) / 2


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (["plant", "none.toml"], 2),
        (["run", "none.toml"], 78),  # which systemd does not restart
        (["check", "none.toml"], 2),
        (["view", "none.rrd"], 2),
    ],
)
def test_a_missing_file_gives_a_one_line_error(command: list[str], code: int) -> None:
    done = subprocess.run([sys.executable, "-m", "otolith", *command], capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert len(done.stderr.splitlines()) == 1
    assert command[1] in done.stderr


def test_a_port_in_use_is_named_in_one_line_and_ends_nothing(own_machine: OwnMachine) -> None:
    import socket  # noqa: PLC0415 - only to take the port away

    host, port = own_machine.endpoint.removeprefix("tcp/").split(":")
    with socket.create_server((host, int(port))):
        command = [sys.executable, "-m", "otolith", "run", str(own_machine.machine)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as daemon:
            assert daemon.stderr is not None
            line = next(line for line in daemon.stderr if own_machine.endpoint in line)
            daemon.terminate()
            daemon.stderr.read()
        assert daemon.returncode == 0
    assert_says(line, "no reports", "cannot open", "in use")


def test_the_lift_sends_in_the_units_of_its_database(own_machine: OwnMachine, tmp_path: Path) -> None:
    """The plant computes in metres; its DBC has millimetres."""
    text = (EXAMPLES / "scenarios" / "hydraulic-fluid.toml").read_text(encoding="utf-8")
    bus = (
        f'[bus]\ninterface = "udp_multicast"\nchannel = "{own_machine.group}"\nport = {own_machine.port}\n\n[[faults]]'
    )
    text = text.replace("../hydraulic-actuator.dbc", str(EXAMPLES / "hydraulic-actuator.dbc")).replace(
        "[[faults]]", bus
    )
    (tmp_path / "lift.toml").write_text(text, encoding="utf-8")
    node = subprocess.Popen([*PLANT, str(tmp_path / "lift.toml")], stderr=subprocess.DEVNULL)
    database = load_dbc(EXAMPLES / "hydraulic-actuator.dbc")
    values: dict[str, float] = {}
    with open_bus(BusOptions(interface="udp_multicast", channel=own_machine.group, port=own_machine.port)) as bus_:
        while len(values) < 6:
            frame = bus_.recv(PATIENCE)
            assert frame is not None
            values |= database.decode_message(frame.arbitration_id, frame.data)  # type: ignore[arg-type]
    node.terminate()
    assert node.wait(timeout=PATIENCE) == 0
    assert values["ValveArea"] == pytest.approx(63.28, abs=5.0)  # mm², in balance at first
    assert values["LoadForce"] == pytest.approx(9806.65)
    assert values["SystemPressure"] == pytest.approx(49945.0, abs=50.0)
