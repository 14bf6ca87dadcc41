"""A driver for Otolith: a device that sends its readings as JSON over UDP, one datagram per reading.

{"speed": 10.2, "current": 1.98}
"""

import json
import math
import socket
import threading
import time
from typing import Annotated

from pydantic import Field

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.units import factor

MAX_DATAGRAM = 1500  # bytes
STOP_DELAY = 0.2  # s that a stop may go unnoticed
SILENCE_TIMEOUT = 2.0  # s without a datagram, after which the device counts as disconnected


class Options(StrictModel):
    """The keys of ``[driver]`` except ``type``."""

    port: Annotated[int, Field(ge=1024, le=65535)]


class Source(StrictModel):
    """The keys of each signal in ``[signals]``."""

    key: str
    """Key in the JSON object."""
    unit: str


def build(options: Options, setup: Setup) -> "UdpJson":
    """Return a driver that is not open yet.

    Raises:
        ConfigurationError: a unit has the wrong dimension.
    """
    conversions = {}
    for signal in setup.signals:
        try:
            conversions[signal.name] = (signal.source.key, *factor(signal.source.unit, signal.unit))
        except ValueError as error:  # the daemon adds file and line
            raise ConfigurationError(str(error), ("signals", signal.name)) from error
    return UdpJson(options.port, conversions)


class UdpJson:
    """Implements the protocol ``otolith_drivers.base.Driver``."""

    sampling = Sampling.CYCLIC

    def __init__(self, port: int, conversions: dict[str, tuple[str, float, float]]) -> None:
        """``conversions`` has, by signal, the JSON key, and scale and offset to the unit of the twin."""
        self._port = port
        self._conversions = conversions
        self._received = self._bad = 0
        self._latest = -math.inf
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, deliver: Deliver) -> None:
        """Bind the port and start the thread."""
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            listener.bind(("127.0.0.1", self._port))
        except OSError as error:
            listener.close()
            raise DeviceError(f"UDP port {self._port}: {error.strerror}; set another driver.port") from error
        listener.settimeout(STOP_DELAY)
        self._thread = threading.Thread(target=self._listen, args=(listener, deliver), name="udp-json", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def counters(self) -> Counters:
        """Return the counts so far."""
        return Counters(received=self._received, bad=self._bad)

    def link(self) -> Link:
        """Return whether datagrams arrive: a UDP socket itself is always up."""
        silent = time.monotonic() - self._latest
        if math.isinf(silent):
            return Link(up=False, reason="no datagram has arrived yet")
        up = silent < SILENCE_TIMEOUT
        return Link(up=up, reason="" if up else f"silent for {silent:.0f} s")

    def describe(self) -> list[str]:
        """Return a line per fact, for ``otolith check``."""
        return [f"JSON over UDP, port {self._port}"] + [
            f"{name} from {key}" for name, (key, _, _) in self._conversions.items()
        ]

    def _listen(self, listener: socket.socket, deliver: Deliver) -> None:
        with listener:
            while not self._stop.is_set():
                try:
                    datagram = listener.recv(MAX_DATAGRAM)
                except TimeoutError:
                    continue
                self._take(datagram, time.monotonic(), deliver)

    def _take(self, datagram: bytes, moment: float, deliver: Deliver) -> None:
        try:
            reading = json.loads(datagram)
            samples = [
                Sample(name, moment, scale * float(reading[key]) + offset)
                for name, (key, scale, offset) in self._conversions.items()
            ]
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):  # no datagram may end the thread
            self._bad += 1
            return
        self._latest = moment
        self._received += len(samples)
        deliver(samples)
