"""A hall on one serial line: each device has its turn, and a silent one is missing for its machine alone."""

from pathlib import Path

import pytest

from otolith.health.limits import Level
from tests.drivers.modbus.test_shared_line import line_of
from tests.system.halls import RunningHall, write_modbus
from tests.variants import often

SILENT = 2  # device number


@pytest.mark.parametrize("devices", often([4], [4, 20]))
def test_a_silent_device_of_a_line_is_no_data_of_its_machine_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, devices: int
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder = tmp_path / "machines"
    folder.mkdir()
    names = {number: f"pump-{number}" for number in range(1, devices + 1)}
    with line_of(devices, SILENT) as (line, asked):
        for number, name in names.items():
            options = f'serial = "{line}"\ndevice = {number}\nbaudrate = 115200\ntimeout = "0.1 s"'
            write_modbus(folder, name, options)
        hall = RunningHall(folder)
        try:
            hall.have(2, *names.values())
            for number, name in names.items():
                last = hall.reports[name][-1]
                assert last.driver is not None
                assert last.driver.up == (number != SILENT), last.driver.reason
                assert (last.window.quality.missing == 1.0) == (number == SILENT)
            silent = hall.reports[names[SILENT]][-1]
            assert silent.health is not None
            assert silent.driver is not None
            assert silent.health.state is Level.NO_DATA
            assert "no device answers" in silent.driver.reason
            answered = [count for number, count in asked.items() if number != SILENT]
            assert max(answered) < 2 * min(answered)  # a fair rate
        finally:
            assert hall.close() == 0
