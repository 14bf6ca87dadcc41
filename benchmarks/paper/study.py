"""What is done with one scenario: the comparison with the paper, the study of windows, and the studies of noise.

Pure of processes: a job goes in, progress is told, and what was found comes out; the same job finds the same.

One life through the heart, window by window, as the daemon would have it: what was published, and what was true.

How far what was published lies from what was true, in numbers.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache

import numpy as np

from benchmarks.paper.scenarios import CHUNK, HIDING, PEAK, SENSORS, Life, Row, Sensor, live, plan_of, problem_of
from otolith.acquisition.window import Array, Mask
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.information import Identifiability
from otolith.estimation.problem import Problem
from otolith.health.schema import Report, Status

EXCITED = 10.0  # standard deviations of a sensor: how far an output must move for a window to be excited


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Of every window what was said of the parameter; not a number where nothing was. Arrays are (windows,)."""

    length: float
    """Of a window, s."""
    ends: Array
    """s."""
    truth: Array
    """At the end of each window."""
    value: Array
    """Published: from this window and those before it."""
    low: Array
    high: Array
    raw: Array
    """What the window alone says."""
    excited: Mask
    """Whether an output moved."""
    determined: Mask
    """Whether the window alone determines the parameter."""
    statuses: tuple[Status, ...]

    @property
    def begun(self) -> int:
        """The first excited window: from there on everything counts."""
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
    """Not a number where nothing was predicted."""


def listened(problem: Problem, life: Life, records: int, heard: Callable[[], None]) -> list[Report]:
    """What the heart says of ``life`` in windows of so many records; ``heard`` is called after each."""
    state = initial_state("paper", "paper", problem)
    reports = []
    for window in life.windows(records):
        state, report = adapt(state, window)
        reports.append(report)
        heard()
    return reports


def track(problem: Problem, life: Life, length: float, heard: Callable[[], None]) -> tuple[Track, Curves]:
    """Let the heart hear ``life`` in windows of ``length`` s; ``heard`` is called after each."""
    name, records = problem.free[0].name, round(length / life.period)
    reports = listened(problem, life, records, heard)
    said = [(report, report.document.parameters[name]) for report in reports]
    ends = np.arange(1, len(said) + 1) * records
    found = Track(
        length=length,
        ends=np.asarray(ends * life.period, dtype=np.float64),
        truth=life.truth[ends],
        value=_column([entry.value for _, entry in said]),
        low=_column([entry.low for _, entry in said]),
        high=_column([entry.high for _, entry in said]),
        raw=_column([entry.raw for _, entry in said]),
        excited=np.array([_is_excited(report, problem) for report in reports], dtype=np.bool_),
        determined=np.array([entry.identifiability is Identifiability.DETERMINED for _, entry in said]),
        statuses=tuple(entry.status for _, entry in said),
    )
    return found, curves(problem, life, reports)


def _column(values: list[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values])


def _is_excited(report: Report, problem: Problem) -> bool:
    moved = np.ptp(report.traces.measured, axis=0)
    return bool((moved > EXCITED * np.array(problem.noise)).any())


def curves(problem: Problem, life: Life, reports: list[Report]) -> Curves:
    """The outputs of all windows."""
    outputs = problem.twin.outputs
    traces = [report.traces for report in reports]
    measured = np.concatenate([trace.measured for trace in traces])
    nothing = np.full_like(traces[0].measured, np.nan)
    return Curves(
        outputs=tuple(entry.name for entry in outputs),
        units=tuple(entry.unit for entry in outputs),
        times=np.asarray(life.period * np.arange(len(measured)), dtype=np.float64),
        measured=measured,
        predicted=np.concatenate([nothing if trace.predicted is None else trace.predicted for trace in traces]),
    )


@dataclass(frozen=True, slots=True)
class Spread:
    """Of relative errors, over every window from the first excited one on; None where no window said anything."""

    median: float | None
    p99: float | None
    maximum: float | None
    missing: int
    """Windows without a value."""

    def meets(self, target: float) -> bool:
        """Whether the 99th percentile is within it, and the largest error within five times as much."""
        return self.p99 is not None and self.maximum is not None and self.p99 <= target >= self.maximum / PEAK


@dataclass(frozen=True, slots=True)
class Score:
    """What a track comes to."""

    length: float
    """Of a window, s."""
    windows: int
    begun: int
    """The first excited window."""
    first: int | None
    """The first window that estimated the parameter."""
    published: Spread
    raw: Spread
    """Of each window alone, as the paper reports it."""
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


