"""The pool: whatever a worker does, every window is answered or counted as missed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from otolith.acquisition.window import Quality, Verdict, Window
from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import initial_state
from otolith.cli.main import cli
from otolith.health.schema import Report
from otolith.kernel_cache import SOURCE, CompileStep
from otolith.machine import load_machine
from otolith.runtime.hall.machine import MAX_WAITING_WINDOWS, NOT_READY, Task
from otolith.runtime.hall.pool import COMPILE_TIMEOUT, WINDOW_TIMEOUT, Preparation
from otolith.runtime.worker import WARM_UP_KERNELS, Ready, answer, perform
from otolith_drivers.base import Counters, Link, SourceState
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.acquisition.series import uncut
from tests.conftest import EXAMPLES
from tests.estimation.test_window_fit import Cut, state_for
from tests.runtime.pools import LENGTH, OneMachine
from tests.waiting import PATIENCE, wait_for

BAD = Quality(Verdict.BAD, 0.5, 0.0, 0.0, 0.0)


@pytest.fixture
def batch(scenario: MotorScenario, windows: Cut) -> list[Window]:
    return [window for window, _ in windows(scenario, 5)]


@pytest.fixture
def pooled() -> Iterator[OneMachine]:
    running = OneMachine.of(state_for("R_a"))
    running.pool.start(time.monotonic())
    yield running
    running.pool.kill()


def poll_for_report(pooled: OneMachine) -> Report:
    """Poll until a report is there, and return it; fail if there are several."""
    reports: list[Report] = []

    def has_report() -> bool:
        reports.extend(finished.report for finished in pooled.poll(time.monotonic()))
        return bool(reports)

    wait_for(has_report, 3 * PATIENCE)
    assert len(reports) == 1
    return reports[0]


def poll_until_missed(pooled: OneMachine, count: int) -> None:
    def is_missed() -> bool:
        pooled.poll(time.monotonic())
        return pooled.machine.missed == count

    wait_for(is_missed, 3 * PATIENCE)


def test_a_window_whose_worker_died_is_tried_again(pooled: OneMachine, batch: list[Window]) -> None:
    pooled.submit(Task(uncut(batch[0])), time.monotonic())
    poll_for_report(pooled)
    pooled.submit(Task(uncut(batch[1])), time.monotonic())
    pooled.worker.process.kill()
    assert poll_for_report(pooled).document.window.index == 1
    assert (pooled.machine.missed, pooled.pool.restarts, pooled.machine.finished) == (0, 1, 2)


def test_a_window_that_kills_two_workers_is_missed(pooled: OneMachine, batch: list[Window]) -> None:
    invalid = replace(batch[0], signals=())  # raises an exception in the worker, which survives
    pooled.submit(Task(uncut(invalid)), time.monotonic())
    poll_until_missed(pooled, 1)
    assert pooled.pool.restarts == 0
    pooled.submit(Task(uncut(batch[1])), time.monotonic())
    for _ in range(2):
        pooled.worker.process.kill()
        pooled.poll(time.monotonic())
    poll_until_missed(pooled, 2)
    pooled.submit(Task(uncut(batch[2])), time.monotonic())
    assert poll_for_report(pooled).document.window.index == 2


def test_samples_that_cannot_be_cut_cost_their_window_only(pooled: OneMachine, batch: list[Window]) -> None:
    raw = uncut(batch[0])
    without = replace(raw, samples=replace(raw.samples, series={}))
    pooled.submit(Task(without), time.monotonic())
    poll_until_missed(pooled, 1)
    pooled.submit(Task(uncut(batch[1])), time.monotonic())
    assert poll_for_report(pooled).document.window.index == 1
    assert (pooled.machine.missed, pooled.pool.restarts, pooled.machine.finished) == (1, 0, 1)


def test_the_worker_tells_which_sources_and_outputs_failed(batch: list[Window]) -> None:
    """As the daemon knew it at the end of the window; and it counts windows of bad quality."""
    drive = SourceState("drive", ("omega",), Link(up=False, reason="no answer"), Counters())
    link, raw = Link(up=True, sources=(drive,)), uncut(batch[0])
    result = answer(PackedState.of(state_for("R_a")), Task(raw, link, {"history": "disk full"}))
    assert result.window is not None
    assert "no answer" in result.window.absent["drive"]
    assert result.window.outages == {"history": "disk full"}
    pooled, worker = slow(batch)
    worker.sent = [replace(result, window=replace(result.window, quality=BAD))]
    assert len(pooled.poll(1.0)) == 1
    assert (pooled.machine.finished, pooled.machine.bad) == (1, 1)


def test_a_worker_that_hangs_is_killed(pooled: OneMachine, batch: list[Window]) -> None:
    pooled.submit(Task(uncut(batch[0])), time.monotonic())
    poll_for_report(pooled)
    os.kill(pooled.worker.process._process.pid, signal.SIGSTOP)
    now = time.monotonic()
    pooled.submit(Task(uncut(batch[1])), now)
    pooled.poll(now + WINDOW_TIMEOUT + 2 * LENGTH + 0.1)
    assert poll_for_report(pooled).document.window.index == 1
    assert pooled.pool.restarts == 1


def test_windows_beyond_the_queue_are_missed(batch: list[Window]) -> None:
    pooled = OneMachine.of(state_for("R_a"))
    for window in batch:
        pooled.submit(Task(uncut(window)), 0.0)
    assert pooled.machine.missed == len(batch) - MAX_WAITING_WINDOWS


def test_the_worker_is_stateless(batch: list[Window]) -> None:
    first = perform(state_for("R_a"), batch[0])
    again = perform(first.state, batch[1])
    alone = perform(perform(state_for("R_a"), batch[0]).state, batch[1])
    assert again.report is not None
    assert alone.report is not None
    assert again.report.document == alone.report.document


# In a process of its own, as a kernel reports its first call in a process only.
CALLED = """
import sys
from pathlib import Path
from dataclasses import replace
from otolith import kernel_cache
from otolith.adaptation.state import initial_state, with_problem
from otolith.machine import load_machine
from otolith.runtime import worker
machine, steps = load_machine(Path(sys.argv[1]), with_driver=False), []
state = initial_state("motor", "here", machine.problem, machine.plan)
with kernel_cache.observed(steps.append):
    assert not worker.warm_up(state)
    assert sum(step.is_end and step.is_kernel for step in steps) == worker.WARM_UP_KERNELS, steps
    print(len(steps))
    worker.WARM_UP_RECORDS = 200
    for seed in range(3):
        worker.warm_up(with_problem(state, replace(state.problem, seed=seed)))
    print(len(steps))
