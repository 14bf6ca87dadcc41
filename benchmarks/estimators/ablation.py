"""``python -m benchmarks.estimators.ablation``: how often the swarm, the polish and both find the global optimum.

Cold, from random points within bounds much wider than the library's. What was found counts by the χ² of its
parameters with the initial state refitted, the same for all, against the best that is known of the window.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.estimators.cases import WIDER, Case, cases, start, windows
from otolith.acquisition.window import Array, Window
from otolith.estimation.gauss_newton import gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.particle_swarm import particle_swarm
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import estimate

WINDOWS = 10  # machines that the starts are dealt to
NEAR, NEAR_SHARE = 3.0, 0.01  # of the best χ²: what may be missing to it


@dataclass(frozen=True, slots=True)
class Row:
    """One twin. Shares of the starts, and seconds, by way of searching."""

    twin: str
    unknown: tuple[str, ...]
    starts: int
    found: dict[str, float]
    seconds: dict[str, float]
    """Median."""
    seconds_worst: dict[str, float]


WAYS = ("swarm", "polish", "swarm, polish", "both")  # the last as a cold window is estimated, with a vague prior


class Attempt(NamedTuple):
    """What one way of searching came to."""

    values: Array
    """(free,)."""
    seconds: float


def attempts(problem: Problem, window: Window, begin: Array) -> tuple[Attempt, ...]:
    """All ways from one start, in the order of :data:`WAYS`."""
    begun = time.perf_counter()
    objective = Objective(problem, window, begin)
    made = time.perf_counter() - begun

    def polished(values: Array) -> Attempt:
        begun = time.perf_counter()
        found = gauss_newton(objective, objective.guess(values)).guess[: objective.free]
        return Attempt(found, time.perf_counter() - begun + made)

    alone = polished(begin)
    begun = time.perf_counter()
    found = particle_swarm(objective, problem.swarm, begin, problem.seed + window.index).places[0]
    swarm = Attempt(found, time.perf_counter() - begun + made)
    after = polished(found)
    begun = time.perf_counter()
    whole = np.array([entry.value for entry in estimate(problem, window, begin).parameters])
    both = Attempt(whole, time.perf_counter() - begun)
    return swarm, alone, Attempt(after.values, after.seconds + swarm.seconds - made), both


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
    """All ways from the same starts."""
    random = np.random.default_rng(seed)
    dealt = windows(case, min(WINDOWS, starts), seed)
    judges = [Judge(case.problem, window, truth) for truth, window in dealt]
    costs = {way: np.empty(starts) for way in WAYS}
    times = {way: np.empty(starts) for way in WAYS}
    for index in range(starts):
        begin, (_, window) = start(case.problem, random), dealt[index % len(dealt)]
        for way, attempt in zip(WAYS, attempts(case.problem, window, begin), strict=True):
            times[way][index] = attempt.seconds
            costs[way][index] = judges[index % len(dealt)].chi_square(attempt.values)
        if (index + 1) % max(1, starts // 10) == 0:
            print(f"{case.name}: {index + 1} of {starts} starts", file=sys.stderr)
    everything = np.stack(list(costs.values()))
    which = np.arange(starts) % len(dealt)
    best = np.array([min(judge.best, everything[:, which == k].min()) for k, judge in enumerate(judges)])[which]
    near = best + np.maximum(NEAR, NEAR_SHARE * best)
    return Row(
        twin=case.name,
        unknown=tuple(entry.name for entry in case.problem.free),
        starts=starts,
        found={way: float((cost <= near).mean()) for way, cost in costs.items()},
        seconds={way: float(np.median(taken)) for way, taken in times.items()},
        seconds_worst={way: float(taken.max()) for way, taken in times.items()},
    )


def lines(rows: Sequence[Row]) -> list[str]:
    """The table."""
    head = "".join(f"{way:>15}" for way in WAYS)
    found = [f"{'found the global optimum':24}{head}  unknown"]
    for row in rows:
        shares = "".join(f"{100.0 * row.found[way]:>14.1f}%" for way in WAYS)
        found.append(f"{row.twin:12}{row.starts:>5} starts{shares}  {', '.join(row.unknown)}")
    found.append(f"{'seconds: median (worst)':24}{head}")
    for row in rows:
        taken = "".join(f"{f'{row.seconds[way]:.3f} ({row.seconds_worst[way]:.2f})':>15}" for way in WAYS)
        found.append(f"{row.twin:24}{taken}")
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.estimators.ablation", description=__doc__)
    known = {case.name: case for case in cases(WIDER)}
    parser.add_argument("--starts", type=int, default=1000, help="per twin (%(default)s)")
    parser.add_argument("--twin", choices=known, action="append", help="only this one; may be said again")
    parser.add_argument("--wider", type=float, default=WIDER, help="how much than the library's bounds (%(default)g)")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args(arguments)
    known = {case.name: case for case in cases(asked.wider)}
    rows = [ablate(known[name], asked.starts, asked.seed) for name in asked.twin or known]
    print(json.dumps([asdict(row) for row in rows], indent=2) if asked.json else "\n".join(lines(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
