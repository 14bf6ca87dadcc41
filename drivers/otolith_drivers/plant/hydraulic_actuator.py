"""The hydraulic lift of the paper with its valve controller: Eq. 6-10 and 14-17, Table 4.

Not simulated: compressibility, the mass of piston and load, friction of the seal, the valve's own dynamics.

The paper leaves open, and here holds: the density in Bernoulli's equation is 1 kg/m³; 1000 kg is a force of 1000·g;
F_resist is zero; the valve is limited to [0, A_max]; it opens if the piston is above its reference (for a stable loop).
Eq. 16 takes the flow from the pressure of the previous step; a real machine has no step, so the accurate
integrator solves for the pressure.
"""

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BeforeValidator

from otolith_drivers.config_files import StrictModel
from otolith_drivers.plant.faults import PlantSample
from otolith_drivers.plant.scenario import POSITIVE, Scenario, SimulationChunk, chunks
from otolith_drivers.units import Quantity

STEP = 1e-4  # s; of the integrator and the controller, as in the paper
SIGNALS = {"ValveArea": "m^2", "LoadForce": "N", "PistonPosition": "m", "SystemPressure": "Pa"}
UNITS = {
    "k_spring": "N/m",
    "D": "N*s/m",
    "q_pump": "m^3/s",
    "A_max": "m^2",
    "A_piston": "m^2",
    "rho": "kg/m^3",
    "leak": "1",
}


class LiftParameters(StrictModel):
    """The lift's parameters at time zero; the default values are Table 4 of the paper."""

    k_spring: Annotated[float, BeforeValidator(Quantity(UNITS["k_spring"], 0.0))] = 200.0
    D: Annotated[float, BeforeValidator(Quantity(UNITS["D"], 0.0))] = 100.0
    q_pump: Annotated[float, BeforeValidator(Quantity(UNITS["q_pump"], POSITIVE))] = 0.02
    A_max: Annotated[float, BeforeValidator(Quantity(UNITS["A_max"], POSITIVE))] = 10e-5
    A_piston: Annotated[float, BeforeValidator(Quantity(UNITS["A_piston"], POSITIVE))] = 0.196349375
    rho: Annotated[float, BeforeValidator(Quantity(UNITS["rho"], POSITIVE))] = 1.0
    leak: Annotated[float, BeforeValidator(Quantity(UNITS["leak"], -0.9, 10.0))] = 0.0
    """C of Eq. 18: a leak multiplies the pressure by (1 + C)."""


class PositionController(StrictModel):
    """The valve's PID controller, Eq. 17 with the gains of the paper."""

    K_p: Annotated[float, BeforeValidator(Quantity("m", 0.0))] = 0.000346
    K_i: Annotated[float, BeforeValidator(Quantity("m/s", 0.0))] = 3.513406
    K_d: Annotated[float, BeforeValidator(Quantity("m*s", 0.0))] = 0.000119
    N: Annotated[float, BeforeValidator(Quantity("1/s", 0.0))] = 2.076743


class Reference(StrictModel):
    """The set-point of the position, a sine."""

    amplitude: Annotated[float, BeforeValidator(Quantity("m", 0.0, 10.0))] = 0.45
    frequency: Annotated[float, BeforeValidator(Quantity("Hz", 0.0, 10.0))] = 0.005


class LiftNoise(StrictModel):
    """Standard deviation of each sensor."""

    position: Annotated[float, BeforeValidator(Quantity("m", 0.0))] = 0.0
    pressure: Annotated[float, BeforeValidator(Quantity("Pa", 0.0))] = 0.0
    valve: Annotated[float, BeforeValidator(Quantity("m^2", 0.0))] = 0.0


class LiftScenario(Scenario):
    """A scenario of this lift."""

    UNITS: ClassVar[dict[str, str]] = UNITS
    SIGNALS: ClassVar[dict[str, str]] = SIGNALS

    plant: Literal["hydraulic_actuator"]
    parameters: LiftParameters = LiftParameters()
    load: Annotated[float, BeforeValidator(Quantity("N", 0.0))] = 1000.0 * 9.80665
    controller: PositionController = PositionController()
    reference: Reference = Reference()
    noise: LiftNoise = LiftNoise()


