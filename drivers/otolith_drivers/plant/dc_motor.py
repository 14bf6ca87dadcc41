"""The DC motor of the paper with its drive: Eq. 11-13, Table 3, PI speed control, a load proportional to speed.

Not simulated: the converter's switching, dry friction, brush voltage, temperature, and any delay between measuring and
acting. Eq. 5 of the paper has the signs of load and motor torque the other way round; Eq. 12 is right and used here.
"""

from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.plant.faults import Seconds, Unbalance
from otolith_drivers.plant.scenario import POSITIVE, Ageing, Scenario
from otolith_drivers.plant.tick import Tick
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

EULER_STEP = 1e-4  # s, as in the paper
RUNGE_KUTTA_STEP = 1e-3  # s; a hundredth of the shortest time constant, error below 1e-10 of the range


UNITS = {"R_a": "ohm", "L_a": "H", "J": "kg*m^2", "K_e": "V*s/rad", "K_t": "N*m/A", "D": "N*m*s/rad"}


class Parameters(Closed):
    """The motor's parameters at time zero; the default values are Table 3 of the paper."""

    R_a: Annotated[float, BeforeValidator(Quantity(UNITS["R_a"], POSITIVE))] = 6.5
    L_a: Annotated[float, BeforeValidator(Quantity(UNITS["L_a"], POSITIVE))] = 0.673
    J: Annotated[float, BeforeValidator(Quantity(UNITS["J"], POSITIVE))] = 0.001171
    K_e: Annotated[float, BeforeValidator(Quantity(UNITS["K_e"], POSITIVE))] = 0.038
    K_t: Annotated[float, BeforeValidator(Quantity(UNITS["K_t"], POSITIVE))] = 0.038
    D: Annotated[float, BeforeValidator(Quantity(UNITS["D"], 0.0))] = 0.00143


class Controller(Closed):
    """The drive's speed controller, a PI with the gains of the paper."""

    K_p: Annotated[float, BeforeValidator(Quantity("V*s/rad", 0.0))] = 0.3
    K_i: Annotated[float, BeforeValidator(Quantity("V/rad", 0.0))] = 0.1
    voltage_limit: Annotated[float, BeforeValidator(Quantity("V", POSITIVE))] = 48.0


class SetPoint(Closed):
    """The speed asked for, from a moment on."""

    at: Seconds
    speed: Annotated[float, BeforeValidator(Quantity("rad/s", -1e4, 1e4))]


class Noise(Closed):
    """Standard deviation of each sensor; what the controller sees is as noisy as what the bus carries."""

    current: Annotated[float, BeforeValidator(Quantity("A", 0.0))] = 0.0
    speed: Annotated[float, BeforeValidator(Quantity("rad/s", 0.0))] = 0.0
    load_torque: Annotated[float, BeforeValidator(Quantity("N*m", 0.0))] = 0.0


class MotorScenario(Scenario):
    """A scenario of this motor."""

    UNITS: ClassVar[dict[str, str]] = UNITS
    HAS_SHAFT: ClassVar[bool] = True

    plant: Literal["dc_motor"]
    parameters: Parameters = Parameters()
    load: Annotated[float, BeforeValidator(Quantity("N*m*s/rad", 0.0))] = 0.006
    """Load torque per speed."""
    controller: Controller = Controller()
    set_points: Annotated[tuple[SetPoint, ...], Field(min_length=1)]
    repeat_every: Seconds | None = None
    """The set-points start again after this time; without it the last one stays."""
    noise: Noise = Noise()

    @model_validator(mode="after")
    def _set_points_fit(self) -> Self:
        moments = [point.at for point in self.set_points]
        if moments != sorted(set(moments)):
            raise ValueError("set_points must be in the order of their times, each time once")
        if self.repeat_every is not None and moments[-1] >= self.repeat_every:
            raise ValueError(f"repeat_every ({self.repeat_every:g} s) must be later than the last set-point")
        return self


SCENARIO = MotorScenario
SIGNALS = {"ArmatureVoltage": "V", "ArmatureCurrent": "A", "RotorSpeed": "rad/s", "LoadTorque": "N*m"}


def simulate(scenario: Any) -> Iterator[Tick]:
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


def _control(scenario: MotorScenario, time: float, speed: float, integral: float) -> tuple[float, float]:
    """Armature voltage for the next sample period, and the error's integral; it stops while the voltage is limited."""
    error = _set_point(scenario, time) - speed
    gains = scenario.controller
    voltage = gains.K_p * error + gains.K_i * integral
    if abs(voltage) > gains.voltage_limit:
        return float(np.clip(voltage, -gains.voltage_limit, gains.voltage_limit)), integral
    return voltage, integral + error * scenario.sample_period


def _set_point(scenario: MotorScenario, time: float) -> float:
    phase = time % scenario.repeat_every if scenario.repeat_every else time
    past = [point.speed for point in scenario.set_points if point.at <= phase + 1e-9]
    return past[-1] if past else 0.0


class _Machine:
    """Current (A), speed (rad/s) and angle (rad), moved forward a sample period at a time."""

    def __init__(self, scenario: MotorScenario) -> None:
        self.current = self.speed = self.angle = 0.0
        self._scenario = scenario
        self.parameters = Ageing(scenario).at
        self._unbalances = [fault for fault in scenario.faults if isinstance(fault, Unbalance)]

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
