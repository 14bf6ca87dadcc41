"""Shared fixtures: windows of a simulated plant without real time, and a machine file with free ports."""

import atexit
import os
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from itertools import cycle, islice
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from otolith.acquisition.window import Window
from otolith.cli.common import shipped_directory
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.progress import Progress
from tests.waiting import EXACT

EXAMPLES = shipped_directory("config")
TESTS = Path(__file__).parent
# Ports for tests. They are below the ephemeral range, so that the kernel never assigns them to another process.
FIRST_PORT, LAST_PORT, PORTS = 10_000, 32_000, 400  # PORTS: ports of each process
# The time of an example, and of drawing it, depends on the load of the computer; the same examples in every run.
# Examples that share a folder write their file anew.
BY_LOAD = (HealthCheck.too_slow, HealthCheck.function_scoped_fixture)
settings.register_profile("otolith", deadline=None, derandomize=True, suppress_health_check=BY_LOAD)
settings.load_profile("otolith")
SIGNALS = {"V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed"}


# The slowest files of the long tests, then of the others. Workers start with them, so that none of them is left alone
# at the end; files that compute alternate with files that wait for real time.
SLOWEST = (
    "system/test_hall_kills.py",
    "system/test_outages.py",
    "adaptation/test_sampling_coverage.py",
    "adaptation/test_measured_like.py",
    "acquisition/test_fuzzed_logs.py",
    "system/test_modbus_path.py",
    "benchmarks/test_changes.py",
    "system/test_daemon_outlets.py",
    "commissioning/test_delays.py",
    "system/test_service.py",
    "adaptation/test_measured_axis.py",
    "system/test_hall_takeover.py",
    "adaptation/test_measured_rigs.py",
    "system/test_restart.py",
    "discovery/test_search.py",
    "system/test_doors.py",
    "docs/test_from_a_log.py",
    "system/test_main_job.py",
    "discovery/test_noise_hypothesis.py",
    "system/test_hall.py",
    "cli/test_components.py",
    "system/test_faults.py",
    "commissioning/test_identification.py",
    "drivers/test_flapping.py",
    "acquisition/test_own_times.py",
    "system/test_absent_source.py",
    "benchmarks/test_paper.py",
    "system/test_hall_line.py",
    "cli/test_replay.py",
    "system/test_replayed.py",
    "benchmarks/test_paper_discovery.py",
    "publishing/test_recorder.py",
    "benchmarks/test_benchmarks.py",
    "runtime/test_worker.py",
    "storage/test_learned_state.py",
    "drivers/opcua/test_driver.py",
    "adaptation/test_wrong_window.py",
    "drivers/plant/test_modbus_node.py",
    "storage/test_history.py",
    "publishing/test_security.py",
    "estimation/test_data_checks_sensors.py",
    "publishing/test_catch_up.py",
    "commissioning/test_own_values.py",
    "system/test_plant.py",
)


