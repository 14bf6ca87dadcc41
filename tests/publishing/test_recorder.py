"""Recorder: the replay of a recording gives the reports that were made when it was recorded."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith.cli.replay import replay
from otolith.health.schema import ReportDocument
from otolith.machine import LoadedMachine, load_machine
from otolith.publishing.recorder import Recording, RotatedRecording
from otolith.runtime.replay import open_recorded
from otolith.storage.recording_files import RecordingBudget, RecordingFolder
from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay import recording as recording_module
from otolith_drivers.replay.recording import open_recording
from otolith_drivers.replay.sample_names import parts_folder, whole_file
from tests.cli.replays import MACHINE, PERIOD, RECORDS, Lines, recorded, reports, summed_up, written
from tests.drivers.replay.packed_windows import earlier_recording
from tests.messages import assert_each_says, assert_refuses, raises_saying
from tests.publishing.test_recording_size import noise
from tests.variants import often

UNITS = {"V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}
RERUN = Path(sys.executable).with_name("rerun")


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario)


@pytest.fixture
def machine() -> LoadedMachine:
    return load_machine(MACHINE, with_driver=False)


def record(folder: Path, rows: Lines, name: str = "run.rrd") -> Path:
    path = folder / name
    replay(MACHINE, [written(folder, rows)], path, as_json=True, stopped=lambda: False)
    return path


@pytest.fixture
def recording(rows: Lines, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of ``rows``, which tests only read, beside their table; made once."""
    folder = tmp_path_factory.getbasetemp() / "recorded"
    if not (folder / "run.rrd").exists():
        folder.mkdir(exist_ok=True)
        record(folder, rows)
    return folder / "run.rrd"


def assert_same(first: list[ReportDocument], again: list[ReportDocument], share: float = 0.0) -> None:
    """Compare reports, except for what a recording does not contain: arrival times and counts of samples.

    A recording leaves out bad windows. So the inputs before the window that follows are unknown in the replay: values
    may differ by a ``share`` of their standard deviation.
    """
    assert len(first) == len(again)
    for one, other in zip(first, again, strict=True):
        assert other.window.start == pytest.approx(one.window.start, abs=PERIOD / 2)  # jitter moves the grid
        assert other.window.quality.verdict is one.window.quality.verdict
        assert other.decision is one.decision
        for name, parameter in one.parameters.items():
            assert other.parameters[name].status is parameter.status
            assert other.parameters[name].value == pytest.approx(
                parameter.value, rel=1e-6, abs=share * (parameter.sd or 0.0)
            )
            assert other.parameters[name].sd == pytest.approx(parameter.sd, rel=max(1e-3, share))


