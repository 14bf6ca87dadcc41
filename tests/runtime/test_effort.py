"""What counts of the time of a process: what it takes of a processor, and what it waits without taking any."""

import os
import time

import pytest

from otolith.runtime.effort import MAX_TURN, Effort, processor_time


def counted(steps: list[tuple[float, float]]) -> float:
    effort, seconds = Effort(), 0.0
    effort.begin(0.0, 0.0)
    for now, spent in steps:
        seconds = effort.seconds(now, spent)
    return seconds


def test_processor_time_counts_and_turns_of_others_do_not() -> None:
    busy = [(0.9 * MAX_TURN * step, 0.05 * step) for step in range(1, 101)]
    assert counted(busy) == pytest.approx(5.0)


def test_a_time_without_any_processor_time_counts_as_a_whole() -> None:
    waiting = [(0.1 * step, 0.5) for step in range(1, 101)]
    assert counted(waiting) == pytest.approx(0.5 + 9.9)
    assert counted([*waiting, (10.1, 0.6)]) == pytest.approx(0.6 + 9.9)


def test_nobody_knows_what_a_process_did_while_it_was_not_looked_at() -> None:
    assert counted([(1000.0, 0.3)]) == pytest.approx(0.3)
    assert counted([(1000.0, 0.0)]) == pytest.approx(1000.0)


def test_processes_that_die_one_after_the_other_add_up() -> None:
    """Each computes for a second, and the next one starts after 30 s: half an hour is no progress."""
    steps = []
    for start in range(0, 1800, 30):
        steps += [(start + 0.1 * tick, min(0.1 * tick, 1.0)) for tick in range(1, 10)]
        steps += [(start + 0.1 * tick, 0.0) for tick in range(10, 301)]
    assert counted(steps) == pytest.approx(1800.0, rel=0.05)


def test_the_processor_time_of_this_process_is_read() -> None:
    before, end = time.process_time(), time.process_time() + 0.05
    first = processor_time(os.getpid())
    while time.process_time() < end:
        pass
    assert processor_time(os.getpid()) - first == pytest.approx(time.process_time() - before, abs=0.05)
    assert processor_time(2**22 + 1) == 0.0
