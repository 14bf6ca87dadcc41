"""Registers of different requests, read one after the other, come to stand at the same moments of the grid."""

import math
import socket
import time
from pathlib import Path

import numpy as np

from otolith.acquisition.alignment import Limits
from otolith.acquisition.ring import Rings
from otolith.acquisition.windower import Windower
from otolith_drivers.base import Sampling, Setup, Signal
from otolith_drivers.modbus.driver import Options, Source, build
from tests.conftest import free_port
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.waiting import PATIENCE

PERIOD, RECORDS = 0.02, 100
FREQUENCY = 2.0 * math.pi  # rad/s
LATER = 0.006  # s that a request takes
FULL = 10_000.0


class Moving(dict[int, int]):
    """Registers that all show the same sine at the moment at which they are asked."""

    def get(self, address: int, default: object = 0) -> int:
        """The register at ``address``."""
        return round(FULL * math.sin(FREQUENCY * time.monotonic())) & 0xFFFF


def slow(reply: bytes) -> bytes:
    time.sleep(LATER / 2)
    return reply


def read_window(sampling: Sampling) -> float:
    """Root mean square difference of two registers, 500 addresses apart, in a window of the sine; of its amplitude."""
    port = free_port(socket.SOCK_STREAM)
    sources = [{"register": address, "type": "int16", "unit": "V"} for address in (0, 500)]
    signals = tuple(Signal(name, "V", Source.model_validate(s)) for name, s in zip("ab", sources, strict=True))
    rings = Rings(("a", "b"), 4 * RECORDS)
    windower = Windower(("a", "b"), RECORDS, PERIOD, Limits(missing=1.0, gap=10.0, jitter=1.0), sampling)
    driver = build(Options(host="127.0.0.1", port=port), Setup(signals, Path(), PERIOD))
    with odd_server(Behaviour(Moving(), spoil=slow), port):
        driver.open(rings.deliver)
        begun = time.monotonic()
        while not (windower.begin(rings, time.monotonic(), 0.0) and windower.due(rings, time.monotonic())):
            assert time.monotonic() < begun + PATIENCE
            time.sleep(0.01)
        window = windower.cut(rings, 0.0)
        driver.close()
    there = ~window.missing.any(axis=1)
    assert there.sum() > RECORDS / 2
    apart = (window.values[:, 0] - window.values[:, 1])[there]
    return float(np.sqrt(np.mean(apart**2)) / FULL)


def test_the_skew_between_requests_is_taken_out() -> None:
    skewed, corrected = read_window(Sampling.CYCLIC), read_window(Sampling.POLLED)
    assert skewed > 0.3 * FREQUENCY * LATER / 2  # what there is to correct
    assert corrected < 0.5 * skewed
