"""A DC motor with a component that its twin lacks.

Equations and integrator are independent of the twin, so that the search is not tested against itself. The voltage is
held from record to record; the load torque follows the speed.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window

R_A, L_A, J, K_E, K_T, D, LOAD = 6.5, 0.673, 0.001171, 0.038, 0.038, 0.00143, 0.006
PERIOD = 0.01  # s: of the records
STEPS = 10  # of the integrator, per record
SIGNALS = ("V_a", "T_load", "i", "omega")
NOISE = {"T_load": 0.0002, "i": 0.005, "omega": 0.02}

# A torque or voltage by time (s), angle (rad), voltage (V), load torque (N·m), current (A) and speed (rad/s).
Term = Callable[[float, float, float, float, float, float], float]


def nothing(*_: float) -> float:
    """The term of a healthy motor."""
    return 0.0


@dataclass(frozen=True, slots=True)
class Faults:
    """Differences from the twin."""

    torque: Term = nothing
    """N·m on the shaft, added."""
    voltage: Term = nothing
    """V in the winding, added."""
    current_gain: float = 1.0
    """Of the current sensor."""
    resistance: float = R_A
    """Ohm."""
    since: float = 0.0
    """Onset of torque and voltage, s."""


def speeds(kind: str, seconds: float, random: np.random.Generator) -> Callable[[float], float]:
    """A set-point (rad/s) of time: ``steps``, ``constant``, ``sweep`` or ``reversing``."""
    if kind == "constant":
        return lambda t: 15.0
    if kind == "sweep":
        return lambda t: 12.0 + 8.0 * np.sin(2.0 * np.pi * t / 3.0)
    levels = random.uniform(5.0, 25.0, int(seconds / 0.7) + 2)
    if kind == "reversing":
        levels *= np.resize([1.0, -1.0], len(levels))
    return lambda t: float(levels[int(t / 0.7)])


def simulate_motor(kind: str, seconds: float, faults: Faults, seed: int, *, noisy: bool = True) -> Array:
    """(records, signals) as measured."""
    random = np.random.default_rng(seed)
    set_point = speeds(kind, seconds, random)
    records = round(seconds / PERIOD)
    measured = np.empty((records, 4))
    state, integral = [0.0, 0.0, 0.0], 0.0
    start = -2.0  # s: the control loop settles before the first record
    for record in range(round(start / PERIOD), records):
        moment = record * PERIOD
        error = set_point(max(moment, 0.0)) - state[1]
        integral += error * PERIOD
        voltage = 0.3 * error + 0.6 * integral + 0.08 * set_point(max(moment, 0.0))
        if record >= 0:
            measured[record] = voltage, LOAD * state[1], state[0] * faults.current_gain, state[1]
        state = _advance(state, moment, PERIOD, voltage, faults)
    if noisy:
        for column, name in enumerate(SIGNALS):
            measured[:, column] += NOISE.get(name, 0.0) * random.standard_normal(records)
    return measured


def _advance(state: list[float], moment: float, period: float, voltage: float, faults: Faults) -> list[float]:
    """The classical Runge-Kutta method, with steps small enough for dry friction."""
    step = period / STEPS

    def rates(t: float, i: float, w: float, angle: float) -> tuple[float, float, float]:
        load, there = LOAD * w, t >= faults.since
        torque = faults.torque(t, angle, voltage, load, i, w) if there else 0.0
        more = faults.voltage(t, angle, voltage, load, i, w) if there else 0.0
        return (voltage - faults.resistance * i - K_E * w + more) / L_A, (K_T * i - load - D * w + torque) / J, w

    for number in range(STEPS):
        t = moment + number * step
        i, w, angle = state
        a = rates(t, i, w, angle)
        b = rates(t + step / 2, *(x + step / 2 * d for x, d in zip(state, a, strict=True)))
        c = rates(t + step / 2, *(x + step / 2 * d for x, d in zip(state, b, strict=True)))
        d = rates(t + step, *(x + step * e for x, e in zip(state, c, strict=True)))
        state = [x + step / 6 * (p + 2 * q + 2 * r + s) for x, p, q, r, s in zip(state, a, b, c, d, strict=True)]
    return state


def windows(measured: Array, records: int = 200) -> list[Window]:
    """Consecutive windows, as the daemon cuts them."""
    return [
        Window.whole(
            index, index * records * PERIOD, PERIOD, SIGNALS, measured[index * records : (index + 1) * records]
        )
        for index in range(len(measured) // records)
    ]
