"""A child process that reads a recording of Otolith once and sends what a replay needs to its parent.

It is run as a file, and imports nothing of this project. Rerun's native code may abort on a damaged file, which then
ends this process alone. What it sends are parts: a letter, the number of bytes, the bytes.
"""

import json
import struct
import sys
import warnings
from pathlib import Path
from typing import BinaryIO

PART = struct.Struct("<cIf")  # Letter, number of bytes, share of the file that was read so far
OPENED, TIMES, WINDOW, END, FAULT = b"O", b"T", b"W", b"E", b"F"

# The layout of otolith.publishing.recorder.
TIMES_ENTITY, SAMPLES_ENTITY = "/times", "/samples"
TEXT_COLUMN, WINDOW_COLUMN = "TextDocument:text", "window"


def main(path: Path, out: BinaryIO) -> None:
    """Send the parts of the recording at ``path``."""
    from rerun.chunk import RrdReader  # noqa: PLC0415 - half a second
    from rerun.error_utils import RerunWarning  # noqa: PLC0415

    size, before = max(path.stat().st_size, 1), _bytes_read()

    def send(letter: bytes, content: bytes = b"") -> None:
        out.writelines((PART.pack(letter, len(content), min(1.0, (_bytes_read() - before) / size)), content))

    try:
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always", RerunWarning)
            file = RrdReader(path)
        applications = [one.application_id for one in file.recordings()]
        send(OPENED, json.dumps({"applications": applications, "is_closed": not raised}).encode())
        out.flush()
        for chunk in file.stream() if applications else ():
            entity = str(chunk.entity_path)
            if entity == TIMES_ENTITY:
                send(TIMES, str(chunk.to_record_batch().column(TEXT_COLUMN).to_pylist()[0][0]).encode())
            elif entity == SAMPLES_ENTITY:
                for cell in chunk.to_record_batch().column(WINDOW_COLUMN).to_pylist():
                    send(WINDOW, _content(cell))
        send(END)
    except (RuntimeError, ValueError, KeyError, OSError, IndexError, TypeError) as error:  # of a damaged file
        send(FAULT, (str(error).rpartition(": ")[2] or str(error) or type(error).__name__).encode())
    out.flush()


def _content(cell: object) -> bytes:
    """Return the bytes in a cell; none if it is damaged."""
    try:
        return bytes(cell[0])  # type: ignore[index]
    except (ValueError, TypeError, IndexError):
        return b""


def _bytes_read() -> int:
    """Return how many bytes this process has read; 0 where the system does not tell."""
    try:
        return int(Path("/proc/self/io").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return 0


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.stdout.buffer)
