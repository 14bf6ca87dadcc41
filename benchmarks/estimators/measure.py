"""Runs all methods on the same windows in turn, and summarises errors, intervals and times."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.estimators.base import Budget, Estimate, Estimator, Method
from benchmarks.estimators.data import FREE, RUN_IN_WINDOWS, Machine, machines, problem
from otolith.acquisition.window import Array, Mask
from otolith.estimation.information import QUANTILE


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table. Errors and their quantiles are in percent of the truth, per parameter."""

    name: str
    windows: int
    """Scored windows with an estimate."""
    error: dict[str, float]
    """Median."""
    error_p99: dict[str, float]
    covered: dict[str, float]
    """Share of the windows in which the 95 % interval holds the truth; empty without interval."""
    seconds: float
    """Median per window."""
    seconds_p99: float
    note: str

    @property
    def size(self) -> float:
        """Geometric mean of the parameters' median errors; not a number without any."""
        return float(np.exp(np.mean(np.log(list(self.error.values()))))) if self.error else float("nan")


@dataclass
class _Tally:
    method: Method
    errors: list[Array] = field(default_factory=list)
    inside: list[Mask] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, estimate: Estimate, truth: Array, seconds: float) -> None:
        self.seconds.append(seconds * self.method.scale)
        if np.isfinite(estimate.values).all():
            self.errors.append(100.0 * np.abs(estimate.values / truth - 1.0))
            if estimate.sd is not None:
                self.inside.append(np.abs(estimate.values - truth) <= QUANTILE * estimate.sd)

    def row(self, name: str) -> Row:
        def of(rows: Sequence[Array | Mask], quantile: float | None = None) -> dict[str, float]:
            if not rows:
                return {}
            summary = np.mean(rows, axis=0) if quantile is None else np.quantile(rows, quantile, axis=0)
            return dict(zip(FREE, map(float, summary), strict=True))

        return Row(
            name=name,
            windows=len(self.errors),
            error=of(self.errors, 0.5),
            error_p99=of(self.errors, 0.99),
            covered=of(self.inside),
            seconds=float(np.median(self.seconds)),
            seconds_p99=float(np.quantile(self.seconds, 0.99)),
            note=self.method.note,
        )


def compare(methods: Sequence[Method], budget: Budget, seed: int) -> list[Row]:
    """A row for each kind of result, in the order of the methods."""
    tallies = [{name: _Tally(method) for name in method.rows} for method in methods]
    share = max(1.0, budget.windows / budget.slow)
    slow = {round(share * index) for index in range(min(budget.slow, budget.windows))}
    scored = 0
    for machine in machines(budget.windows, budget.drift, seed):
        present = [method.create(problem()) for method in methods]
        for index in range(len(machine.windows)):
            counts = index >= RUN_IN_WINDOWS
            for method, estimator, tally in zip(methods, present, tallies, strict=True):
                if not method.slow or (counts and scored in slow):
                    _time_fit(estimator, machine, index, tally if counts else {})
            scored += counts
        print(f"{scored} of {budget.windows} windows", file=sys.stderr)
    return [tally.row(name) for rows in tallies for name, tally in rows.items()]


def _time_fit(estimator: Estimator, machine: Machine, index: int, tallies: dict[str, _Tally]) -> None:
    begun = time.perf_counter()
    estimates = estimator.fit(machine.windows[index])
    seconds = time.perf_counter() - begun
    for tally, estimate in zip(tallies.values(), estimates, strict=False):  # none where the window is not scored
        tally.add(estimate, machine.truths[index], seconds)
