"""Logs with any times and values through rings, windower and adaptation core: no exception, no wrong number, no stall.

A log is drawn as a clock, a disorder and a rate for each signal; the samples themselves come from a seed. The report of
each window refuses a number that is not finite, so reading a document back is the test for it.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.vendor.pretty import RepresentationPrinter

from otolith.acquisition.records import MAX_LOST_RECORDS
from otolith.acquisition.window import Array, Window
from otolith.health.schema import ReportDocument
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.replay import Replay, open_recorded
from otolith.twin.kernel import MAX_SUBSTEPS, Excitation
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import Reader, Rows

MAX_ROWS, MAX_RECORDS = 2500, 2000
MAX_WINDOWS = 3
MAX_STEPS = 2 * (4 * MAX_SUBSTEPS + 1)  # of the integrator per record: as kernel.py limits them, and each halved
Folders = pytest.TempPathFactory
GAPS = (0.003, 0.05, 0.4, 3.0, 90.0, 3600.0, 36_000.0)  # s
INTERVALS = (0.001, 0.0035, 0.01, 0.0107, 0.05, 0.5, 5.0)  # s
STARTS = (0.0, -1000.0, -0.05, 1.0e9, 1_700_000_000.123456, 1.0e10, 9.9e10)  # s

TWINS = {
    "dc_motor": {"V_a": 12.0, "T_load": 0.01, "i": 1.0, "omega": 100.0},
    "servo_axis": {"F": 40.0, "x": 0.1},
}
"""Signals of each twin, and how large they are."""
MACHINE = """
[machine]
name = "fuzzed"
[twin]
name = "{twin}"
[window]
length = "{length!r} s"
sample_period = "{period!r} s"
{times}
"""


@dataclass(frozen=True)
class Clock:
    """When something is sampled."""

    interval: float
    style: str
    start: float
    gaps: tuple[tuple[float, float], ...]
    """Share of the samples before each gap, and its length, s."""

    def times(self, count: int, random: np.random.Generator) -> Array:
        """Return ``count`` times, s."""
        steps = STYLES[self.style](count, random) * self.interval
        for share, length in self.gaps:
            steps[min(int(share * count), count - 1)] += length
        times = self.start + np.concatenate([[0.0], np.cumsum(steps[:-1])])
        resolution = RESOLUTIONS.get(self.style)
        return times if resolution is None else resolution * np.floor(times / resolution)


def jittered(count: int, random: np.random.Generator) -> Array:
    return np.diff(np.sort(np.arange(count + 1) + random.uniform(-0.5, 0.5, count + 1)))


STYLES: dict[str, Callable[[int, np.random.Generator], Array]] = {
    "regular": lambda count, _: np.ones(count),
    "jittered": jittered,
    "random": lambda count, random: random.exponential(1.0, count),
    "pairs": lambda count, _: np.where(np.arange(count) % 2, 1.0, 1e-4),
    "bursts": lambda count, random: np.where(random.random(count) < 0.9, 1e-7, 1.0),
    "equal": lambda count, random: np.where(random.random(count) < 0.7, 0.0, 1.0),
    "all equal": lambda count, _: np.zeros(count),
    "frozen": lambda count, random: np.where(random.random(count) < 0.98, 0.0, 50.0),
    "drifting": lambda count, _: np.linspace(0.2, 5.0, count),
    "milliseconds": jittered,
    "seconds": jittered,
}
"""Intervals between samples, of about one."""
RESOLUTIONS = {"milliseconds": 1e-3, "seconds": 1.0}  # s
RATIOS = (0.01, 0.3, 1.0, 1.0, 3.0, 100.0)  # of the sample period to the interval of the clock
LENGTHS = (0.1, 0.5, 2.0, 10.0, 60.0)  # s; of a window
CLOCKS = st.builds(
    Clock,
    st.sampled_from(INTERVALS),
    st.sampled_from(sorted(STYLES)),
    st.sampled_from(STARTS),
    st.lists(st.tuples(st.floats(0.0, 1.0), st.sampled_from(GAPS)), max_size=3).map(tuple),
)


@dataclass(frozen=True)
class Column:
    """What is recorded of a signal: in every n-th row, once or never, and which values."""

    rows: str
    every: int
    values: str
    spoiled: str
    share: float

    def cells(self, size: float, times: Array, random: np.random.Generator) -> list[str]:
        """Return a cell for each of ``times`` of a signal that is about ``size``."""
        count = len(times)
        values = self._values(size, times, random)
        present = np.zeros(count, dtype=np.bool_)
        match self.rows:
            case "every":
                present[:: self.every] = True
            case "first":
                present[0] = True
            case "last":
                present[-1] = True
            case "changed":
                present = np.concatenate([[True], np.diff(values) != 0.0])
        text = [repr(float(value)) if there else "" for value, there in zip(values, present, strict=True)]
        for row in np.flatnonzero(random.random(count) < self.share):
            text[row] = self.spoiled
        return text

    def _values(self, size: float, times: Array, random: np.random.Generator) -> Array:
        phase = times - times[0]
        smooth: Array = size * (np.sin(2.0 * phase) + 0.3 * np.sign(np.sin(5.0 * phase)))
        match self.values:
            case "noisy":
                return smooth + 0.01 * size * random.standard_normal(len(times))
            case "random":
                return size * random.standard_normal(len(times))
            case "constant":
                return np.full(len(times), size)
            case "zero":
                return np.zeros(len(times))
            case "quantised":
                return np.asarray(np.round(smooth / (0.05 * size)) * 0.05 * size)
            case "alternating":
                return np.where(np.arange(len(times)) % 2, -size, size)
            case "repeated":
                return np.repeat(smooth[::5], 5)[: len(times)]
            case "huge":
                return smooth * 1e9
        return smooth


COLUMNS = st.builds(
    Column,
    st.sampled_from(("every", "every", "every", "first", "last", "changed", "never")),
    st.sampled_from((1, 1, 2, 10, 500)),
    st.sampled_from(("smooth", "noisy", "random", "constant", "zero", "quantised", "alternating", "repeated", "huge")),
    st.sampled_from(("", "nan", "inf", "-inf", "1e300", "-1e308", "1e11", "1e400", "text", "5e-324")),
    st.sampled_from((0.0, 0.0, 0.01, 0.3)),
)
DISORDERS = (
    "none",
    "none",
    "none",
    "reversed",
    "interleaved",
    "joined",
    "an hour back",
    "swapped",
    "shuffled",
    "one late",
)


def disordered(rows: list[str], times: Array, disorder: str, random: np.random.Generator) -> list[str]:
    """Return the cells of the times, with which the rows are not in order."""
    half = len(times) // 2
    order = np.arange(len(times))
    match disorder:
        case "reversed":
            order = order[::-1]
        case "interleaved":  # two recordings at once
            order = np.concatenate([np.stack([order[:half], order[half : 2 * half]]).T.ravel(), order[2 * half :]])
        case "joined":
            order = np.concatenate([order[half:], order[:half]])
        case "an hour back":
            times = times - np.where(order >= half, 3600.0, 0.0)
        case "swapped":
            order = np.argsort(order + random.uniform(0.0, 4.0, len(order)))
        case "shuffled":
            random.shuffle(order)
        case "one late":
            order = np.concatenate([order[1:], order[:1]])
    text = [f"{time:.9f}" for time in times]
    return [f"{text[row]},{rows[row]}" for row in order]


@dataclass(frozen=True)
class Log:
    """A machine file and a table."""

    machine: str
    table: str
    chunk: int
    """Rows that are read at once."""
    marks: tuple[float, ...]
    """Shares of the rows before each that begins a recording."""

    def _repr_pretty_(self, printer: RepresentationPrinter, _cycle: bool) -> None:
        """Print the log without its table, of which hypothesis prints no long one; the test's folder keeps it."""
        lines, checksum = self.table.count("\n"), crc32(self.table.encode())
        printer.text(f"Log({self.machine!r}, {lines} lines, CRC {checksum:08x}, {self.chunk}, {self.marks})")


