"""What windows say together: sharper than each alone, honest while parameters drift, and hard to fool."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.arrival_cost import Evidence
from otolith.estimation.imm_filter import initial_posterior, moment_match, predict, update
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


def follow(history: Array, sd: float, seed: int) -> tuple[Array, Array]:
    """Errors and standard deviations of the fused value (ohm) after each window."""
    random, belief, found = np.random.default_rng(seed), initial_posterior(PROBLEM), []
    trends = np.gradient(history, LENGTH)
    for time, value, trend in zip(TIMES, history * SIZE, trends * SIZE, strict=True):
        belief = update(predict(belief, float(time)), evidence(value, trend, sd, random), PROBLEM)
        known = moment_match(belief, PROBLEM)
        found.append((known.mean[0] - value, np.sqrt(known.covariance[0, 0])))
    return np.array(found).T[0], np.array(found).T[1]


@pytest.mark.parametrize("sd", [0.002, 0.03, 0.2])
@pytest.mark.parametrize("name", HISTORIES)
def test_fused_intervals_hold_the_truth_whatever_it_does(name: str, sd: float) -> None:
    inside = []
    for seed in range(3):
        errors, deviations = follow(HISTORIES[name], sd, seed)
        inside += list(np.abs(errors[20:]) <= 1.959964 * deviations[20:])
        assert np.mean(deviations[20:]) < sd  # or fusing would be for nothing
    assert np.mean(inside) >= 0.93


def test_a_healthy_parameter_becomes_known_better_and_better() -> None:
    errors, deviations = follow(HISTORIES["constant"], 0.03, 1)
    assert np.sqrt(np.mean(errors[100:] ** 2)) < 0.4 * 0.03
    assert np.mean(deviations[100:]) < 0.5 * 0.03


def test_what_nobody_looks_at_stays_where_it_is_and_becomes_less_certain() -> None:
    random, belief = np.random.default_rng(2), initial_posterior(PROBLEM)
    for time in TIMES[:100]:
        belief = update(predict(belief, float(time)), evidence(SIZE, 0.0, 0.01, random), PROBLEM)
    moments = [TIMES[99] + wait for wait in (0.0, 60.0, 3600.0, 86400.0, 1e9)]
    known = [moment_match(predict(belief, float(moment)), PROBLEM) for moment in moments]
    deviations = [np.sqrt(entry.covariance[0, 0]) for entry in known]
    assert deviations == sorted(deviations)
    for entry, deviation in zip(known, deviations, strict=True):
        assert abs(entry.mean[0] - SIZE) <= 3.0 * deviation
        assert np.isfinite(entry.covariance).all()


def test_a_clock_that_goes_back_does_no_harm() -> None:
    belief = update(
        predict(initial_posterior(PROBLEM), 1e9), evidence(6.0, 0.0, 0.01, np.random.default_rng(3)), PROBLEM
    )
    earlier = predict(belief, 5.0)
    assert moment_match(earlier, PROBLEM).mean == pytest.approx(moment_match(predict(belief, 1e9), PROBLEM).mean)


def test_windows_that_scatter_more_than_they_say_are_believed_less() -> None:
    random, belief = np.random.default_rng(5), initial_posterior(PROBLEM)
    for index in range(200):
        value = SIZE + 0.03 * float(random.standard_normal())  # three times what the window thinks
        belief = update(predict(belief, LENGTH * index), evidence(value, 0.0, 0.01, random), PROBLEM)
    assert 2.0 < belief.variance_ratio < 30.0
    credulous = update(replace(belief, variance_ratio=1.0), evidence(SIZE, 0.0, 0.01, random), PROBLEM)
    doubtful = update(belief, evidence(SIZE, 0.0, 0.01, random), PROBLEM)
    deviations = [moment_match(entry, PROBLEM).covariance[0, 0] ** 0.5 for entry in (credulous, doubtful)]
    assert deviations[0] < 0.8 * deviations[1]
