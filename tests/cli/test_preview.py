"""The preview of a recording: properties of a generated file are printed; short files and slow cores are named."""

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from otolith.cli.main import cli
from otolith.cli.replay import replay
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.preview import Preview, preview_lines, preview_recording, short_lines
from otolith.runtime.replay import open_recordings
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay.readers import Reader
from tests.adaptation.test_parameters_at_bounds import MACHINE as SERVO_MACHINE
from tests.adaptation.test_parameters_at_bounds import TWIN as SERVO_TWIN
from tests.cli.replays import MACHINE, Lines, recorded, written
from tests.messages import assert_says

SERVO = SERVO_TWIN.replace("[1e-5, 1e-4]", "[1e-5, 2e-3]").replace("[5e-5, 2e-4]", "[5e-5, 2e-3]").replace(
    "nominal = 1e-4", "nominal = 2e-4").replace("nominal = 5e-5", "nominal = 4e-4")  # fmt: skip
SERVO_SIGNALS = """
[driver]
type = "replay"
file = "data.csv"
[signals]
T = { column = "T", unit = "N*m" }
w = { column = "w", unit = "rad/s" }
"""


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario, 6)


def previewed(data: Path, window: str = "", max_rows: int | None = None) -> Preview:
    machine = data.parent / "machine.toml"
    machine.write_text(MACHINE.read_text(encoding="utf-8") + f"[window]\n{window}\n", encoding="utf-8")
    loaded = load_machine(machine, with_driver=False)
    return preview_recording(loaded, [data], max_rows=max_rows)


def retimed(rows: Lines, times: Sequence[float]) -> Lines:
    return [[f"{time:.6f}", *row[1:]] for time, row in zip(times, rows, strict=True)]


def check(*arguments: Path | str) -> Result:
    return CliRunner().invoke(cli, ["check", *map(str, arguments)], standalone_mode=False)


def row_of(text: str, label: str) -> list[str]:
    (line,) = [line for line in text.splitlines() if line.startswith(f"  {label} ")]
    return line.split()


def test_a_clean_file_is_usable_and_every_line_fits_80_columns(tmp_path: Path, rows: Lines) -> None:
    result = check(MACHINE, written(tmp_path, rows))
    assert result.return_value == 0, result.exception
    text = result.output[result.output.index("data.csv: ") :]
    assert "data.csv: 1200 rows in 11.99 s" in text
    assert row_of(text, "omega [rad/s]")[2:8] == ["1200", "10", "ms", "0.0%", "0", "-"]
    assert "windows of 2 s with a record every 10 ms: 6, 6 usable, 6 with motion" in text
    assert row_of(text, "R_a")[-3:] == ["6", "of", "6"]
    assert re.search(r"a window of 2 s takes [\d.]+ m?s to compute", text)
    assert "proposed" not in text
    assert "!" not in text
    assert max(map(len, text.splitlines())) <= 80


def test_rate_jitter_and_proposed_window(tmp_path: Path, rows: Lines) -> None:
    random = np.random.default_rng(1)
    times = np.arange(len(rows)) * 0.01 * 2.0 + random.uniform(-0.002, 0.002, len(rows))
    preview = previewed(written(tmp_path, retimed(rows, times.tolist())))
    omega = preview.signals["omega"]
    assert omega.interval_s == pytest.approx(0.02, rel=0.01)
    assert omega.jitter == pytest.approx(0.002 * np.sqrt(2.0 / 3.0) / 0.02, rel=0.1)
    assert preview.windows.sample_period_s == 0.01
    assert preview.proposed.sample_period_s == pytest.approx(omega.interval_s, rel=0.01)
    assert preview.proposed.length_s == pytest.approx(2.0, abs=0.02)
    assert preview.proposed.usable == preview.proposed.count == 12
    assert all(accuracy.determined for accuracy in preview.proposed.parameters.values())


def test_a_gap_is_shown_with_length_and_place(tmp_path: Path, rows: Lines) -> None:
    times = [index * 0.01 + 3.0 * (index >= 700) for index in range(len(rows))]
    preview = previewed(written(tmp_path, retimed(rows, times)))
    text = "\n".join(preview_lines(preview))
    assert row_of(text, "i [A]")[6:9] == ["1", "3.01", "s"]
    (remark,) = [remark for remark in preview.remarks if "gap" in remark]
    assert_says(remark, "V_a, T_load, i, omega", "3.01 s", "6.99 s", "line 702")


