"""The supervisor: whatever the worker does, every window is answered or counted as missed."""

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest

from otolith.acquisition.window import Window
from otolith.health.schema import Report
from otolith.runtime.worker import MAX_WAITING_WINDOWS, NOT_READY, WINDOW_TIMEOUT, Supervisor, perform
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.estimation.test_window_fit import Cut, state_for
from tests.waiting import PATIENCE, wait_for

LENGTH = 2.0  # s of a window


@pytest.fixture
def batch(scenario: MotorScenario, windows: Cut) -> list[Window]:
    return [window for window, _ in windows(scenario, 5)]


@pytest.fixture
def supervisor() -> Iterator[Supervisor]:
    running = Supervisor(state_for("R_a"), window_length=LENGTH)
    running.start()
    yield running
    running.worker.kill()


def poll_for_report(supervisor: Supervisor) -> Report:
    """Poll until a report is there, and return it; fail if there are several."""
    reports: list[Report] = []

    def has_report() -> bool:
        reports.extend(report for report, _ in supervisor.poll(time.monotonic()))
        return bool(reports)

    wait_for(has_report, 3 * PATIENCE)
    assert len(reports) == 1
    return reports[0]


def poll_until_missed(supervisor: Supervisor, count: int) -> None:
    def is_missed() -> bool:
        supervisor.poll(time.monotonic())
        return supervisor.missed == count

    wait_for(is_missed, 3 * PATIENCE)


def test_a_window_whose_worker_died_is_tried_again(supervisor: Supervisor, batch: list[Window]) -> None:
    supervisor.submit(batch[0], time.monotonic())
    poll_for_report(supervisor)
    supervisor.submit(batch[1], time.monotonic())
    supervisor.worker.kill()
    assert poll_for_report(supervisor).document.window.index == 1
    assert (supervisor.missed, supervisor.restarts, supervisor.finished) == (0, 1, 2)


def test_a_window_that_kills_two_workers_is_missed(supervisor: Supervisor, batch: list[Window]) -> None:
    invalid = replace(batch[0], signals=())  # raises an exception in the worker, which survives
    supervisor.submit(invalid, time.monotonic())
    poll_until_missed(supervisor, 1)
    assert supervisor.restarts == 0
    supervisor.submit(batch[1], time.monotonic())
    for _ in range(2):
        supervisor.worker.kill()
        supervisor.poll(time.monotonic())
    poll_until_missed(supervisor, 2)
    supervisor.submit(batch[2], time.monotonic())
    assert poll_for_report(supervisor).document.window.index == 2


def test_a_worker_that_hangs_is_killed(supervisor: Supervisor, batch: list[Window]) -> None:
    supervisor.submit(batch[0], time.monotonic())
    poll_for_report(supervisor)
    os.kill(supervisor.worker._process.pid, signal.SIGSTOP)
    now = time.monotonic()
    supervisor.submit(batch[1], now)
    supervisor.poll(now + WINDOW_TIMEOUT + 2 * LENGTH + 0.1)
    assert poll_for_report(supervisor).document.window.index == 1
    assert supervisor.restarts == 1


def test_windows_beyond_the_queue_are_missed(batch: list[Window]) -> None:
    supervisor = Supervisor(state_for("R_a"), window_length=LENGTH)
    for window in batch:
        supervisor.submit(window, 0.0)
    assert supervisor.missed == len(batch) - MAX_WAITING_WINDOWS


def test_the_worker_is_stateless(batch: list[Window]) -> None:
    first = perform(state_for("R_a"), batch[0])
    again = perform(first.state, batch[1])
    alone = perform(perform(state_for("R_a"), batch[0]).state, batch[1])
    assert again.report is not None
    assert alone.report is not None
    assert again.report.document == alone.report.document


def test_windows_missed_during_compilation_are_logged_once(
    batch: list[Window], caplog: pytest.LogCaptureFixture
) -> None:
    supervisor = Supervisor(state_for("R_a"), window_length=LENGTH)
    for window in batch:
        supervisor.submit(window, 0.0)
    assert supervisor.missed == len(batch) - MAX_WAITING_WINDOWS
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert warnings == [f"window 0 missed: {NOT_READY}"]
