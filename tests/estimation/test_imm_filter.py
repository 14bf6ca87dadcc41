"""The IMM filter over windows: narrower than one window, correct coverage under drift, robust to wrong windows."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation import imm_filter
from otolith.estimation.information import Evidence
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from tests.variants import often

TWIN = find_twin("dc_motor")
FREE = (TWIN.parameter("R_a"),)
KNOWN = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter.name != "R_a")
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
    """Evidence of a window; ``sd`` (ohm) is that of the parameter's mean, ``value`` (ohm) holds at the window's end."""
    sqrt_information = np.array([[1.0, -LENGTH / 2.0], [0.0, LENGTH / np.sqrt(12.0)]]) / sd
    return Evidence(np.array([value, trend]), sqrt_information, random.standard_normal(2))


def predict(posterior: Posterior, end: float) -> Posterior:
    return replace(posterior, belief=imm_filter.predict(posterior.belief, end))


def update(posterior: Posterior, evidence: Evidence) -> Posterior:
    return posterior.update(posterior.innovation(evidence), PhaseAdvance(0.0, 0.0, ()))


def follow(history: Array, sd: float, seed: int) -> tuple[Array, Array]:
    """Errors and standard deviations of the posterior mean (ohm) after each window."""
    random, posterior, rows = np.random.default_rng(seed), Posterior.initial(PROBLEM), []
    trends = np.gradient(history, LENGTH)
    for time, value, trend in zip(TIMES, history * SIZE, trends * SIZE, strict=True):
        posterior = update(predict(posterior, float(time)), evidence(value, trend, sd, random))
        prior = posterior.prior()
        rows.append((prior.mean[0] - value, np.sqrt(prior.covariance[0, 0])))
    return np.array(rows).T[0], np.array(rows).T[1]


@pytest.mark.parametrize("sd", often([0.03], [0.002, 0.03, 0.2]))
@pytest.mark.parametrize("name", HISTORIES)
def test_imm_intervals_cover_the_truth_for_every_history(name: str, sd: float) -> None:
    inside = []
    for seed in range(3):
        errors, deviations = follow(HISTORIES[name], sd, seed)
        inside += list(np.abs(errors[20:]) <= 1.959964 * deviations[20:])
        assert np.mean(deviations[20:]) < sd  # the filter is narrower than one window
    assert np.mean(inside) >= 0.93


def test_imm_error_shrinks_for_a_constant_parameter() -> None:
    errors, deviations = follow(HISTORIES["constant"], 0.03, 1)
    assert np.sqrt(np.mean(errors[100:] ** 2)) < 0.4 * 0.03
    assert np.mean(deviations[100:]) < 0.5 * 0.03


@pytest.mark.parametrize("rate", [0.003, 0.01, 0.03, 0.1])
@pytest.mark.parametrize("sd", [0.002, 0.03])
def test_imm_follows_a_fast_ramp_that_a_hypothesis_has_shown(rate: float, sd: float) -> None:
    """A trend decays by more than its process noise, and a filter that is sure of this lags behind the ramp."""
    inside, moments = [], LENGTH * np.arange(1, 9)
    for seed in range(20):
        random, posterior = np.random.default_rng(seed), predict(Posterior.initial(PROBLEM), 0.0)
        mean, covariance = np.array([1.0, rate]), np.diag([(sd / SIZE) ** 2] * 2)
        shown = imm_filter.equal_modes(np.array([imm_filter.ADDED_LEVEL]), mean, covariance, 0.0, 1.0)
        posterior = replace(posterior, belief=shown)
        for moment in moments.tolist():
            truth = SIZE * (1.0 + rate * moment)
            posterior = update(predict(posterior, moment), evidence(truth, rate * SIZE, sd, random))
            prior = posterior.prior()
            inside.append(abs(prior.mean[0] - truth) <= 1.959964 * np.sqrt(prior.covariance[0, 0]))
    assert np.mean(inside) >= 0.9


def test_imm_interval_grows_without_windows() -> None:
    random, posterior = np.random.default_rng(2), Posterior.initial(PROBLEM)
    for time in TIMES[:100]:
        posterior = update(predict(posterior, float(time)), evidence(SIZE, 0.0, 0.01, random))
    moments = [TIMES[99] + pause for pause in (0.0, 60.0, 3600.0, 86400.0, 1e9)]
    priors = [predict(posterior, float(moment)).prior() for moment in moments]
    deviations = [np.sqrt(prior.covariance[0, 0]) for prior in priors]
    assert deviations == sorted(deviations)
    for prior, deviation in zip(priors, deviations, strict=True):
        assert abs(prior.mean[0] - SIZE) <= 3.0 * deviation
        assert np.isfinite(prior.covariance).all()


def test_a_time_that_goes_back_counts_as_unknown() -> None:
    """Without process noise until the clock has caught up, a parameter that drifts would contradict the twin."""
    posterior = update(predict(Posterior.initial(PROBLEM), 1e9), evidence(6.0, 0.0, 0.01, np.random.default_rng(3)))
    earlier, later = (predict(posterior, 1e9 + pause) for pause in (-3600.0, imm_filter.UNKNOWN_AWAY))
    assert earlier.prior().covariance == pytest.approx(later.prior().covariance)
    assert earlier.prior().mean == pytest.approx(later.prior().mean)
    assert predict(earlier, 1e9 - 3598.0).prior().covariance[0, 0] > earlier.prior().covariance[0, 0]


def test_imm_inconsistent_windows_widen_the_interval() -> None:
    random, posterior = np.random.default_rng(5), Posterior.initial(PROBLEM)
    for index in range(200):
        value = SIZE + 0.03 * float(random.standard_normal())  # three times the window's standard deviation
        posterior = update(predict(posterior, LENGTH * index), evidence(value, 0.0, 0.01, random))
    assert 2.0 < posterior.belief.variance_ratio < 30.0
    uninflated = update(
        replace(posterior, belief=replace(posterior.belief, variance_ratio=1.0)), evidence(SIZE, 0.0, 0.01, random)
    )
    inflated = update(posterior, evidence(SIZE, 0.0, 0.01, random))
    deviations = [posterior.prior().covariance[0, 0] ** 0.5 for posterior in (uninflated, inflated)]
    assert deviations[0] < 0.8 * deviations[1]


@pytest.mark.parametrize("precision", [1e6, 1e9, 1e13, 1e60])
def test_evidence_that_is_far_more_precise_in_one_direction_gives_a_posterior(precision: float) -> None:
    """As of an axis that creeps for seconds: its offset is certain, and nothing else."""
    prediction = imm_filter.initial_modes(np.zeros(4), np.diag([1.0, 1.0, 1e-6, 1e-6]))
    root = np.outer([1.0, -0.3, 1.7, 0.1], [precision, 0.4 * precision, 0.0, 0.0]) + 1e-9 * np.eye(4)
    certain = Evidence(np.zeros(4), root, np.array([0.5, -0.2, 0.1, 0.3]))
    innovation = imm_filter.innovation_of(prediction, certain)
    assert 0.0 <= innovation.nis < 1.0
    mean, covariance = imm_filter.moment_match(imm_filter.update(innovation))
    assert np.isfinite(mean).all()
    assert np.linalg.eigvalsh(covariance).min() >= -1e-9
    assert covariance[0, 0] < 1.0
