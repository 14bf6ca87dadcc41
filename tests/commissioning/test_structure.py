"""What a twin lacks in all windows of a healthy record: an axis whose force depends on its position."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from otolith.commissioning import structure as module
from otolith.commissioning.identification import identify_noise
from otolith.commissioning.likelihood import Likelihood, with_levels
from otolith.commissioning.structure import PooledResponse, Structure, remaining_structure
from otolith.discovery.candidates import best_guesses
from otolith.discovery.screening import ScoredGuess, allowed_forms
from otolith.estimation.information import initial_prior
from otolith.estimation.window_fit import fit
from otolith.twin.components import sources
from tests.cogging_axis import AMPLITUDE, FREE, PITCH, PROBLEM, TRUTH, record
from tests.variants import often


@lru_cache
def structure(count: int, amplitude: float, seed: int, frequency: float | None = None) -> list[Structure]:
    windows = record(count, amplitude, seed, frequency)
    return remaining_structure(PROBLEM, identify_noise(PROBLEM, windows), windows)


@pytest.mark.parametrize("amplitude", often([AMPLITUDE], [0.0, AMPLITUDE]))
def test_a_load_that_is_put_down_is_no_structure(amplitude: float) -> None:
    windows = record(21, amplitude, 1, load=30.0)
    noise = identify_noise(PROBLEM, windows)
    assert noise.changes[0] in {windows[10].start, windows[11].start}
    assert [item.component.key for item in remaining_structure(PROBLEM, noise, windows)] == (
        ["carriage/periodic/x"] if amplitude else []
    )


@pytest.mark.parametrize("half", [slice(0, 10), slice(10, 20)])
def test_a_force_that_depends_on_position_shows_in_all_windows_together(half: slice) -> None:
    windows = record(20, AMPLITUDE, 1)[half]
    (shown,) = remaining_structure(PROBLEM, identify_noise(PROBLEM, windows), windows)
    assert shown.component.key == "carriage/periodic/x"
    assert not shown.is_restarted
    assert 2.0 * np.pi / shown.component.inner == pytest.approx(PITCH, rel=5e-3)
    assert shown.component.amplitude == pytest.approx(AMPLITUDE, rel=0.2)


@pytest.mark.parametrize("seed", range(3))
def test_a_healthy_axis_has_no_structure(seed: int) -> None:
    """Steps of the encoder, uneven motion and a controller make none."""
    assert structure(10, 0.0, seed) == []


def test_a_force_that_depends_on_time_has_another_phase_in_each_window() -> None:
    (shown,) = structure(10, 8.0, 1, frequency=8.3)
    assert shown.component.key == "carriage/periodic/t"
    assert shown.is_restarted
    assert shown.component.inner / (2.0 * np.pi) == pytest.approx(8.3, rel=0.02)
    assert shown.component.amplitude == pytest.approx(8.0, rel=0.2)


def test_less_than_three_cycles_in_a_window_are_no_structure() -> None:
    assert structure(10, 8.0, 1, frequency=2.0) == []


@lru_cache
def pooled(amplitude: float) -> PooledResponse:
    windows, likelihood = record(10, amplitude, 0), Likelihood(PROBLEM)
    levels = np.array(identify_noise(PROBLEM, windows).before_inflation)
    problem, truth = with_levels(PROBLEM, levels), np.array([TRUTH[parameter.name] for parameter in FREE])
    prior, start = initial_prior(problem), np.concatenate([truth, np.zeros(len(FREE))])
    states = [likelihood.fit(levels, window, [truth]).guess[len(FREE) :].tolist() for window in windows]
    pairs = zip(windows, states, strict=True)
    return PooledResponse([fit(problem, window, prior, start, 0, state=tuple(state)) for window, state in pairs])


def test_noise_seldom_gains_from_a_phase_in_each_window() -> None:
    healthy = pooled(0.0)
    forms = [form for form in allowed_forms(healthy.problem, healthy.parts[0].x) if healthy.is_restarted(form)]
    guesses = [(form, 2.0 * np.pi * hertz) for form in forms[:1] for hertz in range(5, 45)]
    assert len(guesses) == 40
    assert np.count_nonzero(healthy.score(guesses).gain) <= 1


@pytest.mark.parametrize(("stands_out", "expected"), [(False, [100.0, 60.0]), (True, [100.0, 60.0, 40.0])])
def test_a_candidate_with_less_than_half_of_the_best_score_is_not_tried(
    monkeypatch: pytest.MonkeyPatch, stands_out: bool, expected: list[float]
) -> None:
    """It imitates the best: windows that do not agree on the best may agree on it. A sine that stands out does not."""
    scores = (100.0, 60.0, 40.0)
    tried: list[float] = []
    monkeypatch.setattr(
        module, "best_guesses", lambda *given: [replace(best_guesses(*given)[0], score=score) for score in scores]
    )
    monkeypatch.setattr(module, "_structure", lambda _, guess: tried.append(guess.score))
    monkeypatch.setattr(PooledResponse, "stands_out", lambda *_: stands_out)
    windows = record(20, AMPLITUDE, 1)[:10]
    assert remaining_structure(PROBLEM, identify_noise(PROBLEM, windows), windows) == []
    assert tried == expected


@pytest.mark.parametrize("phases", [1, 2])
@pytest.mark.parametrize("spread", [1.0, 3.0])
@pytest.mark.parametrize("count", [4, 8])
def test_amplitudes_of_noise_agree_as_often_as_stated(
    count: int, spread: float, phases: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of either sign or any phase, with windows of equal and of different information."""
    monkeypatch.setattr(module, "SIGNIFICANCE", 0.02)
    random = np.random.default_rng(count)
    roots = np.eye(phases) + (spread - 1.0) * random.uniform(-0.3, 1.0, (count, phases, phases))
    information = roots.transpose(0, 2, 1) @ roots
    noise = random.standard_normal((10_000, count, phases))
    amplitudes = np.linalg.solve(roots[None], noise[..., None])[..., 0]
    agreeing = sum(module._amplitude_sd(values, information)[1] < module.SIGNIFICANCE for values in amplitudes)
    assert 0.015 < agreeing / len(amplitudes) < 0.025


