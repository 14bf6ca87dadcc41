"""``otolith noise``: lines for the machine file, JSON, and refusals."""

import json
import re
import tomllib
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from benchmarks.sampling.measure import some_motor, write_machine
from benchmarks.sampling.schedules import Schedule, Timing, record
from click.testing import CliRunner, Result

from otolith.cli.commissioning.noise import HealthyRecord, noise_lines, structure_lines
from otolith.cli.main import cli
from otolith.commissioning.consistency import Band, Whiteness
from otolith.commissioning.delays import IdentifiedDelays
from otolith.commissioning.identification import IdentifiedNoise, NoiseLevel
from otolith.commissioning.structure import Structure
from otolith.estimation.problem import Component
from otolith.machine import load_machine
from otolith.runtime.preview import EvenSpread
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.cli.replays import MACHINE, recorded, written
from tests.messages import assert_says, raises_saying


@pytest.fixture
def data(tmp_path: Path, scenario: MotorScenario) -> Path:
    return written(tmp_path, recorded(scenario))


def noise(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli, ["noise", *map(str, arguments)], catch_exceptions=False, standalone_mode=False)


def test_printed_lines_are_valid_in_a_machine_file(tmp_path: Path, data: Path) -> None:
    result = noise(MACHINE, data)
    text = MACHINE.read_text(encoding="utf-8")
    machine = tmp_path / "machine.toml"
    machine.write_text(text[: text.index("[noise]")] + result.stdout, encoding="utf-8")
    problem = load_machine(machine, with_driver=False).problem
    assert problem.noise == pytest.approx((0.005, 0.02), rel=0.1)
    assert problem.input_noise == pytest.approx((0.0, 0.0002))
    assert problem.process_noise == pytest.approx((0.0, 0.0), abs=0.05)
    assert set(tomllib.loads(result.stdout)) == {"noise", "process_noise"}
    assert "# identified from 5 windows of 2 s" in result.stdout
    assert "chi-square between windows" in result.stdout
    contained = "cannot be told from process noise of omega"
    limit = r"not significant: up to about 0.000\d+ N\*m cannot be detected"
    assert re.search(rf'^T_load = "0.0002 N\*m" +# {limit}; it {contained}.*$', result.stdout, re.MULTILINE)
    assert "# innovations of omega: white" in result.stdout


def test_json_has_units_and_uncertainties(data: Path) -> None:
    document = json.loads(noise(MACHINE, data, "--windows", "3", "--json").stdout)
    assert document["windows"] == 3
    assert [level["unit"] for level in document["outputs"]] == ["A", "rad/s"]
    assert [level["unit"] for level in document["states"]] == ["(A)/s^0.5", "(rad/s)/s^0.5"]
    for level in document["outputs"]:
        assert 0.0 < level["sd"] < 0.2 * level["value"]
    assert document["consistency"]["degrees"] > 0
    assert [row["output"] for row in document["whiteness"]] == ["i", "omega"]
    assert document["whiteness"][0]["bands"]


def test_a_late_signal_is_printed_with_its_delay(tmp_path: Path) -> None:
    """In a machine file without signals the lines are a table; otherwise they are comments for what is there."""
    schedule, random = Schedule(rows=Timing(0.01)), np.random.default_rng(3)
    recording = record(schedule, some_motor(random), 11.0, random).delayed({"omega": 0.01})
    data = tmp_path / "recording.csv"
    data.write_text(recording.table(), encoding="utf-8")
    machine = write_machine(tmp_path, schedule)
    printed = noise(machine, data).stdout
    delay = tomllib.loads(printed)["signals"]["omega"]["delay"]
    assert float(delay.removesuffix(" ms")) == pytest.approx(10.0, abs=0.3)
    assert "# i: no delay is significant; up to about 0." in printed
    text = machine.read_text(encoding="utf-8")
    machine.write_text(text + printed[printed.index("[signals]") :], encoding="utf-8")
    again = noise(machine, data).stdout
    assert "# under [signals], add the key delay to what is there:\n# omega = { delay =" in again
    document = json.loads(noise(machine, data, "--json").stdout)
    delays = {signal["name"]: signal["value"] for signal in document["delays"]}
    assert delays == {"i": 0.0, "omega": pytest.approx(0.01, abs=3e-4), "V_a": 0.0, "T_load": 0.0}


