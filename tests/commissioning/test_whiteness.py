"""Tests of whiteness: innovations of an axis with the right noise levels, and under a slow force."""

from functools import lru_cache

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.commissioning.consistency import Whiteness
from otolith.commissioning.identification import IdentifiedNoise, identify_noise
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

TWIN = find_twin("servo_axis")
FREE = tuple(parameter for parameter in TWIN.parameters if parameter.name in ("M", "F_v"))
PROBLEM = Problem(TWIN, (("F_c", 0.0), ("offset", 0.0)), FREE, noise=(1e-5,))
PERIOD, RECORDS, WINDOWS = 5e-3, 400, 8
TIME = 0.5  # s: correlation time of the slow force


@lru_cache
def record(slow: float, seed: int) -> tuple[Window, ...]:
    """Windows of an axis under a position controller; ``slow`` (N) is the standard deviation of a slow force."""
    random, x, v, force, rows = np.random.default_rng(seed), 0.0, 0.0, 0.0, []
    share = np.exp(-PERIOD / TIME)
    for at in range(WINDOWS * RECORDS):
        target, speed = 0.08 * np.sin(1.9 * at * PERIOD), 0.152 * np.cos(1.9 * at * PERIOD)
        drive = 4000.0 * (target - x) + 1200.0 * (speed - v)
        rows.append((drive, x + 1e-5 * random.standard_normal()))
        for _ in range(4):
            v += PERIOD / 4.0 * (drive + force - 200.0 * v) / 95.0
            x += PERIOD / 4.0 * v
        v += 1e-3 * np.sqrt(PERIOD) * random.standard_normal()
        force = share * force + slow * np.sqrt(1.0 - share**2) * random.standard_normal()
    pieces, length = np.array(rows).reshape(WINDOWS, RECORDS, 2), RECORDS * PERIOD
    return tuple(Window.whole(k, length * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


@lru_cache
def identified(slow: float, seed: int) -> IdentifiedNoise:
    return identify_noise(PROBLEM, record(slow, seed))


def of_position(rows: tuple[Whiteness, ...]) -> Whiteness:
    (row,) = rows
    assert row.output == "x"
    return row


@pytest.mark.parametrize("seed", range(3))
def test_innovations_are_white_with_the_right_levels(seed: int) -> None:
    row = of_position(identified(0.0, seed).whiteness)
    assert row.is_white
    assert abs(row.correlation) < 4.0 / np.sqrt(WINDOWS * RECORDS)
    assert [band.ratio for band in row.bands[1:]] == pytest.approx([1.0] * len(row.bands[1:]), abs=0.3)


def test_a_slow_force_is_shown_with_its_spectrum() -> None:
    """White process noise explains its changes from record to record, and not its low frequencies."""
    noise = identified(2.0, 0)
    row = of_position(noise.whiteness)
    assert not row.is_white
    assert row.of_periodogram is not None
    low, *_, high = (band.ratio for band in row.bands)
    assert low > 2.0 * high
    assert row.bands[0].low == pytest.approx(1.0 / (RECORDS * PERIOD))
    assert row.bands[-1].high == pytest.approx(0.5 / PERIOD)
    assert noise.consistency.factor is not None
    assert noise.consistency.factor > 1.0
    assert not of_position(noise.whiteness_after).is_white
