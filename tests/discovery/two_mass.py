"""A simulated machine of two masses with dry friction on the load, for the tests of discovery.

The equations are integrated here with short steps of the symplectic Euler method, independently of the twin.
"""

import math
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

J_M, J_L, K_S, D_S, D_M, D_L = 0.01, 0.04, 60.0, 0.05, 0.005, 0.01
PERIOD, STEPS, RECORDS = 0.01, 40, 200
NAMES = ("T_m", "T_load", "omega_m", "omega_l")
NOISE = 0.02  # rad/s, of both speeds
TWIN = find_twin("two_mass")


@dataclass(frozen=True, slots=True)
class DryFriction:
    """On the load."""

    torque: float = 0.3
    """N·m."""
    rounding: float = 0.02
    """rad/s within which it changes its sign."""
    since: float = 0.0
    """s."""

    def at(self, time: float, speed: float) -> float:
        """N·m against the motion."""
        return self.torque * math.tanh(speed / self.rounding) if time >= self.since else 0.0


def problem(*free: str) -> Problem:
    """The estimation problem with these free parameters; everything else is known."""
    unknown = tuple(parameter for parameter in TWIN.parameters if parameter.name in free)
    known = tuple((parameter.name, parameter.nominal) for parameter in TWIN.parameters if parameter.name not in free)
    return Problem(TWIN, known, unknown, (NOISE, NOISE))


def simulate(seconds: float, friction: DryFriction, seed: int = 1) -> list[Window]:
    """Windows of 2 s of the machine under a speed controller whose set-point goes through zero."""
    random = np.random.default_rng(seed)
    levels = random.uniform(2.0, 12.0, int(seconds / 0.8) + 2) * np.resize([1.0, -1.0], int(seconds / 0.8) + 2)
    records = round(seconds / PERIOD)
    measured = np.empty((records, len(NAMES)))
    motor = load = twist = integral = 0.0
    for record in range(records):
        time = record * PERIOD
        error = levels[int(time / 0.8)] - motor
        integral += error * PERIOD
        torque = min(max(0.15 * error + 0.3 * integral, -5.0), 5.0)
        measured[record] = torque, 0.0, motor, load
        for _ in range(STEPS):
            step = PERIOD / STEPS
            twist += step * (motor - load)
            shaft = K_S * twist + D_S * (motor - load)
            motor += step * (torque - shaft - D_M * motor) / J_M
            load += step * (shaft - D_L * load - friction.at(time, load)) / J_L
    measured[:, 2:] += NOISE * random.standard_normal((records, 2))
    return windows(measured)


def windows(measured: Array) -> list[Window]:
    """The windows of a recording."""
    return [
        Window.whole(index, index * RECORDS * PERIOD, PERIOD, NAMES, measured[index * RECORDS : (index + 1) * RECORDS])
        for index in range(len(measured) // RECORDS)
    ]
