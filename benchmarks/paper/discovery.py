"""What the heart makes of a scenario in which something appears that the twin does not know. Pure, like the studies."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.paper.scenarios import CHUNK, NOISE, Life, Number, Unknown, live, plan_of, problem_of
from benchmarks.paper.study import LENGTH, PERIOD, SEED, Curves, Kind, Steps, Tell, curves, listened
from otolith.acquisition.window import Array, Window
from otolith.cli.common import examples_directory
from otolith.discovery.decision import WindowDecision
from otolith.health.schema import ComponentDocument, Report, ReportDocument
from otolith_drivers.plant.faults import Step, Unbalance
from otolith_drivers.plant.scenario import Scenario, load_scenario

SUSPICIOUS = frozenset(
    {WindowDecision.SUSPECTED, WindowDecision.REFUSED, WindowDecision.SENSOR, WindowDecision.DISCOVERED}
)


@dataclass(frozen=True, slots=True)
class Search:
    """A scenario with an unknown component, for its first ``seconds``."""

    row: Unknown
    kind: Kind
    seconds: float

    @property
    def steps(self) -> int:
        """How much work it is, as of any job."""
        return int(self.seconds / (CHUNK * PERIOD)) + int(self.seconds / LENGTH)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A number of the component in every window; arrays are (windows,), not a number where it was not known."""

    number: Number
    unit: str
    value: Array
    low: Array
    high: Array
    truth: Array
    scale: float = 1.0
    """What it is multiplied by in the paper's unit."""

    @property
    def errors(self) -> Array:
        """Relative; of a phase in rad, as it has no size."""
        return np.asarray(np.abs(self.value - self.truth) / self._size)

    @property
    def _size(self) -> Array | float:
        return 1.0 if self.number.name == "phase" else np.abs(self.truth)

    @property
    def coverage(self) -> float | None:
        """Share of the 95 % intervals that hold the truth."""
        inside = (self.low <= self.truth) & (self.truth <= self.high)
        said = np.isfinite(self.value)
        return float(inside[said].mean()) if said.any() else None


@dataclass(frozen=True, slots=True, eq=False)
class Discovery:
    """What became of the component. Times are in s, those of windows their ends; None for what never happened."""

    job: Search
    begun: float
    """When it really began."""
    suspected: float | None
    adopted: float | None
    onset: float | None
    """When it began, as published."""
    equation: str
    """In the last window."""
    others: tuple[str, ...]
    """Keys of all other components that were ever in the twin."""
    kept: bool
    """Whether it was in the twin in every window since it was adopted."""
    courses: tuple[Course, ...]
    before: dict[str, float]
    """Largest absolute error of each output, from the beginning of the component to its discovery (DT')."""
    after: dict[str, float]
    """The same from its discovery on (DT'')."""
    curves: Curves

    @property
    def met(self) -> bool:
        """Whether the targets are, in every window since the discovery, and nothing else was found."""
        if self.adopted is None or not self.kept or self.others:
            return False
        ideal, row = self.job.kind is Kind.IDEAL, self.job.row
        if ideal and self.after[row.output] > row.within:
            return False
        targets = [(entry, entry.number.target if ideal else entry.number.noisy) for entry in self.courses]
        return all(target is None or np.nanmax(entry.errors) <= target for entry, target in targets)


def discover(job: Search, tell: Tell) -> Discovery:
    """Do a job.

    Raises:
        OtolithError: an example file that cannot be used.
    """
    steps = Steps(tell, f"{job.row.name}, {job.kind}")
    row, plan = job.row, plan_of(job.row)
    steps.now("simulating")
    noisy = job.kind is Kind.NOISY
    life = live(row, plan, job.seconds, row.sensors if noisy else (), steps)
    deviations: dict[str, float] = {}
    if noisy and row.sensors:
        deviations = {sensor.signal: sensor.deviation for sensor in row.sensors}
    elif noisy:
        deviations = noise_of(life, [entry.name for entry in plan.twin.outputs])
        life = life.with_noise(deviations, SEED)
    steps.now(f"windows of {LENGTH:g} s")
    problem = problem_of(row, plan, deviations)
    records = round(LENGTH / life.period)
    reports = listened(problem, life, records, steps)
    scenario = load_scenario(examples_directory() / "scenarios" / f"{row.name}.toml")
    return _judged(job, scenario, list(life.windows(records)), reports, curves(problem, life, reports))


