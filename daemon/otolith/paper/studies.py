"""What is done with one scenario: the comparison with the paper, the study of windows, and the studies of noise.

Pure of processes: a job goes in, progress is told, and what was found comes out; the same job finds the same.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache

import numpy as np

from otolith.paper.rows import HIDING, SENSORS, Row, Sensor
from otolith.paper.score import Score, score
from otolith.paper.simulation import CHUNK, live, plan_of, problem_of
from otolith.paper.tracking import Curves, Track, track

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