@st.composite
def logs(draw: st.DrawFn, max_rows: int = MAX_ROWS) -> Log:
    """Return any log, and a machine file with a sample period that may be far from its rate."""
    twin = draw(st.sampled_from(sorted(TWINS)))
    clock, random = draw(CLOCKS), np.random.default_rng(draw(st.integers(0, 2**32)))
    if twin == "servo_axis":  # stiff
        clock = replace(clock, interval=min(clock.interval, 0.05))
    period = float(f"{np.clip(clock.interval * draw(st.sampled_from(RATIOS)), 1e-4, 10.0):.4g}")
    records = int(np.clip(draw(st.sampled_from(LENGTHS)) / period, 10, MAX_RECORDS))
    records = max(records, int(np.ceil(LENGTHS[0] / period)))
    length = float(f"{period * records:.9g}")
    windows = draw(st.sampled_from((0.5, 1.2, 4.5)))
    count = int(np.clip(windows * length / clock.interval, 1, max_rows))
    times = clock.times(count, random)
    columns = {name: draw(COLUMNS).cells(size, times, random) for name, size in TWINS[twin].items()}
    rows = [",".join(cells) for cells in zip(*columns.values(), strict=True)]
    lines = disordered(rows, times, draw(st.sampled_from(DISORDERS)), random)
    if draw(st.booleans()):
        lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(("", "-----", "1;2", ",,,,", "t,x,y"))))
    meaning = draw(st.sampled_from(("", "", 'times = "cyclic"')))
    machine = MACHINE.format(twin=twin, length=length, period=period, times=meaning)
    table = "\n".join([",".join(["t", *columns]), *lines]) + "\n"
    marks = draw(st.lists(st.floats(0.0, 1.0), max_size=2).map(tuple))
    return Log(machine, table, draw(st.sampled_from((1, 7, 10_000, 10_000))), marks)


