"""``otolith replay``: the same reports as the daemon, byte for byte; unusable files are refused.

A golden case is a folder with ``data.*`` and a list of what its error contains, where ``{file}`` stands for the data
and ``{machine}`` for the machine file: its own, or the one that all cases without share.
"""

import ast
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.cli.replay import replay
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine
from otolith.runtime.replay import Replay
from otolith.storage.recording_files import MIN_FREE_BYTES
from otolith_drivers.errors import ConfigurationError, OtolithError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay.table import reader as table
from tests.cli.replays import (
    GOLDEN,
    HEADING,
    MACHINE,
    PERIOD,
    RECORDS,
    Lines,
    recorded,
    reports,
    summed_up,
    values,
    written,
)
from tests.conftest import EXAMPLES, SIGNALS
from tests.drivers.logs import frames_of, live
from tests.drivers.logs import written as written_log
from tests.machine.test_machine_file import GOLDEN as MACHINE_FILES
from tests.messages import assert_says_what_is_listed
from tests.waiting import PATIENCE

CASES = sorted(path.parent for path in GOLDEN.glob("*/data.*"))


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_an_unusable_file_gets_its_error(case: Path) -> None:
    (data,) = case.glob("data.*")
    machine = case / "machine.toml" if (case / "machine.toml").exists() else MACHINE
    with pytest.raises(ConfigurationError) as caught:
        replay(machine, [data], None, as_json=True, stopped=lambda: False)
    message = str(caught.value).replace(str(data), "{file}").replace(str(machine), "{machine}")
    assert_says_what_is_listed(message, case)


def test_a_binary_or_missing_file_is_refused(tmp_path: Path) -> None:
    for content in (b"t,V_a\n0,1\0\n", b"PK\3\4\0\0", b"x" * 300_000):
        path = tmp_path / "data.csv"
        path.write_bytes(content)
        with pytest.raises(ConfigurationError, match=r"is not text|is this a CSV file\?"):
            replay(MACHINE, [path], None, as_json=True, stopped=lambda: False)
    with pytest.raises(ConfigurationError, match="No such file"):
        replay(MACHINE, [tmp_path / "none.csv"], None, as_json=True, stopped=lambda: False)
    with pytest.raises(ConfigurationError, match="is a directory"):
        replay(MACHINE, [tmp_path], None, as_json=True, stopped=lambda: False)


def test_only_replay_needs_no_driver() -> None:
    file = MACHINE_FILES / "no-driver" / "machine.toml"
    with pytest.raises(ConfigurationError, match="loaded without its driver"):
        _ = load_machine(file, with_driver=False).driver
    with pytest.raises(ConfigurationError, match=r"missing: write \[driver\]"):
        load_machine(file)


def test_reports_equal_those_of_windows_without_a_file(
    tmp_path: Path, rows: Lines, scenario: MotorScenario, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = load_machine(MACHINE, with_driver=False)
    state = initial_state("motor", "site", machine.problem, machine.plan)
    documents = reports(written(tmp_path, rows), capsys)
    assert len(documents) == 5
    with table.TableReader(tmp_path / "data.csv", {name: machine.twin.unit_of(name) for name in SIGNALS}) as opened:
        windows = list(Replay(machine, opened).windows())
    for index, (window, document) in enumerate(zip(windows, documents, strict=True)):
        own = np.array([row[1:] for row in rows[index * RECORDS : (index + 1) * RECORDS]], dtype=np.float64)
        assert np.array_equal(window.values, own)
        assert window.start == pytest.approx(index * RECORDS * PERIOD, abs=1e-9)
        state, report = adapt(state, window)
        assert report.document == document.model_copy(update={"counters": None})
        assert document.parameters["R_a"].value == pytest.approx(scenario.parameters.R_a, rel=0.005)
    counters = documents[-1].counters
    assert counters is not None
    assert (counters.received, counters.windows) == (4 * len(rows), 5)


@pytest.mark.full
def test_two_runs_print_the_same_bytes(tmp_path: Path, rows: Lines) -> None:
    arguments = ["replay", str(MACHINE), str(written(tmp_path, rows))]
    program = (
        "import sys; from click.testing import CliRunner; from otolith.cli.main import cli\n"
        "for form in (['--json'], []):\n"
        "    done = CliRunner().invoke(cli, [*sys.argv[1:], *form], catch_exceptions=False)\n"
        "    print(repr((done.exit_code, done.stdout, done.stderr)))\n"
    )
    first, second = (
        subprocess.run(
            [sys.executable, "-c", program, *arguments],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    )
    assert first == second
    (code, lines, errors), (_, _, preview) = map(ast.literal_eval, first.splitlines())
    assert (code, errors) == (0, "")
    assert ["seconds" in json.loads(line)["cost"] for line in lines.splitlines()] == [False] * 5
    assert preview


def test_unknown_columns_are_named_and_ignored(tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]) -> None:
    data = written(tmp_path, [[*row, "x"] for row in rows], heading=(*HEADING, "Bemerkung [-]"))
    replay(MACHINE, [data], None, as_json=True, stopped=lambda: False)
    assert capsys.readouterr().err == f"{data}: columns not used: Bemerkung\n"


def test_the_summary_has_parameters_and_counts(tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]) -> None:
    text = summed_up(written(tmp_path, rows[:-50]), capsys)
    assert "motor (site): dc_motor (DT'), from t = 0 s to t = 8 s" in text
    assert "R_a" in text
    assert "Ω" in text
    assert "4 windows: 4 good, 0 bad; the twin explains 4 of 4" in text
    assert "950 rows read, 0 reordered" in text
    assert "the last 1.5 s are too short for a window of 2 s" in text


