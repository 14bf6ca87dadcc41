"""Studies of one scenario: errors of the published values by window length, and the noise that hides a parameter.

Without processes and files: the same job gives the same result.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache

import numpy as np

from benchmarks.paper.scenarios import (
    CHUNK,
    LIMITING_SIGNAL,
    PEAK,
    SENSORS,
    Row,
    Sensor,
    SimulatedRecord,
    machine_of,
    problem_of,
    simulate_row,
)
from otolith.acquisition.window import Array, Mask
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.information import Identifiability
from otolith.estimation.problem import Problem
from otolith.health.schema import Report, Status

EXCITED = 10.0  # standard deviations of a sensor: an output that moves farther excites the window


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """The parameter in every window; arrays are (windows,), not a number without an estimate."""

    length: float
    """Of a window, s."""
    ends: Array
    """s."""
    truth: Array
    """At the end of each window."""
    value: Array
    """Published value: from this window and those before it."""
    low: Array
    high: Array
    raw: Array
    """Estimate of the window alone."""
    excited: Mask
    """Whether an output moved."""
    determined: Mask
    """Whether the window alone determines the parameter."""
    statuses: tuple[Status, ...]

    @property
    def begun(self) -> int:
        """The first excited window, from which on errors count."""
        return int(np.argmax(self.excited)) if self.excited.any() else len(self.excited)

    @property
    def first(self) -> int | None:
        """The first window that estimated the parameter."""
        return self.statuses.index(Status.ESTIMATED) if Status.ESTIMATED in self.statuses else None


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Measured and predicted outputs of all windows, one after the other; (records, outputs)."""

    outputs: tuple[str, ...]
    units: tuple[str, ...]
    times: Array
    """s."""
    measured: Array
    predicted: Array
    """Not a number without a prediction."""


def reports_of(problem: Problem, record: SimulatedRecord, records: int, on_window: Callable[[], None]) -> list[Report]:
    """Reports of the core for windows of so many records; ``on_window`` is called after each."""
    state = initial_state("paper", "paper", problem)
    reports = []
    for window in record.windows(records):
        state, report = adapt(state, window)
        reports.append(report)
        on_window()
    return reports


def track(
    problem: Problem, record: SimulatedRecord, length: float, on_window: Callable[[], None]
) -> tuple[Track, Curves]:
    """Track and curves in windows of ``length`` s; ``on_window`` is called after each."""
    name, records = problem.free[0].name, round(length / record.period)
    reports = reports_of(problem, record, records, on_window)
    estimates = [(report, report.document.parameters[name]) for report in reports]
    ends = np.arange(1, len(estimates) + 1) * records
    result = Track(
        length=length,
        ends=np.asarray(ends * record.period, dtype=np.float64),
        truth=record.truth[ends],
        value=_column([estimate.value for _, estimate in estimates]),
        low=_column([estimate.low for _, estimate in estimates]),
        high=_column([estimate.high for _, estimate in estimates]),
        raw=_column([estimate.raw for _, estimate in estimates]),
        excited=np.array([_is_excited(report, problem) for report in reports], dtype=np.bool_),
        determined=np.array([estimate.identifiability is Identifiability.DETERMINED for _, estimate in estimates]),
        statuses=tuple(estimate.status for _, estimate in estimates),
    )
    return result, curves(problem, record, reports)


def _column(values: list[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values])


def _is_excited(report: Report, problem: Problem) -> bool:
    moved = np.ptp(report.traces.measured, axis=0)
    return bool((moved > EXCITED * np.array(problem.noise)).any())


def curves(problem: Problem, record: SimulatedRecord, reports: list[Report]) -> Curves:
    """The outputs of all windows."""
    outputs = problem.twin.outputs
    traces = [report.traces for report in reports]
    measured = np.concatenate([trace.measured for trace in traces])
    nothing = np.full_like(traces[0].measured, np.nan)
    return Curves(
        outputs=tuple(output.name for output in outputs),
        units=tuple(output.unit for output in outputs),
        times=np.asarray(record.period * np.arange(len(measured)), dtype=np.float64),
        measured=measured,
        predicted=np.concatenate([nothing if trace.predicted is None else trace.predicted for trace in traces]),
    )


