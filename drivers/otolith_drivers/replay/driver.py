"""The replay driver: a recording in the place of a machine, in real time or as fast as its samples are taken.

    file -> [thread replay-read] rows -> [thread replay] samples at their time

What is read lies ahead of what is delivered, so that a long stretch of a file holds nothing up.

Reading a file ahead of its use, so that a long stretch of it holds nothing up.
"""

import contextlib
import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ConfigDict

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup, Signal
from otolith_drivers.config_files import StrictModel, validated
from otolith_drivers.errors import ConfigurationError, DeviceError, OtolithError
from otolith_drivers.replay.readers import Array, Reader, Rows, format_of, holds_frames

AHEAD = 2  # stretches
POLL = 0.1  # s; how late an end can be noticed


def read_ahead(stretches: Iterator[Rows], stop: threading.Event) -> Iterator[Rows]:
    """``stretches``, read in a thread of its own until ``stop`` is set; what it raises is raised here."""
    ready: queue.Queue[Rows | Exception | None] = queue.Queue(AHEAD)
    ended = threading.Event()
    thread = threading.Thread(target=_read, args=(stretches, ready, ended), name="replay-read", daemon=True)
    thread.start()
    try:
        while not stop.is_set():
            with contextlib.suppress(queue.Empty):
                entry = ready.get(timeout=POLL)
                if isinstance(entry, Exception):
                    raise entry
                if entry is None:
                    return
                yield entry
    finally:
        ended.set()
        thread.join(timeout=1.0)


def _read(stretches: Iterator[Rows], ready: "queue.Queue[Rows | Exception | None]", ended: threading.Event) -> None:
    def give(entry: Rows | Exception | None) -> bool:
        while not ended.is_set():
            with contextlib.suppress(queue.Full):
                ready.put(entry, timeout=POLL)
                return True
        return False

    try:
        for rows in stretches:
            if not give(rows):
                return
        give(None)
    except Exception as error:  # noqa: BLE001 - it is raised again where the rows are used
        give(error)


log = logging.getLogger(__name__)

AT_ONCE = 500  # rows that are delivered together, at most
LONGEST_WAIT = 0.2  # s; how late a stop can be noticed
LONG_SILENCE = 60.0  # s without a row in the file, after which it is worth a word


class Options(StrictModel):
    """``[driver]`` with ``type = "replay"``."""

    file: Path
    """A table, a log of a CAN bus or a recording of ours."""
    pace: Literal["real time", "as fast as possible"] = "real time"
    repeat: bool = False
    """Begin again at the end, as if the machine went on."""
    can: dict[str, Any] | None = None
    """For a log of a CAN bus: what ``[driver]`` with ``type = "can"`` would say of its frames."""


class Source(StrictModel):
    """Depends on the file: ``column`` and ``unit`` for a table, what the CAN driver takes for a log of a bus."""

    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)


def build(options: Options, setup: Setup) -> "Replayer":
    """A driver for the file, which is looked into for the signals."""
    path = setup.folder / options.file
    open_file = opener(path, options, setup)
    try:
        with open_file() as reader:
            lines = reader.describe()
    except ConfigurationError as error:
        raise ConfigurationError(str(error), error.key or ("driver", "file")) from error
    title = f"recording {path}, {'in real time' if options.pace == 'real time' else options.pace}"
    return Replayer(open_file, options, setup.sample_period, [title + ", over and over" * options.repeat, *lines])


def opener(path: Path, options: Options, setup: Setup) -> Callable[[], Reader]:
    """What opens ``path`` as often as it is asked to, with the sources of ``setup`` read as its format wants them.

    Raises:
        ConfigurationError: a source or the table ``can`` is not what the format asks for.
    """
    kind = format_of(path)
    can = None
    if holds_frames(path):
        from otolith_drivers.canbus.driver import Options as CanOptions  # noqa: PLC0415 - a table needs no python-can

        if options.can is None:
            raise ConfigurationError(
                "missing: what is in the frames of the log: can = { dbc = ... }", ("driver", "can")
            )
        said = {key: value for key, value in options.can.items() if key != "type"}
        can = validated(said, CanOptions, ("driver", "can"))
    signals = tuple(
        Signal(entry.name, entry.unit, validated(entry.source.model_dump(), kind.Source, ("signals", entry.name)))
        for entry in setup.signals
    )
    wanted = Setup(signals, setup.folder, setup.sample_period)

    def open_file() -> Reader:
        try:
            return kind.open_log(path, wanted, can)
        except ConfigurationError as error:
            if error.key[:1] != ("driver",):
                raise
            raise ConfigurationError(str(error), ("driver", "can", *error.key[1:])) from error

    return open_file


