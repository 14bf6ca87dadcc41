"""The DC motor of the paper with its drive: Eq. 11-13, Table 3, PI speed control, a load proportional to speed.

Not simulated: the converter's switching, dry friction, brush voltage, temperature, and any delay between measuring and
acting. Eq. 5 of the paper has the signs of load and motor torque the other way round; Eq. 12 is right and used here.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith_drivers.plant.faults import Drift, Step, Unbalance
from otolith_drivers.plant.scenario import PARAMETERS, Scenario
from otolith_drivers.quantities import Quantity

EULER_STEP = 1e-4  # s, as in the paper
RUNGE_KUTTA_STEP = 1e-3  # s; a hundredth of the shortest time constant, error below 1e-10 of the range


@dataclass(frozen=True, slots=True)
class Tick:
    """What the drive knows at one sampling instant, and what is true then."""

    time: float
    """s since the start of the scenario."""
    measured: dict[str, float]
    """Signals by their name on the bus, with noise: voltage applied from now on, current, speed, load torque."""
    truth: dict[str, float]
    """The parameters as they are, and the current (A) and speed (rad/s) without noise."""


def simulate(scenario: Scenario) -> Iterator[Tick]:
    """The machine from rest, one tick per sample period, without end; the same for the same seed."""
    machine = _Machine(scenario)
    random = np.random.default_rng(scenario.seed)
    noise = scenario.noise
    integral, index = 0.0, 0
    while True:
        time = index * scenario.sample_period
        errors = random.standard_normal(3)
        current = machine.current + noise.current * errors[0]
        speed = machine.speed + noise.speed * errors[1]
        load_torque = scenario.load * machine.speed + noise.load_torque * errors[2]
        voltage, integral = _control(scenario, time, speed, integral)
        measured = {
            "ArmatureVoltage": voltage,
            "ArmatureCurrent": current,
            "RotorSpeed": speed,
            "LoadTorque": load_torque,
        }
        truth = machine.parameters(time) | {"i": machine.current, "omega": machine.speed}
        yield Tick(time, measured, truth)
        machine.advance(time, voltage)
        index += 1


def _control(scenario: Scenario, time: float, speed: float, integral: float) -> tuple[float, float]:
    """Armature voltage for the next sample period, and the error's integral; it stops while the voltage is limited."""
    error = _set_point(scenario, time) - speed
    gains = scenario.controller
    voltage = gains.K_p * error + gains.K_i * integral
    if abs(voltage) > gains.voltage_limit:
        return float(np.clip(voltage, -gains.voltage_limit, gains.voltage_limit)), integral
    return voltage, integral + error * scenario.sample_period


def _set_point(scenario: Scenario, time: float) -> float:
    phase = time % scenario.repeat_every if scenario.repeat_every else time
    past = [point.speed for point in scenario.set_points if point.at <= phase + 1e-9]
    return past[-1] if past else 0.0


class _Machine:
    """Current (A), speed (rad/s) and angle (rad), moved forward a sample period at a time."""

    def __init__(self, scenario: Scenario) -> None:
        self.current = self.speed = self.angle = 0.0
        self._scenario = scenario
        self._initial = dict(scenario.parameters)
        self._changes = [
            (fault, Quantity(PARAMETERS[fault.parameter][0])(fault.amount))
            for fault in scenario.faults
            if isinstance(fault, Drift | Step)
        ]
        self._unbalances = [fault for fault in scenario.faults if isinstance(fault, Unbalance)]

    def parameters(self, time: float) -> dict[str, float]:
        values = dict(self._initial)
        for fault, amount in self._changes:
            values[fault.parameter] += fault.change(time, amount)
        return values

    def advance(self, time: float, voltage: float) -> None:
        euler = self._scenario.integrator == "euler"
        longest = EULER_STEP if euler else RUNGE_KUTTA_STEP
        steps = max(1, round(self._scenario.sample_period / longest))
        step = self._scenario.sample_period / steps
        for index in range(steps):
            if euler:
                self._euler(time + index * step, step, voltage)
            else:
                self._runge_kutta(time + index * step, step, voltage)

    def _euler(self, time: float, step: float, voltage: float) -> None:
        """Eq. 11-13: the speed already uses the new current."""
        p = self.parameters(time)
        speed, load_torque = self.speed, self._scenario.load * self.speed
        self.current += step * (voltage - p["R_a"] * self.current - p["K_e"] * speed) / p["L_a"]
        self.speed += step * (self.current * p["K_t"] - load_torque - p["D"] * speed) / p["J"]
        self.speed += step * sum(fault.value(time, self.angle) for fault in self._unbalances)
        self.angle += step * speed

    def _runge_kutta(self, time: float, step: float, voltage: float) -> None:
        p = self.parameters(time + step / 2)
        resistance, inductance, inertia = p["R_a"], p["L_a"], p["J"]
        back_emf, torque_constant, friction = p["K_e"], p["K_t"], p["D"] + self._scenario.load
        unbalances = self._unbalances

        def rates(moment: float, current: float, speed: float, angle: float) -> tuple[float, float, float]:
            acceleration = (torque_constant * current - friction * speed) / inertia
            for fault in unbalances:
                acceleration += fault.value(moment, angle)
            return (voltage - resistance * current - back_emf * speed) / inductance, acceleration, speed

        i, w, a = self.current, self.speed, self.angle
        half = step / 2
        i1, w1, a1 = rates(time, i, w, a)
        i2, w2, a2 = rates(time + half, i + half * i1, w + half * w1, a + half * a1)
        i3, w3, a3 = rates(time + half, i + half * i2, w + half * w2, a + half * a2)
        i4, w4, a4 = rates(time + step, i + step * i3, w + step * w3, a + step * a3)
        self.current += step * (i1 + 2 * i2 + 2 * i3 + i4) / 6
        self.speed += step * (w1 + 2 * w2 + 2 * w3 + w4) / 6
        self.angle += step * (a1 + 2 * a2 + 2 * a3 + a4) / 6