def test_data_without_a_usable_window_is_refused(tmp_path: Path, scenario: MotorScenario) -> None:
    rows = recorded(scenario)
    short = written(tmp_path, rows[:100])
    with raises_saying(ConfigurationError, "2 s", "too short"):
        noise(MACHINE, short)
    nearly_empty = written(tmp_path, [row if index < 3 else [row[0], "", "", "", ""] for index, row in enumerate(rows)])
    with pytest.raises(ConfigurationError, match="badly sampled"):
        noise(MACHINE, nearly_empty)
    empty = written(tmp_path, [[row[0], "", "", "", ""] for row in rows])
    with raises_saying(ConfigurationError, "2 s", "no samples"):
        noise(MACHINE, empty)


@pytest.mark.parametrize(("count", "most", "kept"), [(0, 3, 0), (2, 3, 2), (5, 1, 1), (100, 7, 7)])
def test_windows_are_spread_over_the_data(count: int, most: int, kept: int) -> None:
    spread = EvenSpread[int](most)
    for item in range(count):
        spread.add(item)
    chosen = spread.chosen()
    assert len(chosen) == kept == len(set(chosen))
    gaps = [later - earlier for earlier, later in pairwise(chosen)]
    assert max(gaps, default=0) <= 2 * min(gaps, default=0)
    assert not chosen or chosen[0] == 0
    assert kept < 2 or chosen[-1] >= 0.8 * (count - 1)


def test_the_spectrum_of_coloured_innovations_is_printed_before_and_after_inflation() -> None:
    machine = load_machine(MACHINE, with_driver=False)
    bands = (Band(0.5, 2.0, 2.5), Band(2.0, 50.0, 0.9))
    coloured, white = Whiteness("omega", 0.09, 0.07, 1e-9, 0.05, bands), Whiteness("i", 0.01, 0.01, 0.5, 0.5, bands)
    levels = tuple(NoiseLevel(name, 0.0, None, "") for name in ("i", "omega"))
    after = (white, replace(white, output="omega"))
    noise = IdentifiedNoise(levels, levels, (), whiteness=(white, coloured), whiteness_after=after, windows=5)
    lines = list(noise_lines(machine, noise))
    first = lines.index("# innovations of i before inflation: white")
    assert lines[first + 1 :] == [
        "# innovations of omega before inflation: coloured, correlation 0.09 at 0.07 s",
        "#   power over that of white noise, from 0.5 Hz: 2.5 to 2 Hz, 0.9 to 50 Hz",
        "# innovations of i: white",
        "# innovations of omega: white",
        "# process noise stands for what the twin lacks and may bias parameters: replay without it for the causes",
    ]
    slow = replace(noise, whiteness=after)  # what varies from window to window only is process noise
    assert not any("what the twin lacks" in line for line in noise_lines(machine, slow))


def test_a_structure_at_a_bound_is_printed_and_not_offered() -> None:
    machine = load_machine(MACHINE, with_driver=False)
    component = Component("shaft", "power", "omega", -0.5, 0.3, 0.0, 0.3, 4.0)
    structure = [Structure(component, 0.05, 0.03, 500.0, is_restarted=False, is_at_bound=True)]
    lines = list(structure_lines(machine, structure))
    assert lines[0].startswith("# structure: shaft/power/omega: -0.5·omega^0.3 N*m")
    assert_says(lines[1], "# ", "exponent", "bound", "not offered")
    assert not any("commission" in line for line in lines)
    record = HealthyRecord(IdentifiedDelays(()), IdentifiedNoise((), (), ()), structure, ())
    assert record.offered == []
