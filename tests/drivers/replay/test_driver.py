"""The replay driver: times, counts, repetition, and errors with their key."""

import threading
import time
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay.driver import (
    GATHERED,
    MAX_GATHERED,
    Options,
    ReplayDriver,
    SamplesOfRows,
    Source,
    build,
)
from otolith_drivers.replay.player import player
from otolith_drivers.replay.readers import Rows
from otolith_drivers.replay.table import reader as table
from tests.conftest import EXAMPLES, SIGNALS
from tests.drivers.logs import UNITS, frames_of, live, written
from tests.waiting import PATIENCE, wait_for, within

FAST = "as fast as possible"
ENDED = "the recording has ended"


def setup(sources: dict[str, dict[str, Any]], folder: Path = EXAMPLES) -> Setup:
    signals = (Signal(name, UNITS[name], Source.model_validate(source)) for name, source in sources.items())
    return Setup(tuple(signals), folder, 0.01)


def written_table(folder: Path, rows: int) -> Path:
    """Rows of irregular times, with a blank cell, a bad cell and a bad row."""
    random = np.random.default_rng(2)
    times = np.cumsum(random.uniform(0.005, 0.015, rows)).round(4)
    lines = [f"{time},{index},{-index}" for index, time in enumerate(times.tolist())]
    lines[3], lines[5] = lines[3].rsplit(",", 1)[0] + ",", lines[5].rsplit(",", 1)[0] + ",?"
    lines.insert(7, "1,2")
    path = folder / "drive.csv"
    path.write_text("\n".join(["t,i,omega", *lines]) + "\n", encoding="utf-8")
    return path


def driver_of(path: Path, sources: dict[str, dict[str, Any]] | None = None, **options: Any) -> ReplayDriver:
    named = sources if sources is not None else {"i": {}, "omega": {}}
    return build(Options.model_validate({"file": path, **options}), setup(named))


def played(driver: ReplayDriver) -> list[Sample]:
    """All samples of the file."""
    got: list[Sample] = []
    driver.open(got.extend)
    wait_for(lambda: not driver.link().up)
    driver.close()
    assert driver.link().reason == ENDED
    return got


@pytest.mark.timed
@pytest.mark.parametrize("pace", ["real time", FAST])
def test_replay_keeps_spacing_and_counts_every_cell(tmp_path: Path, pace: str) -> None:
    path = written_table(tmp_path, 60)
    driver = driver_of(path, pace=pace)
    assert (driver.link().up, driver.link().reason) == (False, "not opened yet")
    begun = time.monotonic()
    got = played(driver)
    with table.TableReader(path, {"i": "A", "omega": "rad/s"}) as opened:
        rows = reduce(Rows.followed_by, opened.chunks())
    for name, values in rows.columns.items():
        there = np.isfinite(values)
        assert [sample.value for sample in got if sample.signal == name] == values[there].tolist()
        times = np.array([sample.time for sample in got if sample.signal == name])
        assert times - got[0].time == pytest.approx(rows.times[there] - rows.times[0], abs=1e-6)
    assert begun <= got[0].time <= begun + within(1.0)
    counters = driver.counters()
    assert (counters.received, counters.bad, counters.lost) == (len(got), 2, 0) == (118, 2, 0)
    assert any("bad cells: 1, bad rows: 1" in line for line in driver.link().warnings)


@pytest.mark.timed
def test_replay_in_real_time_delivers_no_sample_early(tmp_path: Path) -> None:
    late: list[float] = []
    driver = driver_of(written_table(tmp_path, 100))
    driver.open(lambda samples: late.extend(time.monotonic() - sample.time for sample in samples))
    wait_for(lambda: not driver.link().up)
    assert len(late) == 198
    assert min(late) >= 0.0
    assert float(np.median(late)) < 0.5 * GATHERED + within(0.02)