SCENARIO = LiftScenario


def simulate(scenario: Any) -> Iterator[PlantSample]:
    """The samples of the lift from position 0 on, one per sample period, without end; the same for the same seed."""
    noise = scenario.noise
    for chunk, index, position, pressure, valve in _run(scenario):
        errors = chunk.noise[index]
        measured = {
            "ValveArea": valve + noise.valve * errors[0],
            "LoadForce": scenario.load,
            "PistonPosition": position + noise.position * errors[1],
            "SystemPressure": pressure + noise.pressure * errors[2],
        }
        yield PlantSample(chunk.times.item(index), measured, chunk.truth[index] | {"x": position, "p": pressure})


def _run(scenario: LiftScenario) -> Iterator[tuple[SimulationChunk, int, float, float, float]]:
    """Chunk and index in it, position (m), pressure (Pa), valve area (m²) of each sample; control runs every step."""
    gains, accurate = scenario.controller, scenario.integrator == "accurate"
    k_p, k_i, k_d, n = gains.K_p, gains.K_i, gains.K_d, gains.N
    steps = max(1, round(scenario.sample_period / STEP))
    step = scenario.sample_period / steps
    position, filtered = 0.0, 0.0
    pressure, integral = _balance_of_flows(scenario)
    for chunk in chunks(scenario, steps, where=0.0):
        columns = _columns(scenario, chunk)
        for index in range(chunk.times.size):
            for number, values in enumerate(chunk.steps(index, columns)):
                _, wanted, a_max, inflow, outflow, rest, spring, damping = values
                # Eq. 17 in discrete time: integral and filter include the errors up to the previous step.
                error = position - wanted
                derivative = n * (k_d * error - filtered)
                valve = k_p * error + integral + derivative
                if 0.0 < valve < a_max:
                    integral += k_i * error * STEP
                else:
                    valve = min(max(valve, 0.0), a_max)
                filtered += derivative * STEP
                flow = outflow * valve
                if accurate:
                    blocked, drag = rest + damping * inflow, damping * flow
                    root = _root_of_pressure(blocked + spring * position, drag)
                    pressure = blocked + spring * position - drag * root
                else:
                    root = math.sqrt(pressure) if pressure > 0.0 else 0.0
                if number == 0:
                    yield chunk, index, position, pressure, valve
                if accurate:
                    middle = position + step / 2 * (inflow - flow * root)
                    root = _root_of_pressure(blocked + spring * middle, drag)
                velocity = inflow - flow * root
                position += step * velocity
                if not accurate:
                    pressure = rest + spring * position + damping * velocity


def _columns(scenario: LiftScenario, chunk: SimulationChunk) -> tuple[Any, ...]:
    """Values of each step: position set-point, limit of the valve, and the coefficients of Eq. 7, 8, 16 and 18.

    The velocity of the piston is ``inflow - outflow * valve * sqrt(pressure)``; the pressure is
    ``rest + spring * position + damping * velocity``.
    """
    p, reference = chunk.parameters, scenario.reference
    wanted = reference.amplitude * np.sin(2.0 * math.pi * reference.frequency * chunk.step_times)
    area = p["A_piston"]
    per_force = (1.0 + p["leak"]) / area
    flows = p["q_pump"] / area, (2.0 / p["rho"]) ** 0.5 / area
    return wanted, p["A_max"], *flows, per_force * scenario.load, per_force * p["k_spring"], per_force * p["D"]


def _balance_of_flows(scenario: LiftScenario) -> tuple[float, float]:
    """Initial pressure (Pa) and valve area (m²), with which the lift stands still."""
    p = scenario.parameters
    pressure = scenario.load / p.A_piston
    return pressure, p.q_pump / math.sqrt(2.0 * (1.0 + p.leak) * pressure / p.rho)


def _root_of_pressure(blocked: float, drag: float) -> float:
    """Root of the pressure p that solves ``p = blocked - drag * sqrt(p)``; 0 without a solution."""
    return 2.0 * blocked / (drag + math.sqrt(drag * drag + 4.0 * blocked)) if blocked > 0.0 else 0.0
