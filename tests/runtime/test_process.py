"""Companions: a process that cannot be started, or dies, is counted and tried again with growing pauses."""

import signal
import time
from typing import Any

import pytest

from otolith.runtime import process as companion
from otolith.runtime.process import ChildProcess
from tests.waiting import PATIENCE, within


def test_a_failure_to_spawn_counts_as_a_death(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_more(*_: object) -> None:
        raise OSError(24, "Too many open files")

    tried = ChildProcess("nobody", "time:sleep", room=1)
    monkeypatch.setattr(ChildProcess, "_spawn", no_more)
    tried.start()
    assert not tried.alive
    assert tried.replies() == []
    assert tried.may_start_again(100.0)
    tried.start()
    assert not tried.may_start_again(100.0)
    assert tried.may_start_again(100.0 + companion.FIRST_PAUSE)
    tried.stop(0.1)
    assert tried.starts == 2


def test_pauses_grow_with_every_death_until_it_thrives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ChildProcess, "_spawn", lambda *_: None)
    tried, pauses = ChildProcess("nobody", "time:sleep", room=1), []
    for _ in range(9):
        now = 0.0
        while not tried.may_start_again(now):
            now += 0.25
        pauses.append(now)
        tried.start()
    assert pauses[:4] == [0.0, 0.5, 1.0, 2.0]
    assert pauses[-1] == companion.LONGEST_PAUSE
    tried.has_thrived()
    assert tried.may_start_again(0.0)


def echo(connection: Any) -> None:
    """What the companion of the tests below does."""
    while (message := connection.recv()) is not None:
        connection.send((message, signal.SIGTERM in signal.pthread_sigmask(signal.SIG_BLOCK, [])))


def test_signals_to_the_group_do_not_reach_it_and_messages_do() -> None:
    running = ChildProcess("echo", "tests.runtime.test_process:echo", room=2)
    running.start()
    assert running.offer("a")
    deadline = time.monotonic() + PATIENCE
    said: list[object] = []
    while not said and time.monotonic() < deadline:
        said = running.replies()
        time.sleep(0.01)
    assert said == [("a", True)]
    running.stop(PATIENCE)
    assert not running.alive


@pytest.mark.timed
def test_a_companion_that_does_not_read_is_not_waited_for() -> None:
    stuck = ChildProcess("stuck", "tests.runtime.test_process:sleep", room=2)
    stuck.start()
    begun = time.monotonic()
    taken = [stuck.offer(bytes(1 << 20)) for _ in range(20)]
    assert time.monotonic() - begun < within(0.5)
    assert not all(taken)
    stuck.kill()


def sleep(connection: Any) -> None:
    """Never reads."""
    del connection
    time.sleep(60.0)
