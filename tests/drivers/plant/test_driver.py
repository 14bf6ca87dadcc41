"""The plant driver: every sample is delivered or counted as lost, at its time or later."""

import threading
import time
from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path

import pytest

from otolith_drivers.base import Driver, Sample, Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.faults import FaultInjector
from otolith_drivers.plant.realtime import Options, Source, build
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.conftest import EXAMPLES
from tests.waiting import PATIENCE

SIGNALS = (
    Signal("i", "mA", Source(signal="ArmatureCurrent")),
    Signal("omega", "rad/s", Source(signal="RotorSpeed")),
)
TICK = 0.01  # s


@pytest.fixture
def scenario(tmp_path: Path) -> Callable[[str], Path]:
    """The demo scenario with other faults."""

    def write(faults: str) -> Path:
        text = (EXAMPLES / "scenarios" / "demo.toml").read_text(encoding="utf-8").split("[[faults]]")[0]
        path = tmp_path / "scenario.toml"
        path.write_text(f"{text}{faults}".replace("../dc-motor.dbc", str(EXAMPLES / "dc-motor.dbc")), encoding="utf-8")
        return path

    return write


def driver_of(path: Path, signals: tuple[Signal, ...] = SIGNALS) -> Driver:
    return build(Options(scenario=Path(path.name)), Setup(signals, path.parent, TICK))


def receive(driver: Driver, enough: Callable[[list[Sample]], bool]) -> list[Sample]:
    """Open the driver, wait for enough samples, close it and return them."""
    got: list[Sample] = []
    news = threading.Event()

    def take(samples: Sequence[Sample]) -> None:
        got.extend(samples)
        news.set()

    driver.open(take)
    deadline = time.monotonic() + PATIENCE
    while not enough(got):
        news.clear()
        assert news.wait(deadline - time.monotonic())
    driver.close()
    return got


def test_plant_driver_delivers_and_loses_the_scenarios_samples(scenario: Callable[[str], Path]) -> None:
    path = scenario('[[faults]]\nkind = "dropouts"\nshare = 0.3\nstart = "0.1 s"\n')
    driver = driver_of(path)
    got = receive(driver, lambda got: len(got) >= 200)
    counters, loaded = driver.counters(), load_scenario(path)
    assert (counters.received, counters.bad, counters.reconnects) == (len(got), 0, 0)
    injector = FaultInjector(loaded.faults, loaded.seed)
    samples = list(islice(simulate(loaded), (counters.received + counters.lost) // 2))
    sent = [sample for sample in samples if injector.at(sample.time).withheld is None]
    assert counters.lost == 2 * (len(samples) - len(sent)) > 0
    assert [sample.value for sample in got[::2]] == [1e3 * sample.measured["ArmatureCurrent"] for sample in sent]
    assert [sample.value for sample in got[1::2]] == [sample.measured["RotorSpeed"] for sample in sent]


def test_plant_driver_delays_samples_in_order_never_early(scenario: Callable[[str], Path]) -> None:
    """The clock is late by 0.3 s for 0.5 s; delayed samples stay in order."""
    steps = "".join(f'[[faults]]\nkind = "clock_step"\nby = "{by} s"\nstart = "{start} s"\n'
                    for by, start in ((0.3, 0.5), (-0.3, 1.0)))  # fmt: skip
    path = scenario(steps + '[[faults]]\nkind = "jitter"\ndeviation = "5 ms"\nstart = "0 s"\n')
    begun = time.monotonic()
    times = [sample.time for sample in receive(driver_of(path), lambda got: len(got) >= 300)[::2]]
    assert times == sorted(times)
    loaded = load_scenario(path)
    injector = FaultInjector(loaded.faults, loaded.seed)
    due = [index * TICK + injector.at(index * TICK).delay for index in range(len(times))]
    assert all(moment - begun >= earliest for moment, earliest in zip(times, due, strict=True))
    assert times[50] - begun >= 0.8


def test_plant_driver_reports_gone_and_reconnects(scenario: Callable[[str], Path]) -> None:
    driver = driver_of(scenario('[[faults]]\nkind = "gone"\nstart = "0.2 s"\nuntil = "0.6 s"\n'))
    got: list[Sample] = []
    reasons: list[str] = []
    driver.open(got.extend)
    deadline = time.monotonic() + PATIENCE
    while len(got) < 80:
        assert time.monotonic() < deadline
        reasons.append(driver.link().reason)
        time.sleep(0.01)
    assert driver.link().up
    driver.close()
    assert any("gone" in reason for reason in reasons)
    assert driver.counters().lost == 2 * 40
    assert driver.counters().reconnects == 1


@pytest.mark.parametrize(
    ("faults", "signal", "message"),
    [
        ('[[faults]]\nkind = "word_order"\norder = "CDAB"\nstart = "0 s"\n', SIGNALS[0], "cannot happen on in-process"),
        ("", Signal("i", "A", Source(signal="ArmatureCurent")), "did you mean 'ArmatureCurrent'"),
        ("", Signal("i", "V", Source(signal="ArmatureCurrent")), "does not measure what 'V' does"),
    ],
)
def test_plant_driver_refuses_with_the_key(
    scenario: Callable[[str], Path], faults: str, signal: Signal, message: str
) -> None:
    with pytest.raises(ConfigurationError, match=message) as caught:
        driver_of(scenario(faults), (signal,))
    assert caught.value.key in {("driver", "scenario"), ("signals", "i")}
