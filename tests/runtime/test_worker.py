"""The supervisor's promise: whatever the worker does, every window is answered or counted."""

import os
import signal
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from otolith.acquisition.window import Window
from otolith.health.schema import Report
from otolith.runtime import worker
from otolith.runtime import worker as supervisor
from otolith.runtime.worker import Supervisor
from otolith_drivers.plant.dc_motor import MotorScenario
from tests.estimation.test_window_fit import Cut, state_for
from tests.waiting import PATIENCE


@pytest.fixture
def batch(scenario: MotorScenario, windows: Cut) -> list[Window]:
    return [window for window, _ in windows(scenario, 5)]


def poll_until(
    watched: Supervisor, done: Callable[[list[Report]], bool], seconds: float = 3 * PATIENCE
) -> list[Report]:
    reports: list[Report] = []
    deadline = time.monotonic() + seconds
    while not done(reports) and time.monotonic() < deadline:
        reports += [report for report, _ in watched.poll(time.monotonic())]
        time.sleep(0.01)
    assert done(reports)
    return reports


def test_a_window_whose_worker_died_is_tried_once_more(batch: list[Window]) -> None:
    watched = Supervisor(state_for("R_a"), window_length=2.0)
    watched.start()
    try:
        watched.submit(batch[0], time.monotonic())
        poll_until(watched, lambda reports: len(reports) == 1)
        watched.submit(batch[1], time.monotonic())
        watched._companion.kill()
        reports = poll_until(watched, lambda reports: len(reports) == 1)
        assert reports[0].document.window.index == 1
        assert (watched.missed, watched.restarts, watched.finished) == (0, 1, 2)
    finally:
        watched.stop()


def test_a_window_that_kills_its_worker_twice_is_missed_and_the_next_one_is_not(batch: list[Window]) -> None:
    poison = replace(batch[0], signals=())  # raises in the heart: the worker survives and says so
    watched = Supervisor(state_for("R_a"), window_length=2.0)
    watched.start()
    try:
        watched.submit(poison, time.monotonic())
        poll_until(watched, lambda _: watched.missed == 1)
        assert watched.restarts == 0
        watched.submit(batch[1], time.monotonic())
        for _ in range(2):
            watched._companion.kill()
            watched.poll(time.monotonic())
        poll_until(watched, lambda _: watched.missed == 2)
        watched.submit(batch[2], time.monotonic())
        reports = poll_until(watched, lambda reports: len(reports) == 1)
        assert reports[0].document.window.index == 2
    finally:
        watched.stop()


def test_a_worker_that_hangs_is_killed(batch: list[Window], monkeypatch: pytest.MonkeyPatch) -> None:
    watched = Supervisor(state_for("R_a"), window_length=2.0)
    watched.start()
    try:
        watched.submit(batch[0], time.monotonic())
        poll_until(watched, lambda reports: len(reports) == 1)
        assert watched._companion.pid is not None
        os.kill(watched._companion.pid, signal.SIGSTOP)
        now = time.monotonic()
        watched.submit(batch[1], now)
        watched.poll(now + supervisor.PATIENCE + 4.1)
        reports = poll_until(watched, lambda reports: len(reports) == 1)
        assert reports[0].document.window.index == 1
        assert watched.restarts == 1
    finally:
        watched.stop()


def test_when_windows_come_faster_than_they_are_done_the_oldest_are_counted(batch: list[Window]) -> None:
    watched = Supervisor(state_for("R_a"), window_length=2.0)
    for window in batch:
        watched.submit(window, 0.0)
    assert watched.missed == len(batch) - supervisor.ROOM


def test_the_worker_carries_nothing_over(batch: list[Window]) -> None:
    """Two workers, one window each, come to what one worker comes to."""
    first = worker.perform(worker.Task(state_for("R_a"), batch[0]))
    again = worker.perform(worker.Task(first.state, batch[1]))
    alone = worker.perform(worker.Task(worker.perform(worker.Task(state_for("R_a"), batch[0])).state, batch[1]))
    assert again.report is not None
    assert alone.report is not None
    assert again.report.document == alone.report.document


def test_windows_missed_while_the_twin_is_compiled_are_explained_once(
    batch: list[Window], caplog: pytest.LogCaptureFixture
) -> None:
    watched = Supervisor(state_for("R_a"), window_length=2.0)
    for window in batch:
        watched.submit(window, 0.0)
    assert watched.missed == len(batch) - supervisor.ROOM
    said = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert said == [f"window 0 missed: {supervisor.NOT_READY}"]
