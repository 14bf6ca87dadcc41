"""Every driver of the registry keeps the contract; a new driver is tested as soon as it has a row and a rig."""

import socket
import threading
import time
from collections.abc import Callable

import pytest

from otolith_drivers import base, conformance
from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling
from otolith_drivers.conformance import CONTRACT, Rig, close_ends_everything_within_a_second
from tests.conftest import OwnMachine
from tests.drivers.rigs import RIGS
from tests.waiting import PATIENCE, wait_for, within


@pytest.mark.timed
@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", sorted(base.DRIVERS))
def test_driver_keeps_the_contract(
    name: str, check: Callable[[Rig], None], own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(conformance, "SAMPLES_TIMEOUT", PATIENCE)
    monkeypatch.setattr(conformance, "CLOSE_TIMEOUT", within(conformance.CLOSE_TIMEOUT))
    with RIGS[name](own_machine) as rig:
        check(rig)
        rig.driver.close()


@pytest.mark.timed
@pytest.mark.parametrize("name", sorted(base.DRIVERS))
def test_a_driver_of_the_package_answers_while_its_samples_are_being_taken(name: str, own_machine: OwnMachine) -> None:
    """The guard asks it in the thread of the daemon, so an answer waits for no lock that is held meanwhile."""
    taking, taken = threading.Event(), threading.Event()

    def take(_: object) -> None:
        taking.set()
        taken.wait(PATIENCE)

    with RIGS[name](own_machine) as rig:
        rig.driver.open(take)

        def is_taking() -> bool:
            rig.emit()
            return taking.wait(0.05)

        wait_for(is_taking)
        answers = list[object]()

        def ask() -> None:
            answers.extend((rig.driver.counters(), rig.driver.link()))

        asking = threading.Thread(target=ask)
        asking.start()
        asking.join(PATIENCE)
        taken.set()
        rig.driver.close()
        assert [type(answer) for answer in answers] == [Counters, Link]


class StandIn:
    """A driver that delivers in ``open``, and leaves behind what ``leak`` opens."""

    sampling = Sampling.TRUE

    def __init__(self, leak: Callable[[], object]) -> None:
        self._leak = leak

    def open(self, deliver: Deliver) -> None:
        deliver([Sample("i", time.monotonic(), 2.0)] * conformance.MIN_SAMPLES)
        self._leak()

    def close(self) -> None:
        pass

    def counters(self) -> Counters:
        return Counters()

    def link(self) -> Link:
        return Link(up=True)

    def describe(self) -> list[str]:
        return ["i"]


def test_threads_and_descriptors_that_a_driver_leaves_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conformance, "CLOSE_TIMEOUT", 0.1)
    end, left = threading.Event(), list[socket.socket]()
    thread = threading.Thread(target=end.wait, name="left-behind")

    def leave_a_thread() -> None:
        thread.start()

    with pytest.raises(AssertionError, match=r"descriptors left open: \d+ socket"):
        close_ends_everything_within_a_second(Rig(StandIn(lambda: left.append(socket.socket())), {"i": 2.0}))
    left.pop().close()
    with pytest.raises(AssertionError, match="threads left: left-behind"):
        close_ends_everything_within_a_second(Rig(StandIn(leave_a_thread), {"i": 2.0}))
    end.set()
    thread.join()


def test_threads_that_the_source_starts_are_not_those_of_the_driver() -> None:
    end, asked, started = threading.Event(), threading.Event(), threading.Event()
    answering = threading.Thread(target=end.wait)

    def serve() -> None:
        asked.wait()
        answering.start()
        started.set()

    serving = threading.Thread(target=serve)
    serving.start()

    def connect() -> None:
        asked.set()
        started.wait()

    try:
        close_ends_everything_within_a_second(Rig(StandIn(connect), {"i": 2.0}))
        assert answering.is_alive()
    finally:
        end.set()
        serving.join()
        answering.join()
