"""What a person gives to a method of the API for notebooks: checked, and in the units of the twin.

Each fault is a ConfigurationError that names the argument or column, its value, what is allowed, and the remedy.
"""

import math
import os
from collections.abc import Mapping, Sequence
from datetime import datetime
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from otolith.acquisition.window import Array
from otolith_drivers.errors import ConfigurationError, shown
from otolith_drivers.replay.table.header import name_and_unit
from otolith_drivers.units import factor

TIME = "t"


def path_of(written: object, argument: str, what: str) -> Path:
    """Return a path that is a text or a path."""
    if isinstance(written, str | os.PathLike) and isinstance(text := os.fspath(written), str) and text.strip():
        return Path(text)
    raise ConfigurationError(f"{argument}: {shown(written)} is no path: give that of {what}")


def text_of(written: object, argument: str, example: str) -> str:
    """Return a text that is not empty."""
    if isinstance(written, str) and written.strip():
        return written
    raise ConfigurationError(f"{argument}: {shown(written)} is no text: give one like {example!r}")


def seed_of(written: object) -> int:
    """Return the seed of a random generator."""
    if isinstance(written, int | np.integer) and not isinstance(written, bool) and written >= 0:
        return int(written)
    raise ConfigurationError(f"seed: {shown(written)}: give a whole number from 0 on")


def seconds_of(written: object, argument: str) -> float:
    """Return a time in s: a finite number, or a date with its zone, which is a Unix time."""
    if isinstance(written, datetime | np.datetime64):
        return float(_unix_seconds(written, np.array([written], dtype=object), argument)[0])
    if isinstance(written, Real) and not isinstance(written, bool) and math.isfinite(number := _float(written)):
        return number
    remedy = "give seconds as a number, or a datetime with its zone"
    raise ConfigurationError(f"{argument}: {shown(written)} is no time: {remedy}")


def span_of(written: object) -> tuple[float, float]:
    """Return begin and end of a span, s."""
    if not isinstance(written, Sequence) or isinstance(written, str) or len(written) != 2:
        raise ConfigurationError(f"span: {shown(written)}: give begin and end in s, like (20, 80)")
    begin, end = (seconds_of(item, f"span[{number}]") for number, item in enumerate(written))
    if begin >= end:
        raise ConfigurationError(
            f"span: it ends at {end:.12g} s, before it begins at {begin:.12g} s: give begin and end"
        )
    return begin, end


def is_table(inputs: object) -> bool:
    """Whether something has named columns: a mapping, or a table of pandas, pyarrow or polars."""
    return isinstance(inputs, Mapping) or hasattr(inputs, "column_names") or hasattr(inputs, "columns")


def plan_of(inputs: Any, units: Mapping[str, str]) -> tuple[Array, dict[str, Array]]:
    """Return times (rows,) in s, and the column (rows,) of each input in its unit, which ``units`` has by its name.

    A column may be called ``V_a``, which is in the unit of the twin, or have another unit, as ``V_a [mV]``. Other
    columns are not used. A table has two rows or more, without gaps, and its times rise.
    """
    found = _columns(inputs, {TIME: "s", **units})
    lengths = {name: len(column) for name, column in found.items()}
    for name, length in lengths.items():
        if length != lengths[TIME]:
            remedy = "give each column the same number of rows"
            raise ConfigurationError(
                f"inputs: {name} has {_rows(length)}, but {TIME} has {_rows(lengths[TIME])}: {remedy}"
            )
    times = found.pop(TIME)
    if len(times) < 2:
        remedy = "a plan needs the times of two rows at least, the last of which is its end"
        raise ConfigurationError(f"inputs: {_rows(len(times))}: {remedy}")
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back):
        row = int(back[0]) + 1
        text = (
            f"{TIME} = {times[row]:.12g} s in row {row} is not after {TIME} = {times[row - 1]:.12g} s of the row before"
        )
        raise ConfigurationError(f"inputs: {text}: sort the rows by {TIME}, and remove those that repeat")
    return times, found