class Replayer:
    """Implements :class:`otolith_drivers.base.Driver` over a file."""

    sampling = Sampling.CYCLIC

    def __init__(self, open_file: Callable[[], Reader], options: Options, gap: float, lines: list[str]) -> None:
        """``gap`` is how long (s) after the last row the first one comes again, ``lines`` what is read."""
        self._open_file = open_file
        self._paced, self._repeat = options.pace == "real time", options.repeat
        self._gap = gap
        self._lines = lines
        self._reader: Reader | None = None
        self._down = "not opened yet"
        self._received = self._bad = self._bad_before = self._lost_before = 0
        self._clock = -math.inf  # s, monotonic; of the latest row that is due
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        try:
            reader = self._open_file()
        except OtolithError as error:
            raise DeviceError(str(error)) from error
        self._down, self._clock = "", time.monotonic()
        self._thread = threading.Thread(target=self._play, args=(reader, deliver), name="replay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """See :meth:`otolith_drivers.base.Driver.close`."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def counters(self) -> Counters:
        """See :meth:`otolith_drivers.base.Driver.counters`."""
        reader = self._reader
        lost = self._lost_before + (0 if reader is None else reader.lost)
        return Counters(received=self._received, bad=self._bad, lost=lost)

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        reader = self._reader
        lines = [] if reader is None else reader.warnings()
        silence = self._clock - time.monotonic()
        if self._paced and not self._down and silence > LONG_SILENCE:
            lines.append(f"the file has nothing for another {silence:.0f} s")
        return Link(up=not self._down, reason=self._down, warnings=tuple(lines))

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        return self._lines

    def _play(self, reader: Reader, deliver: Deliver) -> None:
        begin = self._clock
        try:
            while True:
                self._reader = reader
                with reader:
                    self._once(reader, deliver, begin)
                if not self._repeat or self._stop.is_set():
                    break
                begin = self._clock + self._gap
                following = self._open_file()
                self._bad_before, self._lost_before = self._bad, self._lost_before + reader.lost
                reader = following
            self._down = "closed" if self._stop.is_set() else "the recording has ended"
        except OtolithError as error:
            self._down = str(error)
        except Exception as error:
            self._down = f"{type(error).__name__}: {error}"
            log.exception("the replay ended")

    def _once(self, reader: Reader, deliver: Deliver, begin: float) -> None:
        """The whole file, its first row at ``begin`` (s, monotonic)."""
        offset: float | None = None
        for rows in read_ahead(reader.stretches(), self._stop):
            if offset is None:
                offset = begin - float(rows.times[0])
            self._deliver(rows, rows.times + offset, deliver)
        if not self._stop.is_set():
            self._bad = self._bad_before + reader.bad

    def _deliver(self, rows: Rows, times: Array, deliver: Deliver) -> None:
        """Each row when its time has come; rows that go back in time come with those above them."""
        clock = np.maximum.accumulate(np.maximum(times, self._clock))
        at = 0
        while at < len(clock) and not self._stop.is_set():
            until = min(at + AT_ONCE, len(clock))
            if self._paced:
                now = time.monotonic()
                until = min(until, int(np.searchsorted(clock, now, side="right")))
                self._clock = float(clock[at])
                if until <= at:
                    self._stop.wait(min(self._clock - now, LONGEST_WAIT))
                    continue
            samples = _samples(rows, times, slice(at, until))
            self._received += len(samples)
            self._bad = self._bad_before + int(rows.bad[until - 1])
            deliver(samples)
            self._clock, at = float(clock[until - 1]), until


def _samples(rows: Rows, times: Array, part: slice) -> list[Sample]:
    """In the order of the rows; a cell without a reading is none."""
    found = []
    for name, values in rows.columns.items():
        there = np.flatnonzero(np.isfinite(values[part]))
        pairs = zip(times[part][there].tolist(), values[part][there].tolist(), strict=True)
        found += [(row, Sample(name, *pair)) for row, pair in zip(there.tolist(), pairs, strict=True)]
    found.sort(key=lambda entry: entry[0])
    return [sample for _, sample in found]
