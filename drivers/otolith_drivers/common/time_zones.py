"""Time zones by their IANA names, such as Europe/Berlin."""

import difflib
import math
from datetime import UTC, datetime, tzinfo
from zoneinfo import ZoneInfo, available_timezones

from otolith_drivers.errors import ConfigurationError

# s by which a row may come late. Guarded by test_table_times.py; half an hour is the shortest shift of any zone.
MAX_LATE = 60.0


def check_time_zone(name: str) -> str:
    """Return the name of a time zone, or none; raise ValueError, with the most similar name, if no zone has it."""
    try:
        zone_named(name)
    except (ValueError, OSError, KeyError) as error:  # ZoneInfoNotFoundError is a KeyError
        raise ValueError(f"{name!r} is no time zone: write its IANA name, like {_nearest(name)!r}") from error
    return name


def _nearest(name: str) -> str:
    """Return the name of the most similar zone, which people may know by its city; of one zone if none is similar."""
    names = {zone.rpartition("/")[2].casefold(): zone for zone in sorted(available_timezones()) if "/" in zone}
    city = name.rpartition("/")[2].casefold().replace(" ", "_")
    similar = difflib.get_close_matches(city, names, n=1)
    return names[similar[0]] if similar else "Europe/Berlin"


def zone_named(name: str) -> tzinfo:
    """Return the time zone of a checked name; UTC for none."""
    return ZoneInfo(name) if name else UTC


def stated_zone(name: str) -> tzinfo | None:
    """Return the time zone of a checked name; None for none."""
    return zone_named(name) if name else None


def local_moment(seconds: float, zone: str | None = None) -> datetime:
    """Return a Unix time in a zone; in that of this computer without one, or if it does not know the zone.

    A report from elsewhere may name any zone.
    """
    try:
        own = zone_named(zone) if zone else None
    except (ValueError, OSError, KeyError):
        own = None
    return datetime.fromtimestamp(seconds, UTC).astimezone(own)


def comes_twice(seconds: float, zone: str | None = None) -> bool:
    """Whether a Unix time is in an hour that comes twice in a zone, as summer time ends; ours as with local_moment."""
    try:
        first, second = _both(local_moment(seconds, zone).replace(tzinfo=None), zone)
    except (ValueError, OverflowError, OSError):  # no calendar has such a time
        return False
    return second > first


def date_seconds(date: datetime, zone: str | None = None) -> float:
    """Return the Unix time of a date; one without a zone is in ``zone`` or, as with :func:`local_moment`, in ours.

    Raises:
        ConfigurationError: it comes twice there.
    """
    if date.tzinfo is not None:
        return date.timestamp()
    first, second = _both(date, zone)
    if second > first:
        both = (local_moment(seconds, zone) for seconds in (first, second))
        meanings = " or ".join(f"{moment.isoformat(timespec='seconds')} ({moment:%Z})" for moment in both)
        raise ConfigurationError(f"{date:%F %T} comes twice, as summer time ends: write {meanings}")
    return first


def _both(date: datetime, zone: str | None) -> tuple[float, float]:
    """Return the Unix times of a date without a zone; the second is later if the date comes twice."""
    try:
        own = zone_named(zone) if zone else None
    except (ValueError, OSError, KeyError):
        own = None
    first, second = (date.replace(tzinfo=own, fold=fold).timestamp() for fold in (0, 1))
    return first, second


class LocalDates:
    """The dates of a log, one after the other, as Unix times.

    Those that name no zone are in one, in UTC if none is stated. When summer time ends an hour comes twice: a date in
    it is the second if the first would be before the date before; without one, the first.
    """

    def __init__(self, zone: tzinfo | None = None) -> None:
        """``zone`` is that which is stated."""
        self._zone = zone
        self.last = math.nan  # Unix time of the date before
        self._first = ""  # What the first date of an hour that comes twice is taken as
        self._assumed, self._twice = 0, 0  # Number of dates that name no zone, and of those in such an hour

    def seconds(self, date: datetime) -> float:
        """Return the Unix time of the next date."""
        if date.tzinfo is not None:
            return date.timestamp()
        if self._zone is None:
            self._assumed += 1
            return date.replace(tzinfo=UTC).timestamp()
        first, second = (date.replace(tzinfo=self._zone, fold=fold).timestamp() for fold in (0, 1))
        self.last = self.chosen(first, second, self.last)
        return self.last

    def chosen(self, first: float, second: float, before: float) -> float:
        """Return the Unix time of a date that is either, after one at ``before``.

        The second is no later than the first if the date comes once, or never, as the hour that summer time leaves out.
        """
        if second <= first:
            return first
        time = second if before - first > MAX_LATE else first
        self._twice += 1
        if not self._first:
            moment = datetime.fromtimestamp(time, self._zone)
            self._first = f"{moment:%F %H:%M} is taken as {moment:%Z}"
        return time

    def offsets(self, date: datetime) -> tuple[float, float]:
        """Return by how much, s, the clocks of the zone are ahead of UTC at a date: the first time, and the second."""
        own = (date.replace(tzinfo=self._zone or UTC, fold=fold).utcoffset() for fold in (0, 1))
        first, second = (0.0 if offset is None else offset.total_seconds() for offset in own)
        return first, second

    def assumed(self, count: int) -> None:
        """Count dates that name no zone, if none is stated."""
        self._assumed += count if self._zone is None else 0

    def warnings(self) -> list[str]:
        """Return what was assumed of the dates."""
        lines = []
        if self._assumed:
            remedy = 'write timezone = "Europe/Berlin", or what it is, under [machine]'
            lines.append(f"its dates name no time zone and are taken as UTC: if they are local times, {remedy}")
        if self._twice:
            text = f"{self._twice} dates are of an hour that comes twice, as summer time ends: {self._first}"
            lines.append(f"{text}, each other one follows the date before")
        return lines


def utc_seconds(text: str) -> float:
    """Return the Unix time of a date in UTC; raise ValueError if it is none."""
    return datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()
