"""Recordings as loggers write them: repeated rows, stale values, held commands, slow rows, gaps and joins.

Every recording is replayed through the command line with the default limits.
"""

import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.sampling.measure import (
    FREE,
    WINDOW,
    WindowOutcome,
    outcome,
    some_motor,
    summarise,
    write_machine,
)
from benchmarks.sampling.plant import Motor, Voltage
from benchmarks.sampling.schedules import Recording, Schedule, Timing, record

from otolith.acquisition.window import Verdict, Window
from otolith.cli.replay import replay
from otolith.discovery.alternatives import ACCEPTED, WindowDecision
from otolith.health.schema import FindingKind, ReportDocument
from otolith.machine import load_machine
from otolith.runtime.replay import Replay, open_recorded
from tests.variants import often

WINDOWS = 10
UNIFORM = Schedule(rows=Timing(0.01))
Rows = list[list[str]]


def recorded(schedule: Schedule, seed: int = 7, length: float = WINDOWS * WINDOW + 1.0) -> Recording:
    random = np.random.default_rng(seed)
    return record(schedule, some_motor(random), length, random)


def write(folder: Path, header: Sequence[str], rows: Rows) -> Path:
    path = folder / "recording.csv"
    path.write_text("".join(",".join(row) + "\n" for row in [header, *rows]), encoding="utf-8")
    return path