def test_four_windows_agree_on_a_clear_sine() -> None:
    """Of ten standard deviations of each window: noise of one of the two parts is no reason to miss it."""
    random, agreeing = np.random.default_rng(1), 0
    for _ in range(100):
        values = np.array([8.0, -6.0]) + random.standard_normal((4, 2))
        agreeing += module._amplitude_sd(values, np.tile(np.eye(2), (4, 1, 1)))[1] < module.SIGNIFICANCE
    assert agreeing >= 90


def test_one_window_alone_shows_no_agreement() -> None:
    values, information = np.full((8, 1), 10.0), np.ones((8, 1, 1))
    assert module._amplitude_sd(values, information)[1] < module.SIGNIFICANCE
    information[0] = 1e3
    assert module._amplitude_sd(values, information)[1] >= module.SIGNIFICANCE


def test_the_sd_of_an_amplitude_is_that_of_a_mean() -> None:
    values, known = np.random.default_rng(1).normal(10.0, 0.1, (8, 1)), np.ones((8, 1, 1))
    assert module._amplitude_sd(values, known)[0] == pytest.approx(values.std(ddof=1) / np.sqrt(8.0))
    parts = np.random.default_rng(1).normal((30.0, 40.0), 0.1, (8, 2))
    both = np.sqrt((parts.var(axis=0, ddof=1).mean()) / 8.0)
    assert module._amplitude_sd(parts, np.tile(np.eye(2), (8, 1, 1)))[0] == pytest.approx(both)


def test_a_slow_sine_of_the_position_does_not_stand_out() -> None:
    """Less than six cycles are any slow curve, whatever they gain beside their neighbours."""
    uneven = pooled(AMPLITUDE)
    x = [source.name for source in sources(PROBLEM.twin)].index("x")
    form = next(
        form
        for form in allowed_forms(PROBLEM, uneven.x)
        if form.source == x and form.site == 0 and form.model.name == "periodic"
    )
    span = max(float(np.ptp(part.x[x])) for part in uneven.parts)
    assert uneven.stands_out((form, 2.0 * np.pi / PITCH))
    assert not uneven.stands_out((form, 2.0 * np.pi / PITCH + 25.0 * 2.0 * np.pi / span))
    chance = [uneven.stands_out((form, lines * 2.0 * np.pi / span)) for lines in np.arange(1.0, 5.9, 0.1)]
    assert not any(chance)


def test_an_exponent_is_uncertain_by_a_tenth(monkeypatch: pytest.MonkeyPatch) -> None:
    healthy = pooled(0.0)
    form = next(form for form in allowed_forms(healthy.problem, healthy.x) if form.model.name == "power")
    amplitudes = np.full((10, 1), 5.0), np.ones((10, 1, 1))
    monkeypatch.setattr(PooledResponse, "amplitudes_of_windows", lambda *_: amplitudes)
    shown = module._structure(healthy, ScoredGuess(form, 2.0, np.array([5.0, 0.0]), 50.0))
    assert shown is not None
    assert shown[0].inner_sd == pytest.approx(0.2)


@pytest.mark.parametrize(("exponent", "is_at_bound"), [(0.3, True), (0.31, False), (2.0, False), (4.0, True)])
def test_a_shape_at_a_bound_of_the_search_is_not_offered(
    monkeypatch: pytest.MonkeyPatch, exponent: float, is_at_bound: bool
) -> None:
    healthy = pooled(0.0)
    form = next(form for form in allowed_forms(healthy.problem, healthy.x) if form.model.name == "power")
    assert form.bounds == (0.3, 4.0)
    amplitudes = np.full((10, 1), 5.0), np.ones((10, 1, 1))
    monkeypatch.setattr(PooledResponse, "amplitudes_of_windows", lambda *_: amplitudes)
    shown = module._structure(healthy, ScoredGuess(form, exponent, np.array([5.0, 0.0]), 50.0))
    assert shown is not None
    assert shown[0].is_at_bound is is_at_bound
    assert shown[0].is_offered is not is_at_bound


def test_a_component_that_a_parameter_must_make_up_for_is_no_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    """Friction is smoother around standstill than in the twin: 16 722·v^1.01 N less 16 500·v would mend that."""
    windows = record(8, 0.0, 3, None, 0.06, unevenness=5e-4)
    noise = identify_noise(PROBLEM, list(windows))
    possible = remaining_structure(PROBLEM, noise, windows)
    assert possible
    assert all(abs(item.component.amplitude) < 2.0 * TRUTH["F_c"] for item in possible)
    monkeypatch.setattr(PooledResponse, "is_within_bounds", lambda *_: True)
    assert any(abs(item.component.amplitude) > 1e4 for item in remaining_structure(PROBLEM, noise, windows))


def test_few_windows_show_no_structure() -> None:
    windows = record(20, AMPLITUDE, 1)[:3]
    assert remaining_structure(PROBLEM, identify_noise(PROBLEM, windows), windows) == []
