"""Time zones by their IANA names, such as Europe/Berlin."""

import difflib
from datetime import UTC, datetime, tzinfo
from zoneinfo import ZoneInfo, available_timezones


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


def local_moment(seconds: float, zone: str | None = None) -> datetime:
    """Return a Unix time in a zone; in that of this computer without one, or if it does not know the zone.

    A report from elsewhere may name any zone.
    """
    try:
        own = zone_named(zone) if zone else None
    except (ValueError, OSError, KeyError):
        own = None
    return datetime.fromtimestamp(seconds, UTC).astimezone(own)


def date_seconds(date: datetime, zone: str | None = None) -> float:
    """Return the Unix time of a date; one without a zone is in ``zone`` or, as with :func:`local_moment`, in ours."""
    if date.tzinfo is None and zone:
        try:
            return date.replace(tzinfo=zone_named(zone)).timestamp()
        except (ValueError, OSError, KeyError):
            return date.timestamp()
    return date.timestamp()


def utc_seconds(text: str) -> float:
    """Return the Unix time of a date in UTC; raise ValueError if it is none."""
    return datetime.fromisoformat(text).replace(tzinfo=UTC).timestamp()
