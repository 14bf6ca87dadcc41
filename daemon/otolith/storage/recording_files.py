"""Recordings of a machine on disk: their names, when a new one begins, and which are deleted for the others.

A recording has a file for viewing (``.rrd``) and its samples beside it, which are counted, marked and deleted with it.
The names of files sort by time. A file with minutes before or after an event has a mark in its name, and is deleted
last.
"""

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from otolith_drivers.replay.sample_names import FOLDER, RECORDING, SAMPLES, parts_folder, viewing_file, whole_file
from otolith_drivers.user_dirs import writable

if TYPE_CHECKING:  # slow to import
    from otolith.machine import RecordedMachine

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-storage.md has the origin of each.
MIN_FREE_BYTES = 100 << 20  # kept free on any disk
MIN_FREE_SHARE = 0.05  # of the disk, kept free from recordings that the daemon makes by itself
RESUME_FACTOR = 1.1  # times what is kept free, for recording to go on
EVENT_MARGIN = 300.0  # s before and after a change of an event whose files are marked
MAX_LEAP = 86_400.0  # s by which the clock may pass the time of operation
LEAP_PATIENCE = 86_400.0  # s of operation after which a clock that leapt is used
MAX_AHEAD = 86_400.0  # s after the present from which a time is that of a wrong clock
MAX_EVENT_SHARE = 0.5  # of the budget, for marked files
DAY, MEGABYTE, GIGABYTE = 86_400.0, 1e6, 1e9  # s, bytes

STAMP, EVENT = "%Y%m%dT%H%M%S", "-event"
NAME = re.compile(r"(?P<key>[^/]+)-(?P<stamp>\d{8}T\d{6})-\d+(-\d+)?(?P<event>-event)?\.rrd")
FILE_MODE, FOLDER_MODE = 0o640, 0o750  # the group may read


@dataclass(frozen=True, slots=True)
class RecordingBudget:
    """What the recordings of a machine may take, and when a new file begins."""

    max_bytes: float
    max_age: float  # s
    rotate_bytes: float
    rotate_age: float  # s

    def is_full(self, age: float, size: int) -> bool:
        """Return whether a file of ``age`` (s) and ``size`` (bytes) is complete; the clock may have been set back."""
        return abs(age) >= self.rotate_age or size >= self.rotate_bytes


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """A recording on disk, with its samples."""

    path: Path  # For viewing
    key: str  # Site and machine
    begin: float  # Unix seconds, as is end
    end: float
    size: int
    is_marked: bool  # Whether it holds minutes around an event


def recording_file(path: Path) -> RecordingFile | None:
    """Return what follows from name and status of ``path`` and its samples, of which one may be missing.

    None for another name, and where there is no status.
    """
    if (match := NAME.fullmatch(path.name)) is None:
        return None
    try:
        files = _files_of(path)
        statuses = [each.stat() for each in files]
        begin = datetime.strptime(match["stamp"], STAMP).replace(tzinfo=UTC).timestamp()
        # Samples may be united long after their recording has ended.
        end = statuses[0].st_mtime if path in files else max(status.st_mtime for status in statuses)
    except (OSError, ValueError):  # deleted meanwhile, a link to itself, a fault of the disk; no date; no file
        return None
    size = sum(status.st_size for status in statuses)
    return RecordingFile(path, match["key"], begin, end, size, bool(match["event"]))


def _files_of(path: Path) -> list[Path]:
    """Return the files of a recording that are there: for viewing, and with its samples."""
    return [*(each for each in (path, whole_file(path)) if each.exists()), *parts_folder(path).glob("*")]


def size_of(path: Path) -> int:
    """Return how many bytes a recording takes with its samples; raise OSError if its file for viewing is missing."""
    return path.stat().st_size + sum(file.stat().st_size for file in _files_of(path) if file != path)


def recordings_in(folder: Path) -> list[RecordingFile]:
    """Return the recordings in a folder, also those of which only the samples are left."""
    paths = {viewing_file(path) for end in (RECORDING, SAMPLES, FOLDER) for path in folder.glob(f"*{end}")}
    return [file for path in sorted(paths) if (file := recording_file(path)) is not None]


