"""The hydraulic lift of the paper with its valve controller: Eq. 6-10 and 14-17, Table 4.

Not simulated: compressibility, the mass of piston and load, friction of the seal, the valve's own dynamics.

Read so: Bernoulli without density means a density of 1 kg/m³; 1000 kg is a force of 1000·g; F_resist is zero; the valve
is limited to [0, A_max]; it opens where the piston is above its reference, the sign that closes the loop stably. Eq. 16
takes the flow from the pressure of the step before; a real machine has no step, so the accurate integrator solves for
the pressure.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator

from otolith_drivers.plant.scenario import POSITIVE, Ageing, Scenario
from otolith_drivers.plant.tick import Tick
from otolith_drivers.quantities import Quantity
from otolith_drivers.toml_files import Closed

STEP = 1e-4  # s: of the integrator and, as in the paper, of the controller
ITERATIONS = 6  # of the pressure; each gains three digits
UNITS = {
    "k_spring": "N/m",
    "D": "N*s/m",
    "q_pump": "m^3/s",
    "A_max": "m^2",
    "A_piston": "m^2",
    "rho": "kg/m^3",
    "leak": "1",
}


class Parameters(Closed):
    """The lift's parameters at time zero; the default values are Table 4 of the paper."""

    k_spring: Annotated[float, BeforeValidator(Quantity(UNITS["k_spring"], 0.0))] = 200.0
    D: Annotated[float, BeforeValidator(Quantity(UNITS["D"], 0.0))] = 100.0
    q_pump: Annotated[float, BeforeValidator(Quantity(UNITS["q_pump"], POSITIVE))] = 0.02
    A_max: Annotated[float, BeforeValidator(Quantity(UNITS["A_max"], POSITIVE))] = 10e-5
    A_piston: Annotated[float, BeforeValidator(Quantity(UNITS["A_piston"], POSITIVE))] = 0.196349375
    rho: Annotated[float, BeforeValidator(Quantity(UNITS["rho"], POSITIVE))] = 1.0
    leak: Annotated[float, BeforeValidator(Quantity(UNITS["leak"], -0.9, 10.0))] = 0.0
    """C of Eq. 18: the pressure is (1 + C) times that without a leak."""


class Controller(Closed):
    """The valve's PID controller, Eq. 17 with the gains of the paper."""

    K_p: Annotated[float, BeforeValidator(Quantity("m", 0.0))] = 0.000346
    K_i: Annotated[float, BeforeValidator(Quantity("m/s", 0.0))] = 3.513406
    K_d: Annotated[float, BeforeValidator(Quantity("m*s", 0.0))] = 0.000119
    N: Annotated[float, BeforeValidator(Quantity("1/s", 0.0))] = 2.076743


class Reference(Closed):
    """The position asked for, a sine."""

    amplitude: Annotated[float, BeforeValidator(Quantity("m", 0.0, 10.0))] = 0.45
    frequency: Annotated[float, BeforeValidator(Quantity("Hz", 0.0, 10.0))] = 0.005


class Noise(Closed):
    """Standard deviation of each sensor."""

    position: Annotated[float, BeforeValidator(Quantity("m", 0.0))] = 0.0
    pressure: Annotated[float, BeforeValidator(Quantity("Pa", 0.0))] = 0.0
    valve: Annotated[float, BeforeValidator(Quantity("m^2", 0.0))] = 0.0


class LiftScenario(Scenario):
    """A scenario of this lift."""

    UNITS: ClassVar[dict[str, str]] = UNITS

    plant: Literal["hydraulic_actuator"]
    parameters: Parameters = Parameters()
    load: Annotated[float, BeforeValidator(Quantity("N", 0.0))] = 1000.0 * 9.80665
    controller: Controller = Controller()
    reference: Reference = Reference()
    noise: Noise = Noise()


SCENARIO = LiftScenario
SIGNALS = {"ValveArea": "m^2", "LoadForce": "N", "PistonPosition": "m", "SystemPressure": "Pa"}


