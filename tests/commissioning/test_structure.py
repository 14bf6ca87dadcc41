"""What a twin lacks in all windows of a healthy record: an axis whose force depends on its position."""

from functools import lru_cache

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.commissioning.identification import identify_noise
from otolith.commissioning.structure import Structure, remaining_structure
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

TWIN = find_twin("servo_axis")
TRUTH = {"M": 95.0, "F_v": 200.0, "F_c": 20.0, "offset": -3.0, "v_s": 0.002}
FREE = tuple(parameter for parameter in TWIN.parameters if parameter.name in ("M", "F_v", "F_c", "offset"))
PROBLEM = Problem(TWIN, (("v_s", TRUTH["v_s"]),), FREE, noise=(1e-6,))
PITCH, AMPLITUDE = 5e-3, 5.0  # m, N: in each window the process noise hides it
UNEVENNESS, NOISE, QUANTUM = 0.01, 1e-6, 5e-7  # m/s/s^0.5, m, m
PERIOD, RECORDS, SUBSTEPS = 2e-3, 400, 4


@lru_cache
def record(count: int, amplitude: float, seed: int) -> tuple[Window, ...]:
    """Windows of an axis under a position controller that moves to and fro; its encoder has steps."""
    random, x, v, rows = np.random.default_rng(seed), 0.0, 0.0, []
    dt = PERIOD / SUBSTEPS
    for at in range(count * RECORDS):
        time = at * PERIOD
        target, speed = 0.08 * np.sin(1.9 * time), 0.152 * np.cos(1.9 * time)
        force = 4000.0 * (target - x) + 1200.0 * (speed - v) + 25.0 * np.tanh(speed / 0.002)
        rows.append((force, QUANTUM * np.rint((x + NOISE * random.standard_normal()) / QUANTUM)))
        for _ in range(SUBSTEPS):
            friction = TRUTH["F_v"] * v + TRUTH["F_c"] * np.tanh(v / TRUTH["v_s"])
            periodic = amplitude * np.sin(2.0 * np.pi * x / PITCH + 0.7)
            v += dt * (force - friction - TRUTH["offset"] + periodic) / TRUTH["M"]
            x += dt * v
        v += UNEVENNESS * np.sqrt(PERIOD) * random.standard_normal()
    pieces = np.array(rows).reshape(count, RECORDS, 2)
    length = RECORDS * PERIOD
    return tuple(Window.whole(k, length * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


@lru_cache
def structure(count: int, amplitude: float, seed: int) -> list[Structure]:
    windows = record(count, amplitude, seed)
    return remaining_structure(PROBLEM, identify_noise(PROBLEM, windows), windows)


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


def test_few_windows_show_no_structure() -> None:
    windows = record(20, AMPLITUDE, 1)[:3]
    assert remaining_structure(PROBLEM, identify_noise(PROBLEM, windows), windows) == []
