"""From frames to samples, without any clock: serves a bus and a recording of one alike."""

from collections.abc import Iterable

import can
from cantools.database import Message

from otolith_drivers.base import Counters, Sample, Setup
from otolith_drivers.can_fields import bytes_needed, field
from otolith_drivers.can_options import FrameOptions
from otolith_drivers.dbc import Wanted, find_signals, load_dbc
from otolith_drivers.errors import ConfigurationError

EXTENDED = 1 << 29  # added to an extended arbitration ID, to tell it from a standard one of the same number
NO_READING = float("nan")
NOTHING: list[Sample] = []


def decoder_of(options: FrameOptions, setup: Setup) -> "FrameDecoder":
    """What decodes the frames that hold ``setup.signals``.

    Raises:
        ConfigurationError: a signal cannot be found where its source says.
    """
    paths = [setup.folder / path for path in options.databases()]
    if not paths:
        raise ConfigurationError("missing: the CAN database that describes the frames", ("driver", "dbc"))
    wanted = find_signals(load_dbc(paths[0]), setup.signals, paths[0])
    return FrameDecoder(wanted)


def key_of(identifier: int, *, extended: bool) -> int:
    """One number for an arbitration ID of either kind."""
    return identifier + EXTENDED if extended else identifier


class FrameDecoder:
    """Takes frames in the order of their arrival; everything it knows of time comes with them."""

    def __init__(self, wanted: Iterable[Wanted]) -> None:
        messages: dict[int, tuple[Message, list[Wanted]]] = {}
        for entry in wanted:
            key = key_of(entry.message.frame_id, extended=entry.message.is_extended_frame)
            messages.setdefault(key, (entry.message, []))[1].append(entry)
        self._readers = {key: MessageReader(message, entries) for key, (message, entries) in messages.items()}
        self._unreadable = 0

    def decode(self, frame: can.Message, time: float) -> list[Sample]:
        """The samples in ``frame``, which came or was true at ``time`` (s, of any clock that goes on steadily).

        Never raises: what cannot be used is counted.
        """
        try:
            reader = self._readers.get(
                frame.arbitration_id + EXTENDED if frame.is_extended_id else frame.arbitration_id
            )
            if reader is None or frame.is_error_frame or frame.is_remote_frame:
                return NOTHING
            return reader.take(frame.data, time)
        except Exception:  # noqa: BLE001 - interfaces hand on what the wire gave them, and that may be anything
            self._unreadable += 1
            return NOTHING

    @property
    def counters(self) -> Counters:
        """What has been seen so far; ``reconnects`` are not its business."""
        readers = self._readers.values()
        return Counters(
            received=sum(reader.received for reader in readers),
            bad=sum(reader.bad for reader in readers) + self._unreadable,
            lost=sum(reader.lost for reader in readers),
        )

    def complaints(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s, of the clock of :meth:`decode`), a line each."""
        return []

    def identifiers(self) -> list[tuple[int, bool]]:
        """The arbitration IDs that are looked at, and whether each is an extended one."""
        return [(key % EXTENDED, key >= EXTENDED) for key in self._readers]

    def describe(self) -> list[str]:
        """What will be read from where, a line each."""
        return [
            f"{entry.name} [{entry.target_unit}] from {entry.describe()}"
            for reader in self._readers.values()
            for entry in reader.wanted
        ]


class MessageReader:
    """Takes the frames of one message."""

    def __init__(self, message: Message, wanted: list[Wanted]) -> None:
        self.wanted = wanted
        self.received = self.bad = self.lost = 0
        self._length = message.length
        self._fields = []
        for entry in wanted:
            signal = message.get_signal_by_name(entry.signal)
            self._length = max(self._length, bytes_needed(signal))
            low, high, scale, offset = entry.raw_range(signal)
            self._fields.append((entry.name, field(signal), low, high, scale, offset))

    def take(self, data: bytes | bytearray, time: float) -> list[Sample]:
        """The samples in one frame."""
        if len(data) < self._length:
            self.bad += 1
            return NOTHING
        samples = []
        for name, read, low, high, scale, offset in self._fields:
            raw = read(data)
            if low <= raw <= high:
                samples.append(Sample(name, time, scale * raw + offset))
            else:
                self.bad += 1
                samples.append(Sample(name, time, NO_READING))
        self.received += len(samples)
        return samples
