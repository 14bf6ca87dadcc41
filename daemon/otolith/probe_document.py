"""What was found in the registers of a Modbus device, as JSON for programs."""

import math
from collections.abc import Iterator
from typing import Any

from otolith.probe_modbus import Probed, lines_of
from otolith_drivers.modbus_types import LETTERS
from otolith_drivers.probe_modbus import Block, Words, possible_rate
from otolith_drivers.probe_registers import (
    Number,
    Place,
    bytes_of,
    readings_at,
)


def document(probed: Probed) -> dict[str, Any]:
    """The same for machines; a number that is none is null."""
    place = probed.place
    return {
        "line": place.options.title(),
        "device": place.device,
        "table": place.table,
        "first_address": place.first_address,
        "readable": [[place.shown(block.address), place.shown(block.end - 1)] for block in probed.found.blocks],
        "refused": {str(place.shown(at)): reason for at, reason in probed.found.refused.items()},
        "most_registers": probed.found.most,
        "speed": [
            {"registers": speed.registers, "median_s": speed.median, "slow_s": speed.slow} for speed in probed.speeds
        ],
        "possible_hz": possible_rate(probed.speeds),
        "registers": [entry for block, words in probed.readings.items() for entry in _entries(place, block, words)],
        "numbers": [_number(place, number) for number in probed.wanted],
        "lines": lines_of(probed),
    }


def _entries(place: Place, block: Block, words: Words) -> Iterator[dict[str, Any]]:
    if not len(words):
        return
    data = bytes_of(words)
    for at in range(block.count):
        values = {reading.layout.name: _finite(reading.latest) for reading in readings_at(data, at, LETTERS)}
        yield {"register": place.shown(block.address + at), "raw": f"{words[-1, at]:04X}", "values": values}


def _number(place: Place, number: Number) -> dict[str, Any]:
    layout, part = number.part.layout, number.part
    return {
        "register": place.shown(number.address),
        "count": number.count,
        "verdict": part.verdict,
        "type": layout.kind if layout else None,
        "order": layout.order if layout else None,
        "latest": _finite(part.latest),
        "low": _finite(part.low),
        "high": _finite(part.high),
        "others": [
            {"register": place.shown(address), "type": other.kind, "order": other.order, "latest": _finite(latest)}
            for address, other, latest in number.others
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
