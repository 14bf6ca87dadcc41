"""The times of a table: dates, days since 1899, and what is asked where they may mean something else.

A wrong unit of the time makes every estimate wrong, without any sign of it. So a unit that is not stated is questioned
where the rows would come faster than any logger writes, and a column of the time beside which another one contradicts.
"""

import contextlib
import itertools
import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from otolith_drivers.common.message_times import unix_time
from otolith_drivers.errors import shown
from otolith_drivers.replay.readers import Array
from otolith_drivers.units import factor

DAY_FIRST = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})")  # no country writes the month first with points
DATE_NAME = re.compile(r"datum|date", re.IGNORECASE)
TIME_IN_DATE = re.compile(r"\d:\d\d")
TIME_OF_DAY = re.compile(r"\s*\d{1,2}:\d\d")
# Days since 30 December 1899, as spreadsheets count them: from 1980 to 2100. Such days since 1970 are after 2050.
SPREADSHEET_DAYS, DAYS_TO_1970 = (29_221.0, 73_050.0), 25_569.0
DAY = 86_400.0  # s
# Engineering choices, guarded by tests/drivers/replay/test_table_times.py.
MIN_INTERVAL = 1e-6  # s: no logger of a machine writes rows more often, so their times are in another unit
PLAUSIBLE = (1e-5, 3600.0)  # s between two rows, for the units that are proposed
UNITS = {"d": "days", "h": "hours", "min": "minutes", "s": "seconds", "ms": "milliseconds"}
ROUNDED = 1.5  # s by which a span may differ that is read from two dates without fractions of a second
ALIKE = 0.5  # share of the longer one by which two spans of the same rows may differ
# Names of columns that have the times of the column behind them, as TwinCAT Scope and LabVIEW write them.
BESIDE_NAME = re.compile(r"name|x|.*(?:time|zeit).*", re.IGNORECASE)
EVEN = 1e-3  # share by which the intervals of the first rows may differ where they are even


def date_column(names: Sequence[str], rows: Sequence[Sequence[str]], time: int) -> int | None:
    """Return the place of the column of the date, if the column at ``time`` has the time of day only; else None.

    ``names`` are those of all columns, ``rows`` the cells of lines below the header.
    """
    places = [place for place, name in enumerate(names) if DATE_NAME.fullmatch(name)]
    has_times = any(len(cells) > time and TIME_OF_DAY.match(cells[time]) for cells in rows)
    return places[0] if len(places) == 1 and has_times else None


def with_dates(dates: pa.StringArray, times: pa.StringArray) -> pa.StringArray:
    """Return dates with times of day."""
    return pc.binary_join_element_wise(pc.utf8_trim_whitespace(dates), pc.utf8_trim_whitespace(times), " ")


def date_of(text: str, zone: tzinfo) -> float:
    """Return the Unix time (s) of a date, in ``zone`` if it names none; infinity for another text."""
    with contextlib.suppress(ValueError):
        return unix_time(datetime.fromisoformat(DAY_FIRST.sub(r"\3-\2-\1", text.strip()).replace("/", "-")), zone)
    return math.inf


def since_1970(times: Array, scale: float, zone: tzinfo) -> Array:
    """Return ``times`` (n,) in s with those of a spreadsheet, in a unit of ``scale`` s, counted from 1970.

    A spreadsheet shows the time of a day in the ``zone`` of the plant.
    """
    if scale != DAY:
        return times
    low, high = (DAY * days for days in SPREADSHEET_DAYS)
    counted = np.flatnonzero((times >= low) & (times <= high))
    moved = times.copy()
    for row in counted:
        local = datetime.fromtimestamp(float(times[row]) - DAY * DAYS_TO_1970, UTC).replace(tzinfo=None)
        moved[row] = unix_time(local, zone)
    return moved


def question_of_unit(times: Array) -> str:
    """Return what is asked of rows at ``times`` (n,), s, whose unit is not stated; empty if nothing is."""
    steps = np.diff(times)
    forward = steps[steps > 0.0]
    if not len(forward) or (interval := float(np.median(forward))) >= MIN_INTERVAL:
        return ""
    meanings = [
        f"{_interval(interval * scale)} if they are {name}: write 't [{symbol}]'"
        for symbol, name in UNITS.items()
        if PLAUSIBLE[0] <= interval * (scale := factor(symbol, "s")[0]) <= PLAUSIBLE[1]
    ]
    low, high = SPREADSHEET_DAYS
    if low <= float(times[0]) <= high:
        meanings.sort(key=lambda text: "days" not in text)
    question = "; or ".join(meanings) or "write its unit: 't [ms]'"
    return (
        f"a row every {interval:.3g} s, which is faster than any logger. The times of this table are every {question}"
    )


def contradiction(name: str, times: Sequence[float], other: str, cells: Sequence[str]) -> str:
    """Return what is asked where ``cells`` of column ``other`` are dates that contradict ``times``, s; else empty."""
    if not all(map(TIME_IN_DATE.search, cells)):  # a day, or a number of a batch
        return ""
    dates = [date_of(cell, UTC) for cell in cells]
    if len(set(dates)) < 2 or not all(map(math.isfinite, (*dates, *times))):
        return ""
    by_date, by_time = dates[-1] - dates[0], times[-1] - times[0]
    if abs(by_date - by_time) <= ROUNDED + ALIKE * max(abs(by_date), abs(by_time)):
        return ""
    spans = f"{len(dates)} rows last {by_time:.3g} s by {shown(name)}, but {by_date:.3g} s by {shown(other)}"
    return f'{spans}: write time = "{other}" for each signal, or time = "{name}" if that is right'


def rises_evenly(numbers: Sequence[float]) -> bool:
    """Return whether numbers rise in equal steps, as times do."""
    steps = [after - before for before, after in itertools.pairwise(numbers)]
    return len(steps) > 1 and min(steps) > 0.0 and max(steps) - min(steps) <= EVEN * max(steps)


def _interval(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"
