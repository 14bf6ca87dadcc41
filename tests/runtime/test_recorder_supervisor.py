"""The recorder process under supervision: stopped, killed, on a full disk. Times of the supervisor are simulated."""

import errno
import logging
import os
import shutil
import signal
import threading
import time
from collections import namedtuple
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.hall.recorder_process import RecorderProcess
from otolith.runtime.recorder_supervisor import FOLDER_TIMEOUT, MIN_DEATHS, RECORDER_TIMEOUT, RecorderSupervisor
from otolith.storage.recording_files import RecordingFile, RecordingFolder
from otolith_drivers.errors import ServiceError
from otolith_drivers.replay.recording import open_recording
from tests.conftest import EXAMPLES
from tests.messages import assert_says
from tests.publishing.test_recording_size import UNITS, noise
from tests.waiting import PATIENCE, wait_for, within

Usage = namedtuple("Usage", ["total", "used", "free"])


@pytest.fixture
def machine(tmp_path: Path) -> LoadedMachine:
    loaded = load_machine(EXAMPLES / "dc-motor-in-process.toml")
    recording = loaded.file.recording.model_copy(update={"folder": tmp_path / "recordings"})
    return replace(loaded, file=loaded.file.model_copy(update={"recording": recording}))


@pytest.fixture
def supervisor(machine: LoadedMachine) -> Iterator[RecorderSupervisor]:
    running = RecorderSupervisor(machine)
    yield running
    running.stop(0.0)


def answered(supervisor: RecorderSupervisor, now: float) -> Callable[[], bool]:
    def is_answered() -> bool:
        supervisor.poll(now)
        return supervisor._preparation is None and supervisor._unanswered == 0

    return is_answered


def poll(supervisor: RecorderSupervisor, now: float) -> None:
    """Poll until the disk has answered."""
    supervisor.poll(now)
    wait_for(lambda: supervisor._preparation is None or supervisor._preparation.is_done)
    supervisor.poll(now)


def test_a_stopped_recorder_is_killed_and_counted(
    supervisor: RecorderSupervisor, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    first, *rest = noise(4)
    supervisor.start(0.0)
    supervisor.offer(first, 1.0)
    wait_for(answered(supervisor, 2.0))
    stopped = supervisor._whole.child._process.pid
    os.kill(stopped, signal.SIGSTOP)
    for index, one in enumerate(rest):
        supervisor.offer(one, 100.0 + 2.0 * index)
    supervisor.poll(100.0 + RECORDER_TIMEOUT)
    assert (supervisor.restarts, supervisor.dropped) == (0, 0)
    poll(supervisor, 100.1 + RECORDER_TIMEOUT)
    assert not Path(f"/proc/{stopped}").exists()
    assert (supervisor.restarts, supervisor.dropped) == (1, 4)  # one was received, but not yet written
    assert "the recorder has not answered in 60.1 s" in caplog.text
    supervisor.offer(first, 200.0)
    wait_for(answered(supervisor, 201.0))
    supervisor.stop(10.0)
    _, second = sorted((tmp_path / "recordings").glob("*.rrd"), key=lambda path: path.stat().st_mtime_ns)
    with open_recording(second, UNITS) as reader:
        assert sum(len(part.times) for part in reader.chunks()) == 200


def test_a_recorder_that_always_dies_has_an_outage(supervisor: RecorderSupervisor) -> None:
    supervisor.start(0.0)
    poll(supervisor, 0.0)
    supervisor.offer(next(noise(1)), 1.0)
    outages, now = list[str](), 2.0
    for _ in range(MIN_DEATHS):
        supervisor._whole.child._process.kill()
        supervisor._whole.child._process.join()
        wait_for(lambda: not supervisor._process.alive)
        while not supervisor._process.alive:
            outages.append(supervisor.outage)
            poll(supervisor, now)
            now += 0.25
    assert outages[0] == ""
    assert supervisor._process.alive
    assert "ended" in supervisor.outage  # although it lives again, which it did each time


def test_a_recorder_without_work_does_not_hang(supervisor: RecorderSupervisor) -> None:
    supervisor.start(0.0)
    supervisor.offer(next(noise(1)), 1.0)
    wait_for(answered(supervisor, 2.0))
    supervisor.poll(1e6)
    supervisor.offer(next(noise(1)), 1e6)
    supervisor.poll(1e6 + 0.9 * RECORDER_TIMEOUT)
    assert (supervisor.restarts, supervisor.dropped) == (0, 0)


def test_a_full_disk_gives_one_warning_and_one_line_when_it_has_room(
    supervisor: RecorderSupervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """``disk_usage`` is replaced. A day of polls; another program deletes and writes a little all the time."""
    free = [4 * 10**9]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**11, 10**11 - free[0], free[0]))
    report = next(noise(1))
    with caplog.at_level(logging.INFO, "otolith"):
        supervisor.start(0.0)
        for minute in range(1440):
            free[0] = int(5e9 + (minute % 7 - 3) * 1e8)  # around the 5 % that are kept free
            poll(supervisor, 60.0 * minute)
            supervisor.offer(report, 60.0 * minute)
        (line,) = caplog.messages
        assert "recording pauses until" in line
        assert "MB more free" in line
        assert supervisor.dropped == 1440
        assert "MB more free" in supervisor.outage
        assert not any((tmp_path / "recordings").iterdir())
        free[0] = 6 * 10**9
        poll(supervisor, 1e6)
    assert supervisor.outage == ""
    assert len(caplog.messages) == 2
    assert caplog.messages[1].startswith("recording to ")
    assert supervisor.restarts == 0


