"""The CAN driver on real buses, and what it does with frames that no healthy node sends."""

import threading
import time
from pathlib import Path

import can
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from otolith_drivers.base import Sample
from otolith_drivers.canbus.bus import BusOptions, open_bus
from otolith_drivers.canbus.driver import CanReceiver, Options, build, monotonic_of
from otolith_drivers.conformance import Rig
from otolith_drivers.errors import DeviceError
from tests.conftest import OwnMachine
from tests.drivers.rigs import SETUP, can_rig
from tests.waiting import PATIENCE


def collect(rig: Rig, enough: int) -> list[Sample]:
    """Open the driver and let its source speak until there are enough samples."""
    got: list[Sample] = []
    rig.driver.open(got.extend)
    deadline = time.monotonic() + PATIENCE
    while len(got) < enough and time.monotonic() < deadline:
        rig.say()
        time.sleep(0.01)
    return got


def receiver(machine: OwnMachine) -> CanReceiver:
    options = Options(interface="udp_multicast", channel=machine.group, port=machine.port, dbc=Path("dc-motor.dbc"))
    return build(options, SETUP)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(st.sampled_from([385, 641, 7]), st.binary(max_size=8), st.booleans(), st.booleans())
def test_any_frame_is_decoded_or_counted(
    own_machine: OwnMachine, identifier: int, data: bytes, remote: bool, error: bool
) -> None:
    driver, got = receiver(own_machine), list[Sample]()
    frame = can.Message(
        arbitration_id=identifier,
        data=None if remote else data,
        is_extended_id=False,
        is_remote_frame=remote,
        is_error_frame=error,
    )
    got.extend(driver._decoder.decode(frame, 0.0))
    counters = driver.counters()
    wanted = identifier != 7 and not remote and not error
    assert (counters.received + counters.bad > 0) == wanted
    assert len(got) == counters.received


def test_buses_on_the_same_port_do_not_hear_each_other(own_machine: OwnMachine) -> None:
    options = BusOptions(interface="udp_multicast", channel="239.74.163.77", port=own_machine.port)
    with can_rig(own_machine) as rig:
        got: list[Sample] = []
        rig.driver.open(got.extend)
        stranger = open_bus(options)
        for _ in range(20):
            stranger.send(can.Message(arbitration_id=385, data=bytes(8), is_extended_id=False))
        stranger.shutdown()
        while len(got) < 4:
            rig.say()
            time.sleep(0.01)
        assert all(sample.value != 0.0 for sample in got if sample.signal == "i")
        rig.driver.close()


def test_a_frame_that_cannot_be_unpacked_does_not_cost_the_bus(own_machine: OwnMachine) -> None:
    import socket  # noqa: PLC0415 - to send what no CAN node would

    with can_rig(own_machine) as rig:
        collect(rig, 2)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            for _ in range(5):
                sender.sendto(b"\xc1 no frame", (own_machine.group, own_machine.port))
        deadline = time.monotonic() + PATIENCE
        while rig.driver.counters().bad < 5 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert rig.driver.counters().bad == 5
        assert rig.driver.counters().reconnects == 0
        assert rig.driver.link().up
        rig.driver.close()


def test_a_bus_that_breaks_is_opened_again(own_machine: OwnMachine, monkeypatch: pytest.MonkeyPatch) -> None:
    with can_rig(own_machine) as rig:
        collect(rig, 2)
        broken = threading.Event()
        original = can.BusABC.recv

        def recv(self: can.BusABC, timeout: float | None = None) -> can.Message | None:
            if not broken.is_set():
                broken.set()
                raise OSError("Network is down")
            return original(self, timeout)

        monkeypatch.setattr(can.BusABC, "recv", recv)
        deadline = time.monotonic() + PATIENCE
        while rig.driver.counters().reconnects == 0 and time.monotonic() < deadline:
            time.sleep(0.01)
        received = rig.driver.counters().received
        while rig.driver.counters().received == received and time.monotonic() < deadline:
            rig.say()
            time.sleep(0.01)
        assert rig.driver.counters().reconnects == 1
        assert rig.driver.counters().received > received
        rig.driver.close()


@pytest.mark.parametrize("interface", ["socketcan", "auto"])
def test_a_bus_that_is_not_there_is_a_device_error(interface: str) -> None:
    """A real channel has no stand-in: a bus where nobody speaks would look like a silent drive."""
    with pytest.raises(DeviceError, match="can7"):
        open_bus(BusOptions(interface=interface, channel="can7"))


def test_a_channel_that_the_interface_does_not_know_is_refused() -> None:
    with pytest.raises(ValueError, match="udp_multicast takes a group"):
        BusOptions(interface="udp_multicast", channel="vcan9")


@pytest.mark.parametrize(
    ("stamp", "expected"),
    [(1000.0, 50.0), (999.99, 49.99), (1000.5, 50.0), (0.0, 50.0), (2000.0, 50.0)],
    ids=["now", "a little ago", "wall clock set back", "stamp since start", "wall clock set forward"],
)
def test_stamps_land_on_the_monotonic_clock(stamp: float, expected: float) -> None:
    assert monotonic_of(stamp, wall=1000.0, monotonic=50.0) == pytest.approx(expected)