def expendable(
    files: Sequence[RecordingFile], budget: RecordingBudget, now: float, size: int, shortage: int
) -> Iterator[RecordingFile]:
    """Yield the files to delete, in order: the oldest first, marked ones after all others.

    ``size`` is that of the file that is being written, which is not among ``files``; ``shortage`` is how many bytes
    more must be free on the disk. Marked files have no greatest age, but a share of the budget; they are not deleted
    for a disk that even so would not have room. Files from after ``now`` are the oldest: the clock was set back since.
    """
    ordered = sorted(
        files, key=lambda file: (file.is_marked, file.begin <= now + MAX_AHEAD, file.begin, file.path.name)
    )
    clock = _clock(files, now)
    gone = {file for file in ordered if not file.is_marked and clock - file.end > budget.max_age}
    excess = sum(file.size for file in ordered if file.is_marked) - MAX_EVENT_SHARE * budget.max_bytes
    for file in ordered:
        if file.is_marked and excess > 0:
            gone.add(file)
            excess -= file.size
    yield from sorted(gone, key=ordered.index)
    total, freed = sum(file.size for file in ordered), sum(file.size for file in gone)
    for file in ordered:
        in_vain = file.is_marked and shortage > total
        is_needed = size + total - freed > budget.max_bytes or (shortage > freed and not in_vain)
        if is_needed and file not in gone:
            yield file
            freed += file.size


def _clock(files: Sequence[RecordingFile], now: float) -> float:
    """Return ``now``, or the end of the last file before a leap of the clock: a wrong clock deletes nothing."""
    begin = now
    for file in sorted(files, key=lambda file: file.end, reverse=True):
        if begin - file.end > MAX_LEAP:
            return file.end if now - begin < LEAP_PATIENCE else now
        begin = min(begin, file.begin)
    return now


def shortage_of(folder: Path, share: float = 0.0, factor: float = 1.0) -> int:
    """Return how many bytes more must be free on the disk of ``folder``; Rerun gives no error on a full one."""
    usage = shutil.disk_usage(folder)
    return round(factor * max(MIN_FREE_BYTES, share * usage.total)) - usage.free


class RecordingFolder:
    """The recordings of one machine in a folder."""

    def __init__(self, folder: Path, key: str, budget: RecordingBudget, *, set_mode: bool = True) -> None:
        """``key`` is site and machine; with ``set_mode`` the group of the folder may read it."""
        self._folder, self._key, self._set_mode = folder, key, set_mode
        self.budget = budget

    def new_path(self, now: float, *, marked: bool = False) -> Path:
        """Return an unused path for a file that begins ``now``; raise ServiceError if the folder is not writable."""
        writable(self._folder)
        if self._set_mode:
            with contextlib.suppress(OSError):  # a folder of another user that this one may write
                self._folder.chmod(FOLDER_MODE)
        stem = f"{self._key}-{datetime.fromtimestamp(now, UTC).strftime(STAMP)}-{os.getpid()}"
        taken = {viewing_file(path).stem.removesuffix(EVENT) for path in self._folder.glob(f"{stem}*")}
        count = 1
        while (own := f"{stem}-{count}" if count > 1 else stem) in taken:
            count += 1
        return self._folder / f"{own}{EVENT if marked else ''}.rrd"

    def files(self) -> list[RecordingFile]:
        """Return the recordings of the machine."""
        return [file for file in recordings_in(self._folder) if file.key == self._key]

    def make_room(self, now: float, current: Path | None = None, factor: float = 1.0) -> int:
        """Delete what the budget and the disk demand, but not ``current``; return how many bytes are still missing."""
        files, missing = self.files(), shortage_of(self._folder, MIN_FREE_SHARE, factor)
        size = sum(file.size for file in files if file.path == current)
        others = [file for file in files if file.path != current]
        for file in expendable(others, self.budget, now, size, missing):
            with contextlib.suppress(OSError):
                shutil.rmtree(parts_folder(file.path), ignore_errors=True)
                whole_file(file.path).unlink(missing_ok=True)
                file.path.unlink(missing_ok=True)
                log.info("recording deleted for the budget: %s", file.path)
        return shortage_of(self._folder, MIN_FREE_SHARE, factor)

    def mark(self, now: float, current: Path) -> Path:
        """Mark the files with the minutes before ``now``; return the new path of ``current``."""
        for file in self.files():
            if not file.is_marked and (file.path == current or abs(now - file.end) <= EVENT_MARGIN):
                path = file.path.with_name(f"{file.path.stem}{EVENT}{RECORDING}")
                with contextlib.suppress(OSError):  # the disk is read-only: it keeps its name
                    for own in (parts_folder, whole_file, viewing_file):
                        with contextlib.suppress(FileNotFoundError):
                            own(file.path).rename(own(path))
                    current = path if file.path == current else current
        return current


class Opened(NamedTuple):
    """Begins a recording in the recorder process: of one machine, in place of the one before."""

    path: Path
    source: "RecordedMachine"
    folder: RecordingFolder | None
    """Without one all goes into the file ``path``."""


class Ended(NamedTuple):
    """A recording has ended, because of its disk or its file."""

    reason: str