class Marked(Reader):
    """An open table whose rows come in small chunks, some of which begin a new recording."""

    place = "line"
    is_table = True

    def __init__(self, table: Reader, chunk: int, marked: tuple[float, ...]) -> None:
        super().__init__(table.path)
        self.sampling = table.sampling
        self._table, self._chunk, self._marked = table, chunk, marked

    @property
    def bad(self) -> int:
        return self._table.bad

    def chunks(self) -> Iterator[Rows]:
        for rows in self._table.chunks():
            count = len(rows.times)
            marks = np.zeros(count, dtype=np.bool_)
            marks[[int(share * (count - 1)) for share in self._marked]] = True
            for first in range(0, count, self._chunk):
                part = slice(first, first + self._chunk)
                yield rows.part(part, marks[part])

    def describe(self) -> list[str]:
        return self._table.describe()

    def summary_lines(self) -> list[str]:
        return self._table.summary_lines()

    def warnings(self) -> list[str]:
        return self._table.warnings()


@dataclass
class Work:
    """What the kernels had to do."""

    records: int = 0
    """Records that were computed."""
    steps: int = 0
    """Steps of the integrator."""
    worst: float = 0.0
    """Most steps per record of one call."""


@pytest.fixture(scope="module")
def work() -> Iterator[Work]:
    """Counts the steps of all kernels."""
    counted, arguments = Work(), Excitation.__dict__["arguments"].func

    def counting(excitation: Excitation) -> Any:
        steps = int(excitation.counts.sum())
        counted.records += excitation.grid.records
        counted.steps += steps
        counted.worst = max(counted.worst, steps / max(excitation.grid.records, 1))
        return arguments(excitation)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Excitation, "arguments", property(counting))
        yield counted


