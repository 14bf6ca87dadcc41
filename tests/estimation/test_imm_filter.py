"""The filter across windows: narrower than one window, honest while parameters drift, robust against wrong windows."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation import imm_filter
from otolith.estimation.arrival_cost import Evidence
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

TWIN = find_twin("dc_motor")
FREE = (TWIN.parameter("R_a"),)
KNOWN = tuple((entry.name, entry.nominal) for entry in TWIN.parameters if entry.name != "R_a")
PROBLEM = Problem(TWIN, KNOWN, FREE, (0.005, 0.02))
SIZE, LENGTH = 6.5, 2.0  # ohm, s
TIMES = LENGTH * np.arange(1, 601)
HISTORIES = {
    "constant": np.ones(len(TIMES)),
    "paper": 1.0 - 0.0068 * np.expm1(0.003 * np.maximum(TIMES - 160.0, 0.0)),
    "warming up": 1.0 + 0.1 * -np.expm1(-TIMES / 300.0),
    "ramp": 1.0 + np.maximum(TIMES - 300.0, 0.0) * 2e-4,
    "daily": 1.0 + 0.02 * np.sin(TIMES / 200.0),
}


def evidence(value: float, trend: float, sd: float, random: np.random.Generator) -> Evidence:
    """Of a window that knows the parameter's mean to ``sd``, and its trend accordingly; ``value`` is at its end."""
    root = np.array([[1.0, -LENGTH / 2.0], [0.0, LENGTH / np.sqrt(12.0)]]) / sd
    return Evidence(np.array([value, trend]), root, random.standard_normal(2))


def predict(posterior: Posterior, end: float) -> Posterior:
    return replace(posterior, belief=imm_filter.predict(posterior.belief, end))


def update(posterior: Posterior, evidence: Evidence) -> Posterior:
    return posterior.update(evidence, PhaseAdvance(0.0, 0.0, ()))


def follow(history: Array, sd: float, seed: int) -> tuple[Array, Array]:
    """Errors and standard deviations of the fused value (ohm) after each window."""
    random, posterior, rows = np.random.default_rng(seed), Posterior.initial(PROBLEM), []
    trends = np.gradient(history, LENGTH)
    for time, value, trend in zip(TIMES, history * SIZE, trends * SIZE, strict=True):
        posterior = update(predict(posterior, float(time)), evidence(value, trend, sd, random))
        known = posterior.prior()
        rows.append((known.mean[0] - value, np.sqrt(known.covariance[0, 0])))
    return np.array(rows).T[0], np.array(rows).T[1]


@pytest.mark.parametrize("sd", [0.002, 0.03, 0.2])
@pytest.mark.parametrize("name", HISTORIES)
def test_intervals_hold_the_truth_for_every_history(name: str, sd: float) -> None:
    inside = []
    for seed in range(3):
        errors, deviations = follow(HISTORIES[name], sd, seed)
        inside += list(np.abs(errors[20:]) <= 1.959964 * deviations[20:])
        assert np.mean(deviations[20:]) < sd  # or fusing would be for nothing
    assert np.mean(inside) >= 0.93


def test_a_constant_parameter_is_known_better_and_better() -> None:
    errors, deviations = follow(HISTORIES["constant"], 0.03, 1)
    assert np.sqrt(np.mean(errors[100:] ** 2)) < 0.4 * 0.03
    assert np.mean(deviations[100:]) < 0.5 * 0.03


def test_without_windows_the_value_stays_and_its_interval_grows() -> None:
    random, posterior = np.random.default_rng(2), Posterior.initial(PROBLEM)
    for time in TIMES[:100]:
        posterior = update(predict(posterior, float(time)), evidence(SIZE, 0.0, 0.01, random))
    moments = [TIMES[99] + wait for wait in (0.0, 60.0, 3600.0, 86400.0, 1e9)]
    known = [predict(posterior, float(moment)).prior() for moment in moments]
    deviations = [np.sqrt(entry.covariance[0, 0]) for entry in known]
    assert deviations == sorted(deviations)
    for entry, deviation in zip(known, deviations, strict=True):
        assert abs(entry.mean[0] - SIZE) <= 3.0 * deviation
        assert np.isfinite(entry.covariance).all()


def test_a_clock_that_was_set_back_changes_nothing() -> None:
    posterior = update(predict(Posterior.initial(PROBLEM), 1e9), evidence(6.0, 0.0, 0.01, np.random.default_rng(3)))
    earlier = predict(posterior, 5.0)
    assert earlier.prior().mean == pytest.approx(predict(posterior, 1e9).prior().mean)


def test_windows_that_disagree_widen_the_interval() -> None:
    random, posterior = np.random.default_rng(5), Posterior.initial(PROBLEM)
    for index in range(200):
        value = SIZE + 0.03 * float(random.standard_normal())  # three times what the window thinks
        posterior = update(predict(posterior, LENGTH * index), evidence(value, 0.0, 0.01, random))
    assert 2.0 < posterior.belief.variance_ratio < 30.0
    credulous = update(
        replace(posterior, belief=replace(posterior.belief, variance_ratio=1.0)), evidence(SIZE, 0.0, 0.01, random)
    )
    doubtful = update(posterior, evidence(SIZE, 0.0, 0.01, random))
    deviations = [entry.prior().covariance[0, 0] ** 0.5 for entry in (credulous, doubtful)]
    assert deviations[0] < 0.8 * deviations[1]
