"""The example driver keeps the contract of all drivers; run it with pytest in this folder."""

import json
import socket
from collections.abc import Callable
from pathlib import Path

import otolith_udp_json
import pytest

from otolith_drivers.base import Setup, Signal
from otolith_drivers.contract import CONTRACT, Rig


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize("promise", CONTRACT, ids=lambda promise: promise.__name__)
def test_the_driver_keeps_the_contract(promise: Callable[[Rig], None]) -> None:
    port = free_port()
    signals = (
        Signal("omega", "rad/s", otolith_udp_json.Source(key="speed", unit="rpm")),
        Signal("i", "A", otolith_udp_json.Source(key="current", unit="mA")),
    )
    driver = otolith_udp_json.build(otolith_udp_json.Options(port=port), Setup(signals, Path(), 0.01))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as device:
        reading = json.dumps({"speed": 60.0, "current": 500.0}).encode()
        expected = {"omega": 2 * 3.141592653589793, "i": 0.5}
        promise(Rig(driver, expected, lambda: device.sendto(reading, ("127.0.0.1", port))))
        driver.close()
