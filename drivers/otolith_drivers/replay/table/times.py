"""The times of a table: numbers, dates, times of the day, and what is asked where they may mean something else.

A wrong unit of the time makes every estimate wrong, without any sign of it. So a unit that is not stated is questioned
where the rows would come faster than any logger writes, and a column of the time beside which another one contradicts.
"""

import contextlib
import itertools
import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta, tzinfo
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from otolith_drivers.common.time_zones import LocalDates
from otolith_drivers.errors import shown
from otolith_drivers.replay.readers import MAX_TIME, Array, Integers
from otolith_drivers.units import factor

DAY_FIRST = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})")  # no country writes the month first with points
# Day and month, in an order that depends on the country; a year behind them.
EITHER_FIRST = re.compile(r"\s*(\d{1,2})([/-])(\d{1,2})\2(\d{4}|\d\d)(?=\D|$)")
DATE_NAME = re.compile(r"datum|date", re.IGNORECASE)
TIME_IN_DATE = re.compile(r"\d:\d\d")
TIME_OF_DAY = re.compile(r"\s*\d{1,2}:\d\d")
CLOCK_TIME = re.compile(r"\s*(\d{1,3}):([0-5]\d):([0-5]\d)(?:[.,](\d{1,9}))?\s*")
HALF_CLOCK_TIME = re.compile(r"\s*\d{1,3}:[0-5]\d(?:[.,]\d{1,9})?\s*")  # hours and minutes, or minutes and seconds
FRACTION = re.compile(r"(?<=\d)[.,](\d{1,12})(?=\D*$)")  # of the second
DATE = "2026-03-29T01:59:58.25Z"  # an example
MONTHS = 12
NO_YEAR = 1900  # of a date that has none, for strptime
# Days since 30 December 1899, as spreadsheets count them: from 1980 to 2100. Such days since 1970 are after 2050.
SPREADSHEET_DAYS, DAYS_TO_1970 = (29_221.0, 73_050.0), 25_569.0
DAY, HOUR = 86_400.0, 3600.0  # s
CALENDAR = (-6.2e10, MAX_TIME)  # s since 1970, which dates can have: from the year 5 on
QUARTER = 900.0  # s: clocks of all zones change at such a time
# Engineering choices, guarded by tests/drivers/replay/test_table_times.py.
MIN_INTERVAL = 1e-6  # s: no logger of a machine writes rows more often, so their times are in another unit
PLAUSIBLE = (1e-5, 3600.0)  # s between two rows, for the units that are proposed
UNITS = {"d": "days", "h": "hours", "min": "minutes", "s": "seconds", "ms": "milliseconds"}
ROUNDED = 1.5  # s by which a span may differ that is read from two dates without fractions of a second
ALIKE = 0.5  # share of the longer one by which two spans of the same rows may differ
# Names of columns that have the times of the column behind them, as TwinCAT Scope and LabVIEW write them.
BESIDE_NAME = re.compile(r"name|x|.*(?:time|zeit).*", re.IGNORECASE)
EVEN = 1e-3  # share by which the intervals of the first rows may differ where they are even


class TimeRequest(NamedTuple):
    """Where the times of a table are, and how they are written; what is None follows from header and cells."""

    column: str = "t"
    unit: str | None = None  # Of numbers
    date: str | None = None  # Column of the date, if that of the time has none
    format: str | None = None  # Of the date, with that of its own column in front, as strptime takes it
    zone: tzinfo | None = None  # Without it, that of the machine
    epoch: datetime | None = None  # From which numbers count; on the clock of the zone if it names none
    is_known: bool = False  # Whether the format of the file defines all this, whatever its header says