def score(found: Track, curves: Curves) -> Score:
    """Judge a track and the curves that belong to it."""
    begun = found.begun
    value, truth = found.value[begun:], found.truth[begun:]
    off, said = errors(value, truth), np.isfinite(value)
    inside = (found.low[begun:] <= truth) & (truth <= found.high[begun:])
    statuses = Counter(found.statuses[begun:])
    return Score(
        length=found.length,
        windows=len(found.value),
        begun=begun,
        first=found.first,
        published=_spread(off),
        raw=_spread(errors(found.raw[begun:], truth)),
        worst=begun + int(np.nanargmax(off)) if said.any() else None,
        coverage=float(inside[said].mean()) if said.any() else None,
        statuses={status.value: statuses[status] for status in Status},
        alone=int(found.determined[begun:].sum()),
        rmse=_rmse(curves, len(curves.times) // max(len(found.value), 1) * begun),
    )


def errors(values: Array, truth: Array) -> Array:
    """Relative; not a number where there is no value."""
    return np.asarray(np.abs(values / truth - 1.0))


def verdict(row: Row, found: Score) -> bool:
    """Whether the row's targets are met."""
    return found.published.meets(row.target)


def _spread(off: Array) -> Spread:
    said = off[np.isfinite(off)]
    if not said.size:
        return Spread(None, None, None, len(off))
    middle, p99 = np.percentile(said, (50.0, 99.0)).tolist()
    return Spread(middle, p99, float(said.max()), len(off) - len(said))


def _rmse(curves: Curves, first: int) -> dict[str, float]:
    off = (curves.predicted - curves.measured)[first:]
    found = {}
    for index, name in enumerate(curves.outputs):
        said = off[np.isfinite(off[:, index]), index]
        if said.size:
            found[name] = float(np.sqrt(np.mean(said**2)))
    return found


LENGTH = 2.0  # s: the paper's window
LENGTHS = (0.1, 1.0, LENGTH, 4.0, 10.0)  # s: those of section 5.2.1
PERIOD = 0.01  # s: of the paper's records
QUIETEST = (
    0.1  # of a sensor's noise: where the search for the level that hides a parameter begins; it ends at its range
)
HALVINGS = 9  # of that search
BLUNT = 100.0
SEED = 1

Tell = Callable[[int, str], None]
"""How many steps have been done, of :attr:`Job.steps`, and what is being done now."""


class Kind(StrEnum):
    """What is done."""

    IDEAL = "ideal sensors"
    NOISY = "noisy sensors"
    LIMIT = "search for the noise that hides"


@dataclass(frozen=True, slots=True)
class Job:
    """One scenario to be studied for its first ``seconds``."""

    row: Row
    kind: Kind
    seconds: float

    @property
    def steps(self) -> int:
        """How much work it is, in windows of the paper: simulating one takes about as long as estimating from one."""
        per = self.seconds / (CHUNK * PERIOD)
        if self.kind is Kind.LIMIT:
            return int(per * (1 + 3 * HALVINGS))
        return int(per) + sum(int(self.seconds / length) for length in LENGTHS)


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """A scenario in windows of several lengths."""

    job: Job
    unit: str
    """Of the parameter."""
    track: Track
    """In windows of the paper's length, as the curves."""
    curves: Curves
    scores: tuple[Score, ...]
    """By length."""

    @property
    def score(self) -> Score:
        """In windows of the paper's length."""
        return next(entry for entry in self.scores if entry.length == LENGTH)


@dataclass(frozen=True, slots=True)
class Edge:
    """Between which noise levels something is lost; None for one beyond what was searched."""

    kept: float | None
    lost: float | None


@dataclass(frozen=True, slots=True)
class Limit:
    """At which noise of a sensor a parameter is lost, while the other sensors have theirs."""

    job: Job
    sensor: Sensor
    alone: Edge
    """To every window alone."""
    together: Edge
    """To all of them together."""
    unaided: Edge
    """The same with the other sensors ``BLUNT`` times as noisy, so that they tell hardly anything."""


def study(job: Job, tell: Tell) -> Study | Limit:
    """Do a job.

    Raises:
        OtolithError: an example file that cannot be used.
    """
    steps = Steps(tell, f"{job.row.name}, {job.kind}")
    return _limit(job, steps) if job.kind is Kind.LIMIT else _study(job, steps)


class Steps:
    """Counts them."""

    def __init__(self, tell: Tell, what: str) -> None:
        self._tell, self._what = tell, what
        self._done, self._doing = 0, ""

    def now(self, doing: str) -> None:
        """From here on ``doing`` is done."""
        self._doing = doing

    def __call__(self) -> None:
        """One more is done."""
        self._done += 1
        self._tell(self._done, f"{self._what}: {self._doing}")


def _study(job: Job, steps: Steps) -> Study:
    row, plan = job.row, plan_of(job.row)
    sensors = SENSORS[row.machine] if job.kind is Kind.NOISY else ()
    steps.now("simulating")
    life = live(row, plan, job.seconds, sensors, steps)
    problem = problem_of(row, plan, {sensor.signal: sensor.deviation for sensor in sensors})
    found: dict[float, tuple[Track, Curves]] = {}
    for length in LENGTHS:
        steps.now(f"windows of {length:g} s")
        found[length] = track(problem, life, length, steps)
    scores = tuple(score(*found[length]) for length in LENGTHS)
    return Study(job, problem.free[0].unit, *found[LENGTH], scores)


def _limit(job: Job, steps: Steps) -> Limit:
    row, plan = job.row, plan_of(job.row)
    sensor = next(entry for entry in SENSORS[row.machine] if entry.signal == HIDING[row.machine])
    steps.now("simulating")
    life = live(row, plan, job.seconds, (), steps)
    own = {entry.signal: entry.noise for entry in SENSORS[row.machine]}

    @cache
    def heard(level: float, others: float = 1.0) -> Track:
        steps.now(f"{level:.3g} {sensor.unit}")
        deviations = {name: others * noise for name, noise in own.items()} | {sensor.signal: level}
        problem = replace(problem_of(row, plan, deviations), discover=False)  # the plant's own ripple is none of this
        return track(problem, life.with_noise(deviations, SEED), LENGTH, steps)[0]

    alone = _edge(sensor, lambda level: not heard(level).determined.any())
    together = _edge(sensor, lambda level: bool(np.isnan(heard(level).value).all()))
    unaided = _edge(sensor, lambda level: bool(np.isnan(heard(level, BLUNT).value).all()))
    return Limit(job, sensor, alone, together, unaided)


def _edge(sensor: Sensor, lost: Callable[[float], bool]) -> Edge:
    kept, gone = QUIETEST * sensor.noise, sensor.high - sensor.low
    if lost(kept):
        return Edge(None, kept)
    if not lost(gone):
        return Edge(gone, None)
    for _ in range(HALVINGS):
        middle = (kept * gone) ** 0.5
        kept, gone = (kept, middle) if lost(middle) else (middle, gone)
    return Edge(kept, gone)
