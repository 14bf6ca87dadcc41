"""Times for people: the local time of the plant, with its zone. Data have Unix seconds, texts of the core UTC."""

import re
from collections.abc import Callable
from functools import partial

from otolith.acquisition.quality import is_of_calendar, time_text
from otolith_drivers.common.time_zones import local_moment, utc_seconds

NO_TIME_OF_DAY = 172800.0  # s: docs/reference/thresholds-health.md has its origin
Clock = Callable[[float], str]  # From Unix seconds to what people read
DATE = re.compile(r"(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)(\.\d+)? UTC")  # As time_text writes it


def moment_text(seconds: float, zone: str | None = None) -> str:
    """A time of the data without fractions of a second, as that of an event: it is known to a window."""
    return f"{local_moment(seconds, zone):%F %T %Z}" if is_of_calendar(seconds) else time_text(seconds)


def expected_text(seconds: float, spread: float, zone: str | None = None) -> str:
    """A time in the future, which is known to ``spread`` s: the day alone, if that is more than two days."""
    if not is_of_calendar(seconds):
        return time_text(seconds)
    moment = local_moment(seconds, zone)
    return f"{moment:%F}" if spread > NO_TIME_OF_DAY else f"{moment:%F %H:%M %Z}"


def clock_in(zone: str | None) -> Clock:
    """Return what gives times in a zone; in that of this computer without one."""
    return partial(moment_text, zone=zone)


def in_local_time(text: str, zone: str | None) -> str:
    """Return a text of the core with its dates in a zone; in that of this computer without one."""

    def local(match: re.Match[str]) -> str:
        try:
            own = local_moment(utc_seconds(match[1]), zone)
        except (ValueError, OverflowError, OSError):  # no clock has such a time, but a file may
            return match[0]
        return f"{own:%F %T}{match[2] or ''} {own:%Z}"

    return DATE.sub(local, text)