def test_a_folder_that_cannot_be_written_is_logged_once(
    supervisor: RecorderSupervisor, machine: LoadedMachine, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Monitoring begins and goes on without recordings; a file that somebody asked for is refused at once."""
    (tmp_path / "recordings").write_text("a file", encoding="utf-8")
    with pytest.raises(ServiceError, match="a file, not a folder: move it away"):
        RecorderSupervisor(machine, tmp_path / "recordings" / "own.rrd").start(0.0)
    supervisor.start(0.0)
    for minute in range(100):
        poll(supervisor, 60.0 * minute)
    (line,) = caplog.messages
    assert line.startswith("no recording: ")


def test_a_link_to_itself_among_the_recordings_is_left_alone(supervisor: RecorderSupervisor, tmp_path: Path) -> None:
    link = tmp_path / "recordings" / "demo.dc-motor-in-process-20260101T000000-1.rrd"
    link.parent.mkdir()
    link.symlink_to(link.name)
    supervisor.start(0.0)
    poll(supervisor, 1.0)
    assert link.is_symlink()
    assert supervisor.outage == ""


def test_a_disk_that_fails_costs_recordings_alone(
    supervisor: RecorderSupervisor, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: Path) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(shutil, "disk_usage", fail)
    supervisor.start(0.0)
    for minute in range(100):
        poll(supervisor, 60.0 * minute)
    (line,) = caplog.messages
    assert_says(line, "no recording", "[Errno 5] Input/output error")


@pytest.mark.timed
def test_a_folder_that_does_not_answer_delays_nobody(
    supervisor: RecorderSupervisor, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answers = threading.Event()
    files = RecordingFolder.files

    def hang(folder: RecordingFolder) -> list[RecordingFile]:
        assert answers.wait(PATIENCE)
        return files(folder)

    monkeypatch.setattr(RecordingFolder, "files", hang)
    begun = time.monotonic()
    supervisor.start(0.0)
    for index, report in enumerate(noise(3)):
        supervisor.offer(report, 2.0 * index)
        supervisor.poll(2.0 * index)
    assert time.monotonic() - begun < within(0.5)
    assert supervisor.outage == ""
    for _ in range(2):
        supervisor.poll(1.0 + FOLDER_TIMEOUT)
    assert "does not answer" in supervisor.outage
    assert caplog.text.count("does not answer") == 1
    assert supervisor.dropped == 3
    answers.set()
    poll(supervisor, 100.0)
    assert supervisor.outage == ""


def test_windows_that_come_before_the_folder_is_ready_are_recorded(
    supervisor: RecorderSupervisor, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers, files = threading.Event(), RecordingFolder.files
    monkeypatch.setattr(RecordingFolder, "files", lambda folder: answers.wait(PATIENCE) and files(folder))
    supervisor.start(0.0)
    for report in noise(2):
        supervisor.offer(report, 1.0)
    answers.set()
    poll(supervisor, 2.0)
    wait_for(answered(supervisor, 3.0))
    assert (supervisor.dropped, supervisor.restarts) == (0, 0)


def test_a_file_is_never_larger_than_an_eighth_of_the_budget(machine: LoadedMachine) -> None:
    recording = machine.file.recording.model_copy(update={"max_gigabytes": 0.8})
    small = replace(machine, file=machine.file.model_copy(update={"recording": recording}))
    assert RecorderSupervisor(machine)._folder().budget.rotate_bytes == 256e6
    assert RecorderSupervisor(small)._folder().budget.rotate_bytes == 0.1e9


@pytest.mark.parametrize("value", ["off", "0", "False"])
def test_the_environment_may_switch_recordings_off(
    supervisor: RecorderSupervisor, machine: LoadedMachine, monkeypatch: pytest.MonkeyPatch, value: str
) -> None:
    """As ``systemd/otolith.default`` shows; Rerun would raise an error instead of recording nothing."""
    monkeypatch.delenv("RERUN", raising=False)
    assert supervisor.is_enabled
    monkeypatch.setenv("RERUN", value)
    assert not supervisor.is_enabled
    supervisor.reload(machine, 0.0)
    assert not supervisor._process.alive


def test_machines_share_a_process_and_a_disk_that_fails_concerns_one_of_them(
    machine: LoadedMachine, tmp_path: Path
) -> None:
    whole, supervisors = RecorderProcess(), list[RecorderSupervisor]()
    for number in range(2):
        identity = machine.file.machine.model_copy(update={"name": f"motor-{number}"})
        folder = machine.file.recording.model_copy(update={"folder": tmp_path / f"recordings-{number}"})
        file = machine.file.model_copy(update={"machine": identity, "recording": folder})
        supervisors.append(RecorderSupervisor(replace(machine, file=file), None, whole))
    (first, second), (one, other) = supervisors, noise(2)
    for supervisor in supervisors:
        supervisor.start(0.0)
        supervisor.offer(one, 1.0)
    for supervisor in supervisors:
        wait_for(answered(supervisor, 2.0))
    assert whole.child.starts == 1
    (path,) = (tmp_path / "recordings-0").glob("*.rrd")
    path.unlink()  # the size of the file is looked at for each window
    first.offer(other, 3.0)
    second.offer(other, 3.0)
    wait_for(answered(second, 4.0))

    def has_ended() -> bool:
        second.poll(5.0)
        return not first._process.alive

    wait_for(has_ended)
    assert second._process.alive
    poll(first, 6.0)
    assert (first.restarts, first.dropped, second.restarts, second.dropped) == (1, 2, 0, 0)
    whole.stop(10.0)
    (kept,) = (tmp_path / "recordings-1").glob("*.rrd")
    with open_recording(kept, UNITS) as reader:
        assert sum(len(part.times) for part in reader.chunks()) == 400
