"""The DC motor of the paper with its drive: Eq. 11-13, Table 3, PI speed control, a load proportional to speed.

Not simulated: switching of the converter, dry friction, brush voltage, temperature, delay between measurement and
control. Eq. 5 of the paper has the signs of load and motor torque reversed; Eq. 12 is right and used here.
"""

import math
from collections.abc import Callable, Iterable, Iterator
from itertools import repeat
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.config_files import StrictModel
from otolith_drivers.plant.faults import ROUNDING, Array, PlantSample, Seconds, Unbalance, shaking
from otolith_drivers.plant.scenario import POSITIVE, Scenario, SimulationChunk, chunks
from otolith_drivers.units import Quantity

EULER_STEP = 1e-4  # s, as in the paper
# A hundredth of the shortest time constant: the error is below 1e-10 of the range, 1e-9 with an unbalance.
# A parameter is constant for a step: a drift of 1 % per second adds 1e-8. Guarded by test_scenario.py.
RUNGE_KUTTA_STEP = 1e-3  # s

State = tuple[Any, Any, Any]  # Current (A), speed (rad/s), angle (rad): numbers, or arrays of several runs
Steps = Iterable[tuple[Any, ...]]  # Time (s) and coefficients (see _coefficients) of each step
Shake = Callable[[Any, Any], float]  # Acceleration by unbalances (rad/s²) at a time (s) and an angle (rad)
Integrate = Callable[[State, Any, float, Steps, Shake], State]
Advance = Callable[[int, State, float], State]  # From number of the period, state and voltage to the next state

SIGNALS = {"ArmatureVoltage": "V", "ArmatureCurrent": "A", "RotorSpeed": "rad/s", "LoadTorque": "N*m"}
UNITS = {"R_a": "ohm", "L_a": "H", "J": "kg*m^2", "K_e": "V*s/rad", "K_t": "N*m/A", "D": "N*m*s/rad"}


class MotorParameters(StrictModel):
    """The motor's parameters at time zero; the default values are Table 3 of the paper."""

    R_a: Annotated[float, BeforeValidator(Quantity(UNITS["R_a"], POSITIVE))] = 6.5
    L_a: Annotated[float, BeforeValidator(Quantity(UNITS["L_a"], POSITIVE))] = 0.673
    J: Annotated[float, BeforeValidator(Quantity(UNITS["J"], POSITIVE))] = 0.001171
    K_e: Annotated[float, BeforeValidator(Quantity(UNITS["K_e"], POSITIVE))] = 0.038
    K_t: Annotated[float, BeforeValidator(Quantity(UNITS["K_t"], POSITIVE))] = 0.038
    D: Annotated[float, BeforeValidator(Quantity(UNITS["D"], 0.0))] = 0.00143


class SpeedController(StrictModel):
    """The drive's speed controller, a PI with the gains of the paper."""

    K_p: Annotated[float, BeforeValidator(Quantity("V*s/rad", 0.0))] = 0.3
    K_i: Annotated[float, BeforeValidator(Quantity("V/rad", 0.0))] = 0.1
    voltage_limit: Annotated[float, BeforeValidator(Quantity("V", POSITIVE))] = 48.0


class SetPoint(StrictModel):
    """The set-point of the speed from ``at`` on."""

    at: Seconds
    speed: Annotated[float, BeforeValidator(Quantity("rad/s", -1e4, 1e4))]


class MotorNoise(StrictModel):
    """Standard deviation of each sensor; the controller sees the same noise as the bus carries."""

    current: Annotated[float, BeforeValidator(Quantity("A", 0.0))] = 0.0
    speed: Annotated[float, BeforeValidator(Quantity("rad/s", 0.0))] = 0.0
    load_torque: Annotated[float, BeforeValidator(Quantity("N*m", 0.0))] = 0.0


class MotorScenario(Scenario):
    """A scenario of this motor."""

    UNITS: ClassVar[dict[str, str]] = UNITS
    SIGNALS: ClassVar[dict[str, str]] = SIGNALS
    HAS_SHAFT: ClassVar[bool] = True

    plant: Literal["dc_motor"]
    parameters: MotorParameters = MotorParameters()
    load: Annotated[float, BeforeValidator(Quantity("N*m*s/rad", 0.0))] = 0.006  # Load torque divided by speed
    controller: SpeedController = SpeedController()
    set_points: Annotated[tuple[SetPoint, ...], Field(min_length=1)]
    repeat_every: Seconds | None = None  # The set-points are repeated with this period; without it the last one stays
    noise: MotorNoise = MotorNoise()

    @model_validator(mode="after")
    def _set_points_fit(self) -> Self:
        times = [point.at for point in self.set_points]
        if times != sorted(set(times)):
            raise ValueError("set_points must be in the order of their times, each time once")
        if self.repeat_every is not None and times[-1] >= self.repeat_every:
            raise ValueError(f"repeat_every ({self.repeat_every:g} s) must be later than the last set-point")
        return self


SCENARIO = MotorScenario