def test_rows_that_come_twice_and_steps_back_are_counted(tmp_path: Path, rows: Lines) -> None:
    twice = [row for row in rows[:600] for _ in range(2)]
    preview = previewed(written(tmp_path, [*twice, *rows[500:]]))
    assert preview.signals["omega"].duplicates == 600
    assert preview.steps_back == 1
    assert "1 step back in time in line 1202: t = 5 s after t = 5.99 s" in preview.remarks
    assert any(
        "at time and with the value of the sample before: 600 samples (32%)" in remark for remark in preview.remarks
    )


def test_quantisation_step_and_slow_register(tmp_path: Path, rows: Lines) -> None:
    values = np.array([float(row[4]) for row in rows])
    slow = np.repeat(values[::5], 5)
    coarse = [f"{round(float(row[3]) / 0.004) * 0.004:.3f}" for row in rows]
    changed = [[*row[:3], *cells] for row, *cells in zip(rows, coarse, map(str, slow), strict=True)]
    preview = previewed(written(tmp_path, changed))
    assert preview.signals["i"].step == pytest.approx(0.004)
    assert preview.signals["omega"].renewal == 5
    assert "omega: the value changes with every 5th sample only, about every 50 ms" in preview.remarks
    assert row_of("\n".join(preview_lines(preview)), "i [A]")[-2:] == ["0.004", "0"]


