"""The CAN driver on real buses: frames that no healthy node sends, and buses that fail."""

import errno
import gc
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.base import Sample
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.channel import monotonic_of
from otolith_drivers.canbus.driver import CanReceiver, Options, build
from otolith_drivers.conformance import Rig
from otolith_drivers.errors import DeviceError
from tests.conftest import OwnMachine
from tests.drivers.rigs import SETUP, can_rig
from tests.messages import raises_saying
from tests.waiting import wait_for


def emit_until(rig: Rig, condition: Callable[[], bool]) -> None:
    """Let the source emit until ``condition`` holds."""

    def emitted_and_checked() -> bool:
        rig.emit()
        return condition()

    wait_for(emitted_and_checked)


def opened(rig: Rig) -> list[Sample]:
    """The samples of the driver, which is opened and has received two."""
    samples: list[Sample] = []
    rig.driver.open(samples.extend)
    emit_until(rig, lambda: len(samples) >= 2)
    return samples


def receiver(machine: OwnMachine) -> CanReceiver:
    options = Options(interface="udp_multicast", channel=machine.group, port=machine.port, dbc=Path("dc-motor.dbc"))
    return build(options, SETUP)


@given(st.sampled_from([385, 641, 7]), st.binary(max_size=8), st.booleans(), st.booleans())
def test_any_frame_is_decoded_or_counted(
    own_machine: OwnMachine, identifier: int, data: bytes, remote: bool, error: bool
) -> None:
    driver = receiver(own_machine)
    frame = can.Message(
        arbitration_id=identifier,
        data=None if remote else data,
        is_extended_id=False,
        is_remote_frame=remote,
        is_error_frame=error,
    )
    samples = driver._decoder.decode(frame, 0.0)
    counters = driver.counters()
    wanted = identifier != 7 and not remote and not error
    assert (counters.received + counters.bad > 0) == wanted
    assert len(samples) == counters.received


def test_buses_on_the_same_port_are_separate(own_machine: OwnMachine) -> None:
    options = BusOptions(interface="udp_multicast", channel="239.74.163.77", port=own_machine.port)
    with can_rig(own_machine) as rig:
        samples: list[Sample] = []
        rig.driver.open(samples.extend)
        other_bus = open_bus(options)
        for _ in range(20):
            other_bus.send(can.Message(arbitration_id=385, data=bytes(8), is_extended_id=False))
        other_bus.shutdown()
        emit_until(rig, lambda: len(samples) >= 4)
        assert all(sample.value != 0.0 for sample in samples if sample.signal == "i")
        rig.driver.close()


def test_unreadable_frames_do_not_close_the_bus(own_machine: OwnMachine) -> None:
    with can_rig(own_machine) as rig:
        opened(rig)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for _ in range(5):
                sender.sendto(b"\xc1 no frame", (own_machine.group, own_machine.port))
        wait_for(lambda: rig.driver.counters().bad >= 5)
        assert rig.driver.counters().bad == 5
        assert rig.driver.counters().reconnects == 0
        assert rig.driver.link().up
        rig.driver.close()


def test_frames_of_a_busy_bus_are_gathered_and_keep_their_times(
    own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A frame that cannot be unpacked costs none of the frames that were received together with it."""
    monkeypatch.setattr("otolith_drivers.canbus.channel.GATHERING_TIME", 0.2)  # a bus of 20 frames/s is busy
    with can_rig(own_machine) as rig, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        samples = opened(rig)
        driver = rig.driver
        assert isinstance(driver, CanReceiver)
        hearing = driver._hearing
        assert hearing is not None
        emit_until(rig, lambda: hearing.channel._gathers)
        rig.emit()
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        sender.sendto(b"\xc1 no frame", (own_machine.group, own_machine.port))
        before = len(samples)
        for _ in range(20):
            rig.emit()
        wait_for(lambda: len(samples) >= before + 40 and len(samples) == driver.counters().received)
        assert len({sample.time for sample in samples}) == len(samples)
        assert (driver.counters().bad, driver.counters().reconnects) == (1, 0)
        driver.close()


def test_only_frames_with_the_time_of_the_kernel_are_gathered() -> None:
    assert BusOptions(channel="can0").stamped_by_kernel
    assert not BusOptions(interface="slcan", channel="/dev/ttyACM0").stamped_by_kernel


def test_broken_bus_is_reopened(own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    with can_rig(own_machine) as rig:
        opened(rig)
        broken = threading.Event()
        original = can.BusABC.recv

        def recv(self: can.BusABC, timeout: float | None = None) -> can.Message | None:
            if not broken.is_set():
                broken.set()
                raise OSError("Network is down")
            return original(self, timeout)

        monkeypatch.setattr(can.BusABC, "recv", recv)
        wait_for(lambda: rig.driver.counters().reconnects > 0)
        received = rig.driver.counters().received
        emit_until(rig, lambda: rig.driver.counters().received > received)
        assert rig.driver.counters().reconnects == 1
        rig.driver.close()


@pytest.mark.parametrize("interface", ["socketcan", "auto"])
def test_missing_bus_is_a_device_error(interface: str) -> None:
    """A real channel has no substitute: an empty bus would look like a silent drive."""
    with pytest.raises(DeviceError, match="can7"):
        open_bus(BusOptions(interface=interface, channel="can7"))


def test_a_bus_that_cannot_be_opened_is_nothing_but_an_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """python-can logs that the bus which it could not open was not shut down."""

    def refuse(*_: object) -> None:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    with monkeypatch.context() as patched:
        patched.setattr(socket.socket, "bind", refuse)
        with raises_saying(DeviceError, "No such device", "multicast route"):
            open_bus(BusOptions(interface="udp_multicast"))
    gc.collect()
    assert caplog.messages == []


def test_channel_unknown_to_the_interface_is_refused() -> None:
    with pytest.raises(ValueError, match="udp_multicast takes a group"):
        BusOptions(interface="udp_multicast", channel="vcan9")


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [(1000.0, 50.0), (999.99, 49.99), (1000.5, 50.0), (0.0, 50.0), (2000.0, 50.0)],
    ids=["now", "a little ago", "wall clock set back", "stamp since start", "wall clock set forward"],
)
def test_stamps_are_on_the_monotonic_clock(stamp: float, expected: float) -> None:
    assert monotonic_of(stamp, wall=1000.0, monotonic=50.0) == pytest.approx(expected)