def test_a_recording_is_written(tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "run.rrd"
    replay(MACHINE, [written(tmp_path, rows)], path, as_json=False, stopped=lambda: False)
    assert "5 windows" in capsys.readouterr().out
    assert path.stat().st_size > 10_000


def test_a_full_disk_ends_a_recording_with_an_error(
    tmp_path: Path, rows: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("otolith.storage.recording_files.MIN_FREE_BYTES", MIN_FREE_BYTES << 40)
    with pytest.raises(OtolithError, match="MB are free on its disk"):
        replay(MACHINE, [written(tmp_path, rows)], tmp_path / "run.rrd", as_json=True, stopped=lambda: False)


def test_ctrl_c_ends_a_replay_with_the_reports_so_far(tmp_path: Path, rows: Lines) -> None:
    later = [[f"{float(row[0]) + 10.0 * turn:.3f}", *row[1:]] for turn in range(100) for row in rows]
    command = [sys.executable, "-m", "otolith", "replay", str(MACHINE), str(written(tmp_path, later)), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        ReportDocument.from_json(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        rest, errors = process.stdout.read(), process.stderr.read()
    assert process.returncode == 130
    assert len(rest.splitlines()) < 499
    assert "interrupted after" in errors
    assert "Traceback" not in errors


@pytest.mark.full
def test_memory_does_not_grow_with_the_file(tmp_path: Path, rows: Lines) -> None:
    """A hundred thousand rows are 6 MB of text; as cells they would be some 40 MB. Bad windows, to save time."""
    text = "\n".join(f"{index * PERIOD:.3f},,{','.join(rows[index % 1000][2:5])}" for index in range(100_000))
    long, short = tmp_path / "long.csv", tmp_path / "short.csv"
    long.write_text(f"{','.join(HEADING)}\n{text}\n", encoding="utf-8")
    short.write_text("\n".join(long.read_text(encoding="utf-8").splitlines()[:10_000]), encoding="utf-8")
    program = (
        "import resource, sys; from pathlib import Path; from otolith.cli.replay import replay\n"
        "for name in sys.argv[2:]:\n"
        "    replay(Path(sys.argv[1]), [Path(name)], None, as_json=False, stopped=lambda: False)\n"
        "    print('peak', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)\n"
    )
    command = [sys.executable, "-c", program, str(MACHINE), str(short), str(long)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "500 windows: 0 good" in printed
    small, large = (int(line.split()[1]) for line in printed.splitlines() if line.startswith("peak"))
    assert large - small < 10_000  # kB


def test_a_log_of_the_bus_gives_the_values_of_the_table(
    tmp_path: Path, scenario: MotorScenario, capsys: pytest.CaptureFixture[str]
) -> None:
    """Values of the bus have the resolution of its frames, and the table has those."""
    frames = frames_of(scenario, 600)
    received: dict[float, dict[str, float]] = {}
    for sample in live(frames):
        received.setdefault(round(sample.time, 2), {})[sample.signal] = sample.value
    rows = [[f"{time:.2f}", *(repr(row[name]) for name in SIGNALS)] for time, row in received.items()]
    table_path = written(tmp_path, rows)
    machine = tmp_path / "machine.toml"
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    machine.write_text(text.replace('"dc-motor.dbc"', f'"{EXAMPLES / "dc-motor.dbc"}"'), encoding="utf-8")
    estimates = {}
    for path in (
        table_path,
        *(written_log(tmp_path, frames, suffix) for suffix in (".log", ".asc", ".blf", ".trc.gz")),
    ):
        replay(machine, [path], None, as_json=True, stopped=lambda: False)
        lines = capsys.readouterr().out.splitlines()
        estimates[path.suffix] = values([ReportDocument.from_json(line) for line in lines])
    assert len(estimates[".csv"]) == 3
    for printed in estimates.values():
        assert printed == pytest.approx(estimates[".csv"], rel=1e-6)


def test_real_time_waits_for_the_end_of_each_window(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.read_text(encoding="utf-8") + '[window]\nlength = "0.5 s"\n', encoding="utf-8")
    later = [[f"{float(row[0]) + 1000.0 * (index >= 100):.3f}", *row[1:]] for index, row in enumerate(rows[:200])]
    data = written(tmp_path, later)
    printed = []
    for real_time in (False, True):
        begun = time.monotonic()
        replay(machine, [data], None, as_json=True, stopped=lambda: False, real_time=real_time)
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1]
    assert len(printed[0].splitlines()) == 4
    assert 2.0 <= time.monotonic() - begun < PATIENCE  # the gap in the middle is skipped


def test_columns_are_mapped_by_the_machine_file(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = values(reports(written(tmp_path, rows), capsys))
    in_rpm = [[*row[:4], repr(float(row[4]) * 30 / np.pi)] for row in rows]
    data = written(tmp_path, in_rpm, heading=("t", "U", "T_load", "i", "RotorSpeed"))
    machine = tmp_path / "machine.toml"
    signals = 'V_a = { column = "U" }\nT_load = {}\ni = {}\nomega = { column = "RotorSpeed", unit = "rpm" }\n'
    driver = f'[driver]\ntype = "replay"\nfile = "{data.name}"\n\n[signals]\n{signals}\n'
    machine.write_text(MACHINE.read_text(encoding="utf-8").replace("[twin]", driver + "[twin]"), encoding="utf-8")
    replay(machine, [data], None, as_json=True, stopped=lambda: False)
    documents = [ReportDocument.from_json(line) for line in capsys.readouterr().out.splitlines()]
    assert values(documents) == pytest.approx(plain, rel=1e-6)
