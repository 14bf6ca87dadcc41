"""Parquet, Feather, HDF5, MATLAB and TDMS files as tables: each has the values that were written by another library."""

import gzip
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from datetime import time as clock_time
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import h5py
import numpy as np
import pyarrow as pa
import pytest
from nptdms import ChannelObject, TdmsWriter
from pyarrow import feather, parquet
from scipy import io

from otolith_drivers.base import Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.exports import arrays
from otolith_drivers.replay.exports.stores import STORES
from otolith_drivers.replay.readers import ARRAY_HEADS
from tests.drivers.replay.readings import samples
from tests.messages import raises_saying

TIMES, SPEED, TORQUE = np.arange(50) / 100.0, 60.0 * np.arange(50), np.arange(50) ** 2 / 10.0
NOON = datetime(2026, 3, 29, 12, tzinfo=UTC).timestamp()
NOON_IN_BERLIN = datetime(2026, 3, 29, 12, tzinfo=ZoneInfo("Europe/Berlin")).timestamp()


def arrow_table() -> pa.Table:
    names = ("t", "speed", "torque")
    fields = [pa.field(name, pa.float64(), metadata={b"unit": b"rpm"} if name == "speed" else None) for name in names]
    return pa.table([TIMES, SPEED, TORQUE], schema=pa.schema(fields))


def as_parquet(path: Path) -> None:
    parquet.write_table(arrow_table(), path, row_group_size=7)


def as_feather(path: Path) -> None:
    feather.write_feather(arrow_table(), path, chunksize=7)


def as_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["run/t"], file["run/torque"], file["other"] = TIMES, TORQUE, np.arange(3.0)
        file["run/speed"] = SPEED.reshape(1, -1)
        file["run/speed"].attrs["units"] = "rpm"


def as_compound_hdf5(path: Path) -> None:
    kind = [("t", "f8"), ("speed", "f4"), ("torque", "f8")]
    with h5py.File(path, "w") as file:
        file["log"] = np.array(list(zip(TIMES, SPEED / 60.0, TORQUE, strict=True)), dtype=kind)


def as_matlab(path: Path) -> None:
    io.savemat(path, {"run": {"t": TIMES, "speed": SPEED / 60.0, "torque": TORQUE}, "title": "a run", "gain": 3.0})


def as_matlab_vectors(path: Path) -> None:
    columns = {"t": TIMES.reshape(-1, 1), "speed": SPEED / 60.0, "torque": TORQUE.reshape(1, -1)}
    io.savemat(path, columns, do_compression=True)


def as_tdms(path: Path) -> None:
    channels = [("t", TIMES, {}), ("speed", SPEED, {"unit_string": "rpm"}), ("torque", TORQUE, {})]
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("run", name, values, properties) for name, values, properties in channels])


WRITERS: dict[str, Callable[[Path], None]] = {
    "log.parquet": as_parquet,
    "log.feather": as_feather,
    "log.h5": as_hdf5,
    "compound.h5": as_compound_hdf5,
    "log.mat": as_matlab,
    "vectors.mat": as_matlab_vectors,
    "log.tdms": as_tdms,
    "without.any": as_parquet,
}


