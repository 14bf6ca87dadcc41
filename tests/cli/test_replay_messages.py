"""Messages of ``check`` and ``replay``: lengths that fit, files for replay only, dense logs, time, progress."""

import json
import re
from itertools import pairwise
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from otolith.cli.main import cli
from otolith.cli.replay import replay
from otolith.machine import load_machine
from otolith.runtime.replay import Replay, open_recorded
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.cli.replays import MACHINE, PERIOD, recorded, written
from tests.conftest import EXAMPLES
from tests.drivers.logs import frames_of
from tests.drivers.logs import written as written_log
from tests.messages import raises_saying


def with_window(folder: Path, lines: str) -> Path:
    path = folder / "window.toml"
    path.write_text(MACHINE.read_text(encoding="utf-8") + f"[window]\n{lines}\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("length", "period"), [(2.0, 0.012), (2.0, 0.0107), (2.005, 0.01), (1.0, 0.00035), (5.0, 0.3), (0.125, 0.012)]
)
def test_a_length_that_fits_no_grid_is_refused_with_the_two_nearest_that_fit(
    tmp_path: Path, length: float, period: float
) -> None:
    with pytest.raises(ConfigurationError, match="is no whole multiple of the sample period") as caught:
        load_machine(with_window(tmp_path, f'length = "{length} s"\nsample_period = "{period} s"'), with_driver=False)
    proposed = re.findall(r"(?:write|or) ([\d.]+) s", str(caught.value))
    assert len(proposed) == 2
    assert float(proposed[0]) < length < float(proposed[1]) or length < 11 * period
    for text in proposed:
        lines = f'length = "{text} s"\nsample_period = "{period} s"'
        loaded = load_machine(with_window(tmp_path, lines), with_driver=False)
        assert abs(loaded.file.window.length - length) <= period * (1 + 1e-6)


def test_a_window_of_two_seconds_at_12_ms_gets_both_neighbours(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"sample period 0\.012 s: write 1\.992 s or 2\.004 s$"):
        load_machine(with_window(tmp_path, 'sample_period = "12 ms"'), with_driver=False)


def test_a_window_of_too_few_records_gets_the_shortest_length(tmp_path: Path) -> None:
    with raises_saying(ConfigurationError, "5 records", "4 s", "sample_period"):
        load_machine(with_window(tmp_path, 'sample_period = "0.4 s"'), with_driver=False)


def test_a_file_for_replay_only_is_explained_without_a_device() -> None:
    result = CliRunner().invoke(cli, ["check", "--no-device", str(MACHINE)], standalone_mode=False)
    assert result.return_value == 0, result.exception
    assert "for 'otolith replay' only" in result.output
    assert "R_a" in result.output
    with pytest.raises(ConfigurationError, match=r"missing: write \[driver\]"):
        CliRunner().invoke(cli, ["check", str(MACHINE)], standalone_mode=False, catch_exceptions=False)


def test_each_sample_of_a_bus_log_that_is_denser_than_the_grid_is_used(tmp_path: Path, scenario: MotorScenario) -> None:
    """The frames come every 10 ms; a cyclic signal that comes faster than the grid has records of its own."""
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    text = text.replace('"dc-motor.dbc"', f'"{EXAMPLES / "dc-motor.dbc"}"')
    log = written_log(tmp_path, frames_of(scenario, 600), ".log")
    for period in ("40 ms", "20 ms", "10 ms"):
        machine = tmp_path / "machine.toml"
        machine.write_text(text.replace("# [window]", f'[window]\nsample_period = "{period}"'), encoding="utf-8")
        loaded = load_machine(machine, with_driver=False)
        with open_recorded(loaded, log) as reader:
            run = Replay(loaded, reader)
            used = [int((~window.missing).sum()) for window in run.windows()]
        assert used[:2] == [800, 800]
        assert not any("not used" in line for line in run.warnings())


def test_computing_time_is_absent_in_a_replay_unless_it_is_asked_for(
    tmp_path: Path, scenario: MotorScenario, capsys: pytest.CaptureFixture[str]
) -> None:
    data = written(tmp_path, recorded(scenario, 3))
    costs = {}
    for timing in (False, True):
        replay(MACHINE, [data], None, as_json=True, stopped=lambda: False, timing=timing)
        costs[timing] = [json.loads(line)["cost"] for line in capsys.readouterr().out.splitlines()]
    assert all("seconds" not in cost for cost in costs[False])
    assert all(cost["seconds"] > 0.0 for cost in costs[True])
    replay(MACHINE, [data], None, as_json=False, stopped=lambda: False, timing=True)
    assert re.search(r"a window of 2 s takes [\d.]+ m?s to compute", capsys.readouterr().out)


