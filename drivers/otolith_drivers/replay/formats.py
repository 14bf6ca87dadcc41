"""The format of a recorded file by its first bytes: text logs of a CAN bus, and what a refusal names."""

import re
import zlib
from itertools import pairwise
from pathlib import Path

GZIP = ".gz"
HEAD = 1 << 14  # bytes; some hundred lines of a log
MAX_LINES = 20  # of a log, of which one must have its format; the first may be cut off
MIN_STEPS = 4  # times of a log, of which
DIFFERENCE_SHARE = 0.2  # go back, or all are equal: then they are differences

CANDUMP = "candump -ta"
CANDUMP_LOG = "candump -L"
PYTHON_CAN = "CSV of python-can"
SAVVYCAN = "CSV of SavvyCAN"
DIFFERENCES = "candump -td, whose times are differences"
TEXT_LOGS = {
    CANDUMP_LOG: re.compile(r"\(\d+\.\d+\)\s+\S+\s+[0-9A-Fa-f]{3,8}##?"),
    CANDUMP: re.compile(r"(?:\x1b\[\d*m)*\s*\((?:\d+|\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)\.\d+\)\s.*\[\d+\]"),
    PYTHON_CAN: re.compile(r"timestamp,arbitration_id,extended,remote,error,dlc,data\s*$"),
    SAVVYCAN: re.compile(r"\"?Time Stamp\"?,\"?ID\"?,\"?Extended\"?,", re.IGNORECASE),
}
"""By name: how a line of a text log, or its header, begins."""
OTHERS = {
    "Vector BLF": rb"LOGG",
    "MDF (MF4)": rb"MDF ",
    "SQLite": rb"SQLite format 3\x00",
    "a recording of Rerun": rb"RRF",
    "a spreadsheet or another ZIP archive": rb"PK\x03\x04",
    "HDF5 or MATLAB 7.3": rb"\x89HDF",
    "MATLAB 5": rb"MATLAB 5",
    "Parquet": rb"PAR1",
    "LabVIEW TDMS": rb"TDSm",
    "gzip": rb"\x1f\x8b",
    "a capture of network packets (pcap)": rb"(?:\xd4\xc3\xb2\xa1|\xa1\xb2\xc3\xd4|\x0a\x0d\x0d\x0a)",
    "UTF-16 text": rb"(?:\xff\xfe|\xfe\xff)",
    "PEAK TRC": rb";\$FILEVERSION|;\s*\$STARTTIME",
    "Vector ASC": rb"date .*\n(?:base|internal)",
    "BUSMASTER log": rb"\*\*\*BUSMASTER",
    "JSON": rb"[\[{]\s*[\"{\[]",
    "XML": rb"<\?xml",
}
"""By name: how a file of another format begins."""


def head_of(path: Path) -> bytes:
    """Return the first bytes, decompressed if the name ends in ``.gz``; none of a file that cannot be read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            data = file.read(HEAD)
    except OSError:
        return b""
    if path.suffix.lower() != GZIP:
        return data
    try:
        return zlib.decompressobj(wbits=31).decompress(data, HEAD)
    except zlib.error:
        return b""


def text_log(head: bytes) -> str:
    """Return which of ``TEXT_LOGS`` a file is that begins with ``head``; empty if it is none of them."""
    lines = head.decode("utf-8-sig", errors="replace").splitlines()
    names = (name for line in lines[:MAX_LINES] for name, pattern in TEXT_LOGS.items() if pattern.match(line.strip()))
    name = next(names, "")
    return DIFFERENCES if name == CANDUMP and _has_differences(lines) else name


def _has_differences(lines: list[str]) -> bool:
    """Whether the times of ``candump`` are those from frame to frame."""
    written = [match[1] for line in lines if (match := re.match(r"\s*\((\d+\.\d+)\)", line))]
    times = list(map(float, written))
    steps = [after - before for before, after in pairwise(times)]
    back = sum(step < 0.0 for step in steps) > DIFFERENCE_SHARE * len(steps)
    return len(steps) >= MIN_STEPS and (back or len(set(times[1:])) == 1)


def seen(head: bytes) -> str:
    """Return the name of the format that begins with ``head``; empty if it is not known."""
    other = next((name for name, start in OTHERS.items() if re.match(start, head.lstrip(b" \r\n"))), "")
    return other or text_log(head)
