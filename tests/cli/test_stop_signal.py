"""A command that a signal asks to end does so soon, also in the middle of a long step."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from otolith.cli import common
from otolith.cli.common import StopSignal
from tests.waiting import PATIENCE

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)


@pytest.fixture
def stop(monkeypatch: pytest.MonkeyPatch) -> Iterator[StopSignal]:
    monkeypatch.setattr(common, "STEP_TIMEOUT", 0.05)
    monkeypatch.setattr(common, "BREAK_INTERVAL", 0.01)
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield StopSignal()
    for number, handler in before.items():
        signal.signal(number, handler)


def work_for_ever() -> None:
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with suppress(Exception):  # as a library that drops exceptions
            sum(range(1000))
    raise AssertionError("not broken off")


def test_a_step_that_goes_on_after_a_signal_is_broken_off(stop: StopSignal) -> None:
    with stop.ending():
        os.kill(os.getpid(), signal.SIGTERM)
        work_for_ever()
    assert stop.received()
    assert stop.code() == 128 + signal.SIGTERM
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_so_is_a_step_that_begins_after_the_signal(stop: StopSignal) -> None:
    os.kill(os.getpid(), signal.SIGINT)
    with stop.ending():
        work_for_ever()
    assert stop.code() == common.INTERRUPTED


def test_a_step_that_drops_the_first_exception_is_broken_off_by_the_next(stop: StopSignal) -> None:
    dropped = 0
    with stop.ending():
        os.kill(os.getpid(), signal.SIGTERM)
        try:
            work_for_ever()
        except BaseException:  # noqa: BLE001 - the worst that a library can do
            dropped += 1
        work_for_ever()
    assert dropped == 1


def test_outside_of_the_block_nothing_is_broken_off(stop: StopSignal) -> None:
    with stop.ending():
        os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.1)  # twice as long as a step may take
    with stop.ending():
        pass
    assert stop.received()


def test_waiting_ends_soon_after_a_signal(stop: StopSignal) -> None:
    signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
    signal.setitimer(signal.ITIMER_REAL, 0.01)
    begin = time.monotonic()
    stop.wait(PATIENCE)
    assert stop.received()
    assert time.monotonic() - begin < PATIENCE


def test_after_a_release_ctrl_c_ends_what_waits_for_a_person(stop: StopSignal) -> None:
    stop.release()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
    assert not stop.received()
