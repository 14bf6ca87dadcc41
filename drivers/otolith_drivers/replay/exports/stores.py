"""Files of arrays as tables: which columns of one length there are, and their parts.

Parquet and Feather are read part by part, also HDF5 and TDMS; a MATLAB file is read array by array, each as a whole.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.errors import ConfigurationError, installation_of, shown

Part = Mapping[str, NDArray[Any]]  # numbers, times (datetime64) or texts, by column
MAX_MATRIX = 100  # columns of a matrix that are columns of a table; engineering choice


class ArrayTable(NamedTuple):
    """Columns of one length."""

    name: str  # Of its group; empty for that of the whole file
    columns: Mapping[str, str | None]  # Unit of each, None if none is stated
    length: int
    parts: Callable[[Sequence[str], int], Iterator[Part]]  # Some columns, so many rows at a time
    times: Mapping[str, tuple[float, float]] = {}
    """By column: first time and interval, s, of one whose times are not in a column."""


def parquet_tables(path: Path, opened: ExitStack) -> list[ArrayTable]:
    """The table of a Parquet file; a unit is in the metadata of its field."""
    from pyarrow import parquet  # noqa: PLC0415 - few files need it

    file = opened.enter_context(parquet.ParquetFile(path, memory_map=False))

    def parts(columns: Sequence[str], rows: int) -> Iterator[Part]:
        for batch in file.iter_batches(batch_size=rows, columns=list(columns)):
            yield {name: _of_arrow(batch.column(name)) for name in columns}

    schema = file.schema_arrow
    return [ArrayTable("", _arrow_columns(path, schema), file.metadata.num_rows, parts)]


def feather_tables(path: Path, opened: ExitStack) -> list[ArrayTable]:
    """The table of a Feather file (Arrow IPC)."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    file = opened.enter_context(pa.ipc.open_file(opened.enter_context(pa.memory_map(str(path)))))
    lengths = [file.get_batch(index).num_rows for index in range(file.num_record_batches)]

    def parts(columns: Sequence[str], rows: int) -> Iterator[Part]:
        for index in range(file.num_record_batches):
            batch = file.get_batch(index)
            for first in range(0, batch.num_rows, rows):
                part = batch.slice(first, rows)
                yield {name: _of_arrow(part.column(name)) for name in columns}

    return [ArrayTable("", _arrow_columns(path, file.schema), sum(lengths), parts)]


def _arrow_columns(path: Path, schema: Any) -> dict[str, str | None]:
    """The units of the columns of numbers, times and texts; a nested column, or one of bytes, is none."""
    columns = {field.name: _unit_of_field(field) for field in schema if _is_read(field.type)}
    if twice := next((name for name in columns if schema.names.count(name) > 1), None):
        raise ConfigurationError(f"{path}: several columns are called {shown(twice)}: give them names of their own")
    return columns


def _is_read(kind: Any) -> bool:
    import pyarrow as pa  # noqa: PLC0415 - as above

    types = pa.types
    if types.is_dictionary(kind):
        return _is_read(kind.value_type)
    is_number = types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind) or types.is_decimal(kind)
    is_time = types.is_timestamp(kind) or types.is_date(kind) or types.is_time(kind)
    is_text = types.is_string(kind) or types.is_large_string(kind) or types.is_string_view(kind)
    return bool(is_number or is_time or is_text or types.is_null(kind))


def _unit_of_field(field: Any) -> str | None:
    metadata = field.metadata or {}
    unit = metadata.get(b"unit", metadata.get(b"units", b""))
    return unit.decode(errors="replace") or None


def _of_arrow(column: Any) -> NDArray[Any]:
    """Numbers, times in UTC or without zone, or texts; a null is NaN, no time, or blank."""
    import pyarrow as pa  # noqa: PLC0415 - as above

    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    if pa.types.is_timestamp(kind):
        count = column.cast(pa.int64())
        moments = (
            count.fill_null(np.iinfo(np.int64).min).to_numpy(zero_copy_only=False).view(f"datetime64[{kind.unit}]")
        )
        return Moments(moments, has_zone=kind.tz is not None)
    if pa.types.is_date(kind) or pa.types.is_time(kind):
        column, kind = column.cast(pa.string()), pa.string()
    if pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind):
        return np.array([text or "" for text in column.to_pylist()], dtype=object)
    numbers: NDArray[Any] = column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return numbers


