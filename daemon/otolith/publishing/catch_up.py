"""What was published before: how the daemon answers queries from its history."""

import math
import re
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

import zenoh

MAX_REPLIES = 1000  # to one query, see docs/reference/thresholds-runtime.md
UNITS = {"u": 1e-6, "ms": 1e-3, "s": 1.0, "": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
_RANGE = re.compile(r"([\[\]])([^\[\]]*)\.\.([^\[\]]*)([\[\]])")
_NOW = re.compile(r"now\(\s*(?:([+-]?[0-9.]+)\s*(u|ms|s|m|h|d|w|))?\s*\)")


class Archive(Protocol):
    """Where the published documents are kept."""

    def messages(
        self, kind: str, limit: int, after: int = 0, start: float | None = None, end: float | None = None
    ) -> list[str]:
        """Return the first documents above a sequence number and within times; see HistoryReader."""


@dataclass(frozen=True, slots=True)
class Selection:
    """What a query asks for."""

    after: int = 0
    start: float | None = None
    """Unix s, as ``end``; None for no bound."""
    end: float | None = None


def selection(parameters: zenoh.Parameters, now: float) -> Selection | None:
    """Return what the parameters of a query select; None if they select nothing.

    Raises:
        ValueError: they are malformed.
    """
    span, after = parameters.get("_time"), parameters.get("after")
    if span is None and after is None:
        return None
    start, end = (None, None) if span is None else time_range(span, now)
    if after is not None and not re.fullmatch(r"[0-9]{1,18}", after):
        raise ValueError(f"after={after}: write a sequence number")
    return Selection(int(after or 0), start, end)


def time_range(text: str, now: float) -> tuple[float | None, float | None]:
    """Return begin and end of Zenoh's ``[start..end]`` in Unix s, None for no bound; an outward bracket excludes it.

    Raises:
        ValueError: it is malformed.
    """
    match = _RANGE.fullmatch(text.strip())
    if match is None:
        raise ValueError(f"_time={text}: write it like [now(-1h)..now()] or [2026-01-31T06:00:00Z..]")
    start, end = _instant(match[2], now), _instant(match[3], now)
    if start is not None and match[1] == "]":
        start = math.nextafter(start, math.inf)
    if end is not None and match[4] == "[":
        end = math.nextafter(end, -math.inf)
    return start, end


def _instant(text: str, now: float) -> float | None:
    if not text.strip():
        return None
    if match := _NOW.fullmatch(text.strip()):
        return now + float(match[1] or 0.0) * UNITS[match[2] or ""]
    moment = datetime.fromisoformat(text.strip())
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def answer(query: zenoh.Query, key: str, kind: str, latest: str | None, archive: Archive | None) -> None:
    """Reply with the selected documents of a ``kind``, oldest first; with the ``latest`` if nothing is selected."""
    try:
        selected = selection(query.parameters, time.time())
    except (ValueError, OverflowError) as error:
        query.reply_err(str(error))
        return
    if selected is None:
        texts = [] if latest is None else [latest]
    elif archive is None:
        texts = []
    else:
        texts = archive.messages(kind, MAX_REPLIES, selected.after, selected.start, selected.end)
    for text in texts:
        query.reply(key, text, encoding="application/json")
