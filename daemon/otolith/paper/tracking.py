"""One life through the heart, window by window, as the daemon would have it: what was published, and what was true."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith.adaptation.information import Identifiability
from otolith.adaptation.problem import Problem
from otolith.health.report import Report, Status
from otolith.heart import adapt
from otolith.paper.simulation import Life
from otolith.state import begin

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
    state = begin("paper", "paper", problem)
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
