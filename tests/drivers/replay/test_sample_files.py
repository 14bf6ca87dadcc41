"""Samples of a recording in Parquet files: who reads them, and what a kill, a damage or a full disk costs."""

import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay import sample_files as module
from otolith_drivers.replay.joined import JoinedReader
from otolith_drivers.replay.readers import Rows
from otolith_drivers.replay.recording import open_recording
from otolith_drivers.replay.sample_files import SampleWriter, TimesRecord, unite
from otolith_drivers.replay.sample_names import parts_folder, sample_files, whole_file
from tests.messages import assert_refuses, raises_saying

UNITS = {"i": "A", "omega": "rad/s"}
MEANING = TimesRecord(sampling=Sampling.TRUE, delays={}, signals=UNITS)
BEGIN, STEP, COUNT = 1_700_000_000_000_000_000, 10_000_000, 50  # ns, ns, records of a window


def window(number: int) -> tuple[np.ndarray, list[np.ndarray]]:
    random = np.random.default_rng(number)
    times = BEGIN + (COUNT * number + np.arange(COUNT)) * STEP
    return times, [random.normal(size=COUNT), random.normal(size=COUNT)]


def begun(path: Path, windows: int, at_once: int = 1) -> SampleWriter:
    """A writer of so many windows, ``at_once`` of them in each part."""
    writer = SampleWriter(path, MEANING, list(UNITS), {}, None)
    for number in range(windows):
        writer.add(*window(number), good=True)
        if number % at_once == at_once - 1:
            writer.save()
    return writer


def read(path: Path) -> list[Rows]:
    with open_recording(path, UNITS) as reader:
        return list(reader.chunks())


def signals_of(rows: list[Rows]) -> np.ndarray:
    return np.concatenate([np.column_stack([part.columns["i"], part.columns["omega"]]) for part in rows])


def expected(*numbers: int) -> np.ndarray:
    return np.concatenate([np.column_stack(window(number)[1]) for number in numbers])


WORDS = st.integers(-(2**63), 2**63 - 1)
WINDOWS = st.lists(st.lists(WORDS, min_size=3, max_size=3), min_size=1, max_size=30)


@given(WINDOWS, st.booleans())
def test_times_and_values_are_the_same_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, words: list[list[int]], good: bool
) -> None:
    """Values are any 64 bits, but that every not-a-number is a missing record."""
    numbers = np.array(words, dtype=np.int64)
    path = tmp_path_factory.mktemp("bits") / "run.rrd"
    columns = [numbers[:, place].copy().view(np.float64) for place in (1, 2)]
    writer = SampleWriter(path, MEANING, list(UNITS), {}, None)
    writer.add(numbers[:, 0], columns, good=good)
    writer.close()
    (part,) = module.rows_of(whole_file(path), 2, 1000)
    assert not isinstance(part, str)
    times, values, are_good = part
    assert np.array_equal(times, numbers[:, 0])
    assert list(are_good) == [good] * len(words)
    for place, column in enumerate(columns):
        missing = np.isnan(column)
        assert np.array_equal(np.isnan(values[place]), missing)
        assert np.array_equal(values[place][~missing].view(np.int64), column[~missing].view(np.int64))


def test_pandas_and_arrow_read_names_units_and_gaps(tmp_path: Path) -> None:
    pd = pytest.importorskip("pandas")
    path = tmp_path / "run.rrd"
    writer = begun(path, 2)
    times, (first, second) = window(2)
    first = np.where(np.arange(COUNT) % 2, np.nan, first)
    writer.add(times, [first, second], good=False)
    writer.close()
    frame = pd.read_parquet(whole_file(path))
    assert list(frame.columns) == ["time", "i", "omega", "good"]
    assert frame["time"].iloc[0] == pd.Timestamp(BEGIN, tz="UTC")
    assert frame["i"].isna().sum() == COUNT // 2
    assert (~frame["good"]).sum() == COUNT
    assert np.array_equal(frame["omega"][: 2 * COUNT], expected(0, 1)[:, 1])
    file = pq.ParquetFile(whole_file(path))
    assert [file.schema_arrow.field(name).metadata[b"unit"] for name in UNITS] == [b"A", b"rad/s"]
    column = file.metadata.row_group(0).column(1)
    assert column.compression == "ZSTD"
    assert "BYTE_STREAM_SPLIT" in column.encodings
    assert column.statistics.null_count == COUNT // 2


def test_dask_reads_parts_and_whole_files(tmp_path: Path) -> None:
    frames = pytest.importorskip("dask.dataframe")
    path = tmp_path / "run.rrd"
    writer = begun(path, 4)
    assert len(frames.read_parquet(parts_folder(path))) == 4 * COUNT
    writer.close()
    assert len(frames.read_parquet([whole_file(path)])) == 4 * COUNT


KILLED = """
import os, sys
from pathlib import Path
from tests.drivers.replay.test_sample_files import begun
from otolith_drivers.replay import sample_files

path, where = Path(sys.argv[1]), sys.argv[2]
writer = begun(path, 7, at_once=2)
kill = lambda *arguments, **keys: os.kill(os.getpid(), 9)
if where == "before a part":
    sample_files._write = kill
elif where == "in a part":
    Path.replace = kill
elif where == "in the whole file":
    os.fsync = kill
elif where == "before the parts go":
    sample_files.shutil.rmtree = kill
writer.close()
"""