def simulate(scenario: Any) -> Iterator[PlantSample]:
    """The samples of the motor from rest, one per sample period, without end; the same for the same seed."""
    noise, euler = scenario.noise, scenario.integrator == "euler"
    steps = max(1, round(scenario.sample_period / (EULER_STEP if euler else RUNGE_KUTTA_STEP)))
    state: State = (0.0, 0.0, 0.0)
    integral = 0.0
    for chunk in chunks(scenario, steps, where=0.0 if euler else 0.5):
        advance = _advance(scenario, chunk)
        set_points = _set_points(scenario, chunk.times)
        for index, errors in enumerate(chunk.noise):
            current, speed, _ = state
            seen = speed + noise.speed * errors[1]
            voltage, integral = _control(scenario, set_points[index] - seen, integral)
            measured = {
                "ArmatureVoltage": voltage,
                "ArmatureCurrent": current + noise.current * errors[0],
                "RotorSpeed": seen,
                "LoadTorque": scenario.load * speed + noise.load_torque * errors[2],
            }
            yield PlantSample(chunk.times.item(index), measured, chunk.truth[index] | {"i": current, "omega": speed})
            state = advance(index, state, voltage)


def _control(scenario: MotorScenario, error: float, integral: float) -> tuple[float, float]:
    """Voltage (V) for the next sample period and integral of the error; the limit holds the integral (anti-windup)."""
    gains = scenario.controller
    voltage = gains.K_p * error + gains.K_i * integral
    if abs(voltage) > gains.voltage_limit:
        return math.copysign(gains.voltage_limit, voltage), integral
    return voltage, integral + error * scenario.sample_period


def _set_points(scenario: MotorScenario, times: Array) -> list[float]:
    """The set-point of the speed (rad/s) at each of ``times`` (s)."""
    phases = times % scenario.repeat_every if scenario.repeat_every else times
    starts = [point.at for point in scenario.set_points]
    speeds = np.array([0.0, *(point.speed for point in scenario.set_points)])
    current: list[float] = speeds[np.searchsorted(starts, phases + ROUNDING, side="right")].tolist()
    return current


def _advance(scenario: MotorScenario, chunk: SimulationChunk) -> Advance:
    integrate = _euler if scenario.integrator == "euler" else _runge_kutta
    step = scenario.sample_period / len(chunk.step_times)
    coefficients = _coefficients(scenario, chunk.parameters, step)
    unbalances = [fault for fault in scenario.faults if isinstance(fault, Unbalance)]
    if not unbalances:
        return _linear(integrate, chunk, coefficients)
    shake = shaking(unbalances)
    return lambda index, state, voltage: integrate(state, voltage, step, chunk.steps(index, coefficients), shake)


def _coefficients(scenario: MotorScenario, p: dict[str, Any], step: float) -> tuple[Any, ...]:
    """Eq. 11 and 12 times ``step``: of current by voltage, current and speed, then of speed by current and speed."""
    return (
        step / p["L_a"],
        step * p["R_a"] / p["L_a"],
        step * p["K_e"] / p["L_a"],
        step * p["K_t"] / p["J"],
        step * (p["D"] + scenario.load) / p["J"],
    )


def _linear(integrate: Integrate, chunk: SimulationChunk, coefficients: tuple[Any, ...]) -> Advance:
    """The same without unbalance: the final state is a linear function of the initial state and the voltage.

    Three runs, from 1 A, from 1 rad/s and at 1 V, give its matrix, for all sample periods of the chunk at once.
    """
    current, speed, voltage = np.eye(3)[:, :, np.newaxis]
    columns = (column if np.ndim(column) else repeat(column) for column in coefficients)
    steps = zip(chunk.step_times, *columns, strict=False)
    current, speed, _ = integrate((current, speed, 0.0), voltage, 0.0, steps, lambda _time, _angle: 0.0)
    ends = np.broadcast_to(np.concatenate((current, speed)), (6, chunk.times.size)).T.tolist()

    def advance(index: int, state: State, voltage: float) -> State:
        i, w, angle = state
        ii, iw, iv, wi, ww, wv = ends[index]
        return ii * i + iw * w + iv * voltage, wi * i + ww * w + wv * voltage, angle

    return advance


def _euler(state: State, voltage: Any, step: float, steps: Steps, shake: Shake) -> State:
    """Eq. 11-13 by Euler's method; the speed already uses the new current."""
    i, w, angle = state
    for time, gain, resistance, back_emf, torque, friction in steps:
        before = w
        i = i + gain * voltage - resistance * i - back_emf * w
        w = w + torque * i - friction * w + step * shake(time, angle)
        angle = angle + step * before
    return i, w, angle


def _runge_kutta(state: State, voltage: Any, step: float, steps: Steps, shake: Shake) -> State:
    """Eq. 11-13 by the classical Runge-Kutta method of order 4."""
    i, w, angle = state
    half = step / 2
    for time, gain, resistance, back_emf, torque, friction in steps:
        drive = gain * voltage
        i1 = drive - resistance * i - back_emf * w
        w1 = torque * i - friction * w + step * shake(time, angle)
        i_, w_ = i + i1 / 2, w + w1 / 2
        i2 = drive - resistance * i_ - back_emf * w_
        w2 = torque * i_ - friction * w_ + step * shake(time + half, angle + half * w)
        angle_ = angle + half * w_
        i_, w_ = i + i2 / 2, w + w2 / 2
        i3 = drive - resistance * i_ - back_emf * w_
        w3 = torque * i_ - friction * w_ + step * shake(time + half, angle_)
        angle_ = angle + step * w_
        i_, w_ = i + i3, w + w3
        i4 = drive - resistance * i_ - back_emf * w_
        w4 = torque * i_ - friction * w_ + step * shake(time + step, angle_)
        angle = angle + step * (w + (w1 + w2 + w3) / 6)
        i = i + (i1 + 2 * i2 + 2 * i3 + i4) / 6
        w = w + (w1 + 2 * w2 + 2 * w3 + w4) / 6
    return i, w, angle
