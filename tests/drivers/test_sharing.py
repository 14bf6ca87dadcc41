"""Machines at one place share its connection, and nothing that one of them does reaches another one."""

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from otolith_drivers import conformance
from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling
from otolith_drivers.common.reconnection import ThreadedDriver
from otolith_drivers.common.sharing import Delivery, SharedConnection, places
from otolith_drivers.conformance import SHARING, Rig, SharedRig
from otolith_drivers.errors import DeviceError
from tests.conftest import OwnMachine
from tests.drivers.shared_rigs import HALLS, Hall
from tests.waiting import PATIENCE, wait_for

LOG = logging.getLogger(__name__)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(conformance, "SAMPLES_TIMEOUT", PATIENCE)


@pytest.mark.parametrize("check", SHARING, ids=lambda check: check.__name__)
@pytest.mark.parametrize("name", HALLS)
def test_driver_keeps_the_contract_of_sharing(
    name: str, check: Callable[[SharedRig], None], own_machine: OwnMachine
) -> None:
    with HALLS[name](own_machine) as hall:
        check(hall)
    assert not places()


def opened(hall: Hall) -> list[list[Sample]]:
    """Open all machines, and wait until each has samples."""
    samples: list[list[Sample]] = [[] for _ in hall.rigs]
    for rig, own in zip(hall.rigs, samples, strict=True):
        rig.driver.open(own.extend)
    come(hall, samples)
    return samples


def come(hall: Hall, samples: list[list[Sample]], count: int = 10) -> None:
    """Wait until so many samples more of each machine have come."""
    before = [len(own) for own in samples]

    def all_came() -> bool:
        for rig in hall.rigs:
            rig.emit()
        return all(len(own) >= start + count for own, start in zip(samples, before, strict=True))

    wait_for(all_came)


@pytest.mark.parametrize("name", HALLS)
def test_a_machine_with_a_bad_file_or_bad_values_counts_them_alone(
    name: str, own_machine: OwnMachine, tmp_path: Path
) -> None:
    with HALLS[name](own_machine) as hall:
        samples = opened(hall)
        absent, broken = hall.build(tmp_path, hall.absent), hall.build(tmp_path, hall.broken)
        received = list[Sample]()
        absent.open(received.extend)
        broken.open(lambda _: None)
        come(hall, samples, 30)
        wait_for(lambda: bool(absent.link().reason or absent.link().warnings) and not received)
        come(hall, samples, 30)
        assert broken.counters().bad > 0
        assert hall.connections() >= 1
        for driver in (absent, broken):
            driver.close()
        come(hall, samples)
        for rig in hall.rigs:
            counters, link = rig.driver.counters(), rig.driver.link()
            assert (counters.bad, counters.reconnects) == (0, 0)
            assert counters.lost == 0 or name != "can"  # a busy computer asks late, and a busy server sends late
            assert link.up
            assert not link.warnings
            rig.driver.close()


class Line(ThreadedDriver, SharedConnection["Delivery"]):
    """A connection of another package: its one method gives what comes to those who use it."""

    opened = 0

    def __init__(self) -> None:
        ThreadedDriver.__init__(self)
        SharedConnection.__init__(self)
        Line.opened += 1
        self._start("line", self._receive)

    def _receive(self) -> None:
        while not self._stop.wait(0.002):
            for user in self.users:
                user.hand_over([Sample("p", time.monotonic(), 1.0)])


class OtherDriver:
    """A driver of another package that opts in by joining."""

    sampling = Sampling.TRUE

    def __init__(self, rate: int = 1) -> None:
        self._rate, self._received = rate, 0
        self._delivery: Delivery | None = None
        self._line: Line | None = None

    def open(self, deliver: Deliver) -> None:
        def count(samples: object) -> None:
            self._received += 1
            deliver(samples)  # type: ignore[arg-type]

        self._delivery = Delivery(count, LOG)
        self._line = Line.join(("other", "/dev/x"), self._delivery, Line, {"rate": self._rate})

    def close(self) -> None:
        if self._line is not None and self._delivery is not None:
            self._delivery.end()
            self._line.leave(self._delivery)

    def counters(self) -> Counters:
        return Counters(self._received)

    def link(self) -> Link:
        up = self._line is not None
        defect = self._delivery.defect(time.monotonic()) if self._delivery is not None else ""
        return Link(up=up, reason="" if up else "not opened yet", defect=defect)

    def describe(self) -> list[str]:
        return ["p"]


@pytest.mark.parametrize("check", SHARING, ids=lambda check: check.__name__)
def test_a_driver_of_another_package_opts_in_by_joining(check: Callable[[SharedRig], None]) -> None:
    rigs = [Rig(OtherDriver(), {"p": 1.0}) for _ in range(3)]
    lines = [thread for thread in threading.enumerate() if thread.name == "line"]
    assert not lines
    check(SharedRig(rigs, lambda: sum(thread.name == "line" for thread in threading.enumerate())))


def test_a_connection_that_can_be_opened_once_is_refused_to_others_options() -> None:
    first, second = OtherDriver(), OtherDriver(rate=2)
    first.open(lambda _: None)
    with pytest.raises(DeviceError, match="rate 1 there and 2 here"):
        second.open(lambda _: None)
    first.close()
    second.open(lambda _: None)
    second.close()
    assert not places()


def test_a_connection_that_cannot_be_made_is_none() -> None:
    def fail() -> Line:
        raise DeviceError("no device")

    for _ in range(2):
        with pytest.raises(DeviceError, match="no device"):
            Line.join(("other", "/dev/y"), Delivery(lambda _: None, LOG), fail)
    assert not places()


def test_whoever_comes_while_a_connection_is_being_closed_gets_a_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """A place that can be opened once is not opened twice at a time."""
    closing, may_close = threading.Event(), threading.Event()
    close = Line.close

    def close_slowly(self: Line) -> None:
        closing.set()
        may_close.wait(PATIENCE)
        close(self)

    monkeypatch.setattr(Line, "close", close_slowly)
    first, second, count = OtherDriver(), OtherDriver(), Line.opened
    first.open(lambda _: None)
    leaving = threading.Thread(target=first.close)
    leaving.start()
    assert closing.wait(PATIENCE)
    joining = threading.Thread(target=second.open, args=(lambda _: None,))
    joining.start()
    assert Line.opened == count + 1
    may_close.set()
    for thread in (leaving, joining):
        thread.join(PATIENCE)
    assert Line.opened == count + 2
    second.close()
    assert not places()


def test_nobody_joins_a_connection_that_its_last_user_breaks_off() -> None:
    """A user that joins while the last one breaks the connection off gets a new connection."""
    first, second, count = OtherDriver(), OtherDriver(), Line.opened
    first.open(lambda _: None)
    assert first._line is not None
    assert first._delivery is not None
    assert first._line.is_last_use_of(first._delivery)
    joining = threading.Thread(target=second.open, args=(lambda _: None,))
    joining.start()
    assert Line.opened == count + 1
    first.close()
    joining.join(PATIENCE)
    assert second._line is not None
    assert second._line is not first._line
    assert second._delivery is not None
    third = OtherDriver()
    third.open(lambda _: None)
    assert third._line is second._line
    assert not second._line.is_last_use_of(second._delivery)
    for driver in (second, third):
        driver.close()
    assert not places()
