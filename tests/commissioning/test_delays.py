"""Delays of signals against each other, on a plant of the tests' own: within 1 ms and within the interval."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from benchmarks.sampling.measure import some_motor, write_machine
from benchmarks.sampling.schedules import Recording, Schedule, Timing, record

from otolith.acquisition.window import BridgeError, Quality, Verdict, Window
from otolith.commissioning import delays as text
from otolith.commissioning.delays import IdentifiedDelays, SignalDelay, identify_delays, identify_delays_and_noise
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem
from otolith.estimation.timing import shifted
from otolith.machine import find_twin, load_machine, load_twin
from otolith.runtime.replay import Replay, open_recorded

ROWS = Schedule(rows=Timing(0.01))
SLOW = {"omega": Schedule(omega=Timing(0.05)), "i": Schedule(i=Timing(0.05)), "V_a": Schedule(omega=Timing(0.05))}
MS = 1e-3
LINEAR_MOTOR = """
[twin]
name = "linear_motor"
title = "motor"
source = "test"
[states]
n = { unit = "1", bounds = [-2000, 2000], meaning = "speed" }
[inputs]
u = { unit = "1", hold = "zoh", range = [-255, 255], meaning = "duty" }
[outputs]
n = { unit = "1", noise = 30, meaning = "speed" }
[parameters]
tau = { unit = "s", nominal = 0.15, bounds = [0.01, 2], meaning = "time constant" }
gain = { unit = "1", nominal = 5, bounds = [0.5, 50], meaning = "speed per duty" }
u_c = { unit = "1", nominal = 30, bounds = [0, 120], meaning = "duty of dry friction" }
n_s = { unit = "1", nominal = 10, bounds = [1, 100], meaning = "speed within which dry friction changes its sign" }
[equations]
"der(n)" = "(gain*(u - u_c*tanh(n/n_s)) - n) / tau"
"""


def recorded(schedule: Schedule, seed: int, length: float = 13.0) -> Recording:
    random = np.random.default_rng(seed)
    return record(schedule, some_motor(random), length, random)


def cut(folder: Path, schedule: Schedule, recording: Recording, extra: str = "") -> tuple[Problem, list[Window]]:
    """The problem of the machine file, and the windows of the recording."""
    machine = load_machine(write_machine(folder, schedule, extra), with_driver=False)
    data = folder / "recording.csv"
    data.write_text(recording.table(), encoding="utf-8")
    with open_recorded(machine, data) as opened:
        return machine.problem, list(Replay(machine, opened).windows())


def late(identified: IdentifiedDelays) -> dict[str, SignalDelay]:
    return {signal.name: signal for signal in identified.signals if signal.is_late}


def deviation(signal: SignalDelay, truth: float) -> float:
    """In standard deviations."""
    assert signal.sd is not None
    assert 0.0 < QUANTILE * signal.sd < MS
    return abs(signal.value - truth) / signal.sd


@pytest.mark.full
def test_the_delay_of_a_source_with_jitter_is_its_mean(tmp_path: Path) -> None:
    """The speed comes over another bus: 20 ms late with a jitter of 5 ms; the jitter is noise of the speed."""
    schedule, random = Schedule(omega=Timing(0.01)), np.random.default_rng(11)
    recording = recorded(schedule, 100)
    speed = recording.samples["omega"]
    stated = np.sort(speed.times + 20.0 * MS + 5.0 * MS * random.standard_normal(len(speed.times)))
    late_speed = replace(speed, stated=np.round(stated, 6))
    problem, windows = cut(tmp_path, schedule, replace(recording, samples={**recording.samples, "omega": late_speed}))
    signals = late(identify_delays_and_noise(problem, windows, {})[0])
    assert set(signals) == {"omega"}
    assert signals["omega"].value == pytest.approx(20.0 * MS, abs=1.0 * MS)
    assert deviation(signals["omega"], 20.0 * MS) < 3.3


# Each name, delay and rate once or twice; the other combinations are marked full.
LATE = [(name, delay * MS, rate) for name in ("omega", "i", "V_a") for delay in (10, 35) for rate in ("10 ms", "50 ms")]
OFTEN = {("i", 0.035, "10 ms"), ("V_a", 0.035, "50 ms")}


@pytest.mark.parametrize(
    ("name", "delay", "rate"), [pytest.param(*case, marks=() if case in OFTEN else pytest.mark.full) for case in LATE]
)
def test_a_delay_is_identified_within_a_millisecond(tmp_path: Path, name: str, delay: float, rate: str) -> None:
    schedule = ROWS if rate == "10 ms" else SLOW[name]
    problem, windows = cut(tmp_path, schedule, recorded(schedule, 5).delayed({name: delay}))
    signals = late(identify_delays(problem, windows, {}))
    assert set(signals) == {name}
    assert abs(signals[name].value - delay) < MS
    assert deviation(signals[name], delay) < 3.3


@pytest.mark.parametrize("schedule", [ROWS, SLOW["omega"], SLOW["i"]], ids=["rows", "slow omega", "slow i"])
def test_signals_that_are_not_late_get_no_delay(tmp_path: Path, schedule: Schedule) -> None:
    problem, windows = cut(tmp_path, schedule, recorded(schedule, 6))
    identified = identify_delays(problem, windows, {})
    assert not late(identified)
    assert identified.windows == len(windows)
    assert identified.applied(problem, windows) == windows
    for signal in identified.signals:
        assert "no delay is significant; up to about 0." in signal.remark
        assert signal.sd is not None
        assert signal.sd < MS


@pytest.mark.full
def test_two_late_signals_are_identified(tmp_path: Path) -> None:
    truth = {"omega": 20 * MS, "i": 5 * MS}
    problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 8).delayed(truth))
    signals = late(identify_delays(problem, windows, {}))
    assert set(signals) == set(truth)
    for name, delay in truth.items():
        assert deviation(signals[name], delay) < 3.3


def test_an_early_signal_makes_all_others_late(tmp_path: Path) -> None:
    problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 9).delayed({"V_a": -15 * MS}))
    signals = late(identify_delays(problem, windows, {}))
    assert set(signals) == {"i", "omega", "T_load"}
    for signal in signals.values():
        assert deviation(signal, 15 * MS) < 3.3


@pytest.mark.full
def test_intervals_hold_the_truth(tmp_path: Path) -> None:
    """Each recording has another motor, another late signal and another delay."""
    random, count = np.random.default_rng(10), 60
    held, named = [], []
    for seed in range(count):
        name, delay = ("omega", "i", "V_a")[seed % 3], float(random.uniform(2 * MS, 40 * MS))
        problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 100 + seed, 9.0).delayed({name: delay}))
        signals = late(identify_delays(problem, windows, {}))
        named.append(set(signals) == {name})
        held.append(name in signals and deviation(signals[name], delay) <= QUANTILE)
    share = 3.3 * np.sqrt(0.95 * 0.05 / count)
    assert np.mean(held) >= 0.95 - share
    assert np.mean(named) >= 0.95 - share


@pytest.mark.full
def test_intervals_hold_delays_of_whole_steps(tmp_path: Path) -> None:
    """The slope of i jumps where V_a does: at these delays the likelihood has another curvature on each side."""
    cases = [(name, delay) for name in ("omega", "i", "V_a") for delay in (0.0, 10 * MS, 35 * MS)] * 5
    held = []
    for seed, (name, delay) in enumerate(cases, 300):
        problem, windows = cut(tmp_path, ROWS, recorded(ROWS, seed, 9.0).delayed({name: delay}))
        signals = late(identify_delays(problem, windows, {}))
        is_named = set(signals) == ({name} if delay else set())
        held.append(is_named and all(deviation(signal, delay) <= QUANTILE for signal in signals.values()))
    assert np.mean(held) >= 0.95 - 3.3 * np.sqrt(0.95 * 0.05 / len(held))


@pytest.mark.full
def test_noise_is_identified_without_the_delay(tmp_path: Path) -> None:
    """Wrong noise levels hide no delay, and the delay does not become process noise."""
    problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 11, 21.0).delayed({"omega": 10 * MS}))
    wrong = replace(problem, noise=(0.05, 0.002))
    identified, noise = identify_delays_and_noise(wrong, windows, {})
    assert deviation(late(identified)["omega"], 10 * MS) < 3.3
    assert [level.value for level in noise.outputs] == pytest.approx([0.005, 0.02], rel=0.1)
    assert [level.value for level in noise.states] == pytest.approx([0.0, 0.0], abs=0.02)


@pytest.mark.parametrize(("seed", "is_found"), [(0, False), (3, True)])
def test_a_delay_is_stated_only_if_it_exceeds_its_uncertainty(tmp_path: Path, seed: int, *, is_found: bool) -> None:
    """The twin of a saturating motor lacks so much that its windows, with noise that covers it, may show no delay."""
    random, step, delay = np.random.default_rng(seed), 2 * MS, 20 * MS
    windows, speed, before = [], 0.0, 0.0
    for index in range(7):
        rows = []
        for duty in np.repeat(np.sort(random.uniform(40.0, 255.0, 3)), 34)[:100] * (-1.0 if index % 3 else 1.0):
            rows.append((duty, before + 15.0 * random.normal()))
            before = speed
            final = 1350.0 * np.sign(duty) * (1.0 - np.exp(-max(abs(duty) - 45.0, 0.0) / 60.0))
            for _ in range(round(delay / step)):
                speed += step * (final - speed) / 0.15
        windows.append(Window.whole(index, 2.0 * index, delay, ("u", "n"), np.array(rows)))
    (tmp_path / "motor.toml").write_text(LINEAR_MOTOR, encoding="utf-8")
    twin = load_twin(tmp_path / "motor.toml")
    problem = Problem(twin, (("n_s", 10.0),), twin.parameters[:3], noise=(30.0,))
    signals = late(identify_delays_and_noise(problem, windows, {})[0])
    assert set(signals) == ({"n"} if is_found else set())
    for signal in signals.values():
        assert signal.sd is not None
        assert abs(signal.value - delay) < QUANTILE * signal.sd < signal.value


def test_a_declared_delay_is_part_of_the_result(tmp_path: Path) -> None:
    """The result is the delay of the signal as it comes, whatever the machine file declares."""
    declared = '[signals]\nomega = { delay = "7 ms" }'
    problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 12).delayed({"omega": 10 * MS}), declared)
    signals = late(identify_delays(problem, windows, {"omega": 7 * MS}))
    assert set(signals) == {"omega"}
    assert deviation(signals["omega"], 10 * MS) < 3.3


def test_without_a_usable_window_the_declared_delays_stay(tmp_path: Path) -> None:
    problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 13, 5.0))
    bad = Quality(Verdict.BAD, 1.0, 2.0, 0.0, 0.0, ("no samples of i",))
    for unusable in ([], [replace(windows[0], quality=bad)]):
        identified = identify_delays(problem, unusable, {"omega": 7 * MS})
        assert identified.values == {"i": 0.0, "omega": 7 * MS, "V_a": 0.0, "T_load": 0.0}
        assert {signal.remark for signal in identified.signals} == {text.NO_WINDOW}


def test_an_idle_machine_shows_no_delay(tmp_path: Path) -> None:
    problem, windows = cut(tmp_path, ROWS, recorded(ROWS, 14, 7.0))
    resting = []
    for window in windows:
        values = np.random.default_rng(14).normal(size=window.values.shape) * [0.0, 0.0, 0.005, 0.02]
        resting.append(replace(window, values=values))
    identified = identify_delays(problem, resting, {})
    assert not late(identified)
    assert {signal.name for signal in identified.signals} == set(problem.twin.signals)
    assert text.UNOBSERVABLE in {signal.remark for signal in identified.signals}
    for signal in identified.signals:  # noise alone could not show even a delay of 100 ms
        assert signal.remark == text.UNOBSERVABLE or (signal.sd is not None and QUANTILE * signal.sd > 100 * MS)


@pytest.mark.parametrize("variance", [1e-20, 1.0])
def test_a_bridge_error_of_any_size_lasts_as_long_in_a_shifted_window(variance: float) -> None:
    twin, one = find_twin("dc_motor"), np.ones((100, 4))
    whole = Window.whole(0, 0.0, 0.01, twin.signals, one)
    window = replace(whole, bridge_error=BridgeError(one, variance * one, 5.0 * variance * one, 0.0 * one))
    error = shifted(twin, window, {"omega": 20 * MS}).bridge_error
    assert error is not None
    assert error.held_variance / error.variance == pytest.approx(5.0)


def test_a_command_that_changes_between_its_samples_is_not_late(tmp_path: Path) -> None:
    """The controller has a clock of its own: the mean delay of half a row is none, and its scatter no process noise."""
    schedule = Schedule(rows=Timing(0.0107), polled=True)
    problem, windows = cut(tmp_path, replace(schedule, polled=False), recorded(schedule, 100))
    delays, noise = identify_delays_and_noise(problem, windows, {})
    assert not late(delays)
    assert delays.changing == ("V_a",)
    (remark,) = (own.remark for own in delays.signals if own.name == "V_a")
    assert 'times = "polled"' in remark
    assert noise.outputs[0].value == pytest.approx(0.005, rel=0.1)
    assert noise.states[0].value < 0.01


@pytest.mark.full
def test_a_command_that_is_late_by_several_samples_does_not_change_between_them(tmp_path: Path) -> None:
    """A smooth command between its samples is as good as a held one, and late all the same."""
    schedule = replace(ROWS, voltage="sine")
    problem, windows = cut(tmp_path, schedule, recorded(schedule, 100).delayed({"V_a": 35.0 * MS}))
    delays, _ = identify_delays_and_noise(problem, windows, {})
    assert not delays.changing
    assert late(delays)["V_a"].value == pytest.approx(35.0 * MS, abs=1.0 * MS)
