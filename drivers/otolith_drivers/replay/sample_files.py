"""The raw samples of a recording as Parquet files, which pandas, DuckDB and Dask read as they are.

The samples of ``NAME.rrd``, which is for viewing, are beside it in ``NAME.samples.parquet``. Until the recording ends
they are in the folder ``NAME.samples``, in a whole file for each part that was written: a recorder that is killed
leaves files that anybody can read, and the next one makes one file of them.

A file has a row for each record: ``time``, a column for each signal with its unit in the metadata, null where there is
no reading, and ``good``, whether the window of the record was good. What the times mean is in the metadata of the file.
"""

import contextlib
import os
import shutil
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from otolith_drivers.base import Sampling
from otolith_drivers.config_files import StrictModel
from otolith_drivers.replay.readers import Array, Integers, Mask
from otolith_drivers.replay.sample_names import PART, parts_folder, whole_file

if TYPE_CHECKING:
    import pyarrow as pa
    from pyarrow import parquet

TIME, GOOD = "time", "good"  # names of columns
MEANING, CHECK = b"otolith", b"otolith.crc32"  # entries of the metadata: what the times mean, and its checksum
# Thresholds: docs/reference/thresholds-replay.md has the origin of each.
ROW_GROUP = 1 << 17  # rows that are read at once
LEVEL = 3  # of zstd


class TimesRecord(StrictModel):
    """What the times and the records of a recording mean, as the recorder writes it."""

    sampling: Sampling | dict[str, Sampling]  # Of all signals, or by signal
    delays: dict[str, float]  # By signal, s
    signals: dict[str, str]  # Unit of each recorded signal, in their order


class SampleWriter:
    """Writes the samples of one recording. Several windows make a part, each a whole file."""

    def __init__(
        self, recording: Path, meaning: TimesRecord, headers: Sequence[str], about: Mapping[str, str], mode: int | None
    ) -> None:
        """``headers`` has the name of the column of each signal; files get ``mode``, if it is given.

        Samples that lie beside the recording are deleted. Raises OSError.
        """
        import pyarrow as pa  # noqa: PLC0415 - most users of this module only name files

        self.recording = recording
        self._mode, self._parts = mode, 0
        self._waiting: list[tuple[Integers, Sequence[Array], bool]] = []
        fields = [
            pa.field(header, pa.float64(), metadata={"unit": unit})
            for header, unit in zip(headers, meaning.signals.values(), strict=True)
        ]
        time = pa.field(TIME, pa.timestamp("ns", "UTC"), nullable=False)
        good = pa.field(GOOD, pa.bool_(), nullable=False)
        text = meaning.model_dump_json().encode()
        metadata: dict[str | bytes, str | bytes] = dict(about.items())
        metadata |= {MEANING: text, CHECK: str(zlib.crc32(text)).encode()}
        self._schema = pa.schema([time, *fields, good], metadata)
        whole_file(recording).unlink(missing_ok=True)
        shutil.rmtree(parts_folder(recording), ignore_errors=True)
        parts_folder(recording).mkdir()
        if mode is not None:
            parts_folder(recording).chmod(mode | mode >> 2 & 0o111)  # who may read a file may list the folder
        self._write_part()

    def add(self, times: Integers, columns: Sequence[Array], *, good: bool) -> None:
        """Append the records of a window; ``times`` (ns) and each column have a value for each record."""
        self._waiting.append((times, columns, good))

    def save(self) -> None:
        """Write the windows that wait."""
        if self._waiting:
            self._write_part()

    def close(self) -> None:
        """Write everything out, in one file."""
        self.save()
        unite(self.recording)

    def _write_part(self) -> None:
        import pyarrow as pa  # noqa: PLC0415 - as above

        times = np.concatenate([np.zeros(0, dtype=np.int64), *(times for times, _, _ in self._waiting)])
        counts, verdicts = [len(times) for times, _, _ in self._waiting], [good for _, _, good in self._waiting]
        good = np.repeat(np.array(verdicts, dtype=np.bool_), np.array(counts, dtype=np.int64))
        arrays = [pa.array(times).cast(self._schema.field(0).type)]
        for place in range(len(self._schema) - 2):
            values = np.concatenate([np.zeros(0), *(columns[place] for _, columns, _ in self._waiting)])
            arrays.append(pa.array(values, mask=np.isnan(values)))
        self._parts += 1
        table = pa.table([*arrays, pa.array(good)], schema=self._schema)
        path = parts_folder(self.recording) / f"{self._parts:06d}{PART}"
        _write(path, self._schema, [table], self._mode)
        self._waiting = []


