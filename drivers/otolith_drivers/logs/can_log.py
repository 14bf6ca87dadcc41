"""A log of a CAN bus as rows: each frame that has a wanted signal is one, decoded as the driver would have."""

import math
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import can
import numpy as np

from otolith_drivers.base import Sample, Setup
from otolith_drivers.can_decoder import FrameDecoder, decoder_of
from otolith_drivers.can_receiver import Source
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.logs.can_frames import Fault, source_of
from otolith_drivers.logs.files import Opened
from otolith_drivers.logs.readers import suffix_of
from otolith_drivers.logs.rows import LATEST, Rows

__all__ = ["CanLog", "Source", "open_log"]

BATCH = 20_000  # frames
MOST_CHANNELS = 16


def open_log(path: Path, setup: Setup, can: Any | None) -> "CanLog":
    """See :meth:`otolith_drivers.logs.readers.Format.open_log`."""
    if can is None:
        raise ConfigurationError(f"{path}: a log of a CAN bus: what is in its frames must be said as for the bus")
    return CanLog(path, tuple(signal.name for signal in setup.signals), decoder_of(can, setup))


class CanLog:
    """Implements :class:`otolith_drivers.logs.rows.Reader`."""

    ignored = ()

    def __init__(self, path: Path, signals: tuple[str, ...], decoder: FrameDecoder) -> None:
        """Open ``path``.

        Raises:
            ConfigurationError: no such file, or one that cannot be read at all.
        """
        self.path = path
        self._decoder = decoder
        self._opened = Opened(path)
        try:
            self._source = source_of(path, suffix_of(path), self._opened)
        except BaseException:
            self._opened.close()
            raise
        self.place = self._source.place
        self._signals = signals
        self._channels = set[str]()
        self._first_bad: Fault | None = None
        self._frames = self._others = self._unreadable = self._undecoded = 0
        self._latest = -math.inf

    def __enter__(self) -> "CanLog":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._opened.close()

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        return self._opened.progress

    @property
    def bad(self) -> int:
        """Lines that are no frames, frames that cannot be decoded, values out of their range."""
        return self._unreadable + self._decoder.counters.bad

    @property
    def lost(self) -> int:
        """Samples of frames that a counter in them says were sent, and that are not there."""
        return self._decoder.counters.lost

    def stretches(self) -> Iterator[Rows]:
        """See :meth:`otolith_drivers.logs.rows.Reader.stretches`."""
        wanted = set(self._decoder.identifiers())
        batch = _Batch(self._signals)
        for place, frame in self._source.frames():
            if isinstance(frame, Fault):
                self._unreadable += 1
                self._note(frame)
                continue
            if not self._frames:
                self._decoder.begin(frame.timestamp)
            self._frames += 1
            key = (frame.arbitration_id, frame.is_extended_id)
            if key not in wanted or frame.is_error_frame or frame.is_remote_frame:
                self._others += 1
            elif samples := self._samples(place, frame):
                batch.add(place, samples, self._unreadable + self._undecoded)
            if len(batch) >= BATCH:
                yield batch.rows()
                batch = _Batch(self._signals)
        if len(batch):
            yield batch.rows()
        if math.isinf(self._latest):
            raise ConfigurationError(f"{self.path}{self._why_none()}")

    def _samples(self, place: int, frame: can.Message) -> list[Sample]:
        time = frame.timestamp
        if not abs(time) <= LATEST:
            self._unreadable += 1
            self._note(Fault(place, f"its time is {time:g} s"))
            return []
        samples = self._decoder.decode(frame, time)
        if not samples or any(math.isnan(sample.value) for sample in samples):
            bad = self._decoder.counters.bad
            if bad > self._undecoded:
                what = f"frame 0x{frame.arbitration_id:X} with data {bytes(frame.data).hex(' ') or 'of no length'}"
                self._note(Fault(place, f"{what} is too short, or has a value out of its range"))
            self._undecoded = bad
        if samples:
            self._latest = max(self._latest, time)
            if len(self._channels) < MOST_CHANNELS:
                self._channels.add(str(frame.channel))
        return samples

    def _note(self, fault: Fault) -> None:
        if self._first_bad is None:
            self._first_bad = fault

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.logs.rows.Reader.describe`."""
        return self._decoder.describe()

    def found(self) -> list[str]:
        """See :meth:`otolith_drivers.logs.rows.Reader.found`."""
        parts = [f"{self._frames} frames read", f"{self._others} of other messages", f"{self.bad} bad"]
        return parts + ([f"{self._source.passed} {self.place}s without a frame"] if self._source.passed else [])

    def complaints(self) -> list[str]:
        """See :meth:`otolith_drivers.logs.rows.Reader.complaints`."""
        lines = []
        if self._first_bad is not None:
            lines.append(f"bad: {self.bad}, the first in {self.place} {self._first_bad.place}: {self._first_bad.cause}")
        if len(self._channels) > 1:
            names = ", ".join(sorted(self._channels))
            lines.append(f"frames of these messages come from channels {names}: are two machines mixed?")
        lines += [f"cut off: {self._opened.torn}"] if self._opened.torn else []
        lines += self._source.notes
        # What could not be used is told above, by its place in the file.
        return lines + (self._decoder.complaints(self._latest, unused=False) if self._frames else [])

    def _why_none(self) -> str:
        if self._first_bad is not None:
            return f": {self.place} {self._first_bad.place}: {self._first_bad.cause}; no frame can be used"
        if not self._frames:
            return ": no frames" if not self._opened.torn else f": no frames: cut off: {self._opened.torn}"
        wanted = ", ".join(f"0x{identifier:X}" for identifier, _ in self._decoder.identifiers())
        return f": none of its {self._frames} frames is one of {wanted}"


class _Batch:
    """Samples as they come, until they are enough for a stretch."""

    def __init__(self, signals: tuple[str, ...]) -> None:
        self._times: list[float] = []
        self._places: list[int] = []
        self._bad: list[int] = []
        self._values: dict[str, tuple[list[int], list[float]]] = {signal: ([], []) for signal in signals}

    def __len__(self) -> int:
        return len(self._times)

    def add(self, place: int, samples: list[Sample], bad: int) -> None:
        row = len(self._times)
        self._times.append(samples[0].time)
        self._places.append(place)
        self._bad.append(bad)
        for sample in samples:
            rows, values = self._values[sample.signal]
            rows.append(row)
            values.append(sample.value)

    def rows(self) -> Rows:
        columns = {}
        for signal, (rows, values) in self._values.items():
            column = np.full(len(self._times), np.nan)
            column[rows] = values
            columns[signal] = column
        return Rows(np.array(self._times), columns, np.array(self._places), np.array(self._bad))