def pytest_configure(config: pytest.Config) -> None:
    """Register the progress display in the process that distributes the tests, if there are several."""
    if config.getoption("dist", "no") != "no" and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Progress(config))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the slowest files first."""
    ranks = {TESTS / name: rank for rank, name in enumerate(SLOWEST)}
    items.sort(key=lambda item: ranks.get(item.path, len(SLOWEST)))


@pytest.fixture
def runtime() -> Iterator[Path]:
    """The folder of sockets; ``tmp_path`` is too long for the path of one."""
    with tempfile.TemporaryDirectory(prefix="otolith-") as folder:
        yield Path(folder)


@pytest.fixture(autouse=True)
def private_directories(tmp_path: Path, runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Redirect home, state directory and sockets of the user, whose own daemons may run beside the tests.

    All tests share the compiled kernels.
    """
    monkeypatch.setenv("XDG_CACHE_HOME", os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache"))
    home = tmp_path.with_name(f"{tmp_path.name}-home")  # beside: tests list what is in their folder
    home.mkdir(exist_ok=True)
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    for name in ("RUNTIME_DIRECTORY", "STATE_DIRECTORY", "CACHE_DIRECTORY", "NOTIFY_SOCKET", "WATCHDOG_USEC"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def scenario() -> MotorScenario:
    """The scenario of the demo."""
    found = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(found, MotorScenario)
    return found


@pytest.fixture
def windows() -> Callable[..., list[tuple[Window, float]]]:
    """Function that cuts windows of a scenario like the daemon; each has its mean armature resistance (ohm)."""

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


@cache
def _own_ports() -> Iterator[int]:
    """Endless iterator over a block of ports that this process reserves until it ends; RuntimeError if none is left."""
    for first in range(FIRST_PORT, LAST_PORT, PORTS):
        claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            claim.bind(f"\0otolith-tests-ports-{first}")
        except OSError:
            claim.close()
            continue
        atexit.register(claim.close)
        return cycle(range(first, first + PORTS))
    raise RuntimeError(f"all ports from {FIRST_PORT} to {LAST_PORT} are claimed by processes of tests")


def free_port(kind: socket.SocketKind) -> int:
    """A free port of this computer that no other test process receives; RuntimeError if the block is in use."""
    for port in islice(_own_ports(), PORTS):
        with socket.socket(socket.AF_INET, kind) as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise RuntimeError("every port of this process's block is in use")


@pytest.fixture
def own_machine(tmp_path: Path) -> "OwnMachine":
    """A machine file and a scenario on ports that no other test uses."""
    return OwnMachine(tmp_path)


# On a busy computer polls are late. These limits accept such windows; other tests check the default limits.
BUSY = '\n[window]\nmissing_limit = "20 %"\ngap_limit = "250 ms"\n'
RENEWAL = "2 ms"  # of the registers of a simulated drive, which is read every 10 ms
TRANSPORTS = ("can", "modbus-tcp", "modbus-rtu", "in-process")


class OwnMachine:
    """Writes the example files with a separate bus and endpoint; the daemon reads the machine over ``transport``."""

    def __init__(self, folder: Path, transport: str = "can", scenario: str = "demo", faults: str | None = None) -> None:
        """``faults`` (TOML) replace those of the scenario."""
        folder.mkdir(exist_ok=True)
        self.transport = transport
        self.group, self.port = "239.74.163.9", free_port(socket.SOCK_DGRAM)
        self.tcp_port, self.line = free_port(socket.SOCK_STREAM), folder / "line"
        self.endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.machine, self.scenario = folder / "machine.toml", folder / "scenario.toml"
        self.dbc = EXAMPLES / "dc-motor.dbc"
        self.machine.write_text(self._machine_file(), encoding="utf-8")
        text = (EXAMPLES / "scenarios" / f"{scenario}.toml").read_text(encoding="utf-8")
        text = text if faults is None else text.partition("[[faults]]")[0] + faults
        text = text.replace('dbc = "../dc-motor.dbc"', f'dbc = "{self.dbc}"')
        if "[bus]" in text:
            text = text.replace('interface = "auto"', f"{self._bus()}#").replace('channel = "vcan0"', "")
        else:
            text = text.replace("[noise]", f"[bus]\n{self._bus()}\n[noise]")
        # A drive renews its registers more often than they are read: no value is a whole period old. The age of a value
        # that is renewed as often as it is read varies by that period whenever the computer is late.
        if "modbus" in transport:
            text = f'sample_period = "{RENEWAL}"\n{text}'
        modbus = f'port = {self.tcp_port}\nline = "{self.line}"\n'
        text = (
            text.replace("[modbus]", f"[modbus]\n{modbus}")
            if "[modbus]" in text
            else text.replace("[noise]", f"[modbus]\n{modbus}\n[noise]")
        )
        self.scenario.write_text(text, encoding="utf-8")

    @property
    def plays(self) -> list[str]:
        """Arguments of ``otolith plant``; empty if the daemon simulates the plant itself."""
        return [] if self.transport == "in-process" else [str(self.scenario), "--as", self.transport]

    def _bus(self) -> str:
        return f'interface = "udp_multicast"\nchannel = "{self.group}"\nport = {self.port}\n'

    def _machine_file(self) -> str:
        text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
        text += f'\n[zenoh]\nlisten = ["{self.endpoint}"]\n'
        text += "" if EXACT else BUSY
        can = 'type = "can"\ndbc = "dc-motor.dbc"\n'
        if self.transport == "can":
            return text.replace(can, f'type = "can"\ndbc = "{self.dbc}"\n{self._bus()}')
        if self.transport == "in-process":
            return text.replace(can, f'type = "plant"\nscenario = "{self.scenario}"\n')
        for address, name in enumerate(("ArmatureVoltage", "ArmatureCurrent", "RotorSpeed", "LoadTorque")):
            unit = {"ArmatureVoltage": "V", "ArmatureCurrent": "A", "RotorSpeed": "rad/s", "LoadTorque": "N*m"}[name]
            place = f'{{ register = {2 * address}, type = "float32", unit = "{unit}" }}'
            text = text.replace(f'{{ signal = "{name}" }}', place)
        tcp = f'host = "127.0.0.1"\nport = {self.tcp_port}\n'
        rtu = f'serial = "{self.line}"\nbaudrate = 115200\nparity = "N"\n'
        return text.replace(can, f'type = "modbus"\n{tcp if self.transport == "modbus-tcp" else rtu}')
