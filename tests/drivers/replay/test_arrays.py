"""Parquet, Feather, HDF5, MATLAB and TDMS files as tables: each has the values that were written by another library."""

from collections.abc import Callable
from datetime import UTC, datetime
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