@pytest.mark.parametrize(
    ("where", "windows"),
    [("before a part", 6), ("in a part", 6), ("in the whole file", 7), ("before the parts go", 7)],
)
def test_a_kill_at_any_moment_costs_no_window_that_was_written(tmp_path: Path, where: str, windows: int) -> None:
    path = tmp_path / "run.rrd"
    command = [sys.executable, "-c", KILLED, str(path), where]
    assert subprocess.run(command, check=False, cwd=Path(__file__).parents[3]).returncode == -9
    assert np.array_equal(signals_of(read(path)), expected(*range(windows)))
    unite(path)  # as the next recorder does
    assert np.array_equal(signals_of(read(path)), expected(*range(windows)))
    assert sorted(tmp_path.iterdir()) == [whole_file(path)]


def test_parts_are_one_file_afterwards_in_groups_of_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ROW_GROUP", 3 * COUNT)
    begun(tmp_path / "run.rrd", 8).close()
    file = pq.ParquetFile(whole_file(tmp_path / "run.rrd"))
    sizes = [file.metadata.row_group(group).num_rows for group in range(file.num_row_groups)]
    assert sum(sizes) == 8 * COUNT
    assert max(sizes) == 3 * COUNT
    assert np.array_equal(signals_of(read(tmp_path / "run.rrd")), expected(*range(8)))


def test_a_part_that_is_damaged_is_left_out_with_a_line(tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    begun(path, 3)
    parts = sample_files(path)
    parts[2].write_bytes(parts[2].read_bytes()[:-10])
    with open_recording(path, UNITS) as reader:
        assert np.array_equal(signals_of(list(reader.chunks())), expected(0, 2))
        assert sum(parts[2].name in line for line in reader.warnings()) == 1
    parts[0].write_bytes(b"")  # as after a power cut
    unite(path)
    assert np.array_equal(signals_of(read(path)), expected(0, 2))


def test_a_recording_that_is_damaged_is_left_out_with_a_line(tmp_path: Path) -> None:
    names = [tmp_path / f"{name}.rrd" for name in "abc"]
    for path in names:
        begun(path, 2).close()
    for damaged in (0, 1, 2):
        content = whole_file(names[damaged]).read_bytes()
        whole_file(names[damaged]).write_bytes(content[:-20])
        with JoinedReader(names, lambda path: open_recording(path, UNITS)) as reader:
            rows = list(reader.chunks())
            assert sum(len(part.times) for part in rows) == 2 * 2 * COUNT
            assert sum(names[damaged].name in line for line in reader.warnings()) == 1
            assert sum(part.begins.sum() for part in rows) == 1
        with raises_saying(ConfigurationError, names[damaged].name, "damaged"):
            open_recording(names[damaged], UNITS)
        whole_file(names[damaged]).write_bytes(content)
    for path in names:
        whole_file(path).write_bytes(b"PAR1")
    with raises_saying(ConfigurationError, "c.rrd", "damaged"):
        JoinedReader(names, lambda path: open_recording(path, UNITS))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "run.rrd"
    begun(path, 4).close()
    return whole_file(path)


def test_why_no_record_can_be_read_is_said(whole: Path) -> None:
    damaged = whole.with_name("damaged.samples.parquet")
    content = bytearray(whole.read_bytes())
    content[4:200] = bytes(196)
    damaged.write_bytes(content)
    with (
        raises_saying(ConfigurationError, damaged.name, "no records can be read", "damaged"),
        open_recording(damaged, UNITS) as reader,
    ):
        list(reader.chunks())


def test_a_number_of_rows_that_is_damaged_is_told(whole: Path) -> None:
    """It has no checksum, but the file says it of itself and of its groups."""
    count, content = _as_varint(4 * COUNT), whole.read_bytes()
    (footer,) = struct.unpack("<I", content[-8:-4])
    places = [place for place in range(len(content) - 8 - footer, len(content)) if content[place:].startswith(count)]
    assert len(places) >= 2
    for place in places:
        changed = content[:place] + _as_varint(3 * COUNT) + content[place + len(count) :]
        check_damaged(whole.with_name("damaged.samples.parquet"), changed)


def _as_varint(number: int) -> bytes:
    """A number as the footer has it."""
    twice = 2 * number
    return bytes([twice & 0x7F | 0x80, twice >> 7])


@settings(max_examples=30)
@given(st.floats(0.0, 1.0, exclude_max=True), st.integers(1, 255))
def test_a_damaged_byte_is_never_a_wrong_sample(whole: Path, place: float, change: int) -> None:
    content = bytearray(whole.read_bytes())
    content[int(place * len(content))] ^= change
    check_damaged(whole.with_name("damaged.samples.parquet"), content)


def check_damaged(path: Path, content: bytes | bytearray) -> None:
    """A file is refused, said to be damaged, or read without a wrong sample."""
    path.write_bytes(content)
    try:
        with open_recording(path, UNITS) as reader:
            rows = list(reader.chunks())
            is_told = bool(reader.warnings())
    except ConfigurationError as error:
        assert_refuses(error, path)
        return
    values = signals_of(rows)
    assert is_told or np.array_equal(values, expected(0, 1, 2, 3))


@pytest.fixture
def disk_full(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    return lambda: monkeypatch.setattr(pq.ParquetWriter, "write_table", refuse)


def test_a_full_disk_leaves_the_parts_and_no_torn_file(tmp_path: Path, disk_full: Callable[[], None]) -> None:
    path = tmp_path / "run.rrd"
    begun(path, 3)
    disk_full()
    with pytest.raises(OSError, match="No space"):
        unite(path)
    assert sorted(tmp_path.iterdir()) == [parts_folder(path)]
    assert np.array_equal(signals_of(read(path)), expected(0, 1, 2))


def test_a_file_of_something_else_is_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "other.samples.parquet"
    pq.write_table(pa.table({"time": [0.0, 1.0], "i": [1.0, 2.0]}), path)
    with raises_saying(ConfigurationError, path.name):
        open_recording(path, UNITS)
