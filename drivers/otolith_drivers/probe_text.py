"""How numbers are written in tables, and in lines of a machine file. Pure."""

import math
from typing import Any

from otolith_drivers.probe_layouts import Layout
from otolith_drivers.probe_numbers import Part


def quoted(value: Any) -> str:
    """As TOML writes a number or a text."""
    return str(value) if isinstance(value, int) else '"' + str(value).replace("\\", "\\\\").replace('"', '\\"') + '"'


def number_text(value: float, layout: Layout, step: float = 0.0) -> str:
    """A number as people write it: integers in full, floats with the digits in which they differ by ``step``."""
    if not math.isfinite(value):
        return str(value)
    if not layout.is_float:
        return f"{value:.0f}"
    size = max(abs(value), step)
    digits = 4
    if step > 0.0 and size > 0.0:
        digits = min(max(digits, 2 + math.ceil(math.log10(size / step))), 7 if layout.width == 4 else 12)
    return f"{value:.{digits}g}"


def spread(part: Part) -> str:
    """The latest value, and between which it was."""
    layout = part.layout
    if layout is None:
        return ""
    step = part.high - part.low
    latest, low, high = (number_text(value, layout, step) for value in (part.latest, part.low, part.high))
    return f"{latest} now, between {low} and {high}"