def _rows(count: int) -> str:
    return "one row" if count == 1 else f"{count} rows"


def _columns(inputs: Any, units: Mapping[str, str]) -> dict[str, Array]:
    """Return the column of each of the ``units`` by its name, in its unit."""
    names = inputs if isinstance(inputs, Mapping) else getattr(inputs, "column_names", None)
    headers = list(inputs.columns if names is None else names)
    named = [(name_and_unit(str(header).strip()), header) for header in headers]
    columns = {}
    for name, unit in units.items():
        own = [(written, header) for (called, written), header in named if called == name]
        if not own:
            listed = ", ".join(map(str, headers[:12])) or "no column"
            needed = ", ".join(f"{each} [{row}]" for each, row in units.items())
            raise ConfigurationError(f"inputs: the column {name} is missing: a plan needs {needed}; it has {listed}")
        if len(own) > 1:
            listed = " and ".join(str(header) for _, header in own)
            raise ConfigurationError(f"inputs: {len(own)} columns are called {name}: {listed}: leave one of them")
        written, header = own[0]
        columns[name] = _converted(_numbers(inputs[header], name, is_time=name == TIME), name, written, unit)
    return columns


def _converted(values: Array, name: str, written: str | None, unit: str) -> Array:
    """Return values in ``unit`` that are in the unit of a header, if that has one."""
    if written is None:
        return values
    try:
        scale, offset = factor(written, unit)
    except ValueError as error:
        raise ConfigurationError(f"inputs: {name} [{written}]: {error}") from error
    return values * scale + offset


def _numbers(column: Any, name: str, *, is_time: bool) -> Array:
    """Return a column (rows,) as finite numbers; dates with a zone are Unix seconds."""
    try:
        values = np.asarray(column)
    except Exception as error:  # whatever a table of another library raises
        raise ConfigurationError(f"inputs: {name}: {shown(column)} is no column of numbers: {error}") from error
    if values.ndim != 1:
        shape = "a single value" if not values.ndim else f"the shape {values.shape}"
        raise ConfigurationError(f"inputs: {name} has {shape}: give a sequence of numbers, one for each row")
    if is_time and (values.dtype.kind == "M" or (len(values) and isinstance(values[0], datetime))):
        return _unix_seconds(column, values, f"inputs: {name}")
    if values.dtype.kind not in "iuf":
        values = np.array([_number(value, name, row) for row, value in enumerate(values.tolist())], dtype=np.float64)
    values = values.astype(np.float64)
    gaps = np.flatnonzero(~np.isfinite(values))
    if len(gaps):
        row = int(gaps[0])
        remedy = "write a finite one in each row, or leave the row out"
        raise ConfigurationError(f"inputs: {name} has the value {values[row]} in row {row}: {remedy}")
    return values


def _number(value: object, name: str, row: int) -> float:
    if isinstance(value, Real) and not isinstance(value, bool):
        return _float(value)
    raise ConfigurationError(f"inputs: {name} has {shown(value)} in row {row}, which is no number: give numbers")


def _float(value: Any) -> float:
    """Return a number as one of 64 bits, infinite if it is too large: whole numbers and fractions have no bound."""
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _unix_seconds(column: Any, values: NDArray[Any], name: str) -> Array:
    """Return the dates of a column in Unix s; a table of pyarrow knows their zone, and gives values without it."""
    if values.dtype.kind == "M" and getattr(getattr(column, "type", None), "tz", None):
        gaps = np.flatnonzero(np.isnat(values))
        if len(gaps):
            raise ConfigurationError(f"{name} has no date in row {gaps[0]}: write one, or leave the row out")
        return np.asarray(values.astype("datetime64[us]").astype(np.int64) / 1e6)
    for row, value in enumerate(values.tolist()):
        if not isinstance(value, datetime) or value.tzinfo is None:
            where = f" in row {row}" if len(values) > 1 else ""
            remedy = "give seconds as numbers, or dates with their zone"
            raise ConfigurationError(f"{name}: {shown(value)}{where} is no date with a zone: {remedy}")
    return np.array([value.timestamp() for value in values])
