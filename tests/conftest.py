"""What many tests share: a simulated plant's windows without any clock, and a machine of one's own on free ports."""

import socket
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from otolith.acquisition.window import Window
from otolith.paths import examples_directory
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.plants import load_scenario, simulate

EXAMPLES = examples_directory()
settings.register_profile("otolith", deadline=None)  # how long an example takes depends on who else computes
settings.load_profile("otolith")
SIGNALS = {"V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed"}


@pytest.fixture(autouse=True)
def private_directories(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No test reads or writes the state of the user who runs it; compiled kernels are shared by all tests."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in ("STATE_DIRECTORY", "CACHE_DIRECTORY", "NOTIFY_SOCKET", "WATCHDOG_USEC"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def scenario() -> MotorScenario:
    """The demo's."""
    found = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(found, MotorScenario)
    return found


@pytest.fixture
def windows() -> Callable[..., list[tuple[Window, float]]]:
    """Windows of a scenario as the daemon would cut them, each with the mean armature resistance in it."""

    def cut(scenario: MotorScenario, count: int, records: int = 200) -> list[tuple[Window, float]]:
        ticks = list(islice(simulate(scenario), count * records))
        found = []
        for index in range(count):
            part = ticks[index * records : (index + 1) * records]
            values = np.array([[tick.measured[name] for name in SIGNALS.values()] for tick in part])
            window = Window.whole(index, part[0].time, scenario.sample_period, tuple(SIGNALS), values)
            found.append((window, float(np.mean([tick.truth["R_a"] for tick in part]))))
        return found

    return cut


def free_port(kind: socket.SocketKind) -> int:
    """A port of this computer that nobody uses now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def own_machine(tmp_path: Path) -> "OwnMachine":
    """A machine file and a scenario on ports that no other test uses."""
    return OwnMachine(tmp_path)


class OwnMachine:
    """Writes the example files with a bus and an endpoint of their own."""

    def __init__(self, folder: Path) -> None:
        self.group, self.port = "239.74.163.9", free_port(socket.SOCK_DGRAM)
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.machine, self.scenario = folder / "machine.toml", folder / "scenario.toml"
        self.dbc = EXAMPLES / "dc-motor.dbc"
        bus = f'interface = "udp_multicast"\nchannel = "{self.group}"\nport = {self.port}\n'
        text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
        text = text.replace('dbc = "dc-motor.dbc"\n', f'dbc = "{self.dbc}"\n{bus}')
        self.machine.write_text(f'{text}\n[zenoh]\nlisten = ["{self.endpoint}"]\n', encoding="utf-8")
        text = (EXAMPLES / "scenarios" / "demo.toml").read_text(encoding="utf-8")
        text = text.replace('dbc = "../dc-motor.dbc"', f'dbc = "{self.dbc}"')
        text = text.replace('interface = "auto"', f"{bus}#").replace('channel = "vcan0"', "")
        self.scenario.write_text(text, encoding="utf-8")
