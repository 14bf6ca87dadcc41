"""Which recordings are deleted, in which order, and how files are named and marked. No file has more than its name."""

import os
import re
import shutil
from collections import namedtuple
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.storage.recording_files import (
    DAY,
    EVENT_MARGIN,
    MAX_EVENT_SHARE,
    MIN_FREE_BYTES,
    MIN_FREE_SHARE,
    RecordingBudget,
    RecordingFile,
    RecordingFolder,
    expendable,
    recording_file,
    size_of,
)
from otolith_drivers.replay.sample_names import parts_folder, whole_file

NOW, HOUR = 1_800_000_000.0, 3600.0
BUDGET = RecordingBudget(max_bytes=1000, max_age=14 * DAY, rotate_bytes=100, rotate_age=HOUR)
Usage = namedtuple("Usage", ["total", "used", "free"])


def made(age: float, size: int, *, marked: bool = False) -> RecordingFile:
    """A file that ended ``age`` s ago."""
    name = Path(f"s.m-{1e9 - age:.0f}.rrd")
    return RecordingFile(name, "s.m", NOW - age - HOUR, NOW - age, size, marked)


def kept(files: list[RecordingFile], size: int = 0, shortage: int = 0) -> list[RecordingFile]:
    gone = list(expendable(files, BUDGET, NOW, size, shortage))
    return [file for file in files if file not in gone]


def test_the_oldest_are_deleted_first_and_no_more_than_needed() -> None:
    files = [made(hours * HOUR, 300) for hours in range(5)]
    assert kept(files) == files[:3]
    assert kept(files, size=200) == files[:2]
    assert kept(files[:3]) == files[:3]


def test_what_is_too_old_is_deleted_unless_it_is_around_an_event() -> None:
    files = [made(15 * DAY, 1), made(15 * DAY, 1, marked=True), made(13 * DAY, 1)]
    files += [made(hours * HOUR, 1) for hours in range(25)]  # the clock is right
    assert kept(files) == files[1:]


def test_marked_files_leave_room_for_the_newest() -> None:
    files = [made(hours * HOUR, 100, marked=hours > 2) for hours in range(20)]
    left = kept(files)
    assert sum(file.size for file in left if file.is_marked) <= MAX_EVENT_SHARE * BUDGET.max_bytes
    assert left[:3] == files[:3]


def test_files_around_an_event_are_not_deleted_in_vain() -> None:
    files = [made(hours * HOUR, 100, marked=hours > 1) for hours in range(5)]
    assert kept(files, shortage=300) == files[2:4]
    assert kept(files, shortage=600) == files[2:]


def test_a_clock_that_leaps_ahead_deletes_nothing_for_a_day() -> None:
    before = [made(400 * DAY + hours * HOUR, 1) for hours in range(15 * 24)]
    old = [file for file in before if file.end < before[0].end - BUDGET.max_age]
    assert old
    for hours in range(24):  # of operation with the new time
        since = [made(age * HOUR, 1) for age in range(hours)]
        left = kept(before + since)
        assert [file for file in before + since if file not in left] == old
    assert kept(before + [made(age * HOUR, 1) for age in range(25)]) == [made(age * HOUR, 1) for age in range(25)]


def test_files_of_a_clock_that_was_ahead_go_before_newer_ones() -> None:
    ahead = [made(-400 * DAY + hours * HOUR, 300) for hours in range(3)]
    newer = [made(hours * HOUR, 300) for hours in range(3)]
    assert kept([*newer, *ahead]) == newer


FILES = st.lists(st.builds(made, st.floats(-DAY, 20 * DAY), st.integers(0, 500), marked=st.booleans()), max_size=12)


@given(FILES, st.integers(0, 300), st.integers(-100, 2000))
def test_the_budget_is_kept_whatever_there_is(files: list[RecordingFile], size: int, shortage: int) -> None:
    """A plain file goes before a marked one, an older one before a newer one of its kind."""
    left = kept(files, size, shortage)
    assert size + sum(file.size for file in left) <= BUDGET.max_bytes or not left
    freed, total = sum(file.size for file in files) - sum(file.size for file in left), sum(file.size for file in files)
    assert freed >= shortage or (shortage > total and all(file.is_marked for file in left if file.size))
    for marked in (False, True):
        own = sorted((file for file in files if file.is_marked is marked), key=lambda file: file.begin)
        begins = [file.begin for file in own if file in left]
        assert begins == sorted(file.begin for file in own)[len(own) - len(begins) :]


def folder_of(tmp_path: Path, budget: RecordingBudget = BUDGET) -> RecordingFolder:
    return RecordingFolder(tmp_path / "recordings", "site.motor", budget)


def written(folder: RecordingFolder, now: float, size: int = 10) -> Path:
    path = folder.new_path(now)
    path.write_bytes(bytes(size))
    os.utime(path, (now, now))
    return path


