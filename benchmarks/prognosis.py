"""Forecasts of an exponential degradation as in the paper, from half way to the limit until nine tenths.

    python -m benchmarks.prognosis --runs 200
    python -m benchmarks.prognosis --runs 20 --motor

The armature resistance falls by ``amount * (exp(rate * t) - 1)`` from an onset to its limit at -10 %; amount, rate,
onset, noise and correlation of the estimates vary. The Cramér-Rao bound of each history says which share of the errors
would be within 10 % if the forecast were an efficient unbiased estimate. With ``--motor``, the degradation is that of
the paper: the simulated motor's signals go through the daemon's core, until its limit at -5 %. The exit code is 1
unless the median error of the remaining time is below 10 % and 75 to 85 % of the 80 % intervals hold the truth.
"""

import math
import sys
from dataclasses import dataclass
from functools import partial

import click
import numpy as np
from rich.table import Table

from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.diagnosis import of_scenario
from benchmarks.motor import CONFIG
from otolith.acquisition.window import Array
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.limits import Level, Limit, MonitoredQuantity
from otolith.health.prognosis import History, forecast, with_point
from otolith.health.schema import ForecastDocument
from otolith.machine import load_machine

NOMINAL, DISTANCE, PERIOD = 6.5, 0.65, 2.0  # ohm, ohm, s
AMOUNT, RATE, VARIED = 0.044, 0.003, 2.0  # ohm, 1/s (section 5.2 of the paper), and the factor by which both vary
NOISE = 3e-4, 1.5e-3  # of the nominal value
ONSETS = 0.0, 300.0  # s
PAPER_ONSET = 160.0  # s
NEAR = 0.1  # of the remaining time
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
    bound: float = math.nan
    """Lowest standard deviation of an unbiased estimate of the remaining time, over that time."""


def lowest_sd(times: Array, amount: float, rate: float, onset: float, noise: float, rho: float) -> float:
    """Return the Cramér-Rao bound of the time of the crossing, s, from estimates at ``times`` (s).

    Unknown are healthy value, amount, rate and onset; noise and correlation are known. Of the onset it is known in
    addition that it lies in :data:`ONSETS`.
    """
    age = np.maximum(times - onset, 0.0)
    growth, distance = np.exp(rate * age), 1.0 + DISTANCE / amount
    sensitivity = np.stack(
        [age**0, -np.expm1(rate * age), -amount * age * growth, (times > onset) * amount * rate * growth]
    )
    white = np.concatenate([sensitivity[:, :1], np.diff(sensitivity) + (1.0 - rho) * sensitivity[:, :-1]], axis=1)
    white[:, 1:] /= math.sqrt(1.0 - rho**2)
    information = white @ white.T / noise**2 + np.diag([0.0, 0.0, 0.0, 12.0 / ONSETS[1] ** 2])
    gradient = np.array(
        [1.0 / (rate * amount * distance), (1.0 / distance - 1.0) / (rate * amount), -math.log(distance) / rate**2, 1.0]
    )
    return math.sqrt(gradient @ np.linalg.solve(information, gradient))


def run(seed: int) -> list[Outcome]:
    """Return the forecasts of one degradation."""
    random = np.random.default_rng(seed)
    amount, rate = (mean * VARIED ** random.uniform(-1.0, 1.0) for mean in (AMOUNT, RATE))
    onset, noise = random.uniform(*ONSETS), NOMINAL * math.exp(random.uniform(*np.log(NOISE)))
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
        if len(outcomes) < len(SHARES) and time >= onset + SHARES[len(outcomes)] * until:
            bound = lowest_sd(times[: np.searchsorted(times, time) + 1], amount, rate, onset, noise, rho)
            expected = forecast(QUANTITY, history)
            outcomes.append(outcome(expected, SHARES[len(outcomes)], time, onset + until, bound))
    return outcomes


def outcome(
    expected: ForecastDocument | None, share: float, now: float, end: float, bound: float = math.nan
) -> Outcome:
    """Return a forecast at the time ``now`` against the ``end``, Unix s; ``bound`` in s."""
    crossing, left = None if expected is None else expected.act, end - now
    if crossing is None:
        return Outcome(share, math.inf, False, bound / left)
    is_covered = crossing.low <= end <= (crossing.high or math.inf)
    return Outcome(share, (crossing.at - now) / left - 1.0, is_covered, bound / left)


def run_motor(seed: int) -> list[Outcome]:
    """Return the forecasts of the paper's degradation, from the signals of the simulated motor."""
    fault = {"kind": "drift", "parameter": "R_a", "start": f"{PAPER_ONSET} s",
             "amount": f"{-AMOUNT} ohm", "rate": f"{RATE} 1/s"}  # fmt: skip
    machine = load_machine(CONFIG / "dc-motor.toml", with_driver=False)
    limits = machine.plan.parameters["R_a"].limits
    limit = next(item.value for item in limits if item.level is Level.ACT and item.is_lower)
    until = math.log1p((NOMINAL - limit) / AMOUNT) / RATE
    state = initial_state("m", "s", machine.problem, machine.plan)
    outcomes: list[Outcome] = []
    for window in of_scenario("demo", fault, machine, seed, count=round((PAPER_ONSET + until) / PERIOD)):
        state, report = adapt(state, window)
        if len(outcomes) < len(SHARES) and window.end >= PAPER_ONSET + SHARES[len(outcomes)] * until:
            expected = report.document.parameters["R_a"].forecast
            outcomes.append(outcome(expected, SHARES[len(outcomes)], window.end, PAPER_ONSET + until))
    return outcomes


def median_error(outcomes: list[Outcome]) -> float:
    """Return the median of the sizes of the errors."""
    return float(np.median([abs(outcome.error) for outcome in outcomes]))


def coverage(outcomes: list[Outcome]) -> float:
    """Return the share of the intervals that hold the truth."""
    return float(np.mean([outcome.is_covered for outcome in outcomes]))


@click.command(help=__doc__)
@click.option("--runs", default=200, show_default=True)
@click.option("--motor", is_flag=True, help="From the signals of the simulated motor.")
@with_options
def main(options: Options, runs: int, motor: bool) -> None:
    one = run_motor if motor else run
    jobs = [partial(one, options.seed + number) for number in range(runs)]
    outcomes = [outcome for part in in_processes(jobs, options.processes) for outcome in part]
    table = Table(title=f"{runs} degradations")
    for column in ("share of the time", "median error", "within 10 %", "at the bound", "80 % interval holds"):
        table.add_column(column, justify="right")
    for share in (*SHARES, None):
        rows = [outcome for outcome in outcomes if share in (None, outcome.share)]
        within = np.mean([abs(outcome.error) < NEAR for outcome in rows])
        best = np.mean([math.erf(NEAR / (math.sqrt(2.0) * outcome.bound)) for outcome in rows])
        name, bound = "all" if share is None else f"{share:.0%}", "" if motor else f"{best:.1%}"
        table.add_row(name, f"{median_error(rows):.1%}", f"{within:.1%}", bound, f"{coverage(rows):.1%}")
    print_pages(table)
    sys.exit(not (median_error(outcomes) < NEAR and 0.75 <= coverage(outcomes) <= 0.85))


if __name__ == "__main__":
    main()
