"""A DC motor with its own equations, integrated exactly: no code of a twin.

The equations are linear. Between two changes of the inputs the voltage is constant and the load torque is linear in
time, so each mode of the motor has a closed solution, and outputs can be sampled at any times.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg.lapack import dtbtrs

from otolith.acquisition.window import Array

SMALL = 1e-3  # magnitude of an exponent below which its power series is used


@dataclass(frozen=True, slots=True)
class Motor:
    """Constants of the motor in SI units: resistance, inductance, inertia, back-EMF, torque and damping constants."""

    R_a: float = 6.5
    L_a: float = 0.673
    J: float = 1.171e-3
    K_e: float = 0.038
    K_t: float = 0.038
    D: float = 1.43e-3


@dataclass(frozen=True, slots=True)
class Inputs:
    """Voltage, held from each of its times to the next, and load torque, linear between its times."""

    voltage_times: Array
    voltages: Array
    load_times: Array
    loads: Array

    def voltage(self, times: Array) -> Array:
        """Return the armature voltage in V at ``times`` (s); a change counts at its own time."""
        return self.voltages[np.maximum(np.searchsorted(self.voltage_times, times, side="right") - 1, 0)]

    def load(self, times: Array) -> Array:
        """Return the load torque in N·m at ``times`` (s)."""
        return np.interp(times, self.load_times, self.loads)


@dataclass(frozen=True, slots=True)
class Modes:
    """Eigenvalues of the motor in 1/s, and the matrices to and from its modes."""

    eigenvalues: Array
    to_states: Array
    to_modes: Array

    @classmethod
    def of(cls, motor: Motor) -> "Modes":
        """Return the modes; current and speed are the states.

        Raises:
            ValueError: the motor oscillates, which no motor of this benchmark does.
        """
        matrix = [[-motor.R_a / motor.L_a, -motor.K_e / motor.L_a], [motor.K_t / motor.J, -motor.D / motor.J]]
        eigenvalues, to_states = np.linalg.eig(np.array(matrix))
        if np.iscomplexobj(eigenvalues):
            raise ValueError(f"{motor} has complex eigenvalues")
        return cls(eigenvalues, to_states, np.linalg.inv(to_states))


def simulate(motor: Motor, initial: Array, start: float, inputs: Inputs, times: Array) -> Array:
    """Return current (A) and speed (rad/s) at ascending ``times`` (s) >= ``start``: (times, 2).

    ``initial`` (2,) holds the states at ``start``.
    """
    modes = Modes.of(motor)
    end = times[-1] if len(times) else start
    changes = np.concatenate([inputs.voltage_times, inputs.load_times])
    events = np.unique(np.concatenate([[start], changes[(changes > start) & (changes < end)], times]))
    steps, load = np.diff(events), inputs.load(events)
    voltage = inputs.voltage(events[:-1])
    constant = np.column_stack([voltage / motor.L_a, -load[:-1] / motor.J]) @ modes.to_modes.T
    slope = np.outer(-np.diff(load) / motor.J, modes.to_modes[:, 1])  # times the step
    exponents = np.outer(steps, modes.eigenvalues)
    forced = steps[:, None] * (constant * phi_1(exponents) + slope * phi_2(exponents))
    decay = np.exp(exponents)
    begin = modes.to_modes @ initial
    columns = [_scan(decay[:, mode], forced[:, mode], float(begin[mode])) for mode in range(2)]
    states: Array = np.column_stack(columns) @ modes.to_states.T
    return states[np.searchsorted(events, times)]


def _scan(factors: Array, terms: Array, first: float) -> Array:
    """Return ``first`` and what ``x -> factor * x + term`` makes of it, step by step.

    These are the unknowns of a triangular system with the factors below its diagonal.
    """
    bands = np.stack([np.ones(len(factors) + 1), -np.append(factors, 0.0)])
    values, _ = dtbtrs(bands, np.concatenate([[first], terms]), uplo="L", diag="U")
    return np.asarray(values).ravel()


def phi_1(exponents: Array) -> Array:
    """Return (exp(x) - 1) / x."""
    safe = np.where(np.abs(exponents) < SMALL, 1.0, exponents)
    series = 1.0 + exponents * (1.0 / 2.0 + exponents * (1.0 / 6.0 + exponents / 24.0))
    return np.where(np.abs(exponents) < SMALL, series, np.expm1(safe) / safe)


def phi_2(exponents: Array) -> Array:
    """Return (exp(x) - 1 - x) / x²."""
    safe = np.where(np.abs(exponents) < SMALL, 1.0, exponents)
    series = 1.0 / 2.0 + exponents * (1.0 / 6.0 + exponents * (1.0 / 24.0 + exponents / 120.0))
    return np.where(np.abs(exponents) < SMALL, series, (np.expm1(safe) - safe) / safe**2)


def load_response(motor: Motor, elapsed: Array, *, ramp: bool) -> tuple[Array, Array]:
    """Return current and speed, ``elapsed`` s after the load torque stepped by 1 N·m or began to rise by 1 N·m/s."""
    modes, time = Modes.of(motor), np.maximum(elapsed, 0.0)
    responses = []
    for mode in range(2):
        exponents = time * modes.eigenvalues[mode]
        integral = time**2 * phi_2(exponents) if ramp else time * phi_1(exponents)
        responses.append(-modes.to_modes[mode, 1] / motor.J * integral)
    current, speed = (row[0] * responses[0] + row[1] * responses[1] for row in modes.to_states)
    return current, speed


Voltage = Literal["steps", "levels", "sine"]
Load = Literal["slow", "walk"]
STEP = 0.5  # s between the changes of "steps"
MEAN_HOLD = 0.15  # s between the changes of "levels"
WALK = 0.01  # N·m per square root of a second, of "walk"


def voltages(kind: Voltage, times: Array, random: np.random.Generator) -> tuple[Array, Array]:
    """Return times and values (V) of the changes of a command that can change at ``times`` (s) only."""
    if kind == "sine":
        rates, phases = random.uniform([2.0, 9.0], [6.0, 20.0]), random.uniform(0.0, 2.0 * np.pi, 2)
        return times, 11.0 + 6.0 * np.sin(rates[0] * times + phases[0]) + 3.0 * np.sin(rates[1] * times + phases[1])
    if kind == "steps":
        due = np.arange(times[0], times[-1], STEP)
    else:
        holds = random.exponential(MEAN_HOLD, int(3.0 * (times[-1] - times[0]) / MEAN_HOLD) + 10)
        due = times[0] + np.concatenate([[0.0], np.cumsum(holds)])
    changes = times[np.unique(np.searchsorted(times, due[due <= times[-1]]))]
    return changes, random.uniform(4.0, 20.0, len(changes))


def loads(kind: Load, times: Array, random: np.random.Generator) -> Array:
    """Return the load torque in N·m at ``times`` (s), between which a walk is linear."""
    if kind == "slow":
        return 0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * times + random.uniform(0.0, 2.0 * np.pi))
    steps = random.normal(size=len(times)) * WALK * np.sqrt(np.diff(times, prepend=times[0]))
    return 0.05 + np.cumsum(steps)
