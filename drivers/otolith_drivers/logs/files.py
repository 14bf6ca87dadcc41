"""Opening a file of recorded data, packed by gzip or not."""

import gzip
import io
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from otolith_drivers.errors import ConfigurationError

if TYPE_CHECKING:
    from _typeshed import WriteableBuffer

GZIP = ".gz"
BUFFER = 1 << 16  # bytes; what can be looked at before anything is read


class Opened:
    """The bytes of a file, how many of them were read, and whether its packing broke off."""

    def __init__(self, path: Path) -> None:
        """Open ``path``.

        Raises:
            ConfigurationError: no such file, or not to be read.
        """
        try:
            if path.exists() and not path.is_file():
                raise ConfigurationError(f"{path}: is a directory or a device, not a file")
            self._raw = io.BufferedReader(io.FileIO(path), BUFFER)
        except OSError as error:
            raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}") from error
        self._size, self._read = max(path.stat().st_size, 1), 0
        self._unpacked = _Unpacked(self._raw) if path.suffix.lower() == GZIP else None
        self.stream = self._raw if self._unpacked is None else io.BufferedReader(self._unpacked, BUFFER)

    @property
    def progress(self) -> float:
        """Share of the file that was read, 0 to 1."""
        if not self._raw.closed:
            self._read = self._raw.tell()
        return min(1.0, self._read / self._size)

    @property
    def torn(self) -> str:
        """Why the rest of a packed file cannot be had; empty if it can, or was not asked for yet."""
        return "" if self._unpacked is None else self._unpacked.torn

    def close(self) -> None:
        """Give it back."""
        _ = self.progress
        self.stream.close()
        self._raw.close()


class _Unpacked(io.RawIOBase):
    """Ends where the packing breaks off, as a file does that was cut there."""

    def __init__(self, raw: BinaryIO) -> None:
        self._file = gzip.GzipFile(fileobj=raw)
        self.torn = ""

    def readable(self) -> bool:
        return True

    def readinto(self, room: "WriteableBuffer") -> int:
        view = memoryview(room)
        try:
            found = self._file.read1(len(view))  # more at once would be lost where the packing breaks off
        except (EOFError, OSError, zlib.error) as error:
            self.torn = str(error)
            return 0
        view[: len(found)] = found
        return len(found)

    def close(self) -> None:
        self._file.close()
        super().close()