class Log:
    """A folder with a machine file and a table, and what the command line prints of them."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.folder, self._capsys = folder, capsys

    def reports(self, schedule: Schedule, header: Sequence[str], rows: Rows) -> list[ReportDocument]:
        machine, data = write_machine(self.folder, schedule), write(self.folder, header, rows)
        self._capsys.readouterr()
        replay(machine, [data], None, as_json=True, stopped=lambda: False)
        return [ReportDocument.from_json(line) for line in self._capsys.readouterr().out.splitlines()]

    def of(self, schedule: Schedule, recording: Recording) -> list[ReportDocument]:
        return self.reports(schedule, recording.header, recording.rows())


@pytest.fixture
def log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Log:
    return Log(tmp_path, capsys)


def cut(folder: Path, schedule: Schedule, recording: Recording) -> list[Window]:
    """Windows of a recording, without estimating from them."""
    machine = load_machine(write_machine(folder, schedule), with_driver=False)
    with open_recorded(machine, write(folder, recording.header, recording.rows())) as opened:
        return list(Replay(machine, opened).windows())


def assert_used(documents: Sequence[ReportDocument], at_least: int = WINDOWS) -> None:
    """Every window is good and updates the estimates."""
    reasons = [(document.window.quality.reasons, document.decision) for document in documents]
    assert len(documents) >= at_least, reasons
    assert all(document.window.quality.verdict is Verdict.GOOD for document in documents), reasons
    assert all(document.decision in ACCEPTED for document in documents), reasons


def assert_valid_intervals(outcomes: Sequence[WindowOutcome]) -> None:
    """Intervals hold the truth, except in as many windows as chance explains, and the errors are near the bound."""
    summary = summarise(outcomes)
    share = 3.3 * np.sqrt(0.95 * 0.05 / summary.windows)
    assert (summary.raw_coverage >= 0.95 - share).all(), summary.raw_coverage
    assert (summary.published_coverage >= 0.95 - share).all(), summary.published_coverage
    assert (summary.spread <= 1.0 + 3.3 / np.sqrt(2.0 * summary.windows)).all(), summary.spread


def test_each_row_twice_gives_the_estimates_of_each_row_once(log: Log) -> None:
    recording = recorded(UNIFORM)
    once, twice = log.of(UNIFORM, recording), log.of(UNIFORM, replace(recording, copies=2))
    assert_used(once)
    assert_used(twice)
    for alone, repeated in zip(once, twice, strict=True):
        for name in FREE:
            assert repeated.parameters[name].raw == pytest.approx(alone.parameters[name].raw, rel=1e-6)
            assert repeated.parameters[name].raw_sd == pytest.approx(alone.parameters[name].raw_sd, rel=1e-3)


@pytest.mark.parametrize("copied", ["outputs", "all signals"])
def test_a_register_renewed_every_fifth_row_is_used_and_counted_once(log: Log, copied: str) -> None:
    """Stale repeats carry no information: they neither veto a window nor narrow its intervals."""
    timing = Timing(renewed_every=5)
    schedule = replace(UNIFORM, i=timing, omega=timing)
    recording = recorded(schedule)
    rows = recording.rows()
    if copied == "all signals":
        slow = Timing(0.05)
        schedule = Schedule(rows=slow)
        recording = recorded(schedule)
        rows = [[f"{float(row[0]) + 0.01 * copy:.6f}", *row[1:]] for row in recording.rows() for copy in range(5)]
    documents = log.reports(schedule, recording.header, rows)
    assert_used(documents)
    assert_valid_intervals([outcome(recording, document) for document in documents])


@pytest.mark.parametrize("step", [0.015625, 0.05, 0.1])
def test_rows_of_a_coarse_clock_give_the_estimates_of_exact_times(log: Log, step: float) -> None:
    """The clock of the log stands still for several rows."""
    recording = recorded(UNIFORM)
    exact, rows = log.of(UNIFORM, recording), recording.rows()
    coarse = [[f"{np.floor(float(row[0]) / step + 1e-6) * step:.6f}", *row[1:]] for row in rows]
    documents = log.reports(UNIFORM, recording.header, coarse)
    assert_used(documents)
    for one, other in zip(exact, documents, strict=True):
        for name in FREE:
            assert other.parameters[name].raw == pytest.approx(one.parameters[name].raw, rel=1e-5)


@pytest.mark.parametrize(("interval", "step"), [(0.0035, 0.001), (0.0107, 0.01)])
def test_rows_with_rounded_times_give_the_estimates_of_exact_times(log: Log, interval: float, step: float) -> None:
    """Half a step of the clock, times the slope of the current at a step of the voltage, is more than its noise."""
    schedule = Schedule(rows=Timing(interval))
    recording = recorded(schedule)
    exact, rows = log.of(schedule, recording), recording.rows()
    rounded = [[f"{np.rint(float(row[0]) / step) * step:.6f}", *row[1:]] for row in rows]
    documents = log.reports(schedule, recording.header, rounded)
    assert_used(documents)
    for one, other in zip(exact, documents, strict=True):
        for name in FREE:
            sd = one.parameters[name].raw_sd
            assert sd is not None
            assert other.parameters[name].raw == pytest.approx(one.parameters[name].raw, abs=0.5 * sd)


def test_irregular_rows_of_a_coarse_clock_are_refused_and_give_no_finding(log: Log) -> None:
    """Their times are not known, so nothing can be concluded from them about a sensor or the machine."""
    schedule = Schedule(rows=Timing(jitter=0.5), load="walk", load_noise=True)
    recording = recorded(schedule)
    rows = [[f"{np.floor(float(row[0]) / 0.1) * 0.1:.6f}", *row[1:]] for row in recording.rows()]
    documents = log.reports(schedule, recording.header, rows)
    assert len(documents) >= WINDOWS - 2
    assert not any(document.findings for document in documents)
    assert all(
        "share a time but differ: log finer times" in document.window.quality.reasons[0] for document in documents
    )


def test_a_replay_at_1_khz_stays_within_300_mb(tmp_path: Path) -> None:
    """With pandas, which is installed beside the reader of MF4 logs, pyarrow would take 45 MB more."""
    schedule = Schedule(rows=Timing(0.001))
    machine = write_machine(tmp_path, schedule, '[window]\nsample_period = "1 ms"')
    recording = recorded(schedule, length=8.0)
    data = write(tmp_path, recording.header, recording.rows())
    program = (
        "import sys; from pathlib import Path; from otolith.cli.replay import replay\n"
        "replay(Path(sys.argv[1]), [Path(sys.argv[2])], None, as_json=False, stopped=lambda: False)\n"
        "print(*(line for line in open('/proc/self/status') if line.startswith('VmHWM')))\n"
        "print('pandas', 'pandas' in sys.modules)\n"
    )
    command = [sys.executable, "-c", program, str(machine), str(data)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "4 windows: 4 good" in printed
    assert "pandas False" in printed
    assert int(printed.split("VmHWM:")[1].split()[0]) < 300_000  # kB


COMMANDS = {
    "steps": Schedule(voltage="steps", commands_on_change=True),
    "outputs every 50 ms": Schedule(i=Timing(0.05), omega=Timing(0.05), commands_on_change=True),
    "outputs mostly missing": Schedule(i=Timing(missing=0.8), omega=Timing(missing=0.8), commands_on_change=True),
    "sampled every 10 ms": Schedule(voltage="sine"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_held_between_its_samples(tmp_path: Path, name: str) -> None:
    """No sample of it is lost, at whatever times the other signals have theirs."""
    schedule = COMMANDS[name]
    for seed in (7, 8, 9):
        recording = recorded(schedule, seed, length=8.0)
        windows = cut(tmp_path, schedule, recording)
        assert len(windows) >= 3
        for window in windows:
            times = window.start + window.grid.offsets
            nearest = np.abs(times[:, None] - recording.inputs.voltage_times).min(axis=1)
            clear = nearest > 1e-6  # a record at the very time of a change may have either value
            assert window.column("V_a")[clear] == pytest.approx(recording.inputs.voltage(times[clear]), abs=1e-9)
            assert window.quality.verdict is Verdict.GOOD, window.quality.reasons


@pytest.mark.parametrize("voltage", ["steps", "levels"])
def test_commands_on_change_give_valid_intervals(log: Log, voltage: Voltage) -> None:
    schedule = Schedule(voltage=voltage, commands_on_change=True)
    recording = recorded(schedule)
    documents = log.of(schedule, recording)
    assert_used(documents)
    assert_valid_intervals([outcome(recording, document) for document in documents])


@pytest.mark.parametrize("voltage", often(["levels"], ["levels", "steps", "sine"]))
def test_a_command_that_changes_between_rows_is_recognised_and_named(log: Log, voltage: Voltage) -> None:
    """The controller has a clock of its own: no window says that the command is late. The machine file may say it."""
    truth = Schedule(rows=Timing(0.0107), voltage=voltage, polled=True)
    recording = recorded(truth)
    documents = log.of(replace(truth, polled=False), recording)
    remedy = 'write times = "polled" under [signals] V_a'
    for document in documents:
        assert all(finding.kind is not FindingKind.TIMING for finding in document.findings)
    assert_used(documents[2:], at_least=WINDOWS - 2)
    assert documents[1].decision is WindowDecision.NOISIER
    assert_valid_intervals([outcome(recording, document) for document in documents[1:]])
    for document in documents[2:]:
        (finding,) = document.findings
        assert (finding.subject, finding.setting, finding.of_file) == ("V_a", remedy, True)
    for document in documents[-2:]:
        assert [hint.setting for hint in document.hints] == [remedy]
        assert not document.open_events
    path = write_machine(log.folder, UNIFORM, '[signals]\nV_a = { times = "polled" }')
    machine = load_machine(path, with_driver=False)
    data = write(log.folder, recording.header, recording.rows())
    with open_recorded(machine, data) as opened:
        declared = [report.document for report in Replay(machine, opened).reports()]
    assert_used(declared)
    assert not any(document.findings or document.events for document in declared)
    for own, other in zip(documents[2:], declared[2:], strict=True):
        for name in FREE:
            sd = other.parameters[name].raw_sd
            assert sd is not None
            assert own.parameters[name].raw == pytest.approx(other.parameters[name].raw, abs=0.3 * sd)


SLOW_OMEGA = Schedule(rows=Timing(0.01), omega=Timing(missing=0.8))
LOGS = {
    "rows every 10.7 ms": Schedule(rows=Timing(0.0107)),
    "rows every 3.5 ms": Schedule(rows=Timing(0.0035)),
    "30 % of rows missing": Schedule(rows=Timing(missing=0.3), load="walk", load_noise=True),
    "rows with jitter": Schedule(rows=Timing(jitter=0.5), load="walk", load_noise=True),
    "omega every 50 ms": Schedule(omega=Timing(0.05)),
    "80 % of omega missing": SLOW_OMEGA,
    "i every 100 ms, omega every 20 ms": Schedule(i=Timing(0.1), omega=Timing(0.02)),
}


@pytest.mark.parametrize("name", often(["rows every 10.7 ms", "80 % of omega missing"], LOGS))
def test_an_irregular_or_slow_log_is_used_with_valid_intervals(log: Log, name: str) -> None:
    schedule, outcomes = LOGS[name], []
    for seed in (7, 8):
        recording = recorded(schedule, seed)
        documents = log.of(schedule, recording)
        assert_used(documents)
        outcomes += [outcome(recording, document) for document in documents]
    assert_valid_intervals(outcomes)


def test_outputs_are_never_interpolated(tmp_path: Path) -> None:
    """A record counts as a measurement only where the log has a sample, with the value of that sample."""
    recording = recorded(Schedule(omega=Timing(0.05)), length=8.0)
    windows = cut(tmp_path, Schedule(omega=Timing(0.05)), recording)
    assert len(windows) >= 3
    for window in windows:
        for name in ("i", "omega"):
            own = recording.samples[name]
            part = (own.stated >= window.start - 1e-9) & (own.stated < window.end - 1e-9)
            present = ~window.missing_in(name)
            assert present.sum() == part.sum()
            assert window.column(name)[present] == pytest.approx(own.values[part], rel=1e-12)
            assert (window.start + window.grid.offsets)[present] == pytest.approx(own.stated[part], abs=1e-6)


@pytest.mark.parametrize("period", [0.01, 0.0107])
def test_a_gap_of_27_s_at_the_start_does_not_spoil_what_follows(log: Log, period: float) -> None:
    """The windows begin anew with the first sample after it."""
    schedule = Schedule(rows=Timing(period))
    gap_end = 27.5
    recording = recorded(schedule, length=gap_end + WINDOWS * WINDOW + 0.2).without(0.5, gap_end)
    outcomes = [outcome(recording, document) for document in log.of(schedule, recording)]
    after = [item for item in outcomes if item.document.window.start >= gap_end - period]
    assert_used([item.document for item in after])
    assert_valid_intervals(after)
    refused = [item.document.window for item in outcomes if item.document.window.start < gap_end - period]
    assert all(window.quality.verdict is Verdict.BAD and window.quality.reasons for window in refused)


def joined(later: float) -> tuple[Recording, Rows]:
    """Two recordings of one motor of 7 s each, the second ``later`` s after the start of the first."""
    random = np.random.default_rng(9)
    motor: Motor = some_motor(random)
    first, second = (record(UNIFORM, motor, 7.0, random) for _ in range(2))
    rows = [[*row, "1"] for row in first.rows()] + [[*row, "2"] for row in second.rows(shift=later)]
    return first, rows


@pytest.mark.parametrize("later", [7.0, 0.0], ids=["times go on", "times begin anew"])
def test_two_recordings_joined_by_a_segment_column_share_no_window(log: Log, later: float) -> None:
    first, rows = joined(later)
    documents = log.reports(UNIFORM, [*first.header, "segment"], rows)
    assert_used(documents, at_least=6)
    if later:
        ends = [(document.window.start, document.window.end) for document in documents]
        assert not any(start < later - 0.005 < end - 0.01 for start, end in ends), ends
    truth = [getattr(first.motor, name) for name in FREE]
    for name, value in zip(FREE, truth, strict=True):
        last = documents[-1].parameters[name]
        assert last.value == pytest.approx(value, rel=0.01)