def test_many_recordings_wake_their_thread_less_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is gathered for longer is late by so much more, and the link says so: a window waits for it."""
    path, deliveries = written_table(tmp_path, 100), list[int]()
    monkeypatch.setattr(player, "playing", 0)
    alone = driver_of(path).link().latency
    monkeypatch.setattr(player, "playing", 1000)
    driver = driver_of(path)
    assert alone == 0.0
    assert driver.link().latency == pytest.approx(MAX_GATHERED - GATHERED)
    driver.open(lambda samples: deliveries.append(len(samples)))
    wait_for(lambda: not driver.link().up)
    assert sum(deliveries) == 198
    assert len(deliveries) <= 1.0 / MAX_GATHERED + 2


def test_replay_waits_for_a_slow_receiver(tmp_path: Path) -> None:
    """Memory stays bounded, and no sample is lost."""
    path = tmp_path / "long.csv"
    path.write_text("t,i,omega\n" + "".join(f"{0.01 * k:.2f},1,2\n" for k in range(300_000)), encoding="utf-8")
    gate, got = threading.Event(), list[int]()

    def deliver(samples: Any) -> None:
        gate.wait(PATIENCE)
        got.append(len(samples))

    driver = driver_of(path, pace=FAST)
    driver.open(deliver)
    wait_for(lambda: driver.counters().received > 0)
    assert driver._reader is not None
    assert driver._reader.progress < 1.0
    assert driver.counters().received <= 1000
    gate.set()
    wait_for(lambda: not driver.link().up)
    assert sum(got) == driver.counters().received == 600_000


def test_replay_repeats_with_increasing_time(tmp_path: Path) -> None:
    driver, got = driver_of(written_table(tmp_path, 60), pace=FAST, repeat=True), list[Sample]()
    driver.open(got.extend)
    wait_for(lambda: len(got) > 3 * 118)
    assert driver.link().up
    driver.close()
    assert not driver.link().up
    times = np.array([sample.time for sample in got if sample.signal == "i"])
    assert (np.diff(times) > 0.0).all()
    assert times[60] - times[59] == pytest.approx(0.01, abs=1e-6)
    counters = driver.counters()
    assert counters.received == len(got)
    assert counters.bad == pytest.approx(2 * len(got) / 118, abs=2)


@pytest.mark.parametrize("suffix", [".log", ".blf", ".trc.gz"])
def test_replay_of_can_log_equals_live_samples(tmp_path: Path, scenario: MotorScenario, suffix: str) -> None:
    frames = frames_of(scenario, 300)
    path = written(tmp_path, frames, suffix)
    sources = {name: {"signal": SIGNALS[name]} for name in UNITS}
    driver = driver_of(path, sources, pace=FAST, can={"type": "can", "dbc": "dc-motor.dbc", "channel": "can0"})
    from_bus = live(frames)
    got = played(driver)
    assert [(sample.signal, sample.value) for sample in got] == [(sample.signal, sample.value) for sample in from_bus]
    assert driver.counters().received == len(from_bus)
    assert all(any(name in line for line in driver.describe()) for name in UNITS)


def test_replay_names_the_key_of_what_is_missing(tmp_path: Path, scenario: MotorScenario) -> None:
    path = written_table(tmp_path, 10)
    log = written(tmp_path, frames_of(scenario, 10), ".log")
    named: list[tuple[dict[str, Any], dict[str, dict[str, Any]], str, tuple[str, ...]]] = [
        ({"file": "none.csv"}, {"i": {}}, "No such file", ("driver", "file")),
        ({"file": path}, {"i": {"column": "I"}}, "no column 'I'", ("driver", "file")),
        ({"file": path}, {"i": {"signal": "x"}}, "unknown key 'signal'", ("signals", "i", "signal")),
        ({"file": log}, {"i": {"signal": "x"}}, "the description of the frames", ("driver", "can")),
        ({"file": log, "can": {"dcb": 1}}, {"i": {}}, "did you mean 'dbc'", ("driver", "can", "dcb")),
        ({"file": log, "can": {"dbc": "none.dbc"}}, {"i": {"signal": "x"}}, "No such file", ("driver", "can", "dbc")),
        (
            {"file": log, "can": {"dbc": "dc-motor.dbc"}},
            {"i": {"signal": "ArmatureCurent"}},
            "did you mean 'ArmatureCurrent'",
            ("signals", "i"),
        ),
    ]
    for options, sources, text, key in named:
        with pytest.raises(ConfigurationError, match=text) as caught:
            build(Options.model_validate(options), setup(sources, tmp_path if "none" in str(options) else EXAMPLES))
        assert caught.value.key == key


def test_replay_of_a_deleted_file_is_a_device_error(tmp_path: Path) -> None:
    path = written_table(tmp_path, 10)
    driver = driver_of(path)
    path.unlink()
    with pytest.raises(DeviceError, match="No such file"):
        driver.open(lambda _: None)


def test_replay_without_usable_rows_brings_the_link_down(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text("t,i,omega\nx,y,z\n", encoding="utf-8")
    driver = driver_of(path)
    driver.open(lambda _: None)
    wait_for(lambda: not driver.link().up)
    assert "none of the 1 rows can be used" in driver.link().reason
    driver.close()


def test_all_recordings_of_a_process_share_a_thread(tmp_path: Path) -> None:
    """A hall replays hundreds of them. Each gets all its rows, and closing one leaves the others."""
    path, before = written_table(tmp_path, 60), set(threading.enumerate())
    drivers = [driver_of(path) for _ in range(20)]
    got: list[list[Sample]] = [[] for _ in drivers]
    for driver, samples in zip(drivers, got, strict=True):
        driver.open(samples.extend)
    playing = [own for own in set(threading.enumerate()) - before if own.name == "replay"]
    drivers[0].close()
    assert len(playing) <= 1
    wait_for(lambda: not any(driver.link().up for driver in drivers))
    assert all(driver.link().reason == ENDED for driver in drivers[1:])
    assert {len(samples) for samples in got[1:]} == {drivers[1].counters().received} == {118}


def test_a_receiver_that_raises_ends_no_other_recording(tmp_path: Path) -> None:
    def refusing(_: object) -> None:
        raise ValueError("full")

    path, got = written_table(tmp_path, 60), list[Sample]()
    wrong, right = driver_of(path), driver_of(path)
    wrong.open(refusing)
    right.open(got.extend)
    wait_for(lambda: not right.link().up)
    assert right.link().reason == ENDED
    assert len(got) == 118
    assert "full" in wrong.link().reason


@pytest.mark.parametrize("step", [1, 7, 90, 250])
def test_rows_have_the_same_samples_however_many_are_taken(step: int) -> None:
    random = np.random.default_rng(0)
    columns = {name: np.where(random.random(250) < 0.3, np.nan, random.random(250)) for name in "ab"}
    times, numbers = np.linspace(0.0, 2.49, 250), np.zeros(250, dtype=np.int64)
    ready = SamplesOfRows(Rows(times, columns, numbers, numbers), times)
    taken = [sample for first in range(0, 250, step) for sample in ready.take(first, min(first + step, 250))]
    rows = range(250)
    assert taken == [
        Sample(name, times[row], columns[name][row]) for row in rows for name in "ab" if np.isfinite(columns[name][row])
    ]
    assert {type(sample.time) for sample in taken} == {float}