def meaning_of(file: Path) -> tuple[TimesRecord, int]:
    """Return what the records of a file mean, and how many it has; raise ValueError or OSError if it is damaged."""
    with opened_parquet(file) as opened:
        schema, rows = opened.schema_arrow, opened.metadata.num_rows
    metadata = schema.metadata or {}
    if (text := metadata.get(MEANING)) is None:
        raise ValueError("it is no file of samples")
    if metadata.get(CHECK) != str(zlib.crc32(text)).encode():
        raise ValueError("what its times mean has another checksum")
    meaning = TimesRecord.model_validate_json(text)
    kinds = ["timestamp[ns, tz=UTC]", *("double" for _ in meaning.signals), "bool"]
    if (found := [str(kind) for kind in schema.types]) != kinds:
        raise ValueError(f"its columns are {', '.join(found)} instead of {', '.join(kinds)}")
    return meaning, int(rows)


def first_line(error: Exception) -> str:
    """Return the first line of an error of a library, or its type if it says nothing."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def unite(recording: Path) -> None:
    """Make one file of the parts of a recording that has ended; parts that are damaged are left out.

    A process that is killed meanwhile leaves either the parts or the file. Without a readable part nothing is done.
    """
    folder, whole = parts_folder(recording), whole_file(recording)
    if not whole.exists():
        parts = sorted(folder.glob(f"*{PART}"))
        schema = next((part.schema_arrow for path in parts for part in _opened(path)), None)
        if schema is None:
            return
        _write(whole, schema, _joined(parts, schema), folder.stat().st_mode & 0o666, lasting=True)
    shutil.rmtree(folder, ignore_errors=True)


def _joined(parts: Sequence[Path], schema: "pa.Schema") -> "Iterator[pa.Table]":
    """Yield the rows of all parts, ``ROW_GROUP`` at a time."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    tables: list[pa.Table] = []
    for path in parts:
        with contextlib.suppress(pa.ArrowException, OSError):
            tables += [part.read() for part in _opened(path) if part.schema_arrow.equals(schema)]
        if sum(map(len, tables)) >= ROW_GROUP:
            yield pa.concat_tables(tables)
            tables = []
    yield pa.concat_tables([schema.empty_table(), *tables])


def _opened(path: Path) -> "Iterator[parquet.ParquetFile]":
    """Yield an open file, or nothing if it is damaged."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    with contextlib.suppress(pa.ArrowException, OSError), opened_parquet(path) as file:
        yield file


def opened_parquet(path: Path) -> "parquet.ParquetFile":
    """Return an open file, whose checksums are compared."""
    from pyarrow import parquet  # noqa: PLC0415 - as above

    return parquet.ParquetFile(path, memory_map=False, page_checksum_verification=True)


def _write(
    path: Path,
    schema: "pa.Schema",
    tables: "Iterator[pa.Table] | list[pa.Table]",
    mode: int | None,
    *,
    lasting: bool = False,
) -> None:
    """Write a file that appears once it is whole; with ``lasting`` it stays even if the power fails afterwards."""
    from pyarrow import parquet  # noqa: PLC0415 - as above

    encodings = {TIME: "DELTA_BINARY_PACKED", **dict.fromkeys(schema.names[1:-1], "BYTE_STREAM_SPLIT")}
    options: dict[str, Any] = {"compression": "zstd", "compression_level": LEVEL, "use_dictionary": False}
    new = path.with_name(f"{path.name}.new")
    try:
        with new.open("wb") as file:
            with parquet.ParquetWriter(
                file, schema, column_encoding=encodings, write_page_checksum=True, **options
            ) as writer:
                for table in tables:
                    writer.write_table(table, row_group_size=ROW_GROUP)
            if lasting:
                file.flush()
                os.fsync(file.fileno())
        if mode is not None:
            new.chmod(mode)
        new.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise


def rows_of(path: Path, signals: int, rows: int) -> "Iterator[tuple[Integers, Array, Mask] | str]":
    """Yield times in ns, values (signals, records) and which are good, some ``rows`` at a time.

    A text is yielded in place of rows that are damaged.
    """
    import pyarrow as pa  # noqa: PLC0415 - as above

    with opened_parquet(path) as file:
        count, is_told = 0, False
        for group in range(file.num_row_groups):
            try:
                for batch in file.iter_batches(batch_size=rows, row_groups=[group]):
                    columns = [batch.column(place + 1).to_numpy(zero_copy_only=False) for place in range(signals)]
                    times = batch.column(0).cast(pa.int64()).to_numpy(zero_copy_only=False)
                    values = np.array(columns, dtype=np.float64).reshape(signals, len(times))
                    count += len(times)
                    yield times, values, batch.column(signals + 1).to_numpy(zero_copy_only=False)
            except (pa.ArrowException, OSError, ValueError) as error:
                is_told = True
                yield first_line(error)
        if count != file.metadata.num_rows and not is_told:  # which the file says twice, without a checksum
            yield f"{count} records instead of {file.metadata.num_rows}"
