"""The mode of constants: a parameter that does not change is known far ahead, and one that drifts stays covered."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from otolith.acquisition.window import Array
from otolith.estimation import imm_filter
from otolith.estimation.imm_filter import CONSTANT, ImmPosterior
from otolith.estimation.posterior import Posterior
from tests.estimation.test_imm_filter import HISTORIES, LENGTH, PROBLEM, SIZE, TIMES, evidence, update
from tests.variants import often

MINUTE = 60.0  # s
AHEAD = round(MINUTE / LENGTH)  # windows
SLOW = {f"{rate:g}/s": 1.0 + rate * np.maximum(TIMES - 400.0, 0.0) for rate in (1e-6, 5e-6, 2e-5, 1e-4, 1e-3)}
STOPPED = {"after a ramp": 1.0 + 1e-3 * np.minimum(TIMES, 100.0)}


def predict(posterior: Posterior, end: float) -> Posterior:
    bank = posterior.belief
    mode = imm_filter.predict_constants(posterior.constant or imm_filter.constant_mode(bank), bank, end)
    return replace(posterior, belief=imm_filter.predict(bank, end), constant=mode)


def followed(history: Array, sd: float, seed: int, every: int = 5) -> list[tuple[int, Posterior]]:
    """Index of a window, and what is known after it, of every fifth one after a start-up of 200 s."""
    random, posterior, states = np.random.default_rng(seed), Posterior.initial(PROBLEM), []
    trends = np.gradient(history, LENGTH)
    for index, (time, value, trend) in enumerate(zip(TIMES, history * SIZE, trends * SIZE, strict=True)):
        posterior = update(predict(posterior, float(time)), evidence(value, trend, sd, random))
        if index >= 100 and index + AHEAD < len(TIMES) and index % every == 0:
            states.append((index, posterior))
    return states


def probability_below(value: float, belief: ImmPosterior, seconds: float) -> float:
    """Probability that the parameter is below ``value`` in so many seconds; a trend goes on or decays."""
    (_, run), _ = imm_filter.process_model(seconds)[0]
    grown = imm_filter.process_model(seconds)[1][0, 0] * imm_filter.TREND_NOISE[belief.level[:, 0]] ** 2
    shares = []
    for lasting in (run, seconds):
        ahead = np.array([1.0, lasting])
        variance = np.einsum("i,mij,j->m", ahead, belief.covariance, ahead) + grown
        shares.append(belief.weight @ ndtr((value - belief.mean @ ahead) / np.sqrt(variance)))
    return float(np.mean(shares))


@pytest.mark.parametrize("sd", often([0.0005], [0.0005, 0.03]))  # ohm
@pytest.mark.parametrize("name", HISTORIES | SLOW)
def test_what_follows_is_covered(name: str, sd: float) -> None:
    """A minute ahead, in the 95 % interval of all modes; where a trend turns round, as in a daily cycle, less."""
    history, held = (HISTORIES | SLOW)[name], []
    for seed in range(2):
        for index, posterior in followed(history, sd, seed):
            below = probability_below(history[index + AHEAD], posterior.with_constants().belief, MINUTE)
            held.append(0.025 <= below <= 0.975)
    assert np.mean(held) >= (0.85 if name == "daily" else 0.92)


@pytest.mark.parametrize("sd", [0.0005, 0.03])  # ohm
@pytest.mark.parametrize("name", ["constant", *STOPPED])
def test_a_minute_ahead_a_constant_is_known_better_than_from_one_window(name: str, sd: float) -> None:
    history = (HISTORIES | STOPPED)[name]
    states, ahead = followed(history, sd, 1)[20:], np.array([1.0, MINUTE])
    by_both = [posterior.with_constants() for _, posterior in states]
    assert [own.belief.weight.sum() for own in by_both] == pytest.approx([1.0] * len(states))
    assert np.median([own.belief.weight[-1] for own in by_both]) > 0.6
    errors, of_bank = (
        np.array([ahead @ own.prior().mean - SIZE * history[-1] for own in known])
        for known in (by_both, [posterior for _, posterior in states])
    )
    assert np.median(np.abs(errors)) < 0.6 * sd
    assert np.median(np.abs(of_bank)) > 1.5 * np.median(np.abs(errors))


def test_it_changes_nothing_of_the_bank() -> None:
    random, with_it = np.random.default_rng(2), Posterior.initial(PROBLEM)
    without = with_it
    for time in TIMES[:30]:
        window = evidence(SIZE * (1.0 + 1e-4 * time), 1e-4 * SIZE, 0.003, random)
        with_it = update(predict(with_it, float(time)), window)
        without = update(replace(without, belief=imm_filter.predict(without.belief, float(time))), window)
    assert with_it.constant is not None
    assert without.constant is None
    for name in ("level", "mean", "covariance", "weight"):
        assert (getattr(with_it.belief, name) == getattr(without.belief, name)).all()


def test_it_has_no_trends_and_loses_to_a_drift() -> None:
    modes = [posterior.constant for _, posterior in followed(SLOW["0.001/s"], 0.0005, 3)]
    for mode in modes:
        assert mode is not None
        assert (mode.level == CONSTANT).all()
        assert not mode.mean[0, 1:].any()
        assert not mode.covariance[0, 1:].any()
    assert modes[-1] is not None
    assert modes[-1].weight < 0.05


def test_after_a_change_it_begins_anew() -> None:
    _, posterior = followed(HISTORIES["constant"], 0.03, 1)[-1]
    assert posterior.constant is not None
    for changed in (posterior.set_prior(posterior.prior()), posterior.reset_parameters([0])):
        assert changed.constant is None
        again = predict(changed, posterior.belief.end + LENGTH)
        assert again.constant is not None
        assert again.constant.weight < 0.1


def test_in_a_log_that_begins_again_it_begins_anew() -> None:
    _, posterior = followed(HISTORIES["constant"], 0.03, 1)[-1]
    again = predict(posterior, LENGTH)
    assert again.constant is not None
    assert again.constant.end == LENGTH
    assert again.constant.weight == imm_filter.NEW_MODE_WEIGHT


def test_given_an_entry_those_that_are_correlated_move_with_it() -> None:
    belief = imm_filter.initial_modes(np.zeros(4), np.eye(4))
    belief.covariance[:, 0, 1] = belief.covariance[:, 1, 0] = 0.6
    given = imm_filter.condition(belief, 0, 2.0)
    assert given.mean[:, :2] == pytest.approx(np.tile([2.0, 1.2], (len(belief.weight), 1)))
    assert given.covariance[:, 1, 1] == pytest.approx(1.0 - 0.36)
    assert not given.covariance[:, 0].any()
    again = imm_filter.condition(given, 0, 2.0)
    assert again.mean == pytest.approx(given.mean)
    assert again.covariance == pytest.approx(given.covariance)