@pytest.mark.parametrize("begun", often([1_700_000_000.0], [0.0, 1_700_000_000.0]))
def test_a_replayed_recording_gives_the_same_reports(
    tmp_path: Path, rows: Lines, begun: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """The data have blank cells, a spike, a window without outputs and one with jitter."""
    random = np.random.default_rng(3)
    for index, row in enumerate(rows):
        jitter = random.uniform(0.0, 0.02) if 2 * RECORDS < index < 3 * RECORDS else 0.0
        row[0] = f"{begun + float(row[0]) + jitter:.6f}"
    rows[50][3], rows[60][1], rows[70][4] = "", "", "1e6"
    for row in rows[RECORDS : 2 * RECORDS]:
        row[3:5] = "", ""
    path = record(tmp_path, rows)
    capsys.readouterr()
    first, again = reports(tmp_path / "data.csv", capsys), reports(path, capsys)
    assert {document.window.quality.verdict for document in first} == {"good", "bad"}
    assert_same(first, again, share=0.1)
    assert f"windows that were bad when they were recorded, left out: {RECORDS}" in summed_up(path, capsys)


def test_the_delay_of_a_signal_is_subtracted_once(
    tmp_path: Path, rows: Lines, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recording has corrected times; a bad window is left out by them, not by the times of the readings."""
    late = tmp_path / "late.toml"
    late.write_text(
        MACHINE.read_text(encoding="utf-8") + '\n[signals]\nomega = { delay = "30 ms" }\n', encoding="utf-8"
    )
    for row in rows[RECORDS : 2 * RECORDS]:
        row[3:5] = "", ""
    delayed = [[row[0], *row[1:4], rows[index - 3][4] if index >= 3 else ""] for index, row in enumerate(rows)]
    path = tmp_path / "late.rrd"
    replay(late, [written(tmp_path, delayed)], path, as_json=True, stopped=lambda: False)
    replay(late, [path], None, as_json=True, stopped=lambda: False)
    lines = [ReportDocument.from_json(line) for line in capsys.readouterr().out.splitlines()]
    first, again = lines[: len(lines) // 2], lines[len(lines) // 2 :]
    assert len(first) >= 4
    assert_same(first, again, share=0.1)


@pytest.mark.full
def test_two_replays_of_a_recording_are_identical(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reports(recording, capsys) == reports(recording, capsys)
    text = summed_up(recording, capsys)
    assert "1000 records read, 0 reordered, 0 bad; 4000 samples, 0 lost" in text


def test_a_recording_of_a_replay_has_the_same_samples(tmp_path: Path, recording: Path, machine: LoadedMachine) -> None:
    second = tmp_path / "again.rrd"
    replay(MACHINE, [recording], second, as_json=True, stopped=lambda: False)
    with open_recorded(machine, recording) as one, open_recorded(machine, second) as other:
        for left, right in zip(one.chunks(), other.chunks(), strict=True):
            assert left.times == pytest.approx(right.times, abs=2e-9)
            assert all(np.array_equal(left.columns[name], right.columns[name]) for name in UNITS)


def test_a_recording_of_an_earlier_version_is_read_also_optimised_by_rerun(tmp_path: Path) -> None:
    """It has its samples in itself."""
    own, better = earlier_recording(tmp_path / "own.rrd"), tmp_path / "better.rrd"
    subprocess.run([RERUN, "rrd", "optimize", own, "-o", better], capture_output=True, check=True)
    signals = np.random.default_rng(7)  # as tests/publishing/test_recording_size.py makes them
    signals.normal()
    expected = signals.normal(size=(RECORDS, 2))
    for path in (own, better):
        with open_recording(path, UNITS) as reader:
            read = list(reader.chunks())
            assert reader.warnings() == []
        assert sum(len(rows.times) for rows in read) == 3 * RECORDS
        for place, name in enumerate(("i", "omega")):
            assert np.array_equal(read[0].columns[name][:RECORDS], expected[:, place])


def test_a_recording_without_its_samples_says_where_they_are(tmp_path: Path, recording: Path) -> None:
    alone = tmp_path / "alone.rrd"
    alone.write_bytes(recording.read_bytes())
    with raises_saying(ConfigurationError, "alone.rrd", "alone.samples.parquet", "beside"):
        open_recording(alone, UNITS)
    samples = tmp_path / "alone.samples.parquet"
    samples.write_bytes(whole_file(recording).read_bytes())
    alone.unlink()
    with open_recording(samples, UNITS) as reader:
        assert sum(len(rows.times) for rows in reader.chunks()) == 5 * RECORDS


def test_what_a_killed_recorder_left_is_one_file_with_the_next_one(tmp_path: Path, machine: LoadedMachine) -> None:
    folder = RecordingFolder(tmp_path / "recordings", "site.motor", RecordingBudget(1e9, 1e9, 1e9, 1e9))
    source, begin, (one, other, *_) = machine.recorded(Sampling.TRUE), 1_700_000_000.0, noise(3)
    killed = RotatedRecording(folder.new_path(begin), source, folder, begin)
    killed.add(one, begin)
    killed.write()
    killed.add(other, begin)  # it is lost
    following = RotatedRecording(folder.new_path(begin + 60.0), source, folder, begin + 60.0)
    assert not parts_folder(killed.path).exists()
    assert whole_file(killed.path).stat().st_mode & 0o777 == 0o640
    with open_recording(killed.path, UNITS) as reader:
        assert sum(len(rows.times) for rows in reader.chunks()) == RECORDS
    assert parts_folder(following.path).stat().st_mode & 0o777 == 0o750
    following.add(other, begin + 60.0)
    following.close()
    assert sorted(path.suffix for path in folder._folder.iterdir()) == [".parquet", ".parquet", ".rrd", ".rrd"]


@pytest.mark.full
def test_an_unclosed_recording_is_read(tmp_path: Path, recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    killed = tmp_path / "killed.rrd"
    program = (
        "import os, sys; from pathlib import Path\n"
        "import otolith.publishing.recorder as module, otolith.cli.replay as replaying\n"
        "close = module.Recording.close\n"
        "module.Recording.close = lambda self: (self.write(), os.kill(os.getpid(), 9))\n"
        "machine, data, path = map(Path, sys.argv[1:])\n"
        "replaying.replay(machine, [data], path, as_json=True, stopped=lambda: False)\n"
    )
    subprocess.run(
        [sys.executable, "-c", program, MACHINE, recording.with_name("data.csv"), killed],
        capture_output=True,
        check=False,
    )
    assert reports(killed, capsys) == reports(recording, capsys)
    assert "never closed by the recorder" in summed_up(killed, capsys)


def test_a_torn_recording_of_an_earlier_version_says_how_it_is_repaired(tmp_path: Path) -> None:
    torn = earlier_recording(tmp_path / "torn.rrd")
    torn.write_bytes(torn.read_bytes()[:-20_000])
    with (
        pytest.raises(ConfigurationError, match=r"torn\.rrd: damaged, .*'rerun rrd optimize --continue") as info,
        open_recording(torn, UNITS) as reader,
    ):
        list(reader.chunks())
    command = str(info.value).split("'")[1].replace("whole.rrd", str(tmp_path / "whole.rrd"))
    subprocess.run([RERUN.with_name(command.split()[0]), *command.split()[1:]], capture_output=True, check=True)
    with open_recording(tmp_path / "whole.rrd", UNITS) as reader:
        assert sum(len(rows.times) for rows in reader.chunks()) >= RECORDS


def test_a_recording_that_is_still_being_written_is_no_damage(recording: Path) -> None:
    """Its recorder may have written all so far, but has not closed it."""
    with open_recording(recording, UNITS) as reader:
        reader._closed = False
        assert "never closed" in " ".join(reader.warnings())
    with recording.open("ab"), open_recording(recording, UNITS) as reader:
        assert reader.warnings() == []
        reader._closed = False
        (line,) = reader.warnings()
        assert "still being written" in line
        assert "never" not in line


def test_ctrl_c_does_not_call_a_recording_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal signals the process group; the child that reads the file is in another one."""
    monkeypatch.setattr(recording_module, "READ_IN_CHILD", [sys.executable, "-c", CHILD_IN_OTHER_GROUP])
    path = tmp_path / "empty.rrd"
    path.touch()
    with pytest.raises(ConfigurationError, match="another group"):
        open_recording(path, {})


CHILD_IN_OTHER_GROUP = """
import os, struct, sys
text = b"another group" if os.getpgrp() != os.getpgid(os.getppid()) else b"the same group"
sys.stdout.buffer.write(struct.pack("<cIf", b"F", len(text), 0.0) + text)
"""


def test_a_child_that_aborts_is_a_damaged_file_and_costs_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = earlier_recording(tmp_path / "run.rrd")
    monkeypatch.setattr(recording_module, "READ_IN_CHILD", [sys.executable, "-c", "import os; os.abort()"])
    with raises_saying(ConfigurationError, "run.rrd", "aborts", "rerun rrd optimize"):
        open_recording(recording, UNITS)


def test_a_recording_of_an_earlier_version_is_read_by_one_child_which_ends_with_its_reader(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = earlier_recording(tmp_path / "run.rrd")
    started: list[subprocess.Popen[bytes]] = []

    class Counted(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **keys: Any) -> None:
            super().__init__(*arguments, **keys)
            started.append(self)

    monkeypatch.setattr(recording_module.subprocess, "Popen", Counted)  # type: ignore[attr-defined]
    with open_recording(recording, UNITS) as reader:
        (child,) = started
        assert sum(len(rows.times) for rows in reader.chunks()) == 3 * RECORDS
        assert reader.progress == 1.0
    assert child.returncode is not None
    assert len(started) == 1
    assert "rerun" not in vars(recording_module)


def test_a_recording_of_another_application_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.rrd"
    with pytest.raises(ConfigurationError, match="No such file"):
        open_recording(path, UNITS)
    stream = rr.RecordingStream("somebody_else", recording_id="x")
    stream.save(path)
    stream.log("signals/i", rr.Scalars([1.0]))
    stream.disconnect()
    with raises_saying(ConfigurationError, "'somebody_else'", "Otolith"):
        open_recording(path, UNITS)


@pytest.mark.parametrize(
    "text",
    ["", "{}", '{"sampling": "true"}', '{"sampling": "guessed", "delays": {}}', '{"sampling": "true", "delays": 1}'],
)
def test_a_recording_whose_times_mean_something_unknown_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "run.rrd"
    stream = rr.RecordingStream("otolith", recording_id="x")
    stream.save(path)
    stream.log("times", rr.TextDocument(text), static=True)
    stream.log("signals/i", rr.Scalars([1.0]))
    stream.disconnect()
    with raises_saying(ConfigurationError, "/times", "mean"):
        open_recording(path, {"i": "A"})


def test_the_error_names_a_signal_that_was_not_recorded(recording: Path) -> None:
    with raises_saying(ConfigurationError, "'p' (Pa)", "T_load, V_a, i, omega"):
        open_recording(recording, {**UNITS, "p": "Pa"})
    with raises_saying(ConfigurationError, "'i'", "'A'", "'V'"):
        open_recording(recording, {**UNITS, "i": "V"})
    with open_recording(recording, {**UNITS, "i": "mA"}) as milli, open_recording(recording, UNITS) as plain:
        ampere = np.concatenate([part.columns["i"] for part in plain.chunks()])
        assert np.concatenate([part.columns["i"] for part in milli.chunks()]) == pytest.approx(1e3 * ampere)


DAMAGE = st.lists(st.tuples(st.floats(0.0, 1.0, exclude_max=True), st.integers(0, 255)), max_size=3)
SHORT = settings(max_examples=8)
LONG = settings(max_examples=40)


def check_damaged(tmp_path: Path, scenario: MotorScenario, changes: list[tuple[float, int]], end: float) -> None:
    whole = tmp_path / "whole.rrd"
    if not whole.exists():
        record(tmp_path, recorded(scenario)[: 2 * RECORDS], whole.name)
    content = bytearray(whole_file(whole).read_bytes())
    for place, value in changes:
        content[int(place * len(content))] = value
    path = whole_file(tmp_path / "damaged.rrd")
    path.write_bytes(content[: int(end * len(content))])
    try:
        with open_recording(path, UNITS) as damaged:
            read = [len(part.times) for part in damaged.chunks()]
            assert all(read)
            assert sum(read) == 2 * RECORDS or damaged.warnings()
    except ConfigurationError as error:
        assert_refuses(error, path)


@pytest.mark.full
@SHORT
@given(DAMAGE, st.floats(0.0, 1.0))
def test_a_damaged_recording_is_refused_or_read(
    tmp_path: Path, scenario: MotorScenario, changes: list[tuple[float, int]], end: float
) -> None:
    check_damaged(tmp_path, scenario, changes, end)


@pytest.mark.full
@LONG
@given(DAMAGE, st.floats(0.0, 1.0))
def test_many_damaged_recordings_are_refused_or_read(
    tmp_path: Path, scenario: MotorScenario, changes: list[tuple[float, int]], end: float
) -> None:
    check_damaged(tmp_path, scenario, changes, end)


RECORDS_NOTHING = """
import sys
from pathlib import Path
from otolith.machine import load_machine
from otolith.publishing import recorder
from otolith.storage.recording_files import Opened
from otolith_drivers.base import Sampling

class Messages(list):
    recv = list.pop

machine = load_machine(Path(sys.argv[1]), with_driver=False)
opened = Opened(Path(sys.argv[2]), machine.recorded(Sampling.TRUE), None)
recorder.main(Messages([None, ("here.motor", 1, opened)]))
print(sys.modules.get("pandas"))
"""


def test_the_recorder_does_without_pandas(tmp_path: Path) -> None:
    """Where it is installed, pyarrow would import it, which costs 34 MB; without it nothing of the layout is lost."""
    command = [sys.executable, "-c", RECORDS_NOTHING, str(MACHINE), str(tmp_path / "run.rrd")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("None\n", "")
    assert (tmp_path / "run.rrd").stat().st_size > 0


def test_a_recording_without_a_window_yet_is_not_said_to_lack_a_signal(tmp_path: Path, machine: LoadedMachine) -> None:
    """A daemon that began less than a minute ago has written what the records will mean, and none of them."""
    path, still_open = tmp_path / "run.rrd", tmp_path / "open.rrd"
    Recording(path, machine.recorded(Sampling.TRUE)).close()
    being_written = Recording(still_open, machine.recorded(Sampling.TRUE))
    for file, state in ((path, "ended"), (still_open, "minutes")):
        with pytest.raises(ConfigurationError) as refused:
            open_recording(file, UNITS)
        assert_each_says([str(refused.value)], (file.name, "window", state))
        assert "V_a" not in str(refused.value)
    with raises_saying(ConfigurationError, "'p' (Pa)", "T_load, V_a, i, omega"):
        open_recording(path, {"p": "Pa"})
    being_written.close()
