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

LONGEST = 1500  # bytes of a datagram
WAKE = 0.2  # s; how late a stop can be noticed
SILENCE = 2.0  # s, after which the device is taken to be gone


class Options(StrictModel):
    """The keys of ``[driver]`` beside ``type``."""

    port: Annotated[int, Field(ge=1024, le=65535)]


class Source(StrictModel):
    """The keys of each of ``[signals]``."""

    key: str
    """In the JSON object."""
    unit: str


def build(options: Options, setup: Setup) -> "UdpJson":
    """What the registry calls: a driver ready to be opened."""
    conversions = {}
    for signal in setup.signals:
        try:
            conversions[signal.name] = (signal.source.key, *factor(signal.source.unit, signal.unit))
        except ValueError as error:  # told with file, line and key by the daemon
            raise ConfigurationError(str(error), ("signals", signal.name)) from error
    return UdpJson(options.port, conversions)


class UdpJson:
    """Implements the protocol ``otolith_drivers.base.Driver``."""

    sampling = Sampling.CYCLIC

    def __init__(self, port: int, conversions: dict[str, tuple[str, float, float]]) -> None:
        """``conversions``: of each signal its key, and scale and offset to the unit that is wanted."""
        self._port = port
        self._conversions = conversions
        self._received = self._bad = 0
        self._latest = -math.inf
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, deliver: Deliver) -> None:
        """Start to listen."""
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            listener.bind(("127.0.0.1", self._port))
        except OSError as error:
            listener.close()
            raise DeviceError(f"UDP port {self._port}: {error.strerror}; set another driver.port") from error
        listener.settimeout(WAKE)
        self._thread = threading.Thread(target=self._listen, args=(listener, deliver), name="udp-json", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def counters(self) -> Counters:
        """So far."""
        return Counters(received=self._received, bad=self._bad)

    def link(self) -> Link:
        """A socket is always open; what counts is whether somebody speaks."""
        silent = time.monotonic() - self._latest
        if math.isinf(silent):
            return Link(up=False, reason="nothing has come yet")
        return Link(up=silent < SILENCE, reason="" if silent < SILENCE else f"silent for {silent:.0f} s")

    def describe(self) -> list[str]:
        """For ``otolith check``."""
        return [f"JSON over UDP, port {self._port}"] + [
            f"{name} from {key}" for name, (key, _, _) in self._conversions.items()
        ]

    def _listen(self, listener: socket.socket, deliver: Deliver) -> None:
        with listener:
            while not self._stop.is_set():
                try:
                    datagram = listener.recv(LONGEST)
                except TimeoutError:
                    continue
                self._take(datagram, time.monotonic(), deliver)

    def _take(self, datagram: bytes, moment: float, deliver: Deliver) -> None:
        try:
            found = json.loads(datagram)
            samples = [
                Sample(name, moment, scale * float(found[key]) + offset)
                for name, (key, scale, offset) in self._conversions.items()
            ]
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):  # whatever comes, the thread goes on
            self._bad += 1
            return
        self._latest = moment
        self._received += len(samples)
        deliver(samples)