@dataclass(frozen=True, slots=True)
class Spread:
    """Relative errors of all windows from the first excited one on; None without any estimate."""

    median: float | None
    p99: float | None
    maximum: float | None
    missing: int
    """Windows without a value."""

    def meets(self, target: float) -> bool:
        """Whether the 99th percentile is within the target, and the largest error within ``PEAK`` times it."""
        return self.p99 is not None and self.maximum is not None and self.p99 <= target >= self.maximum / PEAK


@dataclass(frozen=True, slots=True)
class Score:
    """Summary of a track."""

    length: float
    """Of a window, s."""
    windows: int
    begun: int
    """The first excited window."""
    first: int | None
    """The first window that estimated the parameter."""
    published: Spread
    raw: Spread
    """Errors of each window alone, as the paper reports it."""
    worst: int | None
    """The window with the largest published error."""
    coverage: float | None
    """Share of the published 95 % intervals that hold the truth."""
    statuses: dict[str, int]
    """Windows of each status, from the first excited one on."""
    alone: int
    """Windows that determine the parameter alone."""
    rmse: dict[str, float]
    """Of the predicted outputs, from the first excited window on, each in its unit."""


def score(track: Track, curves: Curves) -> Score:
    """Summary of a track and its curves."""
    begun = track.begun
    value, truth = track.value[begun:], track.truth[begun:]
    off, present = errors(value, truth), np.isfinite(value)
    inside = (track.low[begun:] <= truth) & (truth <= track.high[begun:])
    statuses = Counter(track.statuses[begun:])
    return Score(
        length=track.length,
        windows=len(track.value),
        begun=begun,
        first=track.first,
        published=_spread(off),
        raw=_spread(errors(track.raw[begun:], truth)),
        worst=begun + int(np.nanargmax(off)) if present.any() else None,
        coverage=float(inside[present].mean()) if present.any() else None,
        statuses={status.value: statuses[status] for status in Status},
        alone=int(track.determined[begun:].sum()),
        rmse=_rmse(curves, len(curves.times) // max(len(track.value), 1) * begun),
    )


def errors(values: Array, truth: Array) -> Array:
    """Relative errors; not a number without a value."""
    return np.asarray(np.abs(values / truth - 1.0))


def verdict(row: Row, score: Score) -> bool:
    """Whether the row's targets are met."""
    return score.published.meets(row.target)


def _spread(off: Array) -> Spread:
    present = off[np.isfinite(off)]
    if not present.size:
        return Spread(None, None, None, len(off))
    middle, p99 = np.percentile(present, (50.0, 99.0)).tolist()
    return Spread(middle, p99, float(present.max()), len(off) - len(present))


def _rmse(curves: Curves, first: int) -> dict[str, float]:
    off = (curves.predicted - curves.measured)[first:]
    rmse = {}
    for index, name in enumerate(curves.outputs):
        errors = off[np.isfinite(off[:, index]), index]
        if errors.size:
            rmse[name] = float(np.sqrt(np.mean(errors**2)))
    return rmse


LENGTH = 2.0  # s: the paper's window
LENGTHS = (0.1, 1.0, LENGTH, 4.0, 10.0)  # s: those of section 5.2.1
PERIOD = 0.01  # s: of the paper's records
MIN_NOISE_RATIO = 0.1  # of a sensor's noise: where the search for the limiting noise begins; it ends at the range
BISECTIONS = 9  # of that search
OTHERS_NOISE_FACTOR = 100.0  # on the noise of the other sensors, so that they hardly contribute
SEED = 1

OnProgress = Callable[[int, str], None]
"""Called with the steps done, of :attr:`Job.steps`, and the present activity."""


class Kind(StrEnum):
    """Kind of study."""

    IDEAL = "ideal sensors"
    NOISY = "noisy sensors"
    LIMIT = "search for the limiting noise"


@dataclass(frozen=True, slots=True)
class Job:
    """Study of the first ``seconds`` of a scenario."""

    row: Row
    kind: Kind
    seconds: float

    @property
    def steps(self) -> int:
        """Amount of work in windows of the paper; simulating one takes about as long as estimating from it."""
        per = self.seconds / (CHUNK * PERIOD)
        if self.kind is Kind.LIMIT:
            return int(per * (1 + 3 * BISECTIONS))
        return int(per) + sum(int(self.seconds / length) for length in LENGTHS)


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Result of a scenario in windows of several lengths."""

    job: Job
    unit: str
    """Of the parameter."""
    track: Track
    """In windows of the paper's length, like the curves."""
    curves: Curves
    scores: tuple[Score, ...]
    """By length."""

    @property
    def score(self) -> Score:
        """In windows of the paper's length."""
        return next(score for score in self.scores if score.length == LENGTH)


@dataclass(frozen=True, slots=True)
class NoiseBracket:
    """Noise levels that enclose the limit; None for one outside the search."""

    kept: float | None
    lost: float | None


@dataclass(frozen=True, slots=True)
class Limit:
    """Noise of a sensor at which a parameter is lost, while the other sensors keep theirs."""

    job: Job
    sensor: Sensor
    alone: NoiseBracket
    """No window alone determines it."""
    together: NoiseBracket
    """All windows together do not determine it."""
    unaided: NoiseBracket
    """The same with the other sensors ``OTHERS_NOISE_FACTOR`` times as noisy."""


def study(job: Job, on_progress: OnProgress) -> Study | Limit:
    """Run a job.

    Raises:
        OtolithError: an example file cannot be used.
    """
    steps = StepCounter(on_progress, f"{job.row.name}, {job.kind}")
    return _limit(job, steps) if job.kind is Kind.LIMIT else _study(job, steps)


class StepCounter:
    """Counts the steps of a job and reports them."""

    def __init__(self, on_progress: OnProgress, job: str) -> None:
        self._tell, self._job = on_progress, job
        self._done, self._activity = 0, ""

    def now(self, activity: str) -> None:
        """Set the present activity."""
        self._activity = activity

    def __call__(self) -> None:
        """Count one step."""
        self._done += 1
        self._tell(self._done, f"{self._job}: {self._activity}")


def _study(job: Job, steps: StepCounter) -> Study:
    row, machine = job.row, machine_of(job.row)
    sensors = SENSORS[row.machine] if job.kind is Kind.NOISY else ()
    steps.now("simulating")
    record = simulate_row(row, machine, job.seconds, sensors, steps)
    problem = problem_of(row, machine, {sensor.signal: sensor.deviation for sensor in sensors})
    results: dict[float, tuple[Track, Curves]] = {}
    for length in LENGTHS:
        steps.now(f"windows of {length:g} s")
        results[length] = track(problem, record, length, steps)
    scores = tuple(score(*results[length]) for length in LENGTHS)
    return Study(job, problem.free[0].unit, *results[LENGTH], scores)


def _limit(job: Job, steps: StepCounter) -> Limit:
    row, machine = job.row, machine_of(job.row)
    sensor = next(candidate for candidate in SENSORS[row.machine] if candidate.signal == LIMITING_SIGNAL[row.machine])
    steps.now("simulating")
    record = simulate_row(row, machine, job.seconds, (), steps)
    own = {candidate.signal: candidate.noise for candidate in SENSORS[row.machine]}

    @cache
    def at_noise(level: float, others: float = 1.0) -> Track:
        steps.now(f"{level:.3g} {sensor.unit}")
        deviations = {name: others * noise for name, noise in own.items()} | {sensor.signal: level}
        problem = replace(
            problem_of(row, machine, deviations), discover=False
        )  # the plant's own ripple would be discovered
        return track(problem, record.with_noise(deviations, SEED), LENGTH, steps)[0]

    alone = _bracket(sensor, lambda level: not at_noise(level).determined.any())
    together = _bracket(sensor, lambda level: bool(np.isnan(at_noise(level).value).all()))
    unaided = _bracket(sensor, lambda level: bool(np.isnan(at_noise(level, OTHERS_NOISE_FACTOR).value).all()))
    return Limit(job, sensor, alone, together, unaided)


def _bracket(sensor: Sensor, lost: Callable[[float], bool]) -> NoiseBracket:
    kept, missing = MIN_NOISE_RATIO * sensor.noise, sensor.high - sensor.low
    if lost(kept):
        return NoiseBracket(None, kept)
    if not lost(missing):
        return NoiseBracket(missing, None)
    for _ in range(BISECTIONS):
        middle = (kept * missing) ** 0.5
        kept, missing = (kept, middle) if lost(middle) else (middle, missing)
    return NoiseBracket(kept, missing)
