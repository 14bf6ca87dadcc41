"""From CAN frames that no database describes to fields that move, and to lines of a machine file. Pure."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from cantools.database import Signal as CanSignal

from otolith_drivers.can_bus import BusOptions
from otolith_drivers.probe_can import Heard, Picture, Value
from otolith_drivers.probe_layouts import FRAMES, Layout
from otolith_drivers.probe_numbers import Part, Verdict, parts
from otolith_drivers.probe_text import number_text, quoted, spread

FEWEST_FRAMES = 8
CLASSIC = 8  # bytes
COUNTERS = re.compile(r"count|alive|rolling|sequence|checksum|crc|^(?:mc|bz|cnt|chk)|(?:mc|bz|cnt|chk)$", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Field:
    """Some bytes of a frame that move as a number does."""

    heard: Heard
    part: Part
    layout: Layout

    @property
    def start(self) -> int:
        """The bit where it begins, as a DBC counts."""
        return start_bit(self.part.start, self.layout)


def start_bit(byte: int, layout: Layout) -> int:
    """The lowest bit of a little-endian number that begins with ``byte``, or the highest of a big-endian one."""
    return 8 * byte + (7 if layout.order == "big" else 0)


def parts_of(heard: Heard) -> list[Part]:
    """What is in the frames of one arbitration ID, as far as it changes."""
    history = [data for data in heard.history if len(data) == len(heard.latest)]
    if len(history) < FEWEST_FRAMES or not heard.latest:
        return []
    return parts(np.frombuffer(b"".join(history), dtype=np.uint8).reshape(len(history), -1), FRAMES, 1)


def fields_of(heard: Heard) -> list[Field]:
    """The numbers in them that move, without counters and what jumps."""
    return [
        Field(heard, part, part.layout)
        for part in parts_of(heard)
        if part.layout is not None and part.verdict in (Verdict.TOLD, Verdict.LIKELY)
    ]


def driver_lines(options: BusOptions, picture: Picture, database: str | None) -> list[str]:
    """The table ``[driver]``."""
    lines = ["[driver]", 'type = "can"']
    for key in ("interface", "channel", "port"):
        value = getattr(options, key)
        if value != BusOptions.model_fields[key].default:
            lines.append(f"{key} = {quoted(value)}")
    if options.bitrate is not None:
        lines.append(f'bitrate = "{options.bitrate:g} bit/s"')
    if any(heard.fd for heard in picture.heard.values()):
        lines.append("fd = true")
    knows = any(heard.message is not None for heard in picture.heard.values())
    return lines + ([f"dbc = {quoted(database)}"] if database and knows else [])


def signal_lines(picture: Picture) -> Iterator[str]:
    """The table ``[signals]``: what the database knows by name, the rest by its bits."""
    yield "[signals]"
    found = [(heard, signal, value) for heard, signal, value in picture.signals() if not _is_counter(signal)]
    names = [signal.name for _, signal, _ in found]
    for heard, signal, value in found:
        message = heard.message.name if heard.message and names.count(signal.name) > 1 else None
        yield _known(signal, value, message)
    for heard in picture.ordered():
        if heard.message is None:
            for field in fields_of(heard):
                yield _raw(field)


def _is_counter(signal: CanSignal) -> bool:
    return not signal.unit and COUNTERS.search(signal.name) is not None


def _known(signal: CanSignal, value: Value, message: str | None) -> str:
    keys = f"signal = {quoted(signal.name)}" + (f", message = {quoted(message)}" if message else "")
    unit = f"{signal.unit}, " if signal.unit else ""
    keys += "" if signal.unit else ', unit = "?"'
    return f"NAME = {{ {keys} }}  # {unit}{value_text(signal, value.latest)} now"


def value_text(signal: CanSignal, number: float) -> str:
    """With as many digits as one step of the signal is worth; with the name of a state that has one."""
    choices: Any = signal.choices or {}
    if number in choices:
        return f"{number:g} {choices[number]}"
    if signal.conversion.is_float:
        return f"{number:.5g}"
    step = abs(float(signal.conversion.scale)) or 1.0
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return f"{number:.{decimals}f}" if decimals <= 12 else f"{number:.5g}"


def _raw(field: Field) -> str:
    heard, layout = field.heard, field.layout
    extended = ", extended = true" if heard.extended else ""
    fd = ", fd = true" if len(heard.latest) > CLASSIC else ""
    kind = "float = true" if layout.is_float else f"signed = {'true' if layout.signed else 'false'}"
    bits = f'start = {field.start}, length = {8 * layout.width}, byte_order = "{layout.order}", {kind}'
    others = ", ".join(
        f"{other.layout.name} from bit {start_bit(other.start, other.layout)} "
        f"({number_text(other.latest, other.layout)})"
        for other in field.part.others
    )
    comment = spread(field.part) + (f"; or {others}" if others else "")
    name = f'"0x{heard.identifier:X}"'
    return f'NAME = {{ id = {name}{extended}{fd}, {bits}, scale = 1.0, unit = "?" }}  # {comment}'
