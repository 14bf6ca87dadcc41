"""``python -m benchmarks.estimators.ablation``: how often a cold start and its parts reach the global optimum.

Cold, from random points within bounds much wider than the library's. A result is judged by the χ² of its
parameters with the initial state refitted, the same for all, against the best that is known of the window.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks.command_line import show_progress
from benchmarks.estimators.cases import BOUNDS_FACTOR, Case, cases, start, windows
from otolith.acquisition.window import Array, Window
from otolith.estimation.global_search import MAX_ROUNDS, search_window
from otolith.estimation.information import initial_prior
from otolith.estimation.minimisers import gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import SwarmSearch, estimate

WINDOWS = 10  # machines, over which the starts are distributed
CHI_SQUARE_TOLERANCE, RELATIVE_TOLERANCE = (
    3.0,
    0.01,
)  # above the best χ², absolute and relative: counts as the global optimum


@dataclass(frozen=True, slots=True)
class Row:
    """Result of one twin: shares of the starts, and seconds, by method."""

    twin: str
    unknown: tuple[str, ...]
    starts: int
    global_optimum: dict[str, float]
    seconds: dict[str, float]
    """Median."""
    seconds_worst: dict[str, float]


# The last is the way a cold window is estimated, with the initial prior.
METHODS_COMPARED = ("Gauss-Newton", "one round", "search", "cold window")


class Attempt(NamedTuple):
    """Result of one method."""

    values: Array
    """(free,)."""
    seconds: float


def attempts(problem: Problem, window: Window, start: Array) -> tuple[Attempt, ...]:
    """All methods from one start, in the order of :data:`METHODS_COMPARED`."""

    def alone() -> Array:
        objective = Objective(problem, window, start)
        return gauss_newton(objective, objective.guess(start)).guess[: objective.free]

    def searched(rounds: int) -> Array:
        random = np.random.default_rng(problem.seed + window.index)
        return search_window(problem, window, start, random, rounds).parameters

    def cold() -> Array:
        estimated = estimate(problem, window, initial_prior(problem), start, SwarmSearch.FROM_BOUNDS)
        return np.array([parameter.value for parameter in estimated.parameters])

    results = []
    for method in (alone, partial(searched, 1), partial(searched, MAX_ROUNDS), cold):
        begin = time.process_time()
        values = method()
        results.append(Attempt(values, time.process_time() - begin))
    return tuple(results)


class Judge:
    """The χ² of parameters over one window, its objective made around the truth."""

    def __init__(self, problem: Problem, window: Window, truth: Array) -> None:
        self._objective = Objective(problem, window, truth)
        self.best = gauss_newton(self._objective, self._objective.guess(truth)).chi_square

    def chi_square(self, parameters: Array) -> float:
        """The least over the initial state."""
        first = self._objective.guess(parameters)[len(parameters) :]
        return gauss_newton(_Pinned(self._objective, parameters), first).chi_square


class _Pinned:
    """An objective of the initial state alone."""

    def __init__(self, objective: Objective, parameters: Array) -> None:
        self._objective, self._parameters = objective, parameters
        self.low, self.high = objective.low[objective.free :], objective.high[objective.free :]

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        residuals, jacobian = self._objective.linearise(np.concatenate([self._parameters, guess]))
        return residuals, jacobian[:, len(self._parameters) :]


def ablate(case: Case, starts: int, seed: int) -> Row:
    """All methods from the same starts."""
    random = np.random.default_rng(seed)
    dealt = windows(case, min(WINDOWS, starts), seed)
    judges = [Judge(case.problem, window, truth) for truth, window in dealt]
    costs = {method: np.empty(starts) for method in METHODS_COMPARED}
    times = {method: np.empty(starts) for method in METHODS_COMPARED}
    for index in range(starts):
        begin, (_, window) = start(case.problem, random), dealt[index % len(dealt)]
        for method, attempt in zip(METHODS_COMPARED, attempts(case.problem, window, begin), strict=True):
            times[method][index] = attempt.seconds
            costs[method][index] = judges[index % len(dealt)].chi_square(attempt.values)
        show_progress(index + 1, starts, f"starts of {case.name}")
    everything = np.stack(list(costs.values()))
    which = np.arange(starts) % len(dealt)
    best = np.array([min(judge.best, everything[:, which == k].min()) for k, judge in enumerate(judges)])[which]
    near = best + np.maximum(CHI_SQUARE_TOLERANCE, RELATIVE_TOLERANCE * best)
    return Row(
        twin=case.name,
        unknown=tuple(parameter.name for parameter in case.problem.free),
        starts=starts,
        global_optimum={method: float((cost <= near).mean()) for method, cost in costs.items()},
        seconds={method: float(np.median(taken)) for method, taken in times.items()},
        seconds_worst={method: float(taken.max()) for method, taken in times.items()},
    )


def lines(rows: Sequence[Row]) -> list[str]:
    """The table."""
    head = "".join(f"{method:>15}" for method in METHODS_COMPARED)
    table = [f"{'reached global optimum':24}{head}  unknown"]
    for row in rows:
        shares = "".join(f"{100.0 * row.global_optimum[method]:>14.1f}%" for method in METHODS_COMPARED)
        table.append(f"{row.twin:12}{row.starts:>5} starts{shares}  {', '.join(row.unknown)}")
    table.append(f"{'seconds: median (worst)':24}{head}")
    for row in rows:
        taken = "".join(
            f"{f'{row.seconds[method]:.3f} ({row.seconds_worst[method]:.2f})':>15}" for method in METHODS_COMPARED
        )
        table.append(f"{row.twin:24}{taken}")
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimators.ablation", description=__doc__)
    known = {case.name: case for case in cases(BOUNDS_FACTOR)}
    parser.add_argument("--starts", type=int, default=1000, help="per twin (%(default)s)")
    parser.add_argument("--twin", choices=known, action="append", help="only this one; may be repeated")
    parser.add_argument(
        "--factor", type=float, default=BOUNDS_FACTOR, help="width of the bounds in those of the library (%(default)g)"
    )
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    known = {case.name: case for case in cases(options.factor)}
    rows = [ablate(known[name], options.starts, options.seed) for name in options.twin or known]
    print(json.dumps([asdict(row) for row in rows], indent=2) if options.json else "\n".join(lines(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
