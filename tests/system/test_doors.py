"""The motor of the other transports behind a real OPC UA server and a real MQTT broker, in other processes."""

import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from otolith.health.schema import ReportDocument, Status
from tests.conftest import OwnMachine
from tests.drivers.mqtt_broker import mqtt_broker
from tests.system.conftest import Running
from tests.waiting import EXACT

TRUE = {"R_a": 6.5, "D": 0.00143, "J": 11.71e-4}
GUESSES = {
    'D = "0.00143 N*m*s/rad"': 'D = { value = "0.0013 N*m*s/rad", estimate = true }',
    'J = "11.71 kg*cm^2"': 'J = { value = "13 kg*cm^2", estimate = true }',
    'value = "6.5 ohm"': 'value = "6 ohm"',
}
UNITS = {"V": "ArmatureVoltage", "A": "ArmatureCurrent", "rad/s": "RotorSpeed", "N*m": "LoadTorque"}
DRIVERS = {
    "opcua": ('endpoint = "opc.tcp://127.0.0.1:{port}/motor"', 'node = "ns=2;s={name}"'),
    "mqtt": ('host = "127.0.0.1"\nport = {port}\ntime = "t"', 'topic = "motor", field = "values.{name}"'),
}
MAX_DEVIATION = 3.5  # standard deviations: one run in 700 exceeds them in one of three parameters by chance


class MachineBehindADoor(OwnMachine):
    """The machine file of the CAN motor, read over OPC UA or MQTT."""

    def __init__(self, folder: Path, door: str) -> None:
        super().__init__(folder, faults="")
        options, source = DRIVERS[door]
        text = self.machine.read_text(encoding="utf-8")
        before, _, rest = text.partition("[driver]")
        rest = rest.partition("[signals]")[2]
        for unit, name in UNITS.items():
            place = source.format(name=name)
            rest = rest.replace(f'{{ signal = "{name}" }}', f'{{ {place}, unit = "{unit}" }}')
        for written, guess in GUESSES.items():
            assert written in rest
            rest = rest.replace(written, guess)
        driver = f'[driver]\ntype = "{door}"\n{options.format(port=self.tcp_port)}\n\n[signals]'
        self.machine.write_text(before + driver + rest, encoding="utf-8")
        steps = ", ".join(f'{{ at = "{at} s", speed = "{speed} rad/s" }}' for at, speed in ((1, 10), (2, 20), (3, 5)))
        scenario = self.scenario.read_text(encoding="utf-8")
        head, _, tail = scenario.partition("set_points")
        tail = tail.partition('repeat_every = "90 s"')[2]
        self.scenario.write_text(f'{head}set_points = [{steps}]\nrepeat_every = "4 s"{tail}', encoding="utf-8")

    @property
    def plays(self) -> list[str]:
        """The plant is no command."""
        return []


def is_right(report: ReportDocument) -> bool:
    """Whether all parameters are estimated narrowly with the truth in their intervals, and the link is well."""
    parameters = {name: report.parameters[name] for name in TRUE}
    if any(one.status is not Status.ESTIMATED for one in parameters.values()):
        return False
    near = [abs((one.value or 0.0) - TRUE[name]) <= MAX_DEVIATION * (one.sd or 0.0) for name, one in parameters.items()]
    narrow = [0.0 < (one.sd or 0.0) <= 0.02 * TRUE[name] for name, one in parameters.items()]
    well = report.driver is not None and report.driver.up and not (EXACT and report.driver.warnings)
    return all(near) and all(narrow) and well and not report.components


@pytest.mark.full
@pytest.mark.parametrize("door", DRIVERS)
def test_the_motor_behind_a_door_has_the_same_parameters(door: str, tmp_path: Path) -> None:
    machine = MachineBehindADoor(tmp_path / door, door)
    with ExitStack() as stack:
        if door == "mqtt":
            stack.enter_context(mqtt_broker(machine.tcp_port, tmp_path))
        running = Running(machine, tmp_path)
        stack.callback(running.close)
        command = [sys.executable, "-m", "tests.system.doors", door, str(machine.tcp_port), str(machine.scenario)]
        motor = stack.enter_context(subprocess.Popen(command))
        stack.callback(motor.kill)
        # A busy computer may stop the motor for a while, which is a jump of its state: then the next ones count.
        reports = running.wait_for(lambda reports: [is_right(one) for one in reports[-4:]] == [True] * 4)
        counters = reports[-1].counters
    assert counters is not None
    assert counters.bad == 0
