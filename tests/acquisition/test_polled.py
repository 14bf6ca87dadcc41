"""Registers read by successive requests have records at the times at which they were read."""

import math
import socket
import time
from pathlib import Path

import numpy as np

from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Window
from otolith.acquisition.windower import Windower
from otolith_drivers.base import Sampling, Setup, Signal
from otolith_drivers.modbus.driver import Options, Source, build
from tests.acquisition.series import cut_next
from tests.conftest import free_port
from tests.drivers.modbus_servers import Behaviour, odd_server
from tests.waiting import wait_for

PERIOD, RECORDS = 0.02, 100
FREQUENCY = 2.0 * math.pi  # rad/s
REQUEST_TIME = 0.006  # s
FULL_SCALE = 10_000.0


class SineRegisters(dict[int, int]):
    """Registers that all have the value of the same sine at the time of the request."""

    def get(self, address: int, default: object = 0) -> int:
        """The register at ``address``."""
        return round(FULL_SCALE * math.sin(FREQUENCY * time.monotonic())) & 0xFFFF


def slow(reply: bytes) -> bytes:
    time.sleep(REQUEST_TIME / 2)
    return reply


def read_window(sampling: Sampling) -> float:
    """Return the median difference of two registers of separate requests in a window, relative to the amplitude.

    Values that were read at other times are compared with a line through the two nearest. The median of a sine's
    magnitude is its RMS value, but requests that a busy computer delays do not enlarge it.
    """
    port = free_port(socket.SOCK_STREAM)
    sources = [{"register": address, "type": "int16", "unit": "V"} for address in (0, 500)]
    signals = tuple(Signal(name, "V", Source.model_validate(s)) for name, s in zip("ab", sources, strict=True))
    rings = Rings(("a", "b"), 4 * RECORDS)
    plans = [SignalPlan(name, sampling=sampling) for name in ("a", "b")]
    windower = Windower(plans, RECORDS, PERIOD, QualityLimits(jitter=1.0))
    driver = build(Options(host="127.0.0.1", port=port), Setup(signals, Path(), PERIOD))
    with odd_server(Behaviour(SineRegisters(), corrupt=slow), port):
        driver.open(rings.deliver)
        windows: list[Window] = []

        def is_read() -> bool:
            """Whether the last window has most of its records, of which a busy computer skips some."""
            if windower.begin(rings, time.monotonic(), 0.0) and windower.due(rings, time.monotonic()):
                windows.append(cut_next(windower, rings))
            return bool(windows) and all((~windows[-1].missing_in(name)).sum() > RECORDS / 2 for name in ("a", "b"))

        wait_for(is_read)
        driver.close()
    window = windows[-1]
    read = {name: ~window.missing_in(name) for name in ("a", "b")}
    times = {name: window.grid.offsets[present] for name, present in read.items()}
    between = np.interp(times["a"], times["b"], window.column("b")[read["b"]])
    return float(np.median(np.abs(window.column("a")[read["a"]] - between)) / FULL_SCALE)


def test_the_skew_between_requests_is_corrected() -> None:
    skewed, corrected = read_window(Sampling.CYCLIC), read_window(Sampling.POLLED)
    assert skewed > 0.3 * FREQUENCY * REQUEST_TIME / 2  # what there is to correct
    assert corrected < 0.5 * skewed
