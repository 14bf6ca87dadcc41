"""A step of a few standard deviations of one window, of a shaft that turns unevenly under a speed controller."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from benchmarks.changes.machines import ONE_MASS, twin_of

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import Ledger, OperatorDecisions, apply_decisions, initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation import imm_filter
from otolith.estimation.imm_filter import ParameterCusum, shift_limit
from otolith.estimation.information import Prior
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.health.schema import ReportDocument
from tests.variants import often_rows

TWIN = twin_of(ONE_MASS)
INERTIA = 0.12  # kg*m^2
DAMPING = 0.02  # N*m*s/rad
SPEED = 30.0  # rad/s
GAIN = 0.2  # N*m*s/rad
UNEVENNESS = 0.1  # rad/s/s^0.5
NOISE = 0.01  # rad/s
PERIOD = 0.01  # s
RECORDS = 200
SUBSTEPS = 4
BEFORE, AFTER, HEALTHY = 5, 8, 50  # windows
SEEDS = 4
FREE = tuple(TWIN.parameter(name) for name in ("J", "D"))
KNOWN = (("T_c", 0.0), ("omega_s", 0.05))
PROBLEM = Problem(TWIN, KNOWN, FREE, noise=(NOISE,), process_noise=(UNEVENNESS,))


def simulate(count: int, step: float, at: int, seed: int) -> list[Window]:
    """Windows of which those from number ``at`` on have (1 + step) times the damping."""
    random, omega, rows = np.random.default_rng(seed), SPEED, []
    dt = PERIOD / SUBSTEPS
    for record in range(count * RECORDS):
        damping = DAMPING * (1.0 + step * (record >= at * RECORDS))
        target = SPEED * (0.95 if record // 50 % 2 else 1.05)
        torque = DAMPING * target + GAIN * (target - omega)
        rows.append((torque, omega + NOISE * random.standard_normal()))
        for _ in range(SUBSTEPS):
            omega += dt * (torque - damping * omega) / INERTIA
        omega += UNEVENNESS * np.sqrt(PERIOD) * random.standard_normal()
    pieces = np.array(rows).reshape(count, RECORDS, 2)
    return [Window.whole(k, 2.0 * k, PERIOD, ("T", "omega"), piece) for k, piece in enumerate(pieces)]


@lru_cache
def reports(count: int, step: float, at: int, seed: int) -> list[ReportDocument]:
    state, documents = initial_state("shaft", "bench", PROBLEM), []
    for window in simulate(count, step, at, seed):
        state, report = adapt(state, window)
        documents.append(report.document)
    return documents


@pytest.mark.parametrize(("step", "within"), often_rows([(0.06, 4)], [(0.1, 2), (0.06, 4), (-0.06, 4)]))
def test_a_step_of_a_few_standard_deviations_is_followed(step: float, within: int) -> None:
    """After so many windows the interval holds the new value, or both."""
    inside, published = 0, 0
    for seed in range(SEEDS):
        for document in reports(BEFORE + AFTER, step, BEFORE, seed)[BEFORE + within :]:
            damping = document.parameters["D"]
            assert document.components == ()
            assert document.decision is not WindowDecision.SENSOR
            assert damping.low is not None
            assert damping.high is not None
            published += 1
            inside += damping.low <= DAMPING * (1.0 + step) <= damping.high
    assert published == SEEDS * (AFTER - within)
    assert inside >= 0.9 * published


def test_healthy_windows_shift_nothing() -> None:
    decisions = [document.decision for document in reports(HEALTHY, 0.0, 0, 9)]
    assert decisions == [WindowDecision.LEARNED] * HEALTHY


def test_a_wrong_window_alone_moves_nothing() -> None:
    once = ParameterCusum().after(np.array([50.0]))
    assert once.moved == []
    assert once.after(np.array([0.5])).moved == []
    assert once.after(np.array([4.0])).moved == [0]


def test_a_parameter_that_is_shifted_along_moves_with_the_other() -> None:
    limit = shift_limit(6)
    for share, moved in ((1.1, [0, 1]), (0.98, [])):
        sums = limit * np.array([[share, 0.52, 0.48], [0.0, 0.0, 0.0]])
        assert ParameterCusum(sums).moved == moved


@pytest.mark.parametrize(("parameters", "least"), [(1, 0), (2, 30), (6, 30)])
def test_sums_of_healthy_windows_alarm_as_often_as_stated(
    parameters: int, least: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any of them, upwards or downwards, however many parameters there are."""
    monkeypatch.setattr(imm_filter, "WINDOWS_PER_ALARM", 500.0)
    random, sums, alarms = np.random.default_rng(parameters), ParameterCusum(), 0
    for shifts in random.standard_normal((30_000, parameters)):
        sums = sums.after(shifts)
        if sums.moved:
            sums, alarms = ParameterCusum(), alarms + 1
    assert least <= alarms <= 75  # 60 are expected of two parameters and more


def test_a_reset_of_one_parameter_forgets_no_other() -> None:
    sums = ParameterCusum(np.array([[3.0, 12.0], [0.0, 0.0]]))
    state = replace(initial_state("shaft", "bench", PROBLEM), ledger=Ledger(sums))
    assert state.ledger.cusum.moved == [0, 1]
    assert apply_decisions(state, OperatorDecisions(resets={"D": 1.0})).ledger.cusum.moved == []


def test_the_lag_behind_a_drift_is_no_shift() -> None:
    """A drift that accelerates is ahead of its prediction in each window: it has not moved at once."""
    scale, rate = PROBLEM.scale, 0.01  # 1/s
    trend = np.array([0.0, rate * DAMPING])
    covariance = np.diag(np.concatenate([1e-4 * scale, 1e-6 * scale]) ** 2)
    mean = np.concatenate([[INERTIA, DAMPING], trend])
    drifting = Posterior.initial(PROBLEM).set_prior(Prior(mean, covariance))
    resting = Posterior.initial(PROBLEM).set_prior(Prior(np.concatenate([mean[:2], [0.0, 0.0]]), covariance))
    values, sd, middle = np.array([INERTIA, DAMPING * 1.005]), 1e-4 * scale, -1.0 * np.eye(2)
    assert drifting.shifts(values + trend * -1.0, sd, middle, 2.0).tolist()[1] == 0.0
    assert resting.shifts(values, sd, middle, 2.0)[1] > 1.0
    assert drifting.shifts(values * [1.0, 1.2], sd, middle, 2.0)[1] > 1.0