"""


@pytest.mark.parametrize("name", ["dc-motor-in-process", pytest.param("odrive-axis", marks=pytest.mark.full)])
def test_the_warm_up_calls_every_kernel_that_windows_need(name: str) -> None:
    command = [sys.executable, "-c", CALLED, str(EXAMPLES / f"{name}.toml")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    first, all_of_them = map(int, done.stdout.split())
    assert first == all_of_them > 0


def test_windows_missed_during_compilation_are_logged_once(
    batch: list[Window], caplog: pytest.LogCaptureFixture
) -> None:
    pooled = OneMachine.of(state_for("R_a"))
    for window in batch:
        pooled.submit(Task(uncut(window)), 0.0)
    assert pooled.machine.missed == len(batch) - MAX_WAITING_WINDOWS
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == [f"window 0 missed: {NOT_READY}"]


class SlowWorker:
    """A process that sends steps when the test does, and never a result."""

    alive, starts, processor_time = True, 1, 0.0

    def __init__(self) -> None:
        self.sent: list[object] = []
        self.killed = 0

    def start(self, *_: object) -> None:
        self.starts += 1

    def replies(self) -> list[object]:
        sent, self.sent = self.sent, []
        return sent

    def offer(self, _: object) -> bool:
        return True

    def reset_backoff(self) -> None:
        """Nothing was restarted."""

    def kill(self) -> None:
        self.killed += 1


def slow(batch: list[Window]) -> tuple[OneMachine, SlowWorker]:
    pooled, worker = OneMachine.of(state_for("R_a")), SlowWorker()
    pooled.worker.process = worker  # type: ignore[assignment]  # has the methods that are used
    pooled.submit(Task(uncut(batch[0])), 0.0)
    return pooled, worker


def test_how_far_a_worker_is_that_starts_is_known_until_it_is_ready(batch: list[Window]) -> None:
    pooled, worker = slow(batch)
    assert pooled.pool.preparation == Preparation(0, WARM_UP_KERNELS, False)
    worker.sent = [
        CompileStep(SOURCE, is_end=True, compiled=True),
        CompileStep("first", is_end=False, compiled=False),
        CompileStep("first", is_end=True, compiled=False),
        CompileStep("second", is_end=False, compiled=False),
        CompileStep("second", is_end=True, compiled=True),
        CompileStep("third", is_end=False, compiled=False),
    ]
    pooled.poll(1.0)
    assert pooled.pool.preparation == Preparation(2, WARM_UP_KERNELS, True)
    worker.sent = [Ready()]
    pooled.poll(2.0)
    assert pooled.pool.preparation is None
    worker.sent = [CompileStep("rare", is_end=True, compiled=True)]
    pooled.poll(3.0)
    assert pooled.pool.preparation is None


STEP = COMPILE_TIMEOUT + WINDOW_TIMEOUT  # s; less than a step may take


def test_a_worker_that_compiles_ten_times_slower_is_not_killed(batch: list[Window]) -> None:
    """Twelve kernels at ten minutes each, before the first window and for a component that is new later."""
    pooled, worker = slow(batch)
    for number in range(1, 13):
        worker.sent = [
            CompileStep("kernel", is_end=True, compiled=True),
            CompileStep("next", is_end=False, compiled=False),
        ]
        assert pooled.poll(number * STEP) == []
        assert (worker.killed, pooled.pool.progress, pooled.worker.is_compiling) == (0, number, True)
    worker.sent = [Ready()]
    pooled.poll(13 * STEP)
    assert not pooled.worker.is_compiling
    worker.sent = [CompileStep("rare", is_end=False, compiled=False)]
    pooled.poll(13 * STEP + WINDOW_TIMEOUT)
    pooled.poll(14 * STEP)
    assert worker.killed == 0


def test_a_worker_that_hangs_while_it_compiles_is_killed(batch: list[Window]) -> None:
    pooled, worker = slow(batch)
    worker.sent = [CompileStep("kernel", is_end=False, compiled=False)]
    pooled.poll(1.0)
    pooled.poll(STEP + 2 * LENGTH + 0.9)
    assert worker.killed == 0
    pooled.poll(STEP + 2 * LENGTH + 1.1)
    assert worker.killed == 1


@pytest.mark.parametrize(("share", "is_killed"), [(1.0, True), (0.05, False), (0.0, True)])
def test_a_worker_on_a_busy_computer_is_killed_by_the_processor_time_that_it_takes(
    share: float, is_killed: bool, batch: list[Window]
) -> None:
    """Three minutes with a ``share`` of a processor, of which the worker gets its turn every 0.5 s."""
    pooled, worker = slow(batch)
    worker.sent = [Ready()]
    pooled.poll(0.0)
    for tick in range(1, 1801):
        worker.processor_time = 0.5 * share * (tick // 5)
        pooled.poll(0.1 * tick)
        if worker.killed:
            break
    assert bool(worker.killed) is is_killed
    if is_killed:
        assert WINDOW_TIMEOUT + 2 * LENGTH < 0.1 * tick < WINDOW_TIMEOUT + 2 * LENGTH + 1.5


def test_kernels_that_are_loaded_are_no_progress(batch: list[Window]) -> None:
    """Otherwise a worker that dies at every start would feed the watchdog for ever."""
    pooled, worker = slow(batch)
    worker.sent = [
        CompileStep("kernel", is_end=False, compiled=False),
        CompileStep("kernel", is_end=True, compiled=False),
        Ready(),
    ]
    pooled.poll(1.0)
    assert pooled.pool.progress == 0


TANK = """[twin]
name = "tank"
title = "tank with a pump and a leak"
source = "mass balance"
validity = "linear leak"
[states]
h = { unit = "m", meaning = "level", bounds = [0, 10] }
[inputs]
q = { unit = "m/s", hold = "zoh", range = [0, 1], meaning = "inflow per area" }
[outputs]
h = { unit = "m", noise = 0.01, meaning = "level" }
[parameters]
k = { unit = "1/s", nominal = 1, bounds = [0.1, 10], role = "estimated", meaning = "leak" }
[equations]
"der(h)" = "q - k*h"
[sites]
level = { into = "der(h)", mode = "additive", unit = "m/s", meaning = "inflow" }
"""


@pytest.mark.full
def test_a_first_start_with_an_empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Daemon and 'otolith compile' with a twin that is new on this computer, and small."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "tank.toml").write_text(TANK, encoding="utf-8")
    file = tmp_path / "machine.toml"
    file.write_text('[machine]\nname = "t"\nsite = "s"\n[twin]\nfile = "tank.toml"\n', encoding="utf-8")
    machine = load_machine(file, with_driver=False)
    state = initial_state("t", "s", machine.problem, machine.plan)
    pooled = OneMachine.of(state)
    pooled.pool.start(time.monotonic())
    values = np.random.default_rng(1).uniform(0.4, 0.6, (200, 2))
    pooled.submit(Task(uncut(Window.whole(0, 0.0, 0.01, machine.twin.signals, values))), time.monotonic())
    try:
        wait_for(lambda: bool(pooled.poll(time.monotonic())) or pooled.machine.missed > 0, 3 * PATIENCE)
    finally:
        pooled.worker.process.kill()
    assert (pooled.pool.restarts, pooled.machine.missed, pooled.machine.finished) == (0, 0, 1)
    assert pooled.pool.progress > 5  # kernels, then the window
    result = CliRunner().invoke(cli, ["compile", str(file)])
    assert (result.exit_code, result.output) == (0, f"all kernels are there: {tmp_path}/cache/otolith/kernels\n")
