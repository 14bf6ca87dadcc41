"""A month on a disk of 500 MB, in simulated time, with the defaults of a machine file. Runs on this computer, as root.

By default it is a day and a half, after which the disk is full: ``OTOLITH_DAYS=30`` sets another time.
"""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from otolith.health.schema import EventChange, Report, Traces
from otolith.machine import load_machine
from otolith.machine_file import EvidenceTable, HistoryTable, RecordingTable
from otolith.publishing.recorder import RotatedRecording
from otolith.storage.history import DAY, HOUR
from otolith.storage.history_writer import Bounds
from otolith.storage.recording_files import GIGABYTE, MEGABYTE, MIN_FREE_BYTES, RecordingBudget, RecordingFolder
from otolith_drivers.base import Sampling
from otolith_drivers.replay.recording import open_recording
from tests.conftest import EXAMPLES
from tests.storage.histories import MACHINE, SITE, document
from tests.storage.test_history import Simulated
from tests.vm.conftest import run

DAYS = float(os.environ.get("OTOLITH_DAYS", "1.5"))  # the disk is full after one
LENGTH, PERIOD = 60.0, 0.01  # s: of a window, and between its records, as in the examples
BETWEEN_EVENTS = 500  # windows
PASSAGE = 75_000  # bytes of a report that stands for those of thirty short windows
UNITS = {"V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    image, folder = tmp_path / "image", tmp_path / "disk"
    folder.mkdir()
    with image.open("wb") as file:
        file.truncate(500_000_000)
    run("mkfs.ext4", "-q", "-F", str(image))
    run("mount", "-o", "loop", str(image), str(folder))
    yield folder
    run("umount", "--lazy", str(folder))  # a test that failed may have files open


def reports(begin: float) -> Iterator[Report]:
    """Noise, which cannot be compressed."""
    random = np.random.default_rng(1)
    records = round(LENGTH / PERIOD)
    for index in range(round(DAYS * DAY / LENGTH)):
        change = EventChange.RAISED if index % BETWEEN_EVENTS == BETWEEN_EVENTS // 2 else None
        end = begin + (index + 1) * LENGTH
        written = document(index, end, 6.5 + 0.01 * random.normal(), length=LENGTH, change=change)
        measured, driving = random.normal(size=(2, records, 2))
        traces = Traces(
            offsets=np.arange(records, dtype=np.float64) * PERIOD,
            outputs=("i", "omega"),
            measured=measured,
            predicted=measured,
            noise=(0.005, 0.02),
            inputs=("V_a", "T_load"),
            driving=driving,
        )
        yield Report(written.model_copy(update={"notes": (random.bytes(PASSAGE).hex(),)}), traces)


def test_the_newest_data_and_all_events_stay(disk: Path, caplog: pytest.LogCaptureFixture) -> None:
    table, kept = RecordingTable(), HistoryTable()
    begin = time.time() - DAYS * DAY  # file times are those of the simulated clock
    rotation = (table.rotate_megabytes * MEGABYTE, table.rotate_minutes * 60.0)
    budget = RecordingBudget(table.max_gigabytes * GIGABYTE, table.max_days * DAY, *rotation)
    folder = RecordingFolder(disk / "recordings", f"{SITE}.{MACHINE}", budget)
    history = Simulated(
        disk / "history" / "month.history.sqlite",
        Bounds(round(kept.max_megabytes * MEGABYTE), kept.days, kept.resend_hours), begin,
    )  # fmt: skip
    (disk / "evidence").write_bytes(bytes(round(EvidenceTable().max_megabytes * MEGABYTE)))
    machine = load_machine(EXAMPLES / "dc-motor.toml", with_driver=False)
    recording = RotatedRecording(folder.new_path(begin), machine.recorded(Sampling.TRUE), folder, begin)
    paused, free, last = 0, [], None
    for last in reports(begin):
        now = last.document.window.end
        history.write(last.document)
        history.prune(now, LENGTH)
        if recording.has_room(now):
            recording.add(last, now)
            os.utime(recording.path, (now, now))
        else:
            paused += 1
        free.append(os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize)
    recording.close()
    assert last is not None
    print(f"{len(free)} windows, {paused} not recorded, at least {min(free) / MEGABYTE:.0f} MB free")
    assert paused == 0
    assert min(free) > 0.5 * MIN_FREE_BYTES  # recordings give way to the history
    assert not [line for line in caplog.messages if "deleted for the budget" not in line]
    reader = history.writer.reader
    assert reader.latest(1)[0].window.end == last.document.window.end
    assert len(reader.events(0.0)) == round(DAYS * DAY / LENGTH) // BETWEEN_EVENTS
    files = sorted(folder.files(), key=lambda file: file.begin)
    marked, size = sum(file.is_marked for file in files), sum(file.size for file in files) / MEGABYTE
    print(
        f"{len(files)} recordings of {size:.0f} MB, {marked} around events; history {history.largest / MEGABYTE:.0f} MB"
    )
    for file in files:
        with open_recording(file.path, UNITS) as opened:
            assert opened.warnings() == []
            newest = [part.columns["omega"] for part in opened.chunks()][-1]
    assert np.array_equal(newest, last.traces.measured[-len(newest) :, 1])
    assert files[-1].begin > last.document.window.end - HOUR - LENGTH
    history.writer._close()
