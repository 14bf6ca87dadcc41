"""The replay driver: a recorded file instead of a machine, in real time or as fast as its samples are taken.

    file -> [threads replay-read] chunks of rows -> [thread replay] samples at their time

A chunk is read while the one before it is delivered, so that reading delays no sample. All drivers of a process share
these threads (:mod:`otolith_drivers.replay.player`).
"""

import logging
import math
import threading
import time
from bisect import bisect_right
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Future
from dataclasses import replace
from itertools import repeat
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import ConfigDict

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup
from otolith_drivers.common.reconnection import CLOSE_TIMEOUT
from otolith_drivers.config_files import StrictModel, validated
from otolith_drivers.errors import ConfigurationError, DeviceError, OtolithError
from otolith_drivers.replay.player import Played, Playing, player, reading
from otolith_drivers.replay.readers import Array, Reader, Rows, format_of, holds_frames

# Engineering choices. The driver contract guards the delays of a stop, test_driver.py the chunks and rows at once.
CHUNK_POLL = 0.005  # s between two looks whether a chunk is read
GATHERED, MAX_GATHERED = 0.05, 0.1  # s between two deliveries at least: rows have their own times, and waking up costs
DELIVERIES = 1000  # per second in a process; of more the rows are gathered for longer
MAX_WAIT = 10.0  # s; the times of rows are taken from the clock at least so often
ROWS_MADE_AT_ONCE = 100  # whose samples are made together
MAX_ROWS_AT_ONCE = 500  # delivered together; bounds how long one call of deliver() takes
SILENCE_WARNING = 60.0  # s without a row in the file, after which the link warns

log = logging.getLogger(__name__)

Read = TypeVar("Read")


class ReplayOptions(StrictModel):
    """``[driver]`` with ``type = "replay"``."""

    file: Path  # A table, a CAN log or a recording of Otolith
    pace: Literal["real time", "as fast as possible"] = "real time"
    repeat: bool = False  # Start again at the end of the file; time goes on
    can: dict[str, Any] | None = None  # For a CAN log: the keys that [driver] with type = "can" would have
    table: dict[str, Any] | None = None  # For a table: its time, and the columns of one with a value per row


