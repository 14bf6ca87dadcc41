"""The noise of a measured input is identified where it shows, and fast forces are not taken for noise."""

from dataclasses import replace

import pytest

from otolith.commissioning.identification import IdentifiedNoise, identify_noise
from tests.noisy_axis import POSITION_NOISE, recorded
from tests.variants import often

USED = 12  # windows


def identified(
    share: float, seed: int, *, roughness: float = 0.0, feedback: float = 0.0
) -> tuple[IdentifiedNoise, float]:
    problem, windows, level = recorded(share, seed, roughness=roughness, feedback=feedback)
    return identify_noise(replace(problem, input_noise=()), windows[:USED]), level


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1, 4))])
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_noise_of_a_force_is_identified(share: float, seed: int) -> None:
    noise, level = identified(share, seed)
    (force,) = noise.inputs
    assert force.is_significant
    assert force.level == pytest.approx(level, rel=0.1)
    assert noise.outputs[0].value == pytest.approx(POSITION_NOISE, rel=0.1)


def test_process_noise_no_longer_contains_it() -> None:
    """Alone, it would give the speed 0.018 m/s per square root of a second."""
    noise, _ = identified(0.3, seed=0)
    assert {level.name: level.value for level in noise.states}["v"] < 0.009


@pytest.mark.parametrize("seed", often([0], range(6)))
def test_fast_changes_that_drive_the_machine_are_no_noise(seed: int) -> None:
    noise, level = identified(0.01, seed, roughness=0.5)
    (force,) = noise.inputs
    assert force.shown > 10.0 * level
    assert not force.is_significant


@pytest.mark.parametrize("feedback", [5e4, 2e5])
def test_a_controller_that_feeds_noise_of_the_position_back_gives_no_false_noise(feedback: float) -> None:
    """The force follows the noise of the position by up to 20 N, a third of its standard deviation."""
    noise, _ = identified(1e-6, seed=1, feedback=feedback)
    assert not any(force.is_significant for force in noise.inputs)


def test_a_level_that_was_not_identified_is_unchanged() -> None:
    problem, windows, _ = recorded(0.01, seed=2)
    noise = identify_noise(problem, windows[:USED])
    assert noise.applied(problem).input_noise == problem.input_noise
