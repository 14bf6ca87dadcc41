"""``otolith export``: the raw samples of recordings, bit for bit, in a file that other programs read."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import click
import numpy as np
import pyarrow.parquet as pq
import pytest

from otolith.cli.operation.export import ROWS_AT_ONCE, _schema
from otolith.machine import LoadedMachine, load_machine
from otolith.machine_file import ParameterTable
from otolith.runtime import replay
from otolith.runtime.replay import open_recorded, open_recordings
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay.readers import Reader
from tests.cli.commands import otolith
from tests.cli.replays import HEADING, MACHINE, Lines, recorded, written
from tests.messages import assert_says, raises_saying

UNITS = {"t": "s", "V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario.model_copy(update={"faults": ()}), 2)


def columns_of(path: Path) -> dict[str, np.ndarray[tuple[int], np.dtype[np.float64]]]:
    table = pq.read_table(path)
    return {name: table.column(name).to_numpy() for name in table.column_names}


def test_a_recording_has_each_sample_bit_for_bit(tmp_path: Path, rows: Lines) -> None:
    rows[7][3] = ""  # a missing reading
    recording, output = tmp_path / "a.rrd", tmp_path / "a.parquet"
    otolith("replay", MACHINE, written(tmp_path, rows), "--json", "--recording", recording)
    otolith("export", MACHINE, recording, "--output", output)
    found = columns_of(output)
    with open_recorded(load_machine(MACHINE, with_driver=False), recording) as reader:
        (part,) = reader.chunks()
    assert np.array_equal(found.pop("t"), part.times)
    assert set(found.pop("recording")) == {1}
    assert found.keys() == part.columns.keys()
    for name, values in part.columns.items():
        assert np.array_equal(found[name], values, equal_nan=True)
    assert np.isnan(found[HEADING[3]]).sum() == 1
    schema = pq.read_schema(output)
    assert {name: schema.field(name).metadata[b"unit"].decode() for name in UNITS} == UNITS
    assert schema.metadata[b"machine"] == b"motor"
    assert schema.metadata[b"site"] == b"site"


def test_files_follow_one_another_and_are_compressed_as_numbers(tmp_path: Path, rows: Lines) -> None:
    files = []
    for name in "abc":
        folder = tmp_path / name
        folder.mkdir()
        files.append(written(folder, rows))
    output = tmp_path / "all.parquet"
    result = otolith("export", MACHINE, *files, "--output", output)
    found = columns_of(output)
    assert np.array_equal(found["recording"], np.repeat([1, 2, 3], len(rows)))
    assert np.array_equal(found["t"][: len(rows)], [float(row[0]) for row in rows])
    assert_says(result.stderr, str(output), f"{3 * len(rows)} rows", "3 recordings")
    file = pq.ParquetFile(output).metadata
    assert file.num_row_groups == 1  # though each file has its own rows
    column = file.row_group(0).column(3)
    assert (column.compression, "BYTE_STREAM_SPLIT" in column.encodings) == ("ZSTD", True)
    assert 3 * len(rows) < ROWS_AT_ONCE


@pytest.mark.parametrize(
    ("name", "number", "own"), [("t", "recording", "t_"), ("recording", "recording_", "recording")]
)
def test_a_signal_may_be_called_as_a_column_of_ours(name: str, number: str, own: str) -> None:
    machine = load_machine(MACHINE, with_driver=False)
    heated = ParameterTable(temperature=name)
    machine = replace(machine, file=machine.file.model_copy(update={"parameters": {"R_a": heated}}))
    schema = _schema(machine)
    assert schema.names == ["t", number, "V_a", "T_load", "i", "omega", own]
    assert schema.field(own).metadata[b"unit"] == b"K"


def test_what_fails_leaves_no_file(tmp_path: Path, rows: Lines) -> None:
    first, output = written(tmp_path, rows), tmp_path / "all.parquet"
    broken = tmp_path / "broken.rrd"
    broken.write_bytes(b"RRF2" + bytes(100))
    with raises_saying(ConfigurationError, str(broken)):
        otolith("export", MACHINE, first, broken, "--output", output)
    assert not output.exists()
    with pytest.raises(click.BadParameter, match="missing"):
        otolith("export", MACHINE, first, "--output", tmp_path / "missing" / "all.parquet")


def test_a_file_that_another_export_has_begun_meanwhile_stays(
    tmp_path: Path, rows: Lines, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "all.parquet"

    def opened(machine: LoadedMachine, files: Sequence[Path]) -> Reader:
        output.write_bytes(b"of the other one")
        return open_recordings(machine, files)

    monkeypatch.setattr(replay, "open_recordings", opened)
    with pytest.raises(OSError, match="exists"):
        otolith("export", MACHINE, written(tmp_path, rows), "--output", output)
    assert output.read_bytes() == b"of the other one"
