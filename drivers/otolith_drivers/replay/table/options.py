"""What a machine file states of a table: its times, the form of its rows, and the column of a signal."""

import time
from datetime import datetime
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from otolith_drivers.common.time_zones import check_time_zone, zone_named
from otolith_drivers.config_files import Range, StrictModel
from otolith_drivers.replay.readers import Array
from otolith_drivers.replay.table.header import SECONDS
from otolith_drivers.replay.table.times import TimeRequest
from otolith_drivers.units import factor

EXAMPLE = time.struct_time((2026, 11, 29, 13, 58, 57, 6, 333, 0))


def _unit_of_time(unit: str) -> str:
    factor(unit, SECONDS)
    return unit


def _date(written: Any) -> Any:
    if isinstance(written, str):
        try:
            return datetime.fromisoformat(written)
        except ValueError as error:
            raise ValueError(f"{written!r} is no date like 1899-12-30 or 1970-01-01T00:00:00Z") from error
    return written


def _strptime(form: str) -> str:
    try:
        time.strptime(time.strftime(form.replace("%f", "0"), EXAMPLE), form.replace("%f", "0"))
    except ValueError as error:
        raise ValueError(f'{form!r} is no format like "%d/%m/%Y %H:%M:%S": {error}') from error
    return form


class TableTime(StrictModel):
    """The column of the times of a table or of a signal; its name alone stands for a table with ``column``."""

    column: str  # Of several with this name, the one before the column of the signal
    unit: Annotated[str, AfterValidator(_unit_of_time)] | None = None  # Of its numbers, if its header does not name it
    date: str | None = None  # Column of the dates, if this one has the time of the day only; one called Date is found
    format: Annotated[str, AfterValidator(_strptime)] | None = None  # Of dates, as strptime takes it
    zone: Annotated[str, AfterValidator(check_time_zone)] | None = (
        None  # Of dates without one; without it, that of [machine]
    )
    epoch: Annotated[datetime, BeforeValidator(_date)] | None = None  # From which its numbers count

    @model_validator(mode="before")
    @classmethod
    def _name(cls, written: Any) -> Any:
        return {"column": written} if isinstance(written, str) else written

    @property
    def request(self) -> TimeRequest:
        """What the reader of the header is asked for."""
        zone = None if self.zone is None else zone_named(self.zone)
        return TimeRequest(self.column, self.unit, self.date, self.format, zone, self.epoch)


class TableSource(StrictModel):
    """The column of a signal."""

    column: str | None = None  # Name of the column; without it, the name of the signal
    unit: str | None = None  # Unit of the numbers in the column, if its header does not name it
    scale: float = 1.0  # times the number in the column, plus
    offset: float = 0.0  # in 'unit', is the value
    invert: bool = False  # Whether the value has the other sign
    range: Range | None = None  # In the unit of the column; a number outside is no reading
    time: TableTime | None = None  # Without it, that of the table

    @model_validator(mode="after")
    def _usable(self) -> "TableSource":
        if self.scale == 0.0:
            raise ValueError("scale = 0 leaves nothing of the numbers: write the value of a step of the number")
        if (self.scale, self.offset) != (1.0, 0.0) and self.unit is None:
            raise ValueError("'scale' and 'offset' change the unit of the column: set 'unit' to the new one")
        return self

    @property
    def scaling(self) -> tuple[float, float]:
        """Scale and offset from a number in the column to the value in ``unit``."""
        sign = -1.0 if self.invert else 1.0
        return sign * self.scale, sign * self.offset

    def value(self, numbers: Array) -> Array:
        """Return the values in ``unit`` of ``numbers`` in the column."""
        scale, offset = self.scaling
        values: Array = scale * numbers + offset
        return values


class TableOptions(StrictModel):
    """Key ``table`` of ``[driver]``: what holds for the whole table."""

    time: TableTime | None = None  # Of all signals that have none of their own
    names: Annotated[str, Field(min_length=1)] | None = None  # Column with the names of variables, one value per row
    values: Annotated[str, Field(min_length=1)] | None = None  # Column with their values

    @model_validator(mode="after")
    def _both(self) -> "TableOptions":
        if (self.names is None) != (self.values is None):
            raise ValueError("a table with one value per row has both 'names' and 'values': the columns of both")
        return self