def test_names_are_unique_and_sort_by_time(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    first = [written(folder, NOW) for _ in range(3)]
    later = [written(folder, NOW + hours * HOUR) for hours in range(1, 30)]
    assert len({*first, *later}) == 32
    assert [path.name for path in later] == sorted(path.name for path in later)
    assert all(re.fullmatch(r"site\.motor-\d{8}T\d{6}-\d+(-\d)?\.rrd", path.name) for path in first)
    marked = folder.new_path(NOW, marked=True)
    assert recording_file(marked) is None
    marked.touch()
    own = recording_file(marked)
    assert own is not None
    assert (own.key, own.begin, own.is_marked) == ("site.motor", NOW, True)


def test_files_around_an_event_are_marked(tmp_path: Path) -> None:
    folder = folder_of(tmp_path)
    old, before = written(folder, NOW - 2 * EVENT_MARGIN), written(folder, NOW - 0.5 * EVENT_MARGIN)
    current = written(folder, NOW)
    renamed = folder.mark(NOW + 1.0, current)
    assert old.exists()
    assert {file.path.name for file in folder.files() if file.is_marked} == {
        before.name.replace(".rrd", "-event.rrd"),
        renamed.name,
    }
    assert folder.mark(NOW + 2.0, renamed) == renamed


def test_only_own_recordings_are_deleted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk: all of the machine go but the one being written; other names, other machines stay."""
    folder = folder_of(tmp_path)
    current, *own = (written(folder, NOW - hours * HOUR) for hours in range(3))
    others = [
        written(RecordingFolder(current.parent, key, BUDGET), NOW) for key in ("site.motor-2", "other.motor", "motor")
    ]
    others += [
        current.with_name(name) for name in ("notes.rrd", "site.motor-kept.rrd", "site.motor-20260101T000000-1.txt")
    ]
    others += [current.with_name("site.motor-20269999T999999-1.rrd")]
    for path in others:
        path.touch()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(1 << 40, 1 << 40, 0))
    assert folder.make_room(NOW, current) > 0
    assert not any(path.exists() for path in own)
    assert all(path.exists() for path in [current, *others])


def test_the_oldest_files_are_deleted_while_the_disk_fills_from_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk of 20 GB of which others take more and more; ``disk_usage`` is replaced."""
    total, size = 20 * 10**9, 10**8
    folder = folder_of(tmp_path, RecordingBudget(10e9, 14 * DAY, 256e6, HOUR))
    paths = [folder.new_path(NOW + hours * HOUR) for hours in range(10)]
    for path in paths:
        with path.open("wb") as file:
            file.truncate(size)  # a sparse file
    taken = 0

    def usage(_: Path) -> Usage:
        used = taken + sum(path.stat().st_size for path in paths if path.exists())
        return Usage(total, used, total - used)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    reserve = max(MIN_FREE_BYTES, MIN_FREE_SHARE * total)
    for step in range(20):
        taken = (170 + step) * 10**8
        missing = folder.make_room(NOW + 10 * HOUR, paths[-1])
        left = [path for path in paths if path.exists()]
        assert left == paths[-len(left) :]
        assert (missing <= 0) == (usage(tmp_path).free >= reserve)
        assert missing <= 0 or left == paths[-1:]
    assert left == paths[-1:]


def test_samples_are_counted_marked_and_deleted_with_their_recording(tmp_path: Path) -> None:
    """Also those that are left alone, and the parts of a recording that is being written."""
    folder = folder_of(tmp_path, RecordingBudget(450, 14 * DAY, 100, HOUR))
    paths = [written(folder, NOW + hours * HOUR, 50) for hours in range(5)]
    for path in paths[:-1]:
        whole_file(path).write_bytes(bytes(100))
    parts_folder(paths[-1]).mkdir()
    for number in range(2):
        (parts_folder(paths[-1]) / f"{number}.parquet").write_bytes(bytes(40))
    paths[0].unlink()
    for path in paths[:-1]:
        os.utime(whole_file(path), (path.stat().st_mtime if path.exists() else NOW,) * 2)
    assert [file.size for file in folder.files()] == [100, 150, 150, 150, 130]
    current = folder.mark(NOW + 4 * HOUR, paths[-1])
    assert current.name.endswith("-event.rrd")
    assert size_of(current) == 130
    assert not parts_folder(paths[-1]).exists()
    folder.make_room(NOW + 4 * HOUR, current)
    assert [file.path for file in folder.files()] == [*paths[2:4], current]
    assert not whole_file(paths[0]).exists()
    assert not whole_file(paths[1]).exists()
    assert folder.new_path(NOW + 4 * HOUR).name.count("-") == paths[-1].name.count("-") + 1  # its name is taken


def test_the_group_may_read_the_folder(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        assert folder_of(tmp_path).new_path(NOW).parent.stat().st_mode & 0o777 == 0o750
    finally:
        os.umask(before)


def test_a_file_is_full_by_age_by_size_and_after_the_clock_was_set_back() -> None:
    assert not BUDGET.is_full(HOUR - 1.0, 99)
    assert BUDGET.is_full(HOUR, 0)
    assert BUDGET.is_full(0.0, 100)
    assert BUDGET.is_full(-HOUR, 0)
