"""Runs of a machine with a change, adapted to window by window, and what each report states."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.changes.machines import in_twin_units, problem_of
from benchmarks.changes.plants import HEALTHY, START, Change, Plant, cut, generator, simulate
from benchmarks.command_line import in_processes
from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument

Disturbance = Callable[[np.random.Generator, Plant, dict[str, Array]], None]
HEALTHY_WINDOWS, CHANGED_WINDOWS = 12, 12
PUBLISHED_AT_LEAST = 0.95  # share of the windows that must have an interval
RUNS_PER_JOB = 10  # runs that are simulated together
BATCHES_PER_PROCESS = 4  # fewer runs per job if there are few: the last job is waited for


@dataclass(frozen=True, slots=True)
class Published:
    """What a report states of one parameter."""

    status: str
    value: float | None
    low: float | None
    high: float | None
    truth: float

    @property
    def holds_truth(self) -> bool | None:
        """Whether the interval contains the truth; None without an interval."""
        if self.low is None or self.high is None:
            return None
        return self.low <= self.truth <= self.high


@dataclass(frozen=True, slots=True)
class Stated:
    """A hypothesis of a report."""

    reason: str
    text: str
    probability: float


@dataclass(frozen=True, slots=True)
class Observed:
    """The report of one window."""

    decision: WindowDecision
    stated: tuple[Stated, ...]
    components: tuple[Stated, ...]
    """In the twin: key and probability when adopted."""
    parameters: Mapping[str, Published]
    cost: float | None


@dataclass(frozen=True, slots=True)
class Case:
    """A machine and a change of it."""

    name: str
    plant: Plant
    after: Change
    free: tuple[str, ...] = ()
    """Estimated parameters; by default those of the twin."""
    before: Change = HEALTHY
    healthy: int = HEALTHY_WINDOWS
    changed: int = CHANGED_WINDOWS
    noise: float = 1.0
    """Noise of the sensors over that of the machine file."""
    disturb: Disturbance | None = None
    """Changes the signals (records,) of a run in place, before noise is added."""
    quantum: float = 0.0
    """Step of the converters over the noise of the machine file; zero for none."""
    onset: float = 0.0
    """Share of a window between its beginning and that of the change."""
    later: tuple[tuple[int, Change], ...] = ()
    """Further changes of the healthy machine, each with its first window."""

    @property
    def problem(self) -> Problem:
        """What the machine file states."""
        return problem_of(self.plant, self.free)

    def change(self, window: int) -> Change:
        """Return how the machine differs in a window."""
        changes = ((0, self.before), (self.healthy, self.after), *self.later)
        return next(own for first, own in reversed(changes) if window >= first)


def observe(case: Case, runs: Sequence[int], seed: int) -> list[list[Observed]]:
    """Return what the reports state, a list for each run."""
    problem = case.problem
    return [
        [observed(document, truth) for document, truth in _reports(case, problem, windows)]
        for windows in recordings(case, problem, runs, seed)
    ]


def recordings(case: Case, problem: Problem, runs: Sequence[int], seed: int) -> Iterator[list[Window]]:
    """Yield the windows of each run, with noise."""
    plant, twin = case.plant, problem.twin
    randoms = [generator(seed, case.plant.name, run) for run in runs]
    records = (case.healthy + case.changed) * plant.records
    later = [(first * plant.records, change) for first, change in case.later]
    at = round((case.healthy + case.onset) * plant.records)
    rows = simulate(plant, randoms, records, case.before, case.after, at, later)
    for number, random in enumerate(randoms):
        own = {name: rows[name][number].copy() for name in twin.signals}
        if case.disturb is not None:
            case.disturb(random, plant, own)
        for output in twin.outputs:
            own[output.name] += case.noise * output.noise * random.standard_normal(records)
            if case.quantum:
                step = case.quantum * output.noise
                own[output.name] = step * np.round(own[output.name] / step)
        yield cut(plant, own, twin.signals)


def _reports(
    case: Case, problem: Problem, windows: Iterable[Window]
) -> Iterator[tuple[ReportDocument, Mapping[str, float]]]:
    """Yield each report with the true values of the parameters."""
    state = initial_state(case.plant.twin, "bench", problem)
    for window in windows:
        values = case.change(window.index).grown(case.plant.parameters, window.end - START)
        state, report = adapt(state, window)
        truth = {free.name: in_twin_units(problem.twin, free.name, values[free.name]) for free in problem.free}
        yield report.document, truth


def observed(document: ReportDocument, truth: Mapping[str, float]) -> Observed:
    """Return what matters of a report."""
    return Observed(
        decision=document.decision,
        stated=tuple(Stated(item.reason.name, item.text, item.probability) for item in document.explanations),
        components=tuple(Stated("COMPONENT", item.id, item.probability) for item in document.components),
        parameters={
            name: Published(str(item.status), item.value, item.low, item.high, truth[name])
            for name, item in document.parameters.items()
        },
        cost=None if document.fit is None else document.fit.cost,
    )


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often the intervals of a parameter hold the truth."""

    published: float
    """Share of the windows with an interval."""
    held: float | None
    """Share of these intervals that hold the truth; None without any."""

    def reaches(self, share: float) -> bool:
        """Whether that share of the intervals holds the truth, and nearly all windows have one."""
        return self.held is not None and self.held >= share and self.published >= PUBLISHED_AT_LEAST


def coverage(published: Sequence[Published]) -> Coverage:
    """Return the shares of one parameter over windows."""
    held = [own.holds_truth for own in published if own.holds_truth is not None]
    return Coverage(len(held) / len(published), sum(held) / len(held) if held else None)


def observe_all(cases: Sequence[Case], runs: int, seed: int, processes: int) -> list[list[list[Observed]]]:
    """Return the windows of each run of each case."""
    size = min(RUNS_PER_JOB, max(1, runs * len(cases) // (processes * BATCHES_PER_PROCESS)))
    jobs = [
        (number, range(first, min(first + size, runs)))
        for number in range(len(cases))
        for first in range(0, runs, size)
    ]
    done = in_processes([partial(observe, cases[number], own, seed) for number, own in jobs], processes)
    parts = list(zip((number for number, _ in jobs), done, strict=True))
    return [[run for of, part in parts if of == number for run in part] for number in range(len(cases))]
