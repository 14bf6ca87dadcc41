"""The example driver keeps the contract of all drivers. Run with pytest in this folder."""

import json
import socket
import time
from collections.abc import Callable
from pathlib import Path

import otolith_udp_json
import pytest

from otolith_drivers.base import Setup, Signal
from otolith_drivers.conformance import CONTRACT, Rig


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def build_driver(port: int) -> otolith_udp_json.UdpJson:
    signals = (
        Signal("omega", "rad/s", otolith_udp_json.Source(key="speed", unit="rpm")),
        Signal("i", "A", otolith_udp_json.Source(key="current", unit="mA")),
    )
    return otolith_udp_json.build(otolith_udp_json.Options(port=port), Setup(signals, Path(), 0.01))


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.__name__)
def test_the_driver_keeps_the_contract(check: Callable[[Rig], None]) -> None:
    port = free_port()
    driver = build_driver(port)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        reading = json.dumps({"speed": 60.0, "current": 500.0}).encode()
        expected = {"omega": 2 * 3.141592653589793, "i": 0.5}
        check(Rig(driver, expected, lambda: device.sendto(reading, ("127.0.0.1", port))))
        driver.close()


BAD_DATAGRAMS = (
    b"",
    b"\xff\xfe",
    b"[]",
    b"{}",
    b'{"speed": "x", "current": 1}',
    b"[" * 1400,
    b'{"speed": 1%s}' % (b"0" * 400),
)


def test_no_datagram_ends_the_thread() -> None:
    port = free_port()
    driver = build_driver(port)
    driver.open(lambda samples: None)
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
            for datagram in (*BAD_DATAGRAMS, b'{"speed": 60, "current": 500}'):
                device.sendto(datagram, ("127.0.0.1", port))
        deadline = time.monotonic() + 30.0
        while driver.counters().received < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        counters = driver.counters()
        assert (counters.received, counters.bad) == (2, len(BAD_DATAGRAMS))
    finally:
        driver.close()
