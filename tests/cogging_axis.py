"""An axis under a position controller whose force depends on its position; its load wanders.

It is integrated here, apart from the kernels of the twin.
"""

from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

TWIN = find_twin("servo_axis")
TRUTH = {"M": 95.0, "F_v": 200.0, "F_c": 20.0, "offset": -3.0, "v_s": 0.002}
FREE = tuple(parameter for parameter in TWIN.parameters if parameter.name in ("M", "F_v", "F_c", "offset"))
PROBLEM = Problem(TWIN, (("v_s", TRUTH["v_s"]),), FREE, noise=(1e-6,))
PITCH = 5e-3  # m
AMPLITUDE = 5.0  # N: in each window the process noise hides it
UNEVENNESS = 0.01  # m/s/s^0.5
NOISE = 1e-6  # m
QUANTUM = 5e-7  # m
PERIOD = 2e-3  # s
RECORDS = 400
SUBSTEPS = 4
WANDER_TIME = 1.0  # s: time constant


@lru_cache
def record(
    count: int,
    amplitude: float,
    seed: int,
    frequency: float | None = None,
    smoothness: float = TRUTH["v_s"],
    *,
    load: float = 0.0,
    unevenness: float = UNEVENNESS,
    wander: float = 0.0,
    encoder_error: float = 0.0,
) -> tuple[Window, ...]:
    """Windows of an axis under a position controller that moves to and fro; its encoder has steps.

    A force is a sine of the position, or of time if it has a ``frequency`` (Hz). Dry friction changes its sign within
    ``smoothness`` (m/s) of standstill. A ``load`` (N) is put down in the middle of the window in the middle. White
    process noise of the speed has the level ``unevenness`` (m/s/s^0.5). Another force wanders with the standard
    deviation ``wander`` (N). The encoder may have an ``encoder_error`` (m), a sine of the position.
    """
    random, x, v, rows = np.random.default_rng(seed), 0.0, 0.0, []
    dt, slow = PERIOD / SUBSTEPS, 0.0  # s, and N: the force that wanders
    for at in range(count * RECORDS):
        time = at * PERIOD
        target, speed = 0.08 * np.sin(1.9 * time), 0.152 * np.cos(1.9 * time)
        force = 4000.0 * (target - x) + 1200.0 * (speed - v) + 25.0 * np.tanh(speed / 0.002)
        if wander:
            share = PERIOD / WANDER_TIME
            slow += wander * np.sqrt(2.0 * share) * random.standard_normal() - share * slow
        read = x + encoder_error * np.sin(2.0 * np.pi * x / PITCH) + NOISE * random.standard_normal()
        rows.append((force, QUANTUM * np.rint(read / QUANTUM)))
        for substep in range(SUBSTEPS):
            turns = x / PITCH if frequency is None else frequency * (time + substep * dt)
            friction = TRUTH["F_v"] * v + TRUTH["F_c"] * np.tanh(v / smoothness)
            periodic = amplitude * np.sin(2.0 * np.pi * turns + 0.7)
            carried = TRUTH["offset"] + (load if at < (count // 2 + 0.5) * RECORDS else 0.0)
            v += dt * (force - friction - carried + periodic + slow) / TRUTH["M"]
            x += dt * v
        v += unevenness * np.sqrt(PERIOD) * random.standard_normal()
    pieces = np.array(rows).reshape(count, RECORDS, 2)
    length = RECORDS * PERIOD
    return tuple(Window.whole(k, length * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))