class Clock:
    """The cells of a column of times as Unix times, or seconds from any start. Cells must come in their order."""

    def __init__(self, request: TimeRequest, scale: float, zone: tzinfo | None, *, has_dates: bool = False) -> None:
        """``scale`` is the unit of numbers, s; ``zone`` that of dates that name none, unless the request does.

        ``has_dates`` says that dates stand in front of the times of the day.
        """
        self._request, self._scale, self.dates = request, scale, LocalDates(request.zone or zone)
        self._has_days: bool | None = False if has_dates else None  # whether times of the day stand alone: the first
        self._midnights, self._latest = 0, -math.inf  # of times of the day

    def times(self, written: Array, texts: pa.StringArray) -> Array:
        """Return the times (n,), s, of cells: NaN for a blank one, infinity for one that is no time.

        ``written`` are the numbers in them, s: NaN for a blank cell, infinity for another text.
        """
        if self._request.format is not None:
            written = np.where(np.isfinite(written), np.inf, written)
        dates = np.flatnonzero(np.isinf(written))
        cells = texts.take(pa.array(dates)).to_pylist()
        if self._has_days is None:
            self._has_days = self._begins_with_time_of_day(written, dates, cells)
        times = np.where(np.isfinite(written), np.inf, written) if self._has_days else self._of_numbers(written)
        times[dates] = [self._of_text(cell) for cell in cells]
        return times

    @property
    def counts_midnights(self) -> bool:
        """Whether a time may depend on the cells before it, so that none may be left out."""
        return self._has_days is not False

    def _begins_with_time_of_day(self, written: Array, dates: Integers, cells: Sequence[str]) -> bool | None:
        """Whether the first time is one of the day: then all are, or none is; None if no cell is a time."""
        first = np.flatnonzero(np.isfinite(written))
        for row, cell in zip(dates.tolist(), cells, strict=True):
            if len(first) and first[0] < row:
                return False
            if CLOCK_TIME.fullmatch(cell):
                return True
            if math.isfinite(date_of(cell, LocalDates())):
                return False
        return False if len(first) else None

    def _of_numbers(self, times: Array) -> Array:
        """Return ``times`` (n,), s, from the start that the request or a spreadsheet has."""
        epoch = self._request.epoch
        if epoch is None:
            return since_1970(times, self._scale, self.dates)
        if epoch.tzinfo is not None:
            return times + epoch.timestamp()
        return on_wall_clock(times + epoch.replace(tzinfo=UTC).timestamp(), self.dates)

    def _of_text(self, text: str) -> float:
        if self._request.format is not None:
            return self._formatted(text, self._request.format)
        if self._has_days:
            if (parts := CLOCK_TIME.fullmatch(text)) is None:
                return math.inf
            hours, minutes, seconds = map(int, parts.groups()[:3])
            fraction = float(f"0.{parts[4]}") if parts[4] else 0.0
            return self._after_midnights(HOUR * hours + 60.0 * minutes + seconds + fraction, DAY)
        return date_of(text, self.dates)

    def _formatted(self, text: str, form: str) -> float:
        """Return the time of a date in the stated format, in which the fraction of a second may be absent."""
        text, fraction = text.strip(), 0.0
        if "%f" not in form and (part := FRACTION.search(text)) is not None:
            text, fraction = text[: part.start()] + text[part.end() :], float(f"0.{part[1]}")
        with contextlib.suppress(ValueError, OverflowError):
            moment = datetime.strptime(FRACTION.sub(lambda part: f".{part[1][:6]}", text), form)  # noqa: DTZ007 - in no zone
            if moment.year > NO_YEAR:
                return self.dates.seconds(moment) + fraction
            since = (moment.replace(tzinfo=UTC) - datetime(NO_YEAR, 1, 1, tzinfo=UTC)).total_seconds() + fraction
            return self._after_midnights(since, DAY if re.search("%[HI]", form) else HOUR)
        return math.inf

    def _after_midnights(self, time: float, period: float) -> float:
        """Return a time (s) of the day or of the hour, whose clock starts again after ``period`` s."""
        time += self._midnights * period
        if time < self._latest - 0.5 * period:
            self._midnights += 1
            time += period
        self._latest = max(self._latest, time)
        return time

    def question(self, text: str) -> str:
        """Return what is asked of a cell that may be two times; empty if it is none at all."""
        if HALF_CLOCK_TIME.fullmatch(text):
            return self._question(text, "minutes and seconds, or hours and minutes", "%M:%S", "%H:%M")
        if (parts := EITHER_FIRST.match(text)) is None:
            return ""
        sign, year = parts[2], "%Y" if len(parts[4]) > 2 else "%y"
        clock = ""
        if TIME_IN_DATE.search(text):
            has_half = re.search("[ap]m", text, re.IGNORECASE)
            seconds = ":%S" if text.count(":") > 1 else ""
            clock = f" %I:%M{seconds} %p" if has_half else f" %H:%M{seconds}"
        months = {f"%d{sign}%m": int(parts[3]), f"%m{sign}%d": int(parts[1])}
        forms = [f"{order}{sign}{year}{clock}" for order, month in months.items() if month <= MONTHS]
        return self._question(text, "the day or the month first", *forms) if forms else ""

    def _question(self, text: str, what: str, *forms: str) -> str:
        keys = f'column = "{self._request.column}", ' + (
            f'date = "{self._request.date}", ' if self._request.date else ""
        )
        either = " or ".join(f'format = "{form}"' for form in forms)
        return f"{shown(text)} may have {what}: write time = {{ {keys}{either} }} under [signals], or dates like {DATE}"


