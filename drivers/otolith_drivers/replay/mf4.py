"""The frames in an MF4 file that a bus logger wrote (ASAM MDF 4), read by asammdf."""

import gc
import heapq
import io
import logging
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

from otolith_drivers.canbus import can
from otolith_drivers.canbus.database import EXTENDED_LIMIT, STANDARD_LIMIT
from otolith_drivers.canbus.options import CLASSIC_LENGTH
from otolith_drivers.errors import ConfigurationError, installation_of, some_names
from otolith_drivers.replay.readers import GZIP, seen

MF4_FRAME = "CAN_DataFrame"  # channel of the frames (ASAM MDF bus logging)
MF4_CHUNK = 20_000  # frames that are read at once

Result = TypeVar("Result")


class Mf4Frames:
    """The frames of an MF4 file."""

    place = "frame"
    passed = 0
    notes: tuple[str, ...] = ()

    def __init__(self, path: Path, head: bytes) -> None:
        if not head.startswith(b"MDF ") or path.suffix.lower() == GZIP:
            kind = seen(head)
            raise ConfigurationError(f"{path}: is not an unpacked MF4 file{f' but {kind}' if kind else ''}")
        if find_spec("asammdf") is None:
            raise ConfigurationError(f"{path}: an MF4 file needs the extra 'mf4': {installation_of('mf4')}")
        self._path = path

    def frames(self) -> Iterator[tuple[int, can.Message | str]]:
        """Number of each frame with the frame, or with the reason why there is none; can be iterated once."""
        number, file = 0, None
        try:
            file = quietly(lambda: _opened(self._path))
            begun = quietly(file.header.start_time.timestamp)
            names = [[channel.name for channel in group.channels] for group in file.groups]
            groups = [index for index, group in enumerate(names) if MF4_FRAME in group]
            if not groups:
                signals = [name for group in names for name in group if name not in {"t", "time"}]
                yield 1, f"signals ({some_names(signals)}) and no CAN frames: export them as CSV"
            frames = (_frames(file, index, begun) for index in groups)
            for frame in heapq.merge(*frames, key=lambda frame: frame.timestamp):
                number += 1
                yield number, frame
        except Exception as error:  # noqa: BLE001 - the library raises anything on damaged data
            yield number + 1, f"the file is damaged or cut off here: reading ends ({error})"
        finally:
            if file is not None:
                quietly(file.close)


def quietly(step: Callable[[], Result]) -> Result:
    """Return what a step of the library returns.

    On damaged data it prints tracebacks, also when its objects are destroyed. Its output is dropped; what it raises
    becomes a ValueError with one line.
    """
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        try:
            return step()
        except Exception as error:  # noqa: BLE001 - as above
            lines = str(error).split("\n")
            text = lines[0].strip() or type(error).__name__
        gc.collect()  # what it has left half-made prints when it is destroyed
    raise ValueError(text)


def _opened(path: Path) -> Any:
    from asammdf import MDF  # noqa: PLC0415 - slow to import

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)
    return MDF(path)


def _frames(file: Any, group: int, begun: float) -> Iterator[can.Message]:
    """The frames of a channel group; ``begun`` is the Unix time (s) from which its times count."""
    count = file.groups[group].channel_group.cycles_nr
    for first in range(0, count, MF4_CHUNK):
        yield from quietly(partial(_chunk, file, group, first, min(MF4_CHUNK, count - first), begun))


def _chunk(file: Any, group: int, first: int, count: int, begun: float) -> list[can.Message]:
    part = file.get(MF4_FRAME, group, record_offset=first, record_count=count)
    fields = part.samples.dtype.names
    channels = part[f"{MF4_FRAME}.BusChannel"] if f"{MF4_FRAME}.BusChannel" in fields else None
    wide = part[f"{MF4_FRAME}.IDE"] if f"{MF4_FRAME}.IDE" in fields else None
    identifiers, lengths = part[f"{MF4_FRAME}.ID"], part[f"{MF4_FRAME}.DataLength"]
    data = part[f"{MF4_FRAME}.DataBytes"]
    frames = []
    for index, time in enumerate(part.timestamps):
        identifier, length = int(identifiers[index]), int(lengths[index])
        extended = bool(wide[index]) if wide is not None else identifier > STANDARD_LIMIT
        frames.append(
            can.Message(
                timestamp=begun + float(time),
                channel=None if channels is None else int(channels[index]),
                arbitration_id=identifier & EXTENDED_LIMIT,
                is_extended_id=extended,
                is_fd=length > CLASSIC_LENGTH,
                dlc=length,
                data=data[index][:length].tobytes(),
            )
        )
    return frames