class ReplaySource(StrictModel):
    """Keys that depend on the format: ``column``, ``unit`` and others of a table, or those of the CAN driver."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)


Options, Source = ReplayOptions, ReplaySource  # for base.DriverType


def build(options: ReplayOptions, setup: Setup) -> "ReplayDriver":
    """A driver for the file, which is opened once to check that it has the signals."""
    path = setup.folder / options.file
    open_file = opener(path, options, setup)
    try:
        with open_file() as reader:
            lines, sampling = reader.describe(), reader.sampling
    except ConfigurationError as error:
        raise ConfigurationError(str(error), error.key or ("driver", "file")) from error
    title = f"recording {path}, {'in real time' if options.pace == 'real time' else options.pace}"
    lines = [title + ", repeated" * options.repeat, *lines]
    return ReplayDriver(open_file, options, setup.sample_period, lines, sampling)


def opener(path: Path, options: ReplayOptions, setup: Setup) -> Callable[[], Reader]:
    """A function that opens ``path``; raise ConfigurationError if a source or an option does not fit its format."""
    kind = format_of(path)
    own = None
    if options.table is not None and not holds_frames(path):
        own = validated(options.table, kind.Options, ("driver", "table"))
    if holds_frames(path):
        from otolith_drivers.canbus.driver import Options as CanOptions  # noqa: PLC0415 - a table needs no python-can

        if options.can is None:
            text = "missing: the description of the frames in the log: can = { dbc = ... }"
            raise ConfigurationError(text, ("driver", "can"))
        keys = {key: value for key, value in options.can.items() if key != "type"}
        own = validated(keys, CanOptions, ("driver", "can"))
    signals = tuple(
        replace(signal, source=validated(signal.source.model_dump(), kind.Source, ("signals", signal.name)))
        for signal in setup.signals
    )
    wanted = replace(setup, signals=signals)

    def open_file() -> Reader:
        try:
            return kind.open_log(path, wanted, own)
        except ConfigurationError as error:
            if error.key[:1] != ("driver",) or not holds_frames(path):
                raise
            raise ConfigurationError(str(error), ("driver", "can", *error.key[1:])) from error

    return open_file


class ReplayDriver:
    """Implements :class:`otolith_drivers.base.Driver` over a file."""

    def __init__(
        self,
        open_file: Callable[[], Reader],
        options: ReplayOptions,
        gap: float,
        description: list[str],
        sampling: Sampling | Mapping[str, Sampling] = Sampling.TRUE,
    ) -> None:
        """``gap`` is the time in seconds from the last row to the first one of the next repetition."""
        self.sampling = sampling
        self._stop = threading.Event()
        self._played: Played | None = None
        self._open_file = open_file
        self._paced, self._repeat = options.pace == "real time", options.repeat
        self._gap = gap
        self._description = description
        self._reader: Reader | None = None
        self._down_reason = "not opened yet"
        self._received = self._bad = self._bad_before = self._lost_before = 0
        self._clock = -math.inf  # s, monotonic; time of the next row, or of the last one delivered

    def open(self, deliver: Deliver) -> None:
        try:
            reader = self._open_file()
        except OtolithError as error:
            raise DeviceError(str(error)) from error
        self._down_reason, self._clock = "", time.monotonic()
        self._played = player.play(self._run(reader, deliver))

    def close(self) -> None:
        self._stop.set()
        if self._played is not None:
            player.hasten(self._played)
            self._played.ended.wait(CLOSE_TIMEOUT)

    def counters(self) -> Counters:
        reader = self._reader
        lost = self._lost_before + (0 if reader is None else reader.lost)
        return Counters(received=self._received, bad=self._bad, lost=lost)

    def link(self) -> Link:
        reader, reason = self._reader, self._down_reason  # the thread may change them
        warnings = [] if reader is None else reader.warnings()
        silence = self._clock - time.monotonic()
        if self._paced and not reason and silence > SILENCE_WARNING:
            warnings.append(f"the next row of the file comes in {silence:.0f} s")
        latency = gathered() - GATHERED if self._paced else 0.0
        return Link(up=not reason, reason=reason, warnings=tuple(warnings), latency=latency)

    def describe(self) -> list[str]:
        return self._description

    def _run(self, reader: Reader, deliver: Deliver) -> Playing:
        begin = self._clock
        try:
            while True:
                self._reader = reader
                with reader:
                    yield from self._play_once(reader, deliver, begin)
                if not self._repeat or self._stop.is_set():
                    break
                begin = self._clock + self._gap
                following = yield from _result(reading.submit(self._open_file))
                self._bad_before, self._lost_before = self._bad, self._lost_before + reader.lost
                reader = following
            self._down_reason = "closed" if self._stop.is_set() else "the recording has ended"
        except OtolithError as error:
            self._down_reason = str(error)
        except Exception as error:  # it is played no longer: the link names the cause
            self._down_reason = f"{type(error).__name__}: {error}"
            log.exception("the replay stopped with an error")

    def _play_once(self, reader: Reader, deliver: Deliver, begin: float) -> Playing:
        """Deliver the whole file, its first row at ``begin`` (s, monotonic)."""
        offset, chunks = None, reader.chunks()
        following = reading.submit(next, chunks, None)
        while (rows := (yield from _result(following))) is not None and not self._stop.is_set():
            following = reading.submit(next, chunks, None)
            if offset is None:
                offset = begin - float(rows.times[0])
            yield from self._deliver(rows, rows.times + offset, deliver)
        if rows is None:
            self._bad = self._bad_before + reader.bad

    def _deliver(self, rows: Rows, times: Array, deliver: Deliver) -> Playing:
        """Deliver each row at its time; a row that goes back in time comes with the row above it."""
        due: list[float] = np.maximum.accumulate(np.maximum(times, self._clock)).tolist()
        at, ready = 0, SamplesOfRows(rows, times)
        while at < len(due) and not self._stop.is_set():
            now, until = time.monotonic(), min(at + MAX_ROWS_AT_ONCE, len(due))
            if self._paced:
                until = bisect_right(due, now, at, until)
            if until > at:
                samples = ready.take(at, until)
                self._received += len(samples)
                self._bad = self._bad_before + int(rows.bad[until - 1])
                deliver(samples)
                self._clock, at = due[until - 1], until
            if self._paced and at < len(due):
                self._clock = due[at]
                yield min(max(self._clock, now + gathered()), now + MAX_WAIT)
            else:
                yield now


def gathered() -> float:
    """Return for how long rows are gathered at least, s: a process that plays many recordings wakes up too often."""
    return min(max(GATHERED, player.playing / DELIVERIES), MAX_GATHERED)


def _result(asked: "Future[Read]") -> Generator[float, None, Read]:
    """Wait for what another thread reads."""
    while not asked.done():
        yield time.monotonic() + CHUNK_POLL
    return asked.result()


class SamplesOfRows:
    """The samples of a chunk in the order of its rows, made for many rows at once: they are taken a few at a time."""

    def __init__(self, rows: Rows, times: Array) -> None:
        """``times`` (rows,) are monotonic, s."""
        self._rows, self._times = rows, times
        self._begin = self._end = 0  # Rows of which the samples are made
        self._made: list[Sample] = []
        self._before = [0]  # Samples before each of those rows, and after the last one

    def take(self, first: int, last: int) -> list[Sample]:
        """Return the samples of the rows from ``first`` until ``last``, none of which is before those taken last."""
        taken: list[Sample] = []
        while first < last:
            if first >= self._end:
                self._make(first, min(max(first + ROWS_MADE_AT_ONCE, last), len(self._times)))
            end = min(last, self._end)
            taken += self._made[self._before[first - self._begin] : self._before[end - self._begin]]
            first = end
        return taken

    def _make(self, first: int, last: int) -> None:
        part, names = slice(first, last), list(self._rows.columns)
        values = np.column_stack([self._rows.columns[name][part] for name in names])
        present = np.isfinite(values)
        at, column = np.nonzero(present)
        named = map(names.__getitem__, column.tolist())
        rows = zip(named, self._times[part][at].tolist(), values[present].tolist(), strict=True)
        self._made = list(map(tuple.__new__, repeat(Sample), rows))  # as Sample(...) for each, in half of the time
        self._before = [0, *np.cumsum(present.sum(axis=1)).tolist()]
        self._begin, self._end = first, last
