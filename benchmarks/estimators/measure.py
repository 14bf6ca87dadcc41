"""Everybody on the same windows in turn, and what comes of it."""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.estimators.base import Budget, Estimator, Rival, Said
from benchmarks.estimators.data import FREE, RUN_IN, Machine, machines, problem
from otolith.acquisition.window import Array, Mask
from otolith.estimation.information import QUANTILE


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table. Errors and their quantiles are in percent of the truth, per parameter."""

    name: str
    windows: int
    """Scored, of those it said something of."""
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
        """Of its error: the geometric mean of the parameters' medians; not a number without any."""
        return float(np.exp(np.mean(np.log(list(self.error.values()))))) if self.error else float("nan")


@dataclass
class _Tally:
    rival: Rival
    errors: list[Array] = field(default_factory=list)
    inside: list[Mask] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, said: Said, truth: Array, seconds: float) -> None:
        self.seconds.append(seconds * self.rival.scale)
        if np.isfinite(said.values).all():
            self.errors.append(100.0 * np.abs(said.values / truth - 1.0))
            if said.sd is not None:
                self.inside.append(np.abs(said.values - truth) <= QUANTILE * said.sd)

    def row(self, name: str) -> Row:
        def of(rows: Sequence[Array | Mask], quantile: float | None = None) -> dict[str, float]:
            if not rows:
                return {}
            found = np.mean(rows, axis=0) if quantile is None else np.quantile(rows, quantile, axis=0)
            return dict(zip(FREE, map(float, found), strict=True))

        return Row(
            name=name,
            windows=len(self.errors),
            error=of(self.errors, 0.5),
            error_p99=of(self.errors, 0.99),
            covered=of(self.inside),
            seconds=float(np.median(self.seconds)),
            seconds_p99=float(np.quantile(self.seconds, 0.99)),
            note=self.rival.note,
        )


def compare(rivals: Sequence[Rival], budget: Budget, seed: int) -> list[Row]:
    """A row for each kind of result, in the order of the rivals."""
    tallies = [{name: _Tally(rival) for name in rival.rows} for rival in rivals]
    share = max(1.0, budget.windows / budget.dear)
    dear = {round(share * index) for index in range(min(budget.dear, budget.windows))}
    scored = 0
    for machine in machines(budget.windows, budget.drift, seed):
        present = [rival.begin(problem()) for rival in rivals]
        for index in range(len(machine.windows)):
            counts = index >= RUN_IN
            for rival, estimator, tally in zip(rivals, present, tallies, strict=True):
                if not rival.dear or (counts and scored in dear):
                    _ask(estimator, machine, index, tally if counts else {})
            scored += counts
        print(f"{scored} of {budget.windows} windows", file=sys.stderr)
    return [tally.row(name) for rows in tallies for name, tally in rows.items()]


def _ask(estimator: Estimator, machine: Machine, index: int, tallies: dict[str, _Tally]) -> None:
    begun = time.perf_counter()
    found = estimator.fit(machine.windows[index])
    seconds = time.perf_counter() - begun
    for tally, said in zip(tallies.values(), found, strict=False):  # none where the window is not scored
        tally.add(said, machine.truths[index], seconds)
