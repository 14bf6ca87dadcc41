"""Studies of the scenarios in which a component appears that the twin lacks."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.paper.scenarios import (
    CHUNK,
    NOISE,
    Number,
    SimulatedRecord,
    Unknown,
    machine_of,
    problem_of,
    simulate_row,
)
from benchmarks.paper.study import LENGTH, PERIOD, SEED, Curves, Kind, OnProgress, StepCounter, curves, reports_of
from otolith.acquisition.window import Array, Window
from otolith.cli.common import shipped_directory
from otolith.discovery.alternatives import WindowDecision
from otolith.health.schema import ComponentDocument, Report, ReportDocument
from otolith_drivers.plant.faults import Step, Unbalance
from otolith_drivers.plant.scenario import Scenario, load_scenario

SUSPICIOUS = frozenset(
    {WindowDecision.SUSPECTED, WindowDecision.REFUSED, WindowDecision.SENSOR, WindowDecision.DISCOVERED}
)


@dataclass(frozen=True, slots=True)
class Search:
    """Study of the first ``seconds`` of a scenario with an unknown component."""

    row: Unknown
    kind: Kind
    seconds: float

    @property
    def steps(self) -> int:
        """Amount of work, as :attr:`Job.steps`."""
        return int(self.seconds / (CHUNK * PERIOD)) + int(self.seconds / LENGTH)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A number of the component in every window; arrays are (windows,), not a number while it was unknown."""

    number: Number
    unit: str
    value: Array
    low: Array
    high: Array
    truth: Array
    scale: float = 1.0
    """Factor to the paper's unit."""

    @property
    def errors(self) -> Array:
        """Relative errors; of a phase in rad."""
        return np.asarray(np.abs(self.value - self.truth) / self._size)

    @property
    def _size(self) -> Array | float:
        return 1.0 if self.number.name == "phase" else np.abs(self.truth)

    @property
    def coverage(self) -> float | None:
        """Share of the 95 % intervals that hold the truth."""
        inside = (self.low <= self.truth) & (self.truth <= self.high)
        known = np.isfinite(self.value)
        return float(inside[known].mean()) if known.any() else None


@dataclass(frozen=True, slots=True, eq=False)
class Discovery:
    """Result for the component. Times are in s, those of windows their ends; None if it never happened."""

    job: Search
    begun: float
    """True onset."""
    suspected: float | None
    adopted: float | None
    onset: float | None
    """Published onset."""
    equation: str
    """In the last window."""
    others: tuple[str, ...]
    """Keys of all other components ever adopted."""
    kept: bool
    """Whether it was in the twin in every window since its adoption."""
    courses: tuple[Course, ...]
    before: dict[str, float]
    """Largest absolute error of each output, from the onset to the discovery (DT')."""
    after: dict[str, float]
    """The same from the discovery on (DT'')."""
    curves: Curves

    @property
    def met(self) -> bool:
        """Whether all targets are met in every window since the discovery, and no other component was adopted."""
        if self.adopted is None or not self.kept or self.others:
            return False
        ideal, row = self.job.kind is Kind.IDEAL, self.job.row
        if ideal and self.after[row.output] > row.within:
            return False
        targets = [(course, course.number.target if ideal else course.number.noisy) for course in self.courses]
        return all(target is None or np.nanmax(course.errors) <= target for course, target in targets)


def discover(job: Search, on_progress: OnProgress) -> Discovery:
    """Run a job.

    Raises:
        OtolithError: an example file cannot be used.
    """
    steps = StepCounter(on_progress, f"{job.row.name}, {job.kind}")
    row, machine = job.row, machine_of(job.row)
    steps.now("simulating")
    noisy = job.kind is Kind.NOISY
    record = simulate_row(row, machine, job.seconds, row.sensors if noisy else (), steps)
    deviations: dict[str, float] = {}
    if noisy and row.sensors:
        deviations = {sensor.signal: sensor.deviation for sensor in row.sensors}
    elif noisy:
        deviations = noise_of(record, [output.name for output in machine.twin.outputs])
        record = record.with_noise(deviations, SEED)
    steps.now(f"windows of {LENGTH:g} s")
    problem = problem_of(row, machine, deviations)
    records = round(LENGTH / record.period)
    reports = reports_of(problem, record, records, steps)
    scenario = load_scenario(shipped_directory("config") / "scenarios" / f"{row.name}.toml")
    return _judged(job, scenario, list(record.windows(records)), reports, curves(problem, record, reports))


