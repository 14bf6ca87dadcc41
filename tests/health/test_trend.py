"""Trends are announced before a limit is reached; the swings of a load that changes by the hour or the day are none."""

import math
from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.prognosis import QUIET, History, SeenTrend, forecast, is_due, seen_trend, span, with_point
from otolith.health.schema import CrossingDocument, ForecastDocument
from tests.variants import often

HOUR, DAY, STEP, SD = 3600.0, 86400.0, 900.0, 0.0003  # s, s, s, relative
LIMIT, SWING = 0.03, 0.01  # relative: of WATCH, and of the load cycle
QUANTITY = MonitoredQuantity(
    "winding", "R", "ohm", 1.0, (Limit(Level.WATCH, 1.0 - LIMIT, True), Limit(Level.WATCH, 1.0 + LIMIT, False))
)
SHAPES: dict[str, Callable[[float], float]] = {
    "sine": lambda turns: math.sin(2.0 * math.pi * turns),
    "shifts": lambda turns: math.copysign(1.0, math.sin(2.0 * math.pi * turns)),
    "ramps": lambda turns: 2.0 * (turns % 1.0) - 1.0,
}


def always(history: History, now: float) -> ForecastDocument:
    """The worst forecast: whatever slope the last hour has goes on."""
    recent = [value for time, value, _ in history if time >= now - HOUR]
    limit = 1.0 + math.copysign(LIMIT, recent[-1] - recent[0])
    crossing = CrossingDocument(limit=limit, at=now + HOUR, low=now + 1.0, high=now + 2.0 * HOUR)
    return ForecastDocument(computed=now, watch=crossing)


def seen(
    value: Callable[[float], float], days: float, *, fitted: bool = False, step: float = STEP, run: float = math.inf
) -> list[SeenTrend]:
    """Return each trend that lasted, until ``value`` of a time passes WATCH or the days are over.

    Estimates come every ``step`` s, and in the first ``run`` s of every two hours only.
    """
    random, lasting = np.random.default_rng(5), list[SeenTrend]()
    history: History = ()
    own: ForecastDocument | None = None
    before: SeenTrend | None = None
    for now in np.arange(0.0, days * DAY, step).tolist():
        if now % (2.0 * HOUR) >= run:
            continue
        if abs(value(now) - 1.0) > LIMIT:
            break
        history = with_point(history, now, value(now) + SD * random.standard_normal(), SD**2)
        if not fitted:
            own = always(history, now)
        elif is_due(own, history):
            own = forecast(QUANTITY, history)
        before = seen_trend(QUANTITY, history, own, before, now)
        if before is not None and before.is_lasting(now, span(history)):
            lasting.append(before)
    return lasting


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("hours", [2.0, 6.0, 24.0])
def test_a_load_cycle_of_days_is_no_trend(shape: str, hours: float) -> None:
    """It covers two thirds of the way from one limit to the other, and each of its slopes would go on for ever."""
    assert seen(lambda time: 1.0 + SWING * SHAPES[shape](time / HOUR / hours), 10.0) == []


@pytest.mark.full
@pytest.mark.parametrize("shape", SHAPES)
def test_a_load_cycle_is_no_trend_by_its_forecasts_either(shape: str) -> None:
    assert seen(lambda time: 1.0 + SWING * SHAPES[shape](time / HOUR / 6.0), 3.0, fitted=True) == []


@pytest.mark.parametrize("hours", often([5.0], [5.0, 50.0, 500.0]))
@pytest.mark.parametrize("swing", [0.0, SWING])
def test_wear_is_announced_before_the_limit_also_under_a_load_cycle(hours: float, swing: float) -> None:
    """Wear that passes the limit after so many hours of a machine that was well for two days."""

    def worn(time: float) -> float:
        cycle = swing * SHAPES["sine"](time / HOUR / 6.0)
        return 1.0 + cycle + LIMIT * max(time - 2.0 * DAY, 0.0) / HOUR / hours

    lasting = seen(worn, 2.0 + 2.0 * hours / 24.0)
    assert lasting
    assert lasting[0].since > 2.0 * DAY


@pytest.mark.parametrize(("step", "run"), [(2.0 * HOUR, math.inf), (8.0 * HOUR, math.inf), (300.0, 1200.0)])
def test_wear_is_announced_on_a_machine_that_seldom_moves(step: float, run: float) -> None:
    """Its estimates are hours apart, or it rests for most of each two hours."""
    lasting = seen(lambda time: 1.0 + LIMIT * max(time - 10.0 * DAY, 0.0) / (20.0 * DAY), 30.0, step=step, run=run)
    assert lasting
    assert lasting[0].since > 10.0 * DAY


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("step", [2.0 * HOUR, 5.0 * HOUR])
def test_a_load_cycle_is_no_trend_of_a_machine_that_seldom_moves(shape: str, step: float) -> None:
    """It covers most of the way to the limit."""
    assert seen(lambda time: 1.0 + 0.02 * SHAPES[shape](time / DAY), 20.0, step=step) == []


def test_a_trend_is_over_a_day_after_it_was_last_seen() -> None:
    trend = SeenTrend(0.0, 100.0)
    times = [100.0, 100.0 + 0.9 * QUIET, 100.0 + QUIET]
    assert [trend.is_over(time) for time in times] == [False, False, True]
    assert trend.is_over(50.0)  # a log goes back in time
    assert all(not SeenTrend(0.0, before).is_lasting(now, HOUR) for before, now in pairwise(times))
