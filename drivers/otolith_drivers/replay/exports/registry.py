"""The forms of text that are read beside plain tables, a row per form."""

from collections.abc import Sequence

from otolith_drivers.replay.exports.codesys import CODESYS
from otolith_drivers.replay.exports.lvm import LVM
from otolith_drivers.replay.exports.text import TextExport
from otolith_drivers.replay.exports.twincat import TWINCAT

EXPORTS = (CODESYS, LVM, TWINCAT)
FIRST_LINES = 10  # among which one says the form; engineering choice: titles and blank lines may stand above


def export_of(lines: Sequence[str]) -> TextExport | None:
    """Return the form of a text that begins with ``lines``; None if it is a plain table."""
    for line in lines[:FIRST_LINES]:
        for export in EXPORTS:
            if export.begins.match(line.lstrip("\ufeff")):
                return export
    return None
