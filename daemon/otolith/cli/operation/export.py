"""``otolith export``: the raw samples of recorded data as a Parquet file, which pandas, DuckDB and Dask read."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import click

from otolith.cli.common import DATA_FILES, FILE, MACHINE_FILE, StopSignal, new_file, progress_line
from otolith.cli.terminal import echo

if TYPE_CHECKING:
    import pyarrow as pa

    from otolith.machine import LoadedMachine
    from otolith_drivers.replay.readers import Reader, Rows

ROWS_AT_ONCE = 1 << 17  # rows of a row group; docs/reference/thresholds-cli.md has the origin
TIME, RECORDING = "t", "recording"


@click.command()
@MACHINE_FILE
@DATA_FILES
@click.option("--output", type=FILE, required=True, callback=new_file, metavar="FILE", help="Write this new file.")
def export(file: Path, data: tuple[Path, ...], output: Path) -> int:
    """Write the raw samples of DATA into a Parquet file.

    DATA are recordings (.rrd) or other files that 'otolith replay' reads.
    The file has a row for each time 't' (s), with a column for each signal.

    \b
    Examples:
      otolith export press-3 monday.rrd tuesday.rrd --output week.parquet
      otolith export my-machine.toml monday.blf --output monday.parquet
    """
    from otolith.machine import load_machine
    from otolith.runtime.replay import open_recordings
    from otolith_drivers.errors import counted

    machine, stop = load_machine(file, with_driver=False), StopSignal()
    with open_recordings(machine, data) as reader, progress_line("reading", enabled=True) as show:
        rows, recordings = _write(machine, reader, output, show, stop.received)
    if stop.received():
        output.unlink(missing_ok=True)
        return stop.code()
    for line in reader.warnings():
        echo(line, err=True)
    size = f"{output.stat().st_size / 1e6:.3g} MB"
    echo(f"{output}: {counted(rows, 'row')} of {counted(recordings, 'recording')}, {size}", err=True)
    return 0


def _write(
    machine: "LoadedMachine", data: "Reader", path: Path, show: Callable[[str], None], stopped: Callable[[], bool]
) -> tuple[int, int]:
    """Write all rows into a new file, and return how many there are, of how many recordings."""
    try:
        target = path.open("xb")
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error
    try:
        with target:
            return _write_rows(machine, data, target, show, stopped)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _write_rows(
    machine: "LoadedMachine", data: "Reader", target: BinaryIO, show: Callable[[str], None], stopped: Callable[[], bool]
) -> tuple[int, int]:
    import numpy as np
    import pyarrow as pa
    import pyarrow.parquet as pq

    from otolith.machine_file import signal_units

    schema, rows, recordings = _schema(machine), 0, 0
    number, headers, signals = schema.names[1], schema.names[2:], signal_units(machine.file, machine.twin)
    split = dict.fromkeys((TIME, *headers), "BYTE_STREAM_SPLIT")
    with pq.ParquetWriter(
        target, schema, compression="zstd", use_dictionary=[number], column_encoding=split
    ) as writer:  # fmt: skip
        for part in _joined(data.chunks()):
            if stopped():
                break
            numbers = 1 + recordings + part.begins.cumsum()
            recordings = int(numbers[-1]) - 1
            blank = np.full(len(part.times), np.nan)  # of a temperature that the data lack
            columns = [part.times, numbers.astype("int32"), *(part.columns.get(name, blank) for name in signals)]
            writer.write_table(pa.table(columns, schema=schema))
            rows += len(part.times)
            show(f"{data.progress:.0%} of the data")
    return rows, recordings + (rows > 0)


def _schema(machine: "LoadedMachine") -> "pa.Schema":
    import pyarrow as pa

    from otolith.exchange.identifiers import identifiers
    from otolith.machine_file import signal_units

    names = machine.file.machine
    units = signal_units(machine.file, machine.twin)
    headers = identifiers(units, str, {TIME})  # a temperature may have any name
    (number,) = identifiers([RECORDING], str, {TIME, *headers.values()}).values()
    numbers = [pa.field(headers[name], pa.float64(), metadata={"unit": unit}) for name, unit in units.items()]
    time = pa.field(TIME, pa.float64(), metadata={"unit": "s"})
    fields = [time, pa.field(number, pa.int32(), nullable=False), *numbers]
    return pa.schema(fields, {"machine": names.name, "site": names.site, "twin": machine.twin.name})


def _joined(chunks: "Iterator[Rows]") -> "Iterator[Rows]":
    """Yield the rows, ``ROWS_AT_ONCE`` or more at a time."""
    parts: list[Rows] = []
    for rows in chunks:
        parts.append(rows)
        if sum(len(part.times) for part in parts) >= ROWS_AT_ONCE:
            yield _one(parts)
            parts = []
    if parts:
        yield _one(parts)


def _one(parts: "list[Rows]") -> "Rows":
    """Return pairs of parts together until one is left: linear in rows, but for their logarithm."""
    while len(parts) > 1:
        pairs = [parts[index : index + 2] for index in range(0, len(parts), 2)]
        parts = [pair[0].followed_by(pair[1]) if len(pair) > 1 else pair[0] for pair in pairs]
    return parts[0]
