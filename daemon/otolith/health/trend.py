"""When a trend is announced: it has led far towards a limit, further than the swings of ordinary operation before.

A load that changes each shift or each day moves temperatures, and with them parameters, up and down. Each slope of such
a cycle is a trend that would pass a limit if it went on. A trend is therefore announced only where the cycles before it
never led, and it is over only after a day without it.
"""

from dataclasses import dataclass

from otolith.health.limits import MonitoredQuantity
from otolith.health.prognosis import History, span
from otolith.health.schema import CrossingDocument, ForecastDocument

# Thresholds: docs/reference/thresholds-health.md has the origin of each.
MIN_TREND_SPAN = 3600.0  # s: of a history whose trend is announced before a limit is passed
MIN_WAY = 0.5  # of the way from the healthy value to a limit, that the value must have gone
MIN_BEYOND = 0.1  # of that way, by which it must be further than in the older half of its history
HOLD, MAX_HOLD = 0.05, 3600.0  # of the length of the history, and s: for which this must be so, the shorter one
QUIET = 86400.0  # s without it, after which it is over: a day, the longest cycle of most loads


@dataclass(frozen=True, slots=True)
class SeenTrend:
    """Since when and until when a parameter was on its way to a limit, service times in s."""

    since: float
    until: float

    def is_over(self, now: float) -> bool:
        """Whether it was not seen for so long that its event ends."""
        return not 0.0 <= now - self.until < QUIET

    def is_lasting(self, now: float, length: float) -> bool:
        """Whether it is seen ``now``, and has been for long enough, in a history of ``length`` s."""
        return self.until == now and now - self.since >= _hold(length)


def _hold(length: float) -> float:
    """Return for how long a trend must be seen in a history of ``length`` s, s."""
    return min(HOLD * length, MAX_HOLD)


def seen_trend(
    quantity: MonitoredQuantity,
    history: History,
    forecast: ForecastDocument | None,
    before: SeenTrend | None,
    now: float,
) -> SeenTrend | None:
    """Return when the trend of a history was seen, up to ``now``; None if it never was."""
    if (crossing := next_crossing(forecast, now)) is None or not _is_new(quantity, history, crossing.limit):
        return before
    goes_on = before is not None and 0.0 <= now - before.until < _hold(span(history))
    return SeenTrend(before.since if before is not None and goes_on else now, now)


def next_crossing(forecast: ForecastDocument | None, now: float) -> CrossingDocument | None:
    """Return the next limit that will be passed, if it is known up to when."""
    both = () if forecast is None else (forecast.watch, forecast.act)
    first = next((item for item in both if item is not None and item.low > now), None)
    return None if first is None or first.high is None else first


def _is_new(quantity: MonitoredQuantity, history: History, limit: float) -> bool:
    """Whether the value has gone far towards the limit, and further than in the older half of its history."""
    way = limit - quantity.nominal
    gone = [(value - quantity.nominal) / way for _, value, _ in history]
    middle = history[-1][0] - 0.5 * span(history)
    older = [share for share, (time, _, _) in zip(gone, history, strict=True) if time <= middle]
    return gone[-1] >= MIN_WAY and gone[-1] >= max(older, default=0.0) + MIN_BEYOND
