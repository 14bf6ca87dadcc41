"""A servo axis that sines of force move, and whose force is measured with noise.

It is integrated here, apart from the kernels of the twin.
"""

from functools import cache

import numpy as np

from otolith.acquisition.window import Array, Quality, TimeGrid, Verdict, Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

AXIS = find_twin("servo_axis")
TRUTH = {"M": 95.0, "F_v": 200.0, "F_c": 20.0, "offset": 5.0}
SHARPNESS = 0.01  # m/s
POSITION_NOISE = 1e-4  # m
RECORDS, PERIOD, SUBSTEPS, WINDOWS = 200, 0.01, 4, 40
FREQUENCIES = (0.3, 0.7, 1.3, 2.9)  # Hz
GOOD = Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0)


def _acceleration(speed: float, force: float) -> float:
    friction = TRUTH["F_v"] * speed + TRUTH["F_c"] * np.tanh(speed / SHARPNESS)
    return float((force - friction - TRUTH["offset"]) / TRUTH["M"])


@cache
def _motion(roughness: float, feedback: float) -> tuple[Array, Array]:
    """Return force and position (records,).

    The force has a white part, of this share of its standard deviation, and ``feedback`` (N/m) times the noise of the
    measured position.
    """
    random, step = np.random.default_rng(5), PERIOD / SUBSTEPS
    times = PERIOD * np.arange(WINDOWS * RECORDS)
    force = np.full(len(times), TRUTH["offset"])
    for own in FREQUENCIES:
        force += 40.0 * np.sin(2.0 * np.pi * own * times + random.uniform(0.0, 2.0 * np.pi))
    force += roughness * float(np.std(force)) * random.standard_normal(len(force))
    noise = POSITION_NOISE * random.standard_normal(len(force))
    force -= feedback * noise
    at, speed, positions = 0.0, 0.0, np.empty(len(times))
    for record, held in enumerate(force.tolist()):
        positions[record] = at
        for _ in range(SUBSTEPS):
            first = _acceleration(speed, held)
            second = _acceleration(speed + 0.5 * step * first, held)
            third = _acceleration(speed + 0.5 * step * second, held)
            fourth = _acceleration(speed + step * third, held)
            at += step * (speed + step / 6.0 * (first + second + third))
            speed += step / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
    return force, positions + noise


def recorded(
    share: float, seed: int, *, roughness: float = 0.0, feedback: float = 0.0
) -> tuple[Problem, list[Window], float]:
    """Return problem, windows, and the noise of the force (N): this ``share`` of its standard deviation."""
    force, positions = _motion(roughness, feedback)
    random, level = np.random.default_rng(seed), share * float(np.std(force))
    measured = np.column_stack([positions, force + level * random.standard_normal(len(force))])
    free = tuple(AXIS.parameter(name) for name in TRUTH)
    problem = Problem(AXIS, (("v_s", SHARPNESS),), free, (POSITION_NOISE,), input_noise=(level,))
    grid = TimeGrid.uniform(RECORDS, PERIOD)
    windows = [
        Window(index, index * RECORDS * PERIOD, grid, ("x", "F"), rows, np.zeros(rows.shape, dtype=bool), GOOD)
        for index, rows in enumerate(np.split(measured, WINDOWS))
    ]
    return problem, windows, level
