"""Samples at their own times: valid intervals and errors near the Cramér-Rao bound, on a plant of this test's own."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from benchmarks.sampling.bound import efficient_estimate, load_effect
from benchmarks.sampling.cases import CASES
from benchmarks.sampling.measure import FREE, Summary, run, some_motor
from benchmarks.sampling.plant import simulate
from benchmarks.sampling.schedules import NOISE, OUTPUTS, Recording, Schedule, Timing, record
from scipy.integrate import solve_ivp

from otolith.acquisition.window import Array

SHORT = ("omega every 50 ms", "rows 30 % missing, commands on change", "polled every 21 ms")
FULL = (
    *SHORT,
    "samples 80 % missing",
    "rows every 10.7 ms",
    "100 ms, 80 % missing",
    "uniform rows",
    "i every 100 ms",
    "inputs every 50 ms",
    "omega every 20 ms",
    "both every 50 ms, commands on change",
    "rows 30 % missing",
    "jitter 50 %",
    "sine held for 10 ms",
    "20 ms, 80 % missing, jitter 50 %",
    "steps on change",
    "load every 50 ms, commands on change",
    "polled every 21 ms, 30 % missing",
)
DEVIATIONS = 3.3  # standard deviations of a share or a spread by which a scenario may miss its target by chance
TARGET, POOLED = 0.95, (0.93, 0.97)
MAX_SPREAD = 1.1  # of errors over the bound
measured = cache(run)


def assert_valid_and_efficient(summary: Summary) -> None:
    """Within what chance explains: coverage 95 %, errors at most 1.1 times the bound; windows are estimated."""
    tolerance = DEVIATIONS * np.sqrt(TARGET * (1.0 - TARGET) / summary.windows)
    assert summary.allowed > 0
    assert summary.estimated >= TARGET, summary.reasons
    assert (summary.raw_coverage >= TARGET - tolerance).all(), summary.raw_coverage
    assert (summary.raw_coverage <= max(POOLED[1], TARGET + tolerance)).all(), summary.raw_coverage
    chance = 1.0 + DEVIATIONS / np.sqrt(2.0 * summary.windows)
    assert (summary.spread <= max(MAX_SPREAD, chance)).all(), summary.spread


@pytest.mark.parametrize("case", SHORT)
def test_windows_are_estimated_with_valid_intervals_near_the_bound(case: str) -> None:
    assert_valid_and_efficient(measured(CASES[case], windows=40, seed=1))


@pytest.mark.full
@pytest.mark.parametrize("case", FULL)
def test_500_windows_are_estimated_with_valid_intervals_near_the_bound(case: str) -> None:
    assert_valid_and_efficient(measured(CASES[case], windows=500, seed=1))


@pytest.mark.parametrize(("windows", "cases"), [(40, SHORT), pytest.param(500, FULL, marks=pytest.mark.full)])
def test_intervals_of_all_scenarios_hold_the_truth_in_95_percent(windows: int, cases: tuple[str, ...]) -> None:
    """The published intervals may be wider: they allow for parameters that drift."""
    summaries = [measured(CASES[case], windows=windows, seed=1) for case in cases]
    low, high = POOLED
    for index, name in enumerate(FREE):
        assert low <= np.mean([summary.raw_coverage[index] for summary in summaries]) <= high, name
        assert low <= np.mean([summary.published_coverage[index] for summary in summaries]), name


NOISY_ROWS = Schedule(rows=Timing(missing=0.3), load="walk", load_noise=True)


@pytest.fixture
def recording() -> Recording:
    random = np.random.default_rng(4)
    return record(NOISY_ROWS, some_motor(random), 4.0, random)


def test_the_plant_is_exact(recording: Recording) -> None:
    motor, inputs = recording.motor, recording.inputs
    times = np.sort(np.random.default_rng(1).uniform(0.0, 2.0, 40))

    def derivative(time: float, state: Array) -> list[float]:
        voltage, load = (float(function(np.array([time]))[0]) for function in (inputs.voltage, inputs.load))
        current, speed = state
        return [
            (voltage - motor.R_a * current - motor.K_e * speed) / motor.L_a,
            (motor.K_t * current - load - motor.D * speed) / motor.J,
        ]

    reference = solve_ivp(derivative, (0.0, 2.0), recording.initial, t_eval=times, max_step=2e-3, rtol=1e-8, atol=1e-10)
    assert simulate(motor, recording.initial, 0.0, inputs, times) == pytest.approx(reference.y.T, abs=1e-3)


def test_the_effect_of_the_load_on_the_outputs_is_exact(recording: Recording) -> None:
    knots, start = recording.inputs.load_times, 0.513
    times = start + np.sort(np.random.default_rng(1).uniform(0.0, 1.0, 30))
    change = np.random.default_rng(2).normal(size=len(knots)) * 0.01
    moved = replace(recording.inputs, loads=recording.inputs.loads + change)
    outputs = [simulate(recording.motor, recording.initial, start, each, times) for each in (recording.inputs, moved)]
    effect = load_effect(recording.motor, knots, [times, times], start) @ change
    assert effect == pytest.approx((outputs[1] - outputs[0]).T.ravel(), abs=1e-9)


def test_the_bound_is_reached_by_a_linear_estimate() -> None:
    """Errors of a least-squares step at the truth have the covariance that the bound states."""
    random = np.random.default_rng(6)
    recording = record(Schedule(omega=Timing(0.05, jitter=0.5, missing=0.3)), some_motor(random), 3.0, random)
    bound = efficient_estimate(recording, 0.5, 2.5, FREE).bound
    samples = [recording.samples[name] for name in OUTPUTS]
    times = [own.times[(own.times >= 0.5) & (own.times < 2.5)] for own in samples]
    sensors = np.concatenate([np.full(len(own), NOISE[name]) for name, own in zip(OUTPUTS, times, strict=True)])
    state = simulate(recording.motor, recording.initial, 0.0, recording.inputs, np.array([0.5]))[0]

    def outputs(guess: Array) -> Array:
        motor = replace(recording.motor, **dict(zip(FREE, guess[:3].tolist(), strict=True)))
        return np.concatenate(
            [simulate(motor, guess[3:], 0.5, recording.inputs, own)[:, column] for column, own in enumerate(times)]
        )

    truth = np.concatenate([[getattr(recording.motor, name) for name in FREE], state])
    steps = 1e-5 * np.abs(truth)
    columns = [(outputs(truth + step) - outputs(truth - step)) for step in np.diag(steps)]
    jacobian = np.column_stack(columns) / (2.0 * steps) / sensors[:, None]
    noise = random.normal(size=(2000, len(sensors)))
    errors = np.linalg.lstsq(jacobian * truth, noise.T, rcond=None)[0].T[:, :3] * truth[:3]
    assert errors.std(axis=0) == pytest.approx(bound, rel=0.06)