@pytest.mark.parametrize("rows", [7, 1000])
@pytest.mark.parametrize("name", WRITERS)
def test_columns_of_a_file_of_arrays_are_read_with_their_units(
    tmp_path: Path, name: str, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(arrays, "ROWS", rows)
    WRITERS[name](tmp_path / name)
    found = samples(tmp_path / name, n={"column": "speed", "of": "turn/s"}, torque={})
    expected = np.arange(50.0)
    assert [time for time, _ in found["n"]] == pytest.approx(TIMES.tolist())
    assert [value for _, value in found["n"]] == pytest.approx(expected.tolist())
    assert [value for _, value in found["torque"]] == pytest.approx(TORQUE.tolist())


def test_each_format_is_recognised_by_its_first_bytes() -> None:
    assert all(start.startswith(ARRAY_HEADS) for start in STORES)


@pytest.mark.parametrize("name", ["log.parquet", "log.h5", "log.mat", "log.tdms", "log.feather"])
def test_a_damaged_file_is_refused_with_its_name(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    path.write_bytes(path.read_bytes()[:100])
    with raises_saying(ConfigurationError, name):
        samples(path, n={"column": "speed"})


@pytest.mark.parametrize(("zone", "expected"), [("UTC", NOON), (None, NOON_IN_BERLIN)])
def test_times_may_be_moments_in_utc_or_on_the_clock_of_the_plant(
    tmp_path: Path, zone: str | None, expected: float
) -> None:
    moments = pa.array([1_774_785_600_000, 1_774_785_600_250, None], pa.timestamp("ms", zone))
    path = tmp_path / "log.parquet"
    parquet.write_table(pa.table({"time": moments, "x": [1.0, 2.0, 3.0]}), path)
    assert samples(path, zone="Europe/Berlin", bad=1, x={})["x"] == [(expected, 1.0), (expected + 0.25, 2.0)]


def test_nulls_and_texts_are_blank_or_numbers(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    parquet.write_table(
        pa.table({"t": [0.0, 1.0, 2.0], "x": [1, None, 3], "y": ["4.5", "", "off"], "b": [True, False, None]}), path
    )
    found = samples(path, x={}, y={}, b={})
    assert found["x"] == [(0.0, 1.0), (2.0, 3.0)]
    assert (found["y"], found["b"]) == ([(0.0, 4.5)], [(0.0, 1.0), (1.0, 0.0)])


def test_a_channel_of_tdms_has_the_times_of_its_waveform(tmp_path: Path) -> None:
    begin = np.datetime64("2026-03-29T12:00:00.5", "us")
    channels = [
        ChannelObject("fast", "x", np.arange(100.0), {"wf_start_time": begin, "wf_increment": 0.001}),
        ChannelObject("slow", "y", np.arange(20.0), {"wf_start_time": begin, "wf_increment": 0.005}),
    ]
    with TdmsWriter(tmp_path / "log.tdms") as writer:
        writer.write_segment(channels)
    found = samples(tmp_path / "log.tdms", zone="Europe/Berlin", x={}, y={})
    for name, step in (("x", 0.001), ("y", 0.005)):
        for time, value in found[name]:
            assert time - NOON - 0.5 == pytest.approx(step * value, abs=1e-6)


def test_a_time_is_asked_about_as_in_a_text(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    parquet.write_table(
        pa.table({"Time": 45203.7157523148 + np.arange(50) * 0.01 / 86400.0, "x": np.arange(50.0)}), path
    )
    with raises_saying(ConfigurationError, "log.parquet", "10 ms if they are days"):
        samples(path, x={})
    found = samples(path, {"time": {"column": "Time", "unit": "d"}}, x={})
    assert np.diff([time for time, _ in found["x"]]) == pytest.approx(0.01, rel=0.02)
    columns: dict[str, Any] = {"clock": np.arange(50.0), "x": np.arange(50.0)}
    parquet.write_table(pa.table(columns), path)
    with raises_saying(ConfigurationError, "log.parquet", "no column 't'"):
        samples(path, x={})


def test_a_column_in_two_groups_is_asked_about(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for group, factor in (("a", 1.0), ("b", 2.0)):
            file[f"{group}/t"], file[f"{group}/x"] = TIMES, factor * TORQUE
    with raises_saying(ConfigurationError, "log.h5", "'x'", "a/x", "b/x"):
        samples(tmp_path / "log.h5", x={})
    found = samples(tmp_path / "log.h5", x={"column": "b/x"})
    assert [value for _, value in found["x"]] == pytest.approx((2.0 * TORQUE).tolist())


def test_a_missing_column_is_named_with_the_nearest(tmp_path: Path) -> None:
    as_tdms(tmp_path / "log.tdms")
    with raises_saying(ConfigurationError, "log.tdms", "'sped'", "'speed'"):
        samples(tmp_path / "log.tdms", n={"column": "sped"})


@pytest.mark.parametrize(("name", "library"), [("log.tdms", "nptdms"), ("log.h5", "h5py")])
def test_a_missing_library_is_named_with_the_command_that_installs_it(
    tmp_path: Path, name: str, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    WRITERS[name](tmp_path / name)
    monkeypatch.setattr(
        "otolith_drivers.replay.exports.stores.find_spec", lambda module: None if module == library else module
    )
    with raises_saying(ConfigurationError, name, "extra", "pip install"):
        samples(tmp_path / name, n={"column": "speed"})


def parquet_of(folder: Path, **columns: Any) -> Path:
    path = folder / "run.parquet"
    parquet.write_table(pa.table(columns), path)
    return path


def hdf5_of(folder: Path, **arrays: Any) -> Path:
    path = folder / "run.h5"
    with h5py.File(path, "w") as file:
        for name, array in arrays.items():
            file[name] = array
    return path


OTHERS: dict[str, Any] = {
    "dates": pa.array([date(2026, 3, 29)] * 50),
    "times of day": pa.array([clock_time(1, 2, 3)] * 50),
    "durations": pa.array([timedelta(1)] * 50),
    "lists": pa.array([[1, 2]] * 50),
    "structures": pa.array([{"a": 1}] * 50),
    "bytes": pa.array([b"\xff"] * 50),
    "large integers": pa.array([2**60 + 1] * 50),
    "texts": pa.array(['a;b\t"c\nd'] * 50),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_other_columns_may_have_anything(kind: str, tmp_path: Path) -> None:
    path = parquet_of(tmp_path, **{"a;b": OTHERS[kind], "t": TIMES, "#\nd": OTHERS[kind], "speed": SPEED})
    assert samples(path, speed={})["speed"] == list(zip(TIMES.tolist(), SPEED.tolist(), strict=True))


@pytest.mark.parametrize("name", ["a;b", "c\nd", "e\tf", 'g"h', "#i", '"j"', "sep=;"])
def test_a_column_may_have_any_name(name: str, tmp_path: Path) -> None:
    path = parquet_of(tmp_path, **{name: SPEED, "t": TIMES})
    assert samples(path, x={"column": name})["x"] == list(zip(TIMES.tolist(), SPEED.tolist(), strict=True))


def test_integers_may_count_nanoseconds(tmp_path: Path) -> None:
    path = parquet_of(tmp_path, stamp=(1e9 * (NOON + TIMES)).astype(np.int64), speed=SPEED)
    found = samples(path, speed={"time": {"column": "stamp", "unit": "ns"}})["speed"]
    assert [time - NOON for time, _ in found] == pytest.approx(TIMES.tolist(), abs=1e-6)
    with raises_saying(ConfigurationError, "none of its 50 rows", "'stamp'", "unit"):
        samples(path, speed={"time": "stamp"})


def test_dates_in_a_column_of_their_own_are_used(tmp_path: Path) -> None:
    days = ["2026-03-29"] * 2 + ["2026-03-31"] * 2
    clocks = ["11:59:59", "12:00:00", "12:00:00", "12:00:01"]
    path = parquet_of(tmp_path, Date=days, Time=clocks, x=[1.0, 2.0, 3.0, 4.0])
    times = [time - NOON for time, _ in samples(path, x={})["x"]]
    assert times == [-1.0, 0.0, 2 * 86400.0, 2 * 86400.0 + 1.0]


@pytest.mark.parametrize("segments", [["a", "a", "", "b"], [1, 1, 1, 2], [1.0, None, 1.0, 2.0]])
def test_a_column_of_segments_splits_arrays(segments: list[Any], tmp_path: Path) -> None:
    path = parquet_of(tmp_path, t=[0.0, 0.1, 0.2, 0.0], x=[1.0, 2.0, 3.0, 4.0], segment=segments)
    signal = Signal(name="x", unit="1", source=arrays.Source())
    with arrays.open_log(path, Setup((signal,), tmp_path, 0.01)) as reader:
        assert [mark for rows in reader.chunks() for mark in rows.begins.tolist()] == [False, False, False, True]


def test_dates_of_another_column_do_not_contradict_times_of_nanoseconds(tmp_path: Path) -> None:
    moments = np.datetime64("2026-03-29T12:00:00", "ns") + np.arange(3) * np.timedelta64(1, "s")
    path = parquet_of(tmp_path, time=moments, Created=[f"2026-03-29 12:00:0{row}" for row in range(3)], x=[1.0] * 3)
    assert [time - NOON for time, _ in samples(path, x={})["x"]] == [0.0, 1.0, 2.0]


def test_moments_that_no_calendar_has_are_bad_rows(tmp_path: Path) -> None:
    seconds = pa.array([-(10**15), 0, None, 10**15, 10**9], pa.timestamp("s"))
    found = samples(parquet_of(tmp_path, time=seconds, x=[1.0, 2.0, 3.0, 4.0, 5.0]), bad=3, zone="Europe/Berlin", x={})
    assert [value for _, value in found["x"]] == [2.0, 5.0]


def test_rows_of_hdf5_may_have_texts_and_matrices(tmp_path: Path) -> None:
    rows = np.zeros(3, dtype=[("x", "f8"), ("m", "f8", (2,)), ("s", "S25"), ("c", "c16")])
    rows["x"], rows["s"] = [1.0, 2.0, 3.0], [f"2026-03-29T12:00:0{row}".encode() for row in range(3)]
    path = hdf5_of(tmp_path, log=rows, info=np.zeros((), dtype=[("a", "f8")]))
    assert samples(path, x={"time": "s"})["x"] == [(NOON, 1.0), (NOON + 1.0, 2.0), (NOON + 2.0, 3.0)]
    for column in "mc":
        with raises_saying(ConfigurationError, "no column", column):
            samples(path, x={"column": column})


def test_arrays_that_cannot_be_read_are_refused_with_their_names(tmp_path: Path) -> None:
    with raises_saying(ConfigurationError, "'x' has 21 rows", "times"):
        samples(hdf5_of(tmp_path, t=np.arange(20.0), x=np.arange(21.0)), x={})
    with raises_saying(ConfigurationError, "'x'", "no rows"):
        samples(parquet_of(tmp_path, t=np.zeros(0), x=np.zeros(0)), x={})
    path = parquet_of(tmp_path, t=TIMES, x=SPEED)
    packed = tmp_path / "run.parquet.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    with raises_saying(ConfigurationError, "run.parquet.gz", "unpack"):
        samples(packed, x={})
    data = bytearray(path.read_bytes())
    data[20:80] = b"\xff" * 60
    path.write_bytes(data)
    with raises_saying(ConfigurationError, "run.parquet", "damaged"):
        samples(path, x={})
    table = pa.Table.from_arrays([pa.array(TIMES), pa.array(SPEED), pa.array(SPEED)], ["t", "x", "x"])
    parquet.write_table(table, path)
    with raises_saying(ConfigurationError, "several columns", "'x'"):
        samples(path, x={})


def test_channels_of_tdms_have_one_origin_of_their_times(tmp_path: Path) -> None:
    path = tmp_path / "run.tdms"
    dated = {"wf_increment": 0.01, "wf_start_time": np.datetime64("2026-03-29T12:00:00")}
    channels = [("speed", dated), ("torque", {"wf_increment": 0.02}), ("force", dated | {"wf_increment": 0.02})]
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("run", name, TIMES, properties) for name, properties in channels])
    assert len(samples(path, speed={}, force={})["force"]) == len(TIMES)
    with raises_saying(ConfigurationError, "torque has no wf_start_time", "speed has one", "set it"):
        samples(path, speed={}, torque={})