def noise_of(record: SimulatedRecord, outputs: Sequence[str]) -> dict[str, float]:
    """Standard deviations of sensors with a noise of :data:`NOISE`."""
    return {name: NOISE * float(np.std(record.values[:, record.signals.index(name)])) for name in outputs}


def _judged(
    job: Search, scenario: Scenario, windows: Sequence[Window], reports: Sequence[Report], drawn: Curves
) -> Discovery:
    documents = [report.document for report in reports]
    begun = scenario.faults[0].start
    components = [_component(document, job.row) for document in documents]
    first = next((at for at, component in enumerate(components) if component is not None), None)
    since = next((at for at, window in enumerate(windows) if window.end > begun), len(windows))
    suspected = next((at for at in range(since, len(windows)) if documents[at].decision in SUSPICIOUS), None)
    last = next((component for component in reversed(components) if component is not None), None)
    keys = {component.id for document in documents for component in document.components}
    return Discovery(
        job=job,
        begun=begun,
        suspected=None if suspected is None else windows[suspected].end,
        adopted=None if first is None else windows[first].end,
        onset=None if last is None else last.onset,
        equation="" if last is None else last.equation,
        others=tuple(sorted(keys - {job.row.component})),
        kept=first is not None and None not in components[first:],
        courses=tuple(_course(number, scenario, windows, components) for number in job.row.numbers),
        before=_largest(reports[since:first]),
        after={} if first is None else _largest(reports[first:]),
        curves=drawn,
    )


def _component(document: ReportDocument, row: Unknown) -> ComponentDocument | None:
    return next((component for component in document.components if component.id == row.component), None)


def _course(
    number: Number, scenario: Scenario, windows: Sequence[Window], components: Sequence[ComponentDocument | None]
) -> Course:
    numbers = [None if component is None else component.values[number.name] for component in components]
    rows = [
        (np.nan,) * 3 if component is None else (component.value, component.low, component.high)
        for component in numbers
    ]
    value, low, high = np.array(rows).T
    truth = np.array([_truth(number, scenario, window) for window in windows])
    if number.name == "phase":
        turns = np.rint((np.where(np.isfinite(value), value, 0.0) - truth) / (2.0 * np.pi))
        truth += 2.0 * np.pi * turns
    scale = float(getattr(scenario.parameters, number.over)) if number.over else 1.0
    return Course(
        number=number,
        unit=next((component.unit for component in numbers if component is not None), ""),
        value=value,
        low=low,
        high=high,
        truth=truth,
        scale=1.0 / scale,
    )


def _truth(number: Number, scenario: Scenario, window: Window) -> float:
    """True value in the unit of the report; of a phase, that at the first record."""
    fault = scenario.faults[0]
    if isinstance(fault, Unbalance):
        frequency = fault.frequency or 0.0
        acceleration = fault.acceleration * float(getattr(scenario.parameters, number.over or "J"))
        return {"amplitude": acceleration, "frequency": frequency, "phase": frequency * window.start}[number.name]
    assert isinstance(fault, Step)  # noqa: S101 - no row has another kind of fault
    return scenario.amount(fault)


def _largest(reports: Sequence[Report]) -> dict[str, float]:
    """Absolute error of each predicted output, in its unit."""
    traces = [report.traces for report in reports if report.traces.predicted is not None]
    if not traces:
        return {}
    errors = np.concatenate(
        [np.abs(trace.predicted - trace.measured) for trace in traces if trace.predicted is not None]
    )
    return dict(zip(traces[0].outputs, map(float, np.nanmax(errors, axis=0)), strict=True))