def refuse(constant: str) -> None:
    pytest.fail(f"{constant} in a document")


def assert_follow(windows: list[tuple[int, Window]], period: float) -> None:
    """Windows of a recording follow each other without overlap; the grid may move by half a period."""
    for (recording, before), (next_recording, after) in pairwise(windows):
        assert after.index == before.index + 1
        assert next_recording > recording or after.start >= before.end - 0.51 * period


def assert_bounded(window: Window, rows: int, span: int) -> None:
    """A window has a record for each sample, each lost sample of an input, or each slot of the grid."""
    inputs = len(window.signals)
    assert window.records <= max(span, 1 + rows + inputs * MAX_LOST_RECORDS * span)
    assert (window.grid.steps > 0.0).all()
    assert np.isfinite(window.values).all()
    assert window.grid.offsets[0] == 0.0
    error = window.bridge_error
    if error is not None:
        for part in (error.noise_ratio, error.variance, error.held_variance):
            assert np.isfinite(part).all()
            assert (part >= 0.0).all()


def check(machine: LoadedMachine, table: Path, log: Log, work: Work) -> list[Window]:
    """Replay a log and check each window and each report."""
    windows: list[tuple[int, Window]] = []
    documents: list[ReportDocument] = []
    refusal = ""
    rows, span = log.table.count("\n"), machine.records
    with open_recorded(machine, table) as opened:
        replay = Replay(machine, Marked(opened, log.chunk, log.marks), lambda: len(windows) > MAX_WINDOWS)
        replay._wait = lambda window: windows.append((replay._player.playback.counts.segments, window))
        try:
            for report in replay.reports():
                documents.append(ReportDocument.from_json(report.document.to_json()))
                json.loads(report.document.to_json(), parse_constant=refuse)
        except ConfigurationError as error:
            refusal = str(error)
        replay.summary()
        replay.warnings()
    counts = replay._player.playback.counts
    assert not refusal or str(table) in refusal
    assert not refusal or not documents or "decreases" in refusal
    assert replay._player.windows_missed == 0
    assert_follow(windows, machine.file.window.sample_period)
    for _, window in windows:
        assert_bounded(window, rows, span)
    used = sum(int((~window.missing).sum()) for _, window in windows)
    assert used + counts.lost + counts.repeated + counts.stale <= counts.received
    assert work.worst <= MAX_STEPS
    return [window for _, window in windows]


def replayed(log: Log, folder: Path, work: Work) -> list[Window]:
    """Check a log, and return its windows."""
    file, table = folder / "machine.toml", folder / "log.csv"
    file.write_text(log.machine, encoding="utf-8")
    table.write_text(log.table, encoding="utf-8")
    return check(load_machine(file, with_driver=False), table, log, work)


@given(log=logs())
@settings(max_examples=40, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
def test_any_log_gives_finite_reports_at_a_bounded_cost(log: Log, tmp_path_factory: Folders, work: Work) -> None:
    replayed(log, tmp_path_factory.mktemp("log"), work)


@pytest.mark.full
@given(log=logs())
@settings(max_examples=600, phases=[Phase.generate], suppress_health_check=list(HealthCheck))
def test_many_logs_give_finite_reports_at_a_bounded_cost(log: Log, tmp_path_factory: Folders, work: Work) -> None:
    replayed(log, tmp_path_factory.mktemp("log"), work)


def test_a_gap_of_hours_and_a_log_of_two_samples_cost_no_records(tmp_path: Path, work: Work) -> None:
    machine = MACHINE.format(twin="servo_axis", length=60.0, period=0.01, times="")
    times = (0.0, 30.0001, 59.99995, 36_000.0, 36_030.0001, 36_059.99995)
    lines = [f"{time!r},1.0,0.1" for time in times]
    windows = replayed(Log(machine, "\n".join(["t,F,x", *lines]) + "\n", chunk=1, marks=()), tmp_path, work)
    assert [window.records for window in windows] == [3, 3]
