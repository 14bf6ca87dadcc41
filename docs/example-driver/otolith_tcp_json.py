"""A driver for Otolith: a device that sends its readings as JSON over TCP, one line per reading.

{"speed": 10.2, "current": 1.98}
"""

import json
import logging
import math
import socket
import time
from typing import Annotated

from pydantic import Field

from otolith_drivers.base import Conversion, Counters, Deliver, Link, Sample, Sampling, ScaledSource, Setup
from otolith_drivers.common.reconnection import Reconnection, ThreadedDriver, cause_of
from otolith_drivers.config_files import StrictModel

MAX_LINE = 4096  # bytes
CONNECT_TIMEOUT = 0.5  # s; below the second in which a driver closes
STOP_DELAY = 0.2  # s that a stop may go unnoticed
SILENCE_TIMEOUT = 2.0  # s without data, after which the connection counts as broken: a pulled cable sends no end

log = logging.getLogger(__name__)


class Options(StrictModel):
    """The keys of ``[driver]`` except ``type``."""

    host: str
    port: Annotated[int, Field(ge=1, le=65535)]


class Source(ScaledSource):
    """The keys of each signal in ``[signals]``: ``key``, and ``unit``, ``scale``, ``offset`` and ``range``."""

    key: str
    """Key in the JSON object."""
    unit: str


def build(options: Options, setup: Setup) -> "TcpJson":
    """Return a driver that is not open yet.

    Raises:
        ConfigurationError: a unit has the wrong dimension.
    """
    signals = {signal.name: (signal.source.key, Conversion.for_signal(signal)) for signal in setup.signals}
    return TcpJson(options, signals)


class TcpJson(ThreadedDriver):
    """Implements the protocol ``otolith_drivers.base.Driver``; ``close`` is that of ``ThreadedDriver``."""

    sampling = Sampling.CYCLIC

    def __init__(self, options: Options, signals: dict[str, tuple[str, Conversion]]) -> None:
        """``signals`` has, by signal, the JSON key and the conversion to the unit of the twin."""
        super().__init__()
        self._place, self._signals = (options.host, options.port), signals
        self._connection = Reconnection(f"JSON over TCP {options.host}:{options.port}", log)
        self._received = self._bad = 0

    def open(self, deliver: Deliver) -> None:
        """Start the thread, which connects and reconnects."""
        self._start("tcp-json", self._run, deliver)

    def counters(self) -> Counters:
        """Return the counts so far."""
        return Counters(self._received, self._bad, reconnects=self._connection.count)

    def link(self) -> Link:
        """Return whether readings arrive, or why not."""
        return Link(*self._connection.state)

    def describe(self) -> list[str]:
        """Return a line per fact, for ``otolith check``."""
        lines = [f"{name} from {key}" for name, (key, _) in self._signals.items()]
        return [f"JSON over TCP {self._place[0]}:{self._place[1]}", *lines]

    def _run(self, deliver: Deliver) -> None:
        while not self._stop.is_set():
            try:
                self._listen(deliver)
            except (OSError, UnicodeError) as error:  # UnicodeError: a host name that cannot be one
                self._connection.go_down(cause_of(error))
            self._stop.wait(self._connection.backoff.next())

    def _listen(self, deliver: Deliver) -> None:
        """Take lines until the driver is closed; an end of the connection is an OSError."""
        with socket.create_connection(self._place, CONNECT_TIMEOUT) as device:
            device.settimeout(STOP_DELAY)
            rest, latest = b"", time.monotonic()
            while not self._stop.is_set():
                try:
                    data = device.recv(MAX_LINE)
                except TimeoutError as error:
                    if time.monotonic() - latest > SILENCE_TIMEOUT:
                        raise ConnectionAbortedError(f"silent for {SILENCE_TIMEOUT:g} s") from error
                    continue
                if not data:
                    raise ConnectionAbortedError("the device has closed the connection")
                latest = time.monotonic()
                *lines, rest = (rest + data).split(b"\n")
                if len(rest) > MAX_LINE:
                    raise ConnectionAbortedError(f"a line of over {MAX_LINE} bytes")
                for line in lines:
                    self._take(line, latest, deliver)

    def _take(self, line: bytes, moment: float, deliver: Deliver) -> None:
        try:
            reading = json.loads(line)
            values = {name: conversion.value(reading[key]) for name, (key, conversion) in self._signals.items()}
        except (ValueError, KeyError, TypeError, RecursionError):  # no line may end the thread
            self._bad += 1
            return
        self._connection.come_up("sends readings")
        usable = sum(map(math.isfinite, values.values()))
        self._received += usable
        self._bad += len(values) - usable
        deliver([Sample(name, moment, value) for name, value in values.items()])