class Moments(np.ndarray[Any, np.dtype[Any]]):
    """Times (datetime64), with whether they are in UTC; else they are on the clock of some zone."""

    has_zone: bool

    def __new__(cls, moments: NDArray[Any], *, has_zone: bool) -> "Moments":
        array = moments.view(cls)
        array.has_zone = has_zone
        return array

    def __array_finalize__(self, other: Any) -> None:
        self.has_zone = getattr(other, "has_zone", False)


def hdf5_tables(path: Path, opened: ExitStack) -> list[ArrayTable]:
    """The arrays of an HDF5 file, or of a MATLAB file of version 7.3: those of a group with one length are a table."""
    _require(path, "h5py", "hdf5", "HDF5 or MATLAB 7.3")
    import h5py  # noqa: PLC0415 - few files need it

    file = opened.enter_context(h5py.File(path, "r"))
    groups: dict[tuple[str, int], dict[str, tuple[Any, Any]]] = {}

    def visit(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or name.startswith("#"):
            return
        group, _, own = name.rpartition("/")
        if item.dtype.names:  # a table of rows
            for column in item.dtype.names if item.ndim == 1 else ():
                if item.dtype[column].kind not in "biufSO" or item.dtype[column].shape:
                    continue
                groups.setdefault((name, len(item)), {})[column] = (item, column)
            return
        if item.dtype.kind not in "biuf" or not 0 < item.ndim <= 2:
            return
        axis = int(np.argmax(item.shape))
        across = item.shape[1 - axis] if item.ndim == 2 else 1
        for place in range(min(across, MAX_MATRIX)):
            key = own if across == 1 else f"{own}({place + 1})"
            groups.setdefault((group, item.shape[axis]), {})[key] = (item, _slicer(axis, place, item.ndim))

    file.visititems(visit)
    return [_hdf5_table(group, length, found) for (group, length), found in groups.items() if length > 1]


def _slicer(axis: int, place: int, dimensions: int) -> Callable[[slice], Any]:
    if dimensions == 1:
        return lambda rows: rows
    return lambda rows: (rows, place) if axis == 0 else (place, rows)


def _hdf5_table(group: str, length: int, found: Mapping[str, tuple[Any, Any]]) -> ArrayTable:
    def parts(columns: Sequence[str], rows: int) -> Iterator[Part]:
        for first in range(0, length, rows):
            at = slice(first, min(first + rows, length))
            part = {}
            for name in columns:
                item, where = found[name]
                part[name] = _decoded(np.asarray(item[at][where] if isinstance(where, str) else item[where(at)]))
            yield part

    return ArrayTable(group, {name: _unit_of_attributes(item) for name, (item, _) in found.items()}, length, parts)


def _decoded(cells: NDArray[Any]) -> NDArray[Any]:
    """Cells of bytes as texts."""
    if cells.dtype.kind not in "SO":
        return cells
    texts = [cell.decode(errors="replace") if isinstance(cell, bytes) else str(cell) for cell in cells.tolist()]
    return np.array(texts, dtype=object)


def _unit_of_attributes(item: Any) -> str | None:
    unit = next((item.attrs[name] for name in ("unit", "units", "Unit", "Units") if name in item.attrs), None)
    return unit.decode(errors="replace") if isinstance(unit, bytes) else unit if isinstance(unit, str) else None


def matlab_tables(path: Path, opened: ExitStack) -> list[ArrayTable]:
    """The arrays of a MATLAB file before version 7.3, also those of structures: those of one length are a table."""
    from scipy import io  # noqa: PLC0415 - slow to import

    del opened  # the arrays are copies
    arrays: dict[str, NDArray[Any]] = {}
    for name, value in io.loadmat(path, squeeze_me=True, struct_as_record=False).items():
        if not name.startswith("__"):
            _collect(arrays, name, value)
    if not arrays:
        remedy = "save numbers: s = table2struct(T, 'ToScalar', true); save file.mat -struct s"
        raise ConfigurationError(
            f"{path}: no arrays of numbers, but objects as a table or timetable of MATLAB: {remedy}"
        )
    tables: dict[tuple[str, int], dict[str, NDArray[Any]]] = {}
    for name, array in arrays.items():
        group, _, own = name.rpartition(".")
        tables.setdefault((group, len(array)), {})[own] = array
    return [_matlab_table(group, length, found) for (group, length), found in tables.items() if length > 1]


def _collect(arrays: dict[str, NDArray[Any]], name: str, value: Any) -> None:
    """Add the vectors of a variable, of the columns of a matrix, and of the fields of a structure."""
    if hasattr(value, "_fieldnames"):
        for field in value._fieldnames:
            _collect(arrays, f"{name}.{field}", getattr(value, field))
        return
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        return
    if array.ndim == 1:
        arrays[name] = array
    elif array.ndim == 2 and array.shape[1] <= MAX_MATRIX:
        arrays |= {f"{name}({place + 1})": array[:, place] for place in range(array.shape[1])}


def _matlab_table(group: str, length: int, found: Mapping[str, NDArray[Any]]) -> ArrayTable:
    def parts(columns: Sequence[str], rows: int) -> Iterator[Part]:
        for first in range(0, length, rows):
            yield {name: found[name][first : first + rows] for name in columns}

    return ArrayTable(group, dict.fromkeys(found), length, parts)


def tdms_tables(path: Path, opened: ExitStack) -> list[ArrayTable]:
    """The channels of a TDMS file: those of a group with one length are a table.

    A channel with ``wf_increment`` has its times by that; else a channel of its group has them.
    """
    _require(path, "nptdms", "tdms", "TDMS")
    from nptdms import TdmsFile  # noqa: PLC0415 - few files need it

    file = opened.enter_context(TdmsFile.open(path))
    tables: dict[tuple[str, int], dict[str, Any]] = {}
    for group in file.groups():
        for channel in group.channels():
            if (len(channel) > 1 and channel.data_type.nptype is not None) or _is_time(channel):
                tables.setdefault((group.name, len(channel)), {})[channel.name] = channel
    return [_tdms_table(group, length, found) for (group, length), found in tables.items()]


def _is_time(channel: Any) -> bool:
    return channel.dtype is not None and channel.dtype.kind == "M"


def _tdms_table(group: str, length: int, found: Mapping[str, Any]) -> ArrayTable:
    def parts(columns: Sequence[str], rows: int) -> Iterator[Part]:
        for first in range(0, length, rows):
            read = {name: np.asarray(found[name][first : min(first + rows, length)]) for name in columns}
            yield {
                name: Moments(values.astype("datetime64[us]"), has_zone=True) if values.dtype.kind == "M" else values
                for name, values in read.items()
            }

    units = {name: str(unit) if (unit := channel.properties.get("unit_string")) else None
             for name, channel in found.items()}  # fmt: skip
    times = dict[str, tuple[float, float]]()
    for name, channel in found.items():
        step = channel.properties.get("wf_increment")
        if step is None or not float(step) > 0.0:
            continue
        begin = channel.properties.get("wf_start_time")
        since = 0.0 if begin is None else float(np.datetime64(begin, "us").astype(np.int64)) * 1e-6
        times[name] = since + float(channel.properties.get("wf_start_offset", 0.0)), float(step)
    return ArrayTable(group, units, length, parts, times)


def _require(path: Path, library: str, extra: str, kind: str) -> None:
    if find_spec(library) is None:
        raise ConfigurationError(f"{path}: a {kind} file needs the extra '{extra}': {installation_of(extra)}")


STORES: Mapping[bytes, tuple[str, Callable[[Path, ExitStack], list[ArrayTable]]]] = {
    b"PAR1": ("a Parquet file", parquet_tables),
    b"ARROW1": ("a Feather file", feather_tables),
    b"\x89HDF\r\n\x1a\n": ("an HDF5 file", hdf5_tables),
    b"MATLAB 7.3": ("a MATLAB file", hdf5_tables),
    b"MATLAB 5.0": ("a MATLAB file", matlab_tables),
    b"TDSm": ("a TDMS file", tdms_tables),
}
"""By its first bytes: the name of a format, and its tables."""
