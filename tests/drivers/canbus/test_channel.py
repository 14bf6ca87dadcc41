"""Machines on one CAN bus: one reader, and each has the frames of its own identifiers."""

import logging
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import can
import pytest

from otolith_drivers.base import Sample, Setup
from otolith_drivers.canbus import bus as can_bus
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.channel import MAX_SILENCE, UNKNOWN_PERIOD_SILENCE, CanChannel, CanListener
from otolith_drivers.canbus.driver import CanOptions, CanReceiver, build
from otolith_drivers.common.sharing import Delivery
from tests.conftest import OwnMachine
from tests.drivers.can_frames import decoder, frame, signals
from tests.waiting import wait_for


@dataclass(slots=True)
class Machine:
    """A driver that listens to one identifier."""

    driver: CanReceiver
    identifier: int
    samples: list[Sample]

    @property
    def channel(self) -> CanChannel:
        assert self.driver._hearing is not None
        return self.driver._hearing.channel


class Bus:
    """A virtual bus on which machines send and are listened to."""

    def __init__(self, own: OwnMachine) -> None:
        self.options = BusOptions(interface="udp_multicast", channel=own.group, port=own.port)
        self.line, self._stack = open_bus(self.options), ExitStack()

    def machine(self, identifier: int) -> Machine:
        source = {"id": f"0x{identifier:X}", "start": 0, "length": 16, "unit": "V"}
        setup = Setup(signals({"V_a": ("V", source)}), Path(), 0.01)
        driver, samples = build(CanOptions(**self.options.model_dump()), setup), list[Sample]()
        driver.open(samples.extend)
        self._stack.callback(driver.close)
        return Machine(driver, identifier, samples)

    def come(self, *machines: Machine, count: int = 1) -> None:
        """Send frames of the machines until each has so many samples more."""
        before = [len(machine.samples) for machine in machines]

        def all_came() -> bool:
            for machine in machines:
                self.line.send(frame(machine.identifier, bytes(8)))
            return all(len(one.samples) >= start + count for one, start in zip(machines, before, strict=True))

        wait_for(all_came)

    def close(self) -> None:
        self._stack.close()
        self.line.shutdown()


@pytest.fixture
def bus(own_machine: OwnMachine) -> Iterator[Bus]:
    line = Bus(own_machine)
    yield line
    line.close()


def test_the_filters_of_the_bus_are_those_of_all_who_are_there(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_bus, "FILTERING", {"udp_multicast"})  # python-can filters instead of the kernel
    first = bus.machine(0x101)
    bus.come(first)
    second = bus.machine(0x102)
    bus.come(first, second)
    channel = first.channel
    second.driver.close()
    wait_for(lambda: channel._has_filters)
    before = channel.frames
    for _ in range(20):
        bus.line.send(frame(0x102, bytes(8)))
    bus.come(first)
    assert channel.frames - before < 20


def test_any_frame_shows_that_the_controller_is_back_on_the_bus(bus: Bus) -> None:
    first, second = bus.machine(0x101), bus.machine(0x102)
    bus.line.send(can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True, is_extended_id=False))
    wait_for(lambda: not first.driver.link().up and not second.driver.link().up)
    bus.come(first)
    wait_for(lambda: first.driver.link().up and second.driver.link().up)


def test_a_bus_that_fails_is_one_reconnection_of_each_machine_that_was_there(
    bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = bus.machine(0x101), bus.machine(0x102)
    broken, receive = threading.Event(), can.BusABC.recv

    def fail_once(self: can.BusABC, timeout: float | None = None) -> can.Message | None:
        if not broken.is_set():
            broken.set()
            raise OSError("Network is down")
        return receive(self, timeout)

    monkeypatch.setattr(can.BusABC, "recv", fail_once)
    wait_for(lambda: first.driver.counters().reconnects > 0)
    third = bus.machine(0x103)
    bus.come(first, second, third)
    assert [each.driver.counters().reconnects for each in (first, second, third)] == [1, 1, 0]


def test_dropped_frames_are_lost_in_shares(bus: Bus) -> None:
    first, second = bus.machine(0x101), bus.machine(0x102)
    bus.come(first, second, count=20)
    first.channel.drops.total += 100
    lost = [each.driver.counters().lost for each in (first, second)]
    assert sum(lost) == pytest.approx(100, abs=2)
    assert min(lost) > 30
    third = bus.machine(0x103)  # which was not there
    bus.come(third)
    assert third.driver.counters().lost == 0


def test_a_machine_with_another_kind_of_frames_has_a_connection_of_its_own(bus: Bus) -> None:
    first = bus.machine(0x101)
    bus.options = bus.options.model_copy(update={"fd": True})
    second = bus.machine(0x102)
    assert first.channel is not second.channel
    bus.come(first, second)


def test_two_spellings_of_an_adapter_are_one_and_its_options_must_agree(tmp_path: Path) -> None:
    (tmp_path / "adapter").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "adapter")
    one = BusOptions(interface="slcan", channel=str(tmp_path / "adapter"), bitrate="500 kbit/s")
    same, other = (
        one.model_copy(update={"channel": str(tmp_path / "by-id"), "bitrate": rate}) for rate in (5e5, 2.5e5)
    )
    assert one.place() == same.place() == other.place()
    assert one.agreed() == same.agreed() != other.agreed()


def test_a_slow_machine_holds_up_the_reopening_of_a_silent_bus_for_a_minute_at_most(tmp_path: Path) -> None:
    requests = {"V_a": ("V", {"id": "0x101", "start": 0, "length": 16, "unit": "V"})}
    frames = {period: decoder(tmp_path, requests) for period in (0.01, 1.0, 60.0)}
    for period, one in frames.items():
        for number in range(300):
            one.decode(frame(0x101, bytes(8)), number * period)
    channel = CanChannel(BusOptions(interface="virtual"))
    limits = []
    for periods in ((0.01,), (0.01, 1.0), (0.01, 60.0), (60.0,), ()):
        channel.users = tuple(
            CanListener(frames[one], Delivery(lambda _: None, logging.getLogger())) for one in periods
        )
        limits.append(channel._silence_limit())
    assert limits == pytest.approx([2.0, 10.0, MAX_SILENCE, 600.0, UNKNOWN_PERIOD_SILENCE], rel=0.01)
