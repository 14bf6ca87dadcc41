"""What a recording costs on the disk, and what of it the viewer shows. The time is simulated."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning

from otolith.health.schema import EventChange, Report, Traces
from otolith.machine import LoadedMachine, load_machine
from otolith.publishing.recorder import BATCH_WINDOWS, FULL_CURVES, Recording
from otolith.storage.recording_files import size_of
from otolith_drivers.base import Sampling
from otolith_drivers.replay.recording import open_recording
from tests.cli.replays import MACHINE, PERIOD, RECORDS
from tests.health.test_events import assessed, report

BEGIN, LENGTH = 1_700_000_000.0, RECORDS * PERIOD
UNITS = {"V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}


@pytest.fixture(scope="module")
def machine() -> LoadedMachine:
    return load_machine(MACHINE, with_driver=False)


def noise(windows: int, seed: int = 1) -> Iterator[Report]:
    """Reports of a motor whose four signals are noise, which cannot be compressed."""
    random = np.random.default_rng(seed)
    for index in range(windows):
        document = report(index, 6.5 + 0.01 * random.normal())
        begin = BEGIN + index * LENGTH
        window = document.window.model_copy(update={"start": begin, "end": begin + LENGTH, "records": RECORDS})
        traces = Traces(
            offsets=np.arange(RECORDS, dtype=np.float64) * PERIOD,
            outputs=("i", "omega"),
            measured=random.normal(size=(RECORDS, 2)),
            predicted=random.normal(size=(RECORDS, 2)),
            noise=(0.005, 0.02),
            inputs=("V_a", "T_load"),
            driving=random.normal(size=(RECORDS, 2)),
        )
        yield Report(document.model_copy(update={"window": window}), traces)


def rows(path: Path, entity: str, column: str = "Scalars:scalars") -> tuple[Any, Any]:
    """Times in ns and values of an entity, ordered by time."""
    times, values = [], []
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            times.append(batch.column("time").cast(pa.int64()).to_numpy())
            values += batch.column(column).to_pylist()
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], [values[place] for place in order]


def test_a_recording_is_not_much_larger_than_its_samples(tmp_path: Path, machine: LoadedMachine) -> None:
    """An hour of noise, the worst case."""
    windows = 1800
    recording = Recording(tmp_path / "run.rrd", machine.recorded(Sampling.TRUE))
    for one in noise(windows):
        recording.add(one)
    recording.close()
    assert size_of(tmp_path / "run.rrd") <= 1.3 * windows * RECORDS * len(UNITS) * 8


def test_curves_have_the_extremes_and_the_begin_all_records(tmp_path: Path, machine: LoadedMachine) -> None:
    path = tmp_path / "run.rrd"
    reports = list(noise(FULL_CURVES + 5))
    recording = Recording(path, machine.recorded(Sampling.TRUE))
    for one in reports:
        recording.add(one)
    recording.close()
    times, values = rows(path, "/signals/i")
    later = times >= round((BEGIN + FULL_CURVES * LENGTH) * 1e9)
    assert np.count_nonzero(~later) == FULL_CURVES * RECORDS
    assert np.count_nonzero(later) == 5 * RECORDS // 20
    shown = np.array([value for value, late in zip(values, later, strict=True) if late])
    for one in reports[FULL_CURVES:]:
        measured = one.traces.measured[:, 0]
        assert {measured.min(), measured.max()} <= set(shown[:, 0])
    with open_recording(path, UNITS) as reader:
        samples = np.concatenate([part.columns["omega"] for part in reader.chunks()])
    assert np.array_equal(samples, np.concatenate([one.traces.measured[:, 1] for one in reports]))


def test_all_curves_may_have_all_records(tmp_path: Path, machine: LoadedMachine) -> None:
    recording = Recording(tmp_path / "run.rrd", replace(machine.recorded(Sampling.TRUE), all_curves=True))
    for one in noise(FULL_CURVES + 2):
        recording.add(one)
    recording.close()
    assert len(rows(tmp_path / "run.rrd", "/signals/V_a")[0]) == (FULL_CURVES + 2) * RECORDS


def test_a_change_of_an_event_is_written_at_once(tmp_path: Path, machine: LoadedMachine) -> None:
    path = tmp_path / "run.rrd"
    recording = Recording(path, machine.recorded(Sampling.TRUE))
    first, second, third = noise(3)
    assert BATCH_WINDOWS > 3
    recording.add(first)
    events = next(after.events for after in assessed(report(index, 5.8) for index in range(9)) if after.events)
    assert events[0].change is EventChange.RAISED
    raised = second.document.model_copy(update={"events": events})
    recording.add(Report(raised, second.traces))
    recording.add(third)
    with pytest.warns(RerunWarning, match="footer"):  # the file is still being written
        written = len(rows(path, "/windows")[0])
    recording.close()
    assert written == 2
    assert len(rows(path, "/windows")[0]) == 3


def test_what_continues_is_logged_once(tmp_path: Path, machine: LoadedMachine) -> None:
    path = tmp_path / "run.rrd"
    recording = Recording(path, machine.recorded(Sampling.TRUE))
    texts = [("stuck",), ("stuck",), (), ("stuck", "late")]
    for one, reasons in zip(noise(len(texts)), texts, strict=True):
        window = one.document.window
        quality = window.quality.model_copy(update={"reasons": reasons})
        changed = window.model_copy(update={"quality": quality})
        recording.add(Report(one.document.model_copy(update={"window": changed}), one.traces))
    recording.close()
    lines = sorted(line[0] for line in rows(path, "/log", "TextLog:text")[1])
    assert lines == ["window 0: stuck", "window 3: late", "window 3: stuck"]