def test_progress_is_the_share_of_the_data_that_was_adapted_to(tmp_path: Path, scenario: MotorScenario) -> None:
    """The file is so small that it is read at once."""
    windows = 20
    machine = load_machine(with_window(tmp_path, 'length = "0.5 s"'), with_driver=False)
    data = written(tmp_path, recorded(scenario, 5))
    shares = []
    with open_recorded(machine, data) as reader:
        run = Replay(machine, reader)
        assert run.progress == 0.0
        shares = [run.progress for _ in run.windows()]
    assert len(shares) == windows
    assert shares == pytest.approx([(index + 1) / windows for index in range(windows)], abs=0.01)
    assert max(shares[:-1]) < 1.0
    assert run.progress == 1.0


def test_progress_rises_steadily_in_a_file_of_many_chunks(
    tmp_path: Path, scenario: MotorScenario, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("otolith_drivers.replay.table.reader.CHUNK", 20_000)
    once = recorded(scenario, 5)
    rows = [[f"{index * PERIOD:.3f}", *once[index % len(once)][1:]] for index in range(20 * len(once))]
    machine = load_machine(MACHINE, with_driver=False)
    with open_recorded(machine, written(tmp_path, rows)) as reader:
        run = Replay(machine, reader)
        shares = [run.progress for _ in run.windows()]
    steps = [after - before for before, after in pairwise(shares)]
    assert min(steps) >= 0.0
    assert max(steps) < 0.08  # the reader is ahead by its buffer
    assert shares[-1] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("repeated", [1, 3])
def test_rows_in_reversed_order_are_an_error_before_any_report(
    tmp_path: Path, scenario: MotorScenario, capsys: pytest.CaptureFixture[str], repeated: int
) -> None:
    rows = [row for row in recorded(scenario, 3)[::-1] for _ in range(repeated)]
    with raises_saying(ConfigurationError, "decreases", "sort"):
        replay(MACHINE, [written(tmp_path, rows)], None, as_json=True, stopped=lambda: False)
    assert capsys.readouterr().out == ""


def test_each_file_of_a_replay_is_checked(tmp_path: Path, scenario: MotorScenario) -> None:
    rows = recorded(scenario)
    first = written(tmp_path, rows).rename(tmp_path / "first.csv")
    second = written(tmp_path, rows[::-1]).rename(tmp_path / "second.csv")
    with raises_saying(ConfigurationError, "second.csv", "decreases"):
        replay(MACHINE, [first, second], None, as_json=True, stopped=lambda: False)


def test_rows_that_are_reversed_in_small_groups_are_sorted(
    tmp_path: Path, scenario: MotorScenario, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = recorded(scenario, 3)
    grouped = [row for first in range(0, len(rows), 10) for row in rows[first : first + 10][::-1]]
    printed = []
    for order in (rows, grouped):
        replay(MACHINE, [written(tmp_path, order)], None, as_json=True, stopped=lambda: False)
        printed.append([json.loads(line)["parameters"] for line in capsys.readouterr().out.splitlines()])
    assert len(printed[0]) == 3
    assert printed[1] == printed[0]


def test_a_time_that_repeats_at_the_start_of_a_slow_log_is_named_with_its_lines(
    tmp_path: Path, scenario: MotorScenario
) -> None:
    rows = recorded(scenario)[:100]
    times = [0.0] * 50 + [float(second) for second in range(50)]
    retimed = [[str(time), *row[1:]] for time, row in zip(times, rows, strict=True)]
    with raises_saying(ConfigurationError, "line 2 ", "line 52", "digits"):
        replay(MACHINE, [written(tmp_path, retimed)], None, as_json=True, stopped=lambda: False)


def test_json_of_a_check_needs_data() -> None:
    with pytest.raises(click.UsageError, match="needs DATA"):
        CliRunner().invoke(cli, ["check", str(MACHINE), "--json"], standalone_mode=False, catch_exceptions=False)
