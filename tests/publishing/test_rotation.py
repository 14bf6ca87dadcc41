"""Rotation of recordings in simulated time: nothing is lost between files, and each file can be used alone."""

import os
import shutil
import warnings
from collections import namedtuple
from pathlib import Path

import numpy as np
import psutil
import pytest
from rerun.chunk import RrdReader

from otolith.health.schema import EventChange, Report
from otolith.machine import LoadedMachine, RecordedMachine, load_machine
from otolith.publishing.recorder import CHECK_INTERVAL, RotatedRecording
from otolith.storage.recording_files import DAY, RecordingBudget, RecordingFolder
from otolith_drivers.base import Sampling
from otolith_drivers.replay.recording import RecordingReader
from tests.cli.replays import MACHINE
from tests.health.test_events import assessed, report
from tests.publishing.test_recording_size import BEGIN, LENGTH, UNITS, noise

Usage = namedtuple("Usage", ["total", "used", "free"])


@pytest.fixture(scope="module")
def machine() -> LoadedMachine:
    return load_machine(MACHINE, with_driver=False)


@pytest.fixture
def source(machine: LoadedMachine) -> RecordedMachine:
    return machine.recorded(Sampling.TRUE)


def folder_of(tmp_path: Path, **changed: float) -> RecordingFolder:
    budget = {"max_bytes": 1e9, "max_age": DAY, "rotate_bytes": 1e9, "rotate_age": 60.0, **changed}
    return RecordingFolder(tmp_path / "recordings", "site.motor", RecordingBudget(**budget))


def recorded(folder: RecordingFolder, source: RecordedMachine, reports: list[Report]) -> None:
    recording = RotatedRecording(folder.new_path(BEGIN), source, folder, BEGIN)
    for one in reports:
        recording.add(one, one.document.window.end)
        assert recording.has_room(one.document.window.end)
    recording.close()


def omega(path: Path) -> np.ndarray:
    with RecordingReader(path, UNITS) as reader:
        assert reader.warnings() == []  # it is complete
        return np.concatenate([part.columns["omega"] for part in reader.chunks()])


def test_nothing_is_lost_between_files_and_each_is_complete(tmp_path: Path, source: RecordedMachine) -> None:
    """100 windows of 2 s, a file per minute."""
    folder, reports = folder_of(tmp_path), list(noise(100))
    recorded(folder, source, reports)
    files = sorted(file.path for file in folder.files())
    assert len(files) == 4
    measured = np.concatenate([one.traces.measured[:, 1] for one in reports])
    assert np.array_equal(np.concatenate([omega(path) for path in files]), measured)
    for path in files:
        assert len(RrdReader(path).blueprints()) == 1
        assert [entry.recording_id for entry in RrdReader(path).recordings()] == ["motor_site"]


def test_a_file_of_the_largest_size_is_followed_by_another(tmp_path: Path, source: RecordedMachine) -> None:
    folder = folder_of(tmp_path, rotate_age=DAY, rotate_bytes=4e5)
    recorded(folder, source, list(noise(120)))
    sizes = [file.size for file in folder.files()]
    assert len(sizes) >= 3
    assert max(sizes) < 8e5  # by up to a batch of windows larger


def test_the_budget_is_kept_and_the_newest_data_stay(tmp_path: Path, source: RecordedMachine) -> None:
    folder, reports = folder_of(tmp_path, max_bytes=1e6), list(noise(240))
    recorded(folder, source, reports)
    files = sorted(file.path for file in folder.files())
    assert sum(path.stat().st_size for path in files) <= 1.5e6  # the budget, and what was written since the last check
    assert np.array_equal(omega(files[-1])[-200:], reports[-1].traces.measured[:, 1])
    with RecordingReader(files[0], UNITS) as reader:
        first = next(reader.chunks()).times[0]
    assert first > BEGIN + 60.0


def test_minutes_after_an_event_are_marked_too(tmp_path: Path, source: RecordedMachine) -> None:
    """The event is in the third of the files of a minute; the mark ends five minutes later."""
    folder, reports = folder_of(tmp_path), list(noise(330))
    events = next(after.events for after in assessed(report(index, 5.8) for index in range(9)) if after.events)
    assert events[0].change is EventChange.RAISED
    reports[75] = Report(reports[75].document.model_copy(update={"events": events}), reports[75].traces)
    recorded(folder, source, reports)
    files = sorted(folder.files(), key=lambda file: file.begin)
    begins = [file.begin - BEGIN for file in files if file.is_marked]
    assert begins[-1] <= 75 * LENGTH + 300.0 < begins[-1] + 124.0
    assert not files[-1].is_marked
    assert len(omega(files[2].path)) == 30 * 200  # a file that was renamed while it was written


def test_an_event_while_the_clock_was_ahead_marks_no_later_file(tmp_path: Path, source: RecordedMachine) -> None:
    folder, reports = folder_of(tmp_path), list(noise(3))
    events = next(after.events for after in assessed(report(index, 5.8) for index in range(9)) if after.events)
    reports[0] = Report(reports[0].document.model_copy(update={"events": events}), reports[0].traces)
    recording = RotatedRecording(folder.new_path(BEGIN), source, folder, BEGIN)
    for one, now in zip(reports, (BEGIN + 1000 * DAY, BEGIN + 61.0, BEGIN + 1000.0), strict=True):
        recording.add(one, now)
    recording.close()
    assert [file.is_marked for file in sorted(folder.files(), key=lambda file: file.begin)] == [
        False,
        False,
        False,
        True,
    ]


def test_the_group_may_read_files_whatever_the_mask_is(tmp_path: Path, source: RecordedMachine) -> None:
    before = os.umask(0o077)
    try:
        folder = folder_of(tmp_path)
        recorded(folder, source, list(noise(40)))
    finally:
        os.umask(before)
    assert {file.path.stat().st_mode & 0o777 for file in folder.files()} == {0o640}


def test_many_files_cost_neither_threads_nor_descriptors(tmp_path: Path, source: RecordedMachine) -> None:
    """Rerun keeps two threads for each stream and for each default blueprint."""
    folder, process = folder_of(tmp_path), psutil.Process()
    recording = RotatedRecording(folder.new_path(BEGIN), source, folder, BEGIN)
    counts = []
    for hour, one in enumerate(noise(40)):
        recording.add(one, BEGIN + 3600.0 * hour)
        counts.append((process.num_threads(), process.num_fds()))
    recording.close()
    assert len(folder.files()) == 40
    first, last = np.array(counts[5:10]), np.array(counts[-5:])  # what other tests left behind may end meanwhile
    assert (last.max(axis=0) - first.max(axis=0)).max() <= 2


def test_a_recording_without_a_folder_is_one_file(tmp_path: Path, source: RecordedMachine) -> None:
    recording = RotatedRecording(tmp_path / "run.rrd", source, None, BEGIN)
    for one in noise(40):
        recording.add(one, one.document.window.end + 1e6)
    recording.close()
    assert [path.name for path in tmp_path.iterdir()] == ["run.rrd"]


def test_the_disk_is_checked_for_each_window(
    tmp_path: Path, source: RecordedMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = folder_of(tmp_path)
    recording = RotatedRecording(folder.new_path(BEGIN), source, folder, BEGIN)
    assert recording.has_room(BEGIN + 1.0)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**10, 96 * 10**8, 4 * 10**8))
    assert not recording.has_room(BEGIN + 2.0)
    assert CHECK_INTERVAL > 2.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        recording.close()
