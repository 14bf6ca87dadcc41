"""A file in the place of a machine: at its pace or as fast as it is taken, counted to the last sample."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otolith_drivers.base import Sample, Setup, Signal
from otolith_drivers.errors import ConfigurationError, DeviceError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.replay import tables as table
from otolith_drivers.replay.driver import Options, Replayer, Source, build
from tests.conftest import EXAMPLES, SIGNALS
from tests.drivers.logs import UNITS, frames_of, live, written
from tests.waiting import wait_for, within

FAST = "as fast as possible"
ENDED = "the recording has ended"


def setup(sources: dict[str, dict[str, Any]], folder: Path = EXAMPLES) -> Setup:
    signals = (Signal(name, UNITS[name], Source.model_validate(source)) for name, source in sources.items())
    return Setup(tuple(signals), folder, 0.01)


def written_table(folder: Path, rows: int) -> Path:
    """Rows that are not evenly spaced, with a cell blank, one wrong, and a row of another length."""
    random = np.random.default_rng(2)
    times = np.cumsum(random.uniform(0.005, 0.015, rows)).round(4)
    lines = [f"{time},{index},{-index}" for index, time in enumerate(times.tolist())]
    lines[3], lines[5] = lines[3].rsplit(",", 1)[0] + ",", lines[5].rsplit(",", 1)[0] + ",?"
    lines.insert(7, "1,2")
    path = folder / "drive.csv"
    path.write_text("\n".join(["t,i,omega", *lines]) + "\n", encoding="utf-8")
    return path


def driver_of(path: Path, sources: dict[str, dict[str, Any]] | None = None, **options: Any) -> Replayer:
    named = sources if sources is not None else {"i": {}, "omega": {}}
    return build(Options.model_validate({"file": path, **options}), setup(named))


def played(driver: Replayer) -> list[Sample]:
    """Everything, up to the end of the file."""
    got: list[Sample] = []
    driver.open(got.extend)
    wait_for(lambda: not driver.link().up)
    driver.close()
    assert driver.link().reason == ENDED
    return got


@pytest.mark.timed
@pytest.mark.parametrize("pace", ["real time", FAST])
def test_the_spacing_is_the_datas_and_every_cell_is_counted(tmp_path: Path, pace: str) -> None:
    path = written_table(tmp_path, 60)
    driver = driver_of(path, pace=pace)
    assert (driver.link().up, driver.link().reason) == (False, "not opened yet")
    begun = time.monotonic()
    got = played(driver)
    with table.Table(path, {"i": "A", "omega": "rad/s"}) as opened:
        (rows,) = opened.stretches()
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
def test_in_real_time_no_sample_comes_before_its_time(tmp_path: Path) -> None:
    late: list[float] = []
    driver = driver_of(written_table(tmp_path, 100))
    driver.open(lambda samples: late.extend(time.monotonic() - sample.time for sample in samples))
    wait_for(lambda: not driver.link().up)
    assert len(late) == 198
    assert min(late) >= 0.0
    assert float(np.median(late)) < within(0.02)


def test_who_takes_slowly_holds_the_replay_up(tmp_path: Path) -> None:
    """Nothing piles up in between, and nothing is lost."""
    path = tmp_path / "long.csv"
    path.write_text("t,i,omega\n" + "".join(f"{0.01 * k:.2f},1,2\n" for k in range(300_000)), encoding="utf-8")
    gate, got = threading.Event(), list[int]()

    def deliver(samples: Any) -> None:
        gate.wait(30.0)
        got.append(len(samples))

    driver = driver_of(path, pace=FAST)
    driver.open(deliver)
    time.sleep(0.5)
    assert driver._reader is not None
    assert driver._reader.progress < 1.0
    assert driver.counters().received <= 1000
    gate.set()
    wait_for(lambda: not driver.link().up)
    assert sum(got) == driver.counters().received == 600_000


def test_over_and_over_time_goes_on(tmp_path: Path) -> None:
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
def test_a_log_of_a_bus_says_what_the_bus_said(tmp_path: Path, scenario: MotorScenario, suffix: str) -> None:
    frames = frames_of(scenario, 300)
    path = written(tmp_path, frames, suffix)
    sources = {name: {"signal": SIGNALS[name]} for name in UNITS}
    driver = driver_of(path, sources, pace=FAST, can={"type": "can", "dbc": "dc-motor.dbc", "channel": "can0"})
    heard = live(frames)
    got = played(driver)
    assert [(sample.signal, sample.value) for sample in got] == [(sample.signal, sample.value) for sample in heard]
    assert driver.counters().received == len(heard)
    assert all(any(name in line for line in driver.describe()) for name in UNITS)


def test_what_the_file_does_not_have_is_said_with_its_key(tmp_path: Path, scenario: MotorScenario) -> None:
    path = written_table(tmp_path, 10)
    log = written(tmp_path, frames_of(scenario, 10), ".log")
    named: list[tuple[dict[str, Any], dict[str, dict[str, Any]], str, tuple[str, ...]]] = [
        ({"file": "none.csv"}, {"i": {}}, "No such file", ("driver", "file")),
        ({"file": path}, {"i": {"column": "I"}}, "no column 'I'", ("driver", "file")),
        ({"file": path}, {"i": {"signal": "x"}}, "unknown key 'signal'", ("signals", "i", "signal")),
        ({"file": log}, {"i": {"signal": "x"}}, "what is in the frames", ("driver", "can")),
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


def test_a_file_that_is_gone_is_a_device_error(tmp_path: Path) -> None:
    path = written_table(tmp_path, 10)
    driver = driver_of(path)
    path.unlink()
    with pytest.raises(DeviceError, match="No such file"):
        driver.open(lambda _: None)


def test_a_file_that_ends_in_garbage_brings_the_link_down_with_its_reason(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text("t,i,omega\nx,y,z\n", encoding="utf-8")
    driver = driver_of(path)
    driver.open(lambda _: None)
    wait_for(lambda: not driver.link().up)
    assert "none of the 1 rows can be used" in driver.link().reason
    driver.close()