def noise_of(life: Life, outputs: Sequence[str]) -> dict[str, float]:
    """Standard deviations of sensors that are as noisy as :data:`NOISE` says."""
    return {name: NOISE * float(np.std(life.values[:, life.signals.index(name)])) for name in outputs}


def _judged(
    job: Search, scenario: Scenario, windows: Sequence[Window], reports: Sequence[Report], drawn: Curves
) -> Discovery:
    documents = [report.document for report in reports]
    begun = scenario.faults[0].start
    found = [_component(document, job.row) for document in documents]
    first = next((at for at, entry in enumerate(found) if entry is not None), None)
    since = next((at for at, window in enumerate(windows) if window.end > begun), len(windows))
    suspected = next((at for at in range(since, len(windows)) if documents[at].decision in SUSPICIOUS), None)
    last = next((entry for entry in reversed(found) if entry is not None), None)
    keys = {entry.id for document in documents for entry in document.components}
    return Discovery(
        job=job,
        begun=begun,
        suspected=None if suspected is None else windows[suspected].end,
        adopted=None if first is None else windows[first].end,
        onset=None if last is None else last.onset,
        equation="" if last is None else last.equation,
        others=tuple(sorted(keys - {job.row.component})),
        kept=first is not None and None not in found[first:],
        courses=tuple(_course(number, scenario, windows, found) for number in job.row.numbers),
        before=_largest(reports[since:first]),
        after={} if first is None else _largest(reports[first:]),
        curves=drawn,
    )


def _component(document: ReportDocument, row: Unknown) -> ComponentDocument | None:
    return next((entry for entry in document.components if entry.id == row.component), None)


def _course(
    number: Number, scenario: Scenario, windows: Sequence[Window], found: Sequence[ComponentDocument | None]
) -> Course:
    numbers = [None if entry is None else entry.values[number.name] for entry in found]
    rows = [(np.nan,) * 3 if entry is None else (entry.value, entry.low, entry.high) for entry in numbers]
    value, low, high = np.array(rows).T
    truth = np.array([_truth(number, scenario, window) for window in windows])
    if number.name == "phase":
        turns = np.rint((np.where(np.isfinite(value), value, 0.0) - truth) / (2.0 * np.pi))
        truth += 2.0 * np.pi * turns
    scale = float(getattr(scenario.parameters, number.over)) if number.over else 1.0
    return Course(
        number=number,
        unit=next((entry.unit for entry in numbers if entry is not None), ""),
        value=value,
        low=low,
        high=high,
        truth=truth,
        scale=1.0 / scale,
    )


def _truth(number: Number, scenario: Scenario, window: Window) -> float:
    """What the number really is, in the unit of the report; a phase is that at the first record."""
    fault = scenario.faults[0]
    if isinstance(fault, Unbalance):
        frequency = fault.frequency or 0.0
        acceleration = fault.acceleration * float(getattr(scenario.parameters, number.over or "J"))
        return {"amplitude": acceleration, "frequency": frequency, "phase": frequency * window.start}[number.name]
    assert isinstance(fault, Step)  # noqa: S101 - rows name scenarios with no other faults
    return scenario.amount(fault)


def _largest(reports: Sequence[Report]) -> dict[str, float]:
    """Absolute error of each predicted output, in its unit."""
    traces = [report.traces for report in reports if report.traces.predicted is not None]
    if not traces:
        return {}
    off = np.concatenate([np.abs(entry.predicted - entry.measured) for entry in traces if entry.predicted is not None])
    return dict(zip(traces[0].outputs, map(float, np.nanmax(off, axis=0)), strict=True))
