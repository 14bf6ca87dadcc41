"""The plant as a user meets it: one per bus, ended cleanly, errors in one line."""

import signal
import subprocess
import sys

import pytest

from otolith_drivers.can_bus import BusOptions, open_bus
from tests.conftest import OwnMachine

PLANT = [sys.executable, "-m", "otolith", "plant"]


def test_a_second_plant_on_the_same_bus_is_refused(own_machine: OwnMachine) -> None:
    first = subprocess.Popen([*PLANT, str(own_machine.scenario)], stderr=subprocess.PIPE, text=True)
    assert first.stderr is not None
    assert "frames of dc-motor.dbc" in first.stderr.readline()
    with open_bus(BusOptions(interface="udp_multicast", channel=own_machine.group, port=own_machine.port)) as bus:
        assert bus.recv(10.0) is not None  # it listens before it speaks
    second = subprocess.run(
        [*PLANT, str(own_machine.scenario)], capture_output=True, text=True, timeout=20, check=False
    )
    first.terminate()
    assert first.wait(timeout=5) == 0
    first.stderr.close()
    assert second.returncode == 2
    assert "another node already sends frame" in second.stderr


def test_it_keeps_its_rate_and_ends_by_itself(own_machine: OwnMachine) -> None:
    command = [*PLANT, str(own_machine.scenario), "--duration", "1"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 0
    assert "200 frames in 1.0 s of simulated time, 0 stalls" in done.stderr


def test_ctrl_c(own_machine: OwnMachine) -> None:
    process = subprocess.Popen([*PLANT, str(own_machine.scenario)], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    process.stderr.readline()
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=5)
    assert process.returncode == 130
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    "command", [["plant", "none.toml"], ["run", "none.toml"], ["check", "none.toml"], ["view", "none.rrd"]]
)
def test_a_missing_file_is_one_line(command: list[str]) -> None:
    done = subprocess.run([sys.executable, "-m", "otolith", *command], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert command[1] in done.stderr


def test_a_port_in_use_is_one_line(own_machine: OwnMachine) -> None:
    import socket  # noqa: PLC0415 - only to take the port away

    host, port = own_machine.endpoint.removeprefix("tcp/").split(":")
    with socket.create_server((host, int(port))):
        command = [sys.executable, "-m", "otolith", "run", str(own_machine.machine)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2
    assert own_machine.endpoint in done.stderr
    assert len(done.stderr.splitlines()) == 1
