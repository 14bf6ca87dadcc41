"""What the main thread of a hall does not wait for is done in turn, and to the end when the hall stops."""

import threading
from functools import partial

from otolith.runtime.hall.background import Background
from tests.waiting import PATIENCE, wait_for


def test_jobs_that_wait_are_done_before_the_end() -> None:
    """They write what is left of a machine whose file was removed just before the hall stops."""
    background, done, begin = Background(), list[int](), threading.Event()

    def write(number: int) -> None:
        begin.wait()
        done.append(number)

    for number in range(3):
        background.do(partial(write, number))
    begin.set()
    background.stop(PATIENCE)
    assert done == [0, 1, 2]


def test_a_job_that_hangs_is_waited_for_no_longer_than_allowed() -> None:
    background, never, begun = Background(), threading.Event(), threading.Event()

    def hang() -> None:
        begun.set()
        never.wait()

    background.do(hang)
    wait_for(begun.is_set)
    background.stop(0.05)
    assert not never.is_set()
    never.set()


def test_a_job_that_fails_ends_no_other_and_what_follows_is_done_by_the_caller() -> None:
    background, followed = Background(), list[str]()

    def fail() -> None:
        raise ValueError("no such file")

    background.do(fail)
    background.do(lambda: lambda: followed.append(threading.current_thread().name))
    background.stop(PATIENCE)
    assert not followed
    background.finish()
    assert followed == [threading.current_thread().name]