def simulate(scenario: Any) -> Iterator[Tick]:
    """The lift from its lowest reference on, one tick per sample period, without end; the same for the same seed."""
    machine = _Machine(scenario)
    random = np.random.default_rng(scenario.seed)
    noise = scenario.noise
    steps = max(1, round(scenario.sample_period / STEP))
    index = 0
    while True:
        time = index * scenario.sample_period
        parameters = machine.parameters(time)
        machine.control(time, parameters)
        errors = random.standard_normal(3)
        measured = {
            "ValveArea": machine.valve + noise.valve * errors[0],
            "LoadForce": scenario.load,
            "PistonPosition": machine.position + noise.position * errors[1],
            "SystemPressure": machine.shown_pressure(parameters) + noise.pressure * errors[2],
        }
        truth = parameters | {"x": machine.position, "p": machine.shown_pressure(parameters)}
        yield Tick(time, measured, truth)
        for step in range(steps):
            moment = time + step * scenario.sample_period / steps
            machine.advance(moment, scenario.sample_period / steps, first=step == 0)
        index += 1


class _Machine:
    """Position (m), pressure (Pa) and the controller's memory, moved forward a step at a time."""

    def __init__(self, scenario: LiftScenario) -> None:
        self._scenario = scenario
        self.parameters = Ageing(scenario).at
        p = self.parameters(0.0)
        self.position = 0.0
        self._pressure = scenario.load / p["A_piston"]
        # In balance at first, so that the loop has nothing to recover from.
        self.valve = p["q_pump"] / math.sqrt(2.0 * (1.0 + p["leak"]) * self._pressure / p["rho"])
        self._integral, self._filter = self.valve, 0.0

    def shown_pressure(self, p: dict[str, float]) -> float:
        """System pressure (Pa) now."""
        if self._scenario.integrator == "accurate":
            self._pressure = self._balance(p, self.position)
        return self._pressure

    def control(self, time: float, p: dict[str, float]) -> None:
        """Eq. 17 with the forward operator z: what is held has been summed up to the step before."""
        gains, reference = self._scenario.controller, self._scenario.reference
        wanted = reference.amplitude * math.sin(2.0 * math.pi * reference.frequency * time)
        error = self.position - wanted
        derivative = gains.N * (gains.K_d * error - self._filter)
        self.valve = min(max(gains.K_p * error + self._integral + derivative, 0.0), p["A_max"])
        saturated = self.valve in (0.0, p["A_max"])
        self._integral += 0.0 if saturated else gains.K_i * error * STEP
        self._filter += derivative * STEP

    def advance(self, time: float, step: float, *, first: bool) -> None:
        p = self.parameters(time)
        if not first:
            self.control(time, p)
        if self._scenario.integrator == "euler":
            velocity = self._velocity(p, self._pressure)
            self.position += step * velocity
            self._pressure = self._pressure_of(p, self.position, velocity)
            return
        velocity = self._velocity(p, self._balance(p, self.position))
        middle = self._velocity(p, self._balance(p, self.position + step / 2.0 * velocity))
        self.position += step * middle

    def _velocity(self, p: dict[str, float], pressure: float) -> float:
        """Eq. 7 and 8."""
        flow = self.valve * math.sqrt(2.0 * max(pressure, 0.0) / p["rho"])
        return (p["q_pump"] - flow) / p["A_piston"]

    def _pressure_of(self, p: dict[str, float], position: float, velocity: float) -> float:
        """Eq. 16 and, with a leak, Eq. 18."""
        force = self._scenario.load + p["k_spring"] * position + p["D"] * velocity
        return (1.0 + p["leak"]) * force / p["A_piston"]

    def _balance(self, p: dict[str, float], position: float) -> float:
        """The pressure that its own flow leaves as it is, by iteration."""
        pressure = self._pressure
        for _ in range(ITERATIONS):
            pressure = self._pressure_of(p, position, self._velocity(p, pressure))
        return pressure
