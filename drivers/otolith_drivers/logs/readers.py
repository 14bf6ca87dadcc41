"""The table of formats: which reader takes a file, by the end of its name."""

from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, cast

from otolith_drivers.base import Setup
from otolith_drivers.logs.files import GZIP
from otolith_drivers.logs.rows import Reader
from otolith_drivers.toml_files import Closed

# The module is imported only when a file asks for it.
CAN_LOG = "otolith_drivers.logs.can_log"
READERS: dict[str, str] = {
    ".asc": CAN_LOG,
    ".blf": CAN_LOG,
    ".log": CAN_LOG,
    ".trc": CAN_LOG,
    ".rrd": "otolith_drivers.logs.recording",
}
TABLE = "otolith_drivers.logs.table"
"""Everything else is text with a column per signal."""


class Format(Protocol):
    """What a row of the table points to: a module with these two names."""

    Source: type[Closed]
    """Where in such a file a signal is."""

    def open_log(self, path: Path, setup: Setup, can: Any | None) -> Reader:
        """The file, open; ``can`` is what ``[driver]`` says of frames, for a log of them.

        Raises:
            ConfigurationError: no such file, or not what ``setup`` asks for.
        """


def suffix_of(path: Path) -> str:
    """The end of the name that tells the format, whatever packs the file."""
    name = path.with_suffix("") if path.suffix.lower() == GZIP else path
    return name.suffix.lower()


def holds_frames(path: Path) -> bool:
    """Whether it is a log of a CAN bus, which cannot be read without what describes the frames."""
    return READERS.get(suffix_of(path)) == CAN_LOG


def format_of(path: Path) -> Format:
    """The module that reads ``path``."""
    return cast("Format", import_module(READERS.get(suffix_of(path), TABLE)))