def on_wall_clock(local: Array, dates: LocalDates) -> Array:
    """Return the Unix times of the next ``dates`` (n,), s since 1970 on the clocks of their zone.

    NaN stands for no time; one that no calendar has becomes infinity.
    """
    times: Array = np.where(np.isnan(local), np.nan, np.inf)
    known = np.flatnonzero((local >= CALENDAR[0]) & (local <= CALENDAR[1]))
    if len(known):
        times[known] = _on_wall_clock(local[known], dates)
    return times


def _on_wall_clock(local: Array, dates: LocalDates) -> Array:
    quarters, place = np.unique(np.floor(local / QUARTER), return_inverse=True)
    begin = datetime(1970, 1, 1, tzinfo=UTC)
    moments = (begin + timedelta(seconds=QUARTER * float(quarter)) for quarter in quarters)
    offsets = np.array([dates.offsets(moment) for moment in moments]).reshape(-1, 2)[place]
    first, second = local - offsets[:, 0], local - offsets[:, 1]
    for row in np.flatnonzero(second > first).tolist():
        before = dates.last if row == 0 else float(first[row - 1])
        first[row] = dates.chosen(float(first[row]), float(second[row]), before)
    dates.assumed(len(local))
    dates.last = float(first[-1])
    return np.asarray(first)


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


def date_of(text: str, dates: LocalDates) -> float:
    """Return the Unix time (s) of the next of the ``dates``; infinity for another text."""
    with contextlib.suppress(ValueError):
        return dates.seconds(datetime.fromisoformat(DAY_FIRST.sub(r"\3-\2-\1", text.strip()).replace("/", "-")))
    return math.inf


def since_1970(times: Array, scale: float, dates: LocalDates) -> Array:
    """Return ``times`` (n,) in s with those of a spreadsheet, in a unit of ``scale`` s, counted from 1970.

    A spreadsheet shows the time of a day in the zone of the plant, as the ``dates`` are.
    """
    if scale != DAY:
        return times
    low, high = (DAY * days for days in SPREADSHEET_DAYS)
    counted = np.flatnonzero((times >= low) & (times <= high))
    moved = times.copy()
    moved[counted] = on_wall_clock(times[counted] - DAY * DAYS_TO_1970, dates)
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
    in_utc = LocalDates(UTC)
    dates = [date_of(cell, in_utc) for cell in cells]
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
