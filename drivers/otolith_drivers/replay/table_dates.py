"""Dates of the rows of a table: in the column of the time, or in one of their own beside the time of day."""

import contextlib
import math
import re
from collections.abc import Sequence
from datetime import datetime, tzinfo

import pyarrow as pa
import pyarrow.compute as pc

from otolith_drivers.common.message_times import unix_time

DAY_FIRST = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})")  # no country writes the month first with points
DATE_NAME = re.compile(r"datum|date", re.IGNORECASE)
TIME_OF_DAY = re.compile(r"\s*\d{1,2}:\d\d")


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
