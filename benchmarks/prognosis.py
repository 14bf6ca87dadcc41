"""Forecasts of an exponential degradation as in the paper, from half way to the limit until nine tenths.

    python -m benchmarks.prognosis --runs 200

The armature resistance falls by ``amount * (exp(rate * t) - 1)`` from an onset to its limit at -10 %; amount, rate,
onset, noise and correlation of the estimates vary. The exit code is 1 unless the median error of the remaining time is
below 10 % and 75 to 85 % of the 80 % intervals hold the truth.
"""

import math
import sys
from dataclasses import dataclass

import click
import numpy as np
from rich.table import Table

from benchmarks.command_line import Options, print_pages, show_progress, with_options
from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.prognosis import History, forecast, with_point

NOMINAL, DISTANCE, PERIOD = 6.5, 0.65, 2.0  # ohm, ohm, s
AMOUNT, RATE, VARIED = 0.044, 0.003, 2.0  # ohm, 1/s (section 5.2 of the paper), and the factor by which both vary
NOISE = 3e-4, 1.5e-3  # of the nominal value
CORRELATIONS = 0.0, 0.5, 0.8, 0.95  # of the errors of consecutive estimates
SHARES = 0.5, 0.6, 0.7, 0.8, 0.9  # of the time from onset to limit
QUANTITY = MonitoredQuantity("winding", nominal=NOMINAL, limits=(Limit(Level.ACT, NOMINAL - DISTANCE, True),))


@dataclass(frozen=True, slots=True)
class Outcome:
    """One forecast against the truth."""

    share: float
    error: float
    """Of the median, over the remaining time; infinite without a forecast."""
    is_covered: bool
    """Whether the interval holds the truth; False without a forecast."""


def run(seed: int) -> list[Outcome]:
    """Return the forecasts of one degradation."""
    random = np.random.default_rng(seed)
    amount, rate = (mean * VARIED ** random.uniform(-1.0, 1.0) for mean in (AMOUNT, RATE))
    onset, noise = random.uniform(0.0, 300.0), NOMINAL * math.exp(random.uniform(*np.log(NOISE)))
    rho, stated = random.choice(CORRELATIONS), math.exp(random.uniform(-0.3, 0.3))
    until = math.log1p(DISTANCE / amount) / rate
    times = np.arange(PERIOD, onset + until, PERIOD)
    errors = random.standard_normal(len(times))
    for index in range(1, len(times)):
        errors[index] = rho * errors[index - 1] + math.sqrt(1.0 - rho**2) * errors[index]
    values = NOMINAL - amount * np.expm1(rate * np.maximum(times - onset, 0.0)) + noise * errors
    history: History = ()
    outcomes: list[Outcome] = []
    for time, value in zip(times.tolist(), values.tolist(), strict=True):
        history = with_point(history, time, value, (stated * noise) ** 2)
        if len(outcomes) == len(SHARES) or time < onset + SHARES[len(outcomes)] * until:
            continue
        crossing, left = forecast(QUANTITY, history).act, onset + until - time
        error, is_covered = math.inf, False
        if crossing is not None:
            error = (crossing.at - time) / left - 1.0
            is_covered = crossing.low <= onset + until <= (crossing.high or math.inf)
        outcomes.append(Outcome(SHARES[len(outcomes)], error, is_covered))
    return outcomes


def median_error(outcomes: list[Outcome]) -> float:
    """Return the median of the sizes of the errors."""
    return float(np.median([abs(outcome.error) for outcome in outcomes]))


def coverage(outcomes: list[Outcome]) -> float:
    """Return the share of the intervals that hold the truth."""
    return float(np.mean([outcome.is_covered for outcome in outcomes]))


@click.command(help=__doc__)
@click.option("--runs", default=200, show_default=True)
@with_options
def main(options: Options, runs: int) -> None:
    outcomes: list[Outcome] = []
    for number in range(runs):
        outcomes += run(options.seed + number)
        show_progress(number + 1, runs, "runs")
    table = Table(title=f"{runs} degradations")
    for column in ("share of the time", "median error", "within 10 %", "80 % interval holds"):
        table.add_column(column, justify="right")
    for share in (*SHARES, None):
        rows = [outcome for outcome in outcomes if share in (None, outcome.share)]
        within = np.mean([abs(outcome.error) < 0.1 for outcome in rows])
        name = "all" if share is None else f"{share:.0%}"
        table.add_row(name, f"{median_error(rows):.1%}", f"{within:.1%}", f"{coverage(rows):.1%}")
    print_pages(table)
    sys.exit(not (median_error(outcomes) < 0.1 and 0.75 <= coverage(outcomes) <= 0.85))


if __name__ == "__main__":
    main()