def test_the_expected_accuracy_is_that_of_the_estimates(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    data = written(tmp_path, rows)
    expected = previewed(data).windows.parameters
    replay(MACHINE, [data], None, as_json=True, stopped=lambda: False)
    reports = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    for name, accuracy in expected.items():
        measured = np.median([1.96 * report["parameters"][name]["raw_sd"] for report in reports])
        assert accuracy.half_width == pytest.approx(measured, rel=0.2)
        assert accuracy.determined == 6


def test_a_machine_at_rest_has_no_motion_and_determines_nothing(tmp_path: Path, rows: Lines) -> None:
    random = np.random.default_rng(1)
    resting = [
        [row[0], "0", "0", repr(0.005 * random.standard_normal()), repr(0.02 * random.standard_normal())]
        for row in rows
    ]
    preview = previewed(written(tmp_path, resting))
    assert (preview.windows.usable, preview.windows.moving) == (6, 0)
    assert all(accuracy.determined == 0 for accuracy in preview.windows.parameters.values())
    assert all(accuracy.reason for accuracy in preview.windows.parameters.values())


def test_a_window_that_is_too_short_for_its_noise_gets_a_longer_one(tmp_path: Path, rows: Lines) -> None:
    """Half of the 95 % interval of R_a is some 0.021 ohm in 0.5 s; here 0.25 % of 6.5 ohm are required."""
    window = 'length = "0.5 s"\n[estimation]\ndetermined_within = "0.25 %"'
    preview = previewed(written(tmp_path, rows), window)
    assert preview.windows.length_s == 0.5
    assert preview.proposed.length_s == 1.0
    lines = list(preview_lines(preview))
    start = lines.index("proposed for the machine file:")
    assert lines[start + 1] == "  [window]"
    pasted = "\n".join(line.strip() for line in lines[start + 2 : start + 4])
    assert previewed(tmp_path / "data.csv", pasted).windows.length_s == preview.proposed.length_s


def servo(tmp_path: Path) -> tuple[LoadedMachine, list[str]]:
    """A servo whose torque steps every 20 s, and the lines of its table: in 2 s at one speed two frictions are traded.

    These are viscous and dry friction.
    """
    (tmp_path / "servo.toml").write_text(SERVO, encoding="utf-8")
    text = SERVO_MACHINE.replace('length = "5 s"', 'length = "2 s"') + SERVO_SIGNALS
    (tmp_path / "m.toml").write_text(text, encoding="utf-8")
    random, speed, lines = np.random.default_rng(1), 0.0, ["t,T,w"]
    for index in range(20_000):
        torque = (0.1, 0.06, -0.08)[(index + 900) // 2000 % 3]
        lines.append(f"{0.01 * index:.2f},{torque},{speed + 0.5 * random.normal():.4f}")
        for _ in range(10):
            speed += 1e-3 * (torque - 4e-4 * speed - 0.0366 * math.tanh(speed / 2.0)) / 2e-4
    return load_machine(tmp_path / "m.toml", with_driver=False), lines


def test_a_window_that_trades_its_parameters_gets_one_that_holds_the_step(tmp_path: Path) -> None:
    machine, lines = servo(tmp_path)
    data = tmp_path / "data.csv"
    data.write_text("\n".join(lines) + "\n", encoding="utf-8")
    preview = preview_recording(machine, [data])
    assert any(2 * accuracy.determined < preview.windows.analysed for accuracy in preview.windows.parameters.values())
    proposed = preview.proposed
    assert 2.0 < proposed.length_s <= 30.0
    assert all(2 * accuracy.determined >= proposed.analysed for accuracy in proposed.parameters.values())
    (line,) = [remark for remark in preview.remarks if "would bring" in remark]
    assert_says(line, "T_c", "instead of")


def test_no_window_is_told_of_that_no_recording_can_fill(tmp_path: Path) -> None:
    """Recordings of 8 s each, with pauses between."""
    machine, (header, *rows) = servo(tmp_path)
    files = [tmp_path / f"{number}.csv" for number in range(5)]
    for number, file in enumerate(files):
        begin = 4000 * number
        file.write_text("\n".join([header, *rows[begin : begin + 800]]) + "\n", encoding="utf-8")
    preview = preview_recording(machine, files)
    assert preview.windows.moving
    assert preview.proposed.length_s <= 8.0
    for remark in preview.remarks:
        assert "would bring" not in remark or "a window of 5 s" in remark


@pytest.mark.parametrize("count", [1, 2, 9])
def test_no_window_is_proposed_that_the_data_cannot_fill(tmp_path: Path, rows: Lines, count: int) -> None:
    preview = previewed(written(tmp_path, rows[:count]))
    assert preview.proposed == preview.windows


def test_the_accuracy_of_a_proposed_window_is_that_of_the_pasted_lines(tmp_path: Path, rows: Lines) -> None:
    """At irregular times process noise has the step of the sample period, whatever the mean step of the records is."""
    random = np.random.default_rng(1)
    late = [
        [
            [f"{float(row[0]) + random.uniform(0.001, 0.009):.6f}", "", "", *cells]
            for cells in ([row[3], ""], ["", row[4]])
        ]
        for row in rows
    ]
    data = written(
        tmp_path, [line for row, others in zip(rows, late, strict=True) for line in ([*row[:3], "", ""], *others)]
    )
    noise = '[process_noise]\nomega = "0.5 rad/s/s^0.5"\ni = "0.02 A/s^0.5"\n'
    proposed = previewed(data, f'length = "0.5 s"\n[estimation]\ndetermined_within = "0.5 %"\n{noise}').proposed
    assert proposed.length_s > 0.5
    period = f"{proposed.sample_period_s * 1e3:.6g} ms"
    lines = f'length = "{proposed.length_s:.9g} s"\nsample_period = "{period}"\n'
    pasted = previewed(data, f'{lines}[estimation]\ndetermined_within = "0.5 %"\n{noise}').windows
    assert proposed.parameters == pasted.parameters


def test_a_file_that_is_too_short_gives_exit_code_1_and_a_shorter_window(tmp_path: Path, rows: Lines) -> None:
    result = check(MACHINE, written(tmp_path, rows[:150]))
    assert result.return_value == 1
    assert "too short for a window" in result.output
    assert 'length = "0.5 s"' in result.output


def test_windows_that_are_all_refused_give_exit_code_1_with_the_reasons(tmp_path: Path, rows: Lines) -> None:
    blank = [[*row[:3], "", ""] for row in rows]
    result = check(MACHINE, written(tmp_path, blank))
    assert result.return_value == 1
    assert "refused: " in result.output
    assert "i, omega: no sample" in result.output
    assert "no window can be used" in result.output


def test_json_has_the_same_numbers(tmp_path: Path, rows: Lines) -> None:
    result = check(MACHINE, written(tmp_path, rows), "--json")
    assert result.return_value == 0, result.exception
    document = json.loads(result.output)
    assert document["rows"] == 1200
    assert document["signals"]["omega"]["interval_s"] == pytest.approx(0.01)
    assert document["windows"]["usable"] == 6
    assert (
        document["proposed"]["parameters"]["R_a"]["half_width"] < document["proposed"]["parameters"]["R_a"]["required"]
    )
    assert document["computing_s"] > 0.0


def test_a_core_that_is_slower_than_the_machine_is_named(
    tmp_path: Path, rows: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = iter(range(0, 1000, 3))
    monkeypatch.setattr("otolith.runtime.worker.time.perf_counter", lambda: float(next(clock)))
    preview = previewed(written(tmp_path, rows))
    assert "slower than real time: a window of 2 s takes 3 s to compute, at most 3 s" in list(preview_lines(preview))


def test_a_replay_begins_with_a_short_preview_on_standard_error(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    data = written(tmp_path, rows)
    replay(MACHINE, [data], None, as_json=False, stopped=lambda: False)
    printed = capsys.readouterr()
    assert "V_a, T_load, i, omega every 10 ms" in printed.err
    assert "6 usable, 6 with motion" in printed.err
    assert "expected 95 % intervals from one window: R_a ±" in printed.err
    assert len(printed.err.splitlines()) <= 5
    assert "6 windows: 6 good" in printed.out
    replay(MACHINE, [data], None, as_json=True, stopped=lambda: False)
    assert capsys.readouterr().err == ""


def test_the_short_preview_reads_only_the_beginning(
    tmp_path: Path, rows: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("otolith_drivers.replay.table.reader.CHUNK", 10_000)
    preview = previewed(written(tmp_path, rows), max_rows=450)
    assert 450 < preview.rows < 1000
    lines = list(short_lines(preview))
    assert lines[0].strip().startswith(f"{preview.rows} rows of data.csv: V_a, T_load")
    assert_says(lines[-1], "not examined", "window", "computing time", "'otolith check'")


def test_the_data_are_read_once_and_again_for_each_window_that_is_tried_unless_the_preview_is_short(
    tmp_path: Path, rows: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Path] = []

    def counting(machine: LoadedMachine, files: Sequence[Path]) -> Reader:
        opened.extend(files)
        return open_recordings(machine, files)

    monkeypatch.setattr("otolith.runtime.preview.open_recordings", counting)
    data = written(tmp_path, rows)
    counts = []
    for window, max_rows in (
        ("", None),
        ('length = "0.5 s"\n[estimation]\ndetermined_within = "0.25 %"', None),
        ('sample_period = "20 ms"', None),
        ('sample_period = "20 ms"', 10_000),
    ):
        preview = previewed(data, window, max_rows)
        counts.append((len(opened), preview.proposed != preview.windows))
        opened.clear()
    # In 0.5 s and 1 s the damping is far from what is asked, so 2 s are tried as well.
    assert counts == [(1, False), (3, True), (2, True), (1, False)]


@pytest.mark.parametrize(("end", "kind"), [(1.0, "largest"), pytest.param(-1.0, "smallest", marks=pytest.mark.full)])
def test_a_saturated_sensor_is_remarked(tmp_path: Path, rows: Lines, end: float, kind: str) -> None:
    """A tenth of the readings of the current are at the end of its range; a turning point or a rest is no end."""
    readings = np.array([float(row[3]) for row in rows])
    limit = float(np.quantile(end * readings, 0.9))
    clipped = [[*row[:3], repr(end * min(end * float(row[3]), limit)), *row[4:]] for row in rows]
    (remark,) = [text for text in previewed(written(tmp_path, clipped)).remarks if "exactly" in text]
    assert remark.startswith(f"i: 10% of the samples have exactly its {kind} value")
    assert "leave these cells blank" in remark
    times = np.array([float(row[0]) for row in rows])
    healthy = np.maximum(np.round(10.0 * np.sin(times), 2), 0.0)  # turns at the step of its converter, and rests at 0
    natural = [[*row[:3], repr(float(value)), *row[4:]] for row, value in zip(rows, healthy, strict=True)]
    assert not [text for text in previewed(written(tmp_path, natural)).remarks if "exactly" in text]


@pytest.mark.parametrize("constant", [(3, 4), (4,)])
def test_a_constant_output_determines_nothing(tmp_path: Path, rows: Lines, constant: tuple[int, ...]) -> None:
    still = [["1.5" if index in constant else cell for index, cell in enumerate(row)] for row in rows]
    preview = previewed(written(tmp_path, still))
    names = ", ".join({3: "i", 4: "omega"}[index] for index in constant)
    assert f"{names}: the value never changes, so it determines no parameter" in preview.remarks
    if constant == (3, 4):
        for accuracy in preview.windows.parameters.values():
            assert accuracy.determined == 0
            assert accuracy.reason
    else:
        moving = previewed(written(tmp_path, rows)).windows
        for name, accuracy in preview.windows.parameters.items():
            assert (accuracy.half_width or np.inf) > 1.2 * (moving.parameters[name].half_width or np.inf)
