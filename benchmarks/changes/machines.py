"""The machines: equations from the sources of the twins, written again, with an ordinary operation of each."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.changes.plants import Plant, Values, levels, smooth
from otolith.acquisition.window import Array
from otolith.estimation.problem import Problem, WindowOptions
from otolith.machine import find_twin, library_twins, load_twin
from otolith.twin.definition import Definition, Role
from otolith_drivers.units import to_base

TWINS = Path(__file__).parent / "twins"
Random = np.random.Generator
CUBIC_METRES_PER_HOUR = 3600.0  # in a m^3/s


def _motor_rates(x: Values, u: Values, q: Values) -> Values:
    brushes = q["V_b"] * np.tanh(x["i"] / q["i_s"])
    friction = (q["D"] * x["omega"] + q["T_c"] * np.tanh(x["omega"] / q["omega_s"])) * (1.0 + q["friction"])
    return {
        "i": (u["V_a"] - q["R_a"] * x["i"] - brushes - q["K_e"] * x["omega"] + q["winding"]) / q["L_a"],
        "omega": (q["K_t"] * x["i"] - u["T_load"] - friction + q["shaft"]) / q["J"],
    }


def _motor_operation(random: Random, times: Array) -> Values:
    return {
        "V_a": levels(random, times, 4.0, 20.0, 0.4),
        "T_load": smooth(random, times, 0.004, 0.02, 1.5),
    }


def _reversing_operation(random: Random, times: Array) -> Values:
    return {
        "V_a": levels(random, times, -20.0, 20.0, 0.4),
        "T_load": smooth(random, times, -0.008, 0.008, 1.5),
    }


_DC_MOTOR = {"R_a": 6.5, "L_a": 0.673, "J": 0.001171, "K_e": 0.038, "K_t": 0.038, "D": 0.00143}
DC_MOTOR = Plant(
    name="dc_motor",
    twin="dc_motor",
    parameters={**_DC_MOTOR, "T_c": 0.0, "V_b": 0.0, "omega_s": 1.0, "i_s": 1.0},
    sites=("shaft", "winding", "friction"),
    initial={"i": 1.0, "omega": 10.0},
    rates=_motor_rates,
    operate=_motor_operation,
    held=("V_a",),
)
REVERSING_MOTOR = replace(DC_MOTOR, name="dc_motor, reversing", operate=_reversing_operation)
DC_MOTOR_COULOMB = replace(
    DC_MOTOR,
    name="dc_motor_coulomb",
    twin="dc_motor_coulomb",
    parameters={**_DC_MOTOR, "T_c": 0.01, "V_b": 0.8, "omega_s": 0.5, "i_s": 0.05},
    steps=20,
    operate=_reversing_operation,
)


def _lab_rates(x: Values, u: Values, q: Values) -> Values:
    friction = q["T_c"] * np.tanh(x["omega"] / q["omega_s"])
    return {"omega": (q["K"] * (u["V"] - q["K"] * x["omega"]) / q["R"] - friction + q["shaft"]) / q["J"]}


def _lab_operation(random: Random, times: Array) -> Values:
    return {"V": levels(random, times, -12.0, 12.0, 0.5)}


LAB_MOTOR = Plant(
    name="lab_motor",
    twin="lab_motor",
    parameters={"K": 0.046, "J": 0.0004, "T_c": 0.012, "R": 2.6, "omega_s": 0.5},
    sites=("shaft",),
    initial={"omega": 0.0},
    rates=_lab_rates,
    operate=_lab_operation,
    held=("V",),
)


def _mass_rates(x: Values, u: Values, q: Values) -> Values:
    friction = q["T_c"] * np.tanh(x["omega"] / q["omega_s"]) + q["D"] * x["omega"]
    return {"omega": (u["T"] - friction + q["shaft"]) / q["J"]}


def _mass_operation(random: Random, times: Array) -> Values:
    return {"speed": levels(random, times, -60.0, 60.0, 1.0)}


def _mass_control(x: Values, u: Values) -> Values:
    return {"T": np.clip(u["speed"] - x["omega"], -6.0, 6.0)}


ONE_MASS = Plant(
    name="one_mass",
    twin="one_mass",
    parameters={"J": 0.12, "T_c": 0.6, "D": 0.0, "omega_s": 0.05},
    sites=("shaft",),
    initial={"omega": 0.0},
    rates=_mass_rates,
    operate=_mass_operation,
    control=_mass_control,
    held=("T", "speed"),
)


def _pump_pressure(x: Values, q: Values) -> Array:
    curve = q["h_0"] * x["omega"] ** 2 - q["h_2"] * x["flow"] * np.abs(x["flow"])
    pressure: Array = curve * (1.0 + q["head"])
    return pressure


def _pump_rates(x: Values, u: Values, q: Values) -> Values:
    torque = q["t_1"] * x["omega"] * x["flow"] + q["t_0"] * x["omega"] ** 2
    pipe = q["k_v"] * x["flow"] * np.abs(x["flow"]) / u["u"] ** 2
    return {
        "omega": (u["T_m"] - torque - q["T_c"] + q["shaft"]) / q["J"],
        "flow": (_pump_pressure(x, q) - q["p_static"] - pipe + q["pipe"]) / q["I_p"],
    }


def _pump_outputs(x: Values, u: Values, q: Values) -> Values:
    return {"omega": x["omega"], "Q": CUBIC_METRES_PER_HOUR * x["flow"], "p": 1e-3 * _pump_pressure(x, q)}


def _pump_operation(random: Random, times: Array) -> Values:
    return {"T_m": levels(random, times, 6.5, 11.0, 1.5), "u": smooth(random, times, 0.5, 1.0, 5.0)}


PUMP = Plant(
    name="pump",
    twin="pump",
    period=0.02,
    records=250,
    steps=8,
    parameters={
        "h_0": 11.5,
        "h_2": 6e8,
        "t_1": 11.5,
        "t_0": 6e-5,
        "J": 0.01,
        "T_c": 0.3,
        "p_static": 80e3,
        "k_v": 1.2e9,
        "I_p": 4e6,
    },
    sites=("shaft", "head", "pipe"),
    initial={"omega": 150.0, "flow": 20.0 / CUBIC_METRES_PER_HOUR},
    rates=_pump_rates,
    outputs=_pump_outputs,
    operate=_pump_operation,
    held=("T_m",),
)
FLAT_PUMP = replace(PUMP, name="pump, flat head curve", parameters={**PUMP.parameters, "h_2": 0.0})


def _axis_rates(x: Values, u: Values, q: Values) -> Values:
    friction = (q["F_v"] * x["v"] + q["F_c"] * np.tanh(x["v"] / q["v_s"])) * (1.0 + q["friction"])
    return {"x": x["v"], "v": (u["F"] - friction - q["offset"] + q["carriage"]) / q["M"]}


def _directional_rates(x: Values, u: Values, q: Values) -> Values:
    viscous = np.where(x["v"] > 0.0, q["F_v_up"], q["F_v_down"])
    dry = np.where(x["v"] > 0.0, q["F_c_up"], q["F_c_down"])
    return _axis_rates(x, u, {**q, "F_v": viscous, "F_c": dry, "offset": np.zeros(1), "friction": np.zeros(1)})


def _axis_operation(random: Random, times: Array) -> dict[str, Array]:
    """A position and its derivatives: smooth moves in both directions."""
    position, speed, acceleration = (np.zeros(len(times)) for _ in range(3))
    for size in (0.08, 0.03, 0.01):
        rate, phase = 2.0 * np.pi / (1.6 * random.uniform(0.6, 1.4)) * 0.08 / (size + 0.02), random.uniform(0.0, 6.28)
        position += size * np.sin(rate * times + phase)
        speed += size * rate * np.cos(rate * times + phase)
        acceleration -= size * rate**2 * np.sin(rate * times + phase)
    return {"x_set": position, "v_set": speed, "a_set": acceleration}


def _axis_control(x: Values, u: Values) -> Values:
    """Feed-forward of an approximate mass, and a position loop of about 3 Hz."""
    force = 90.0 * u["a_set"] + 150.0 * u["v_set"] + 3e4 * (u["x_set"] - x["x"]) + 2e3 * (u["v_set"] - x["v"])
    return {"F": np.clip(force, -150.0, 150.0)}


_AXIS = Plant(
    name="",
    twin="",
    period=0.005,
    records=400,
    steps=10,
    parameters={"M": 95.0, "v_s": 0.002},
    sites=("carriage", "friction"),
    initial={"x": 0.0, "v": 0.0},
    rates=_axis_rates,
    operate=_axis_operation,
    control=_axis_control,
    held=("F", "x_set", "v_set", "a_set"),
)
SERVO_AXIS = replace(
    _AXIS,
    name="servo_axis",
    twin="servo_axis",
    parameters={**_AXIS.parameters, "F_v": 200.0, "F_c": 20.0, "offset": 5.0},
)
SERVO_AXIS_DIRECTIONAL = replace(
    _AXIS,
    name="servo_axis_directional",
    twin="servo_axis_directional",
    sites=("carriage",),
    rates=_directional_rates,
    parameters={**_AXIS.parameters, "F_v_up": 200.0, "F_v_down": 200.0, "F_c_up": 20.0, "F_c_down": 20.0},
)


def _masses_rates(x: Values, u: Values, q: Values) -> Values:
    shaft = (q["k_s"] * x["twist"] + q["d_s"] * (x["omega_m"] - x["omega_l"])) * (1.0 + q["shaft"])
    return {
        "omega_m": (u["T_m"] - shaft - q["D_m"] * x["omega_m"] + q["motor_side"]) / q["J_m"],
        "omega_l": (shaft - u["T_load"] - q["D_l"] * x["omega_l"] + q["load_side"]) / q["J_l"],
        "twist": x["omega_m"] - x["omega_l"],
    }


def _masses_operation(random: Random, times: Array) -> Values:
    return {"T_m": levels(random, times, -2.0, 3.5, 0.3), "T_load": smooth(random, times, 0.0, 0.6, 1.0)}


TWO_MASS = Plant(
    name="two_mass",
    twin="two_mass",
    period=0.005,
    steps=4,
    parameters={"J_m": 0.01, "J_l": 0.04, "k_s": 60.0, "d_s": 0.05, "D_m": 0.005, "D_l": 0.01},
    sites=("motor_side", "load_side", "shaft"),
    initial={"omega_m": 30.0, "omega_l": 30.0, "twist": 0.0},
    rates=_masses_rates,
    operate=_masses_operation,
    held=("T_m",),
)


def _pmsm_rates(x: Values, u: Values, q: Values) -> Values:
    speed, saturation = q["n_p"] * x["omega"], 1.0 + q["s_q"] * np.abs(x["i_q"])
    inductance, slope = q["L_q"] / saturation, q["L_q"] / saturation**2  # of the flux by the current
    lost = q["V_dt"] / np.sqrt(x["i_d"] ** 2 + x["i_q"] ** 2 + 0.25)
    torque = 1.5 * q["n_p"] * x["i_q"] * (q["psi"] + (q["L_d"] - inductance) * x["i_d"]) * (1.0 + q["torque"])
    return {
        "i_d": (u["v_d"] - (q["R_s"] + lost) * x["i_d"] + speed * inductance * x["i_q"]) / q["L_d"],
        "i_q": (u["v_q"] - (q["R_s"] + lost) * x["i_q"] - speed * (q["L_d"] * x["i_d"] + q["psi"])) / slope,
        "omega": (torque - u["T_load"] - q["D"] * x["omega"] + q["shaft"]) / q["J"],
    }


def _pmsm_operation(random: Random, times: Array) -> Values:
    return {
        "v_d": levels(random, times, -8.0, 4.0, 0.2),
        "v_q": levels(random, times, 10.0, 50.0, 0.1),
        "T_load": smooth(random, times, 0.0, 3.0, 0.5),
    }


PMSM = Plant(
    name="pmsm",
    twin="pmsm",
    period=0.002,
    records=250,
    parameters={
        "R_s": 1.2,
        "L_d": 8.5e-3,
        "L_q": 9.5e-3,
        "psi": 0.175,
        "s_q": 0.0,
        "V_dt": 0.0,
        "n_p": 4.0,
        "J": 0.008,
        "D": 0.002,
    },
    sites=("shaft", "torque"),
    initial={"i_d": 0.0, "i_q": 0.0, "omega": 40.0},
    rates=_pmsm_rates,
    operate=_pmsm_operation,
    held=("v_d", "v_q"),
)


def _lift_pressure(x: Values, u: Values, q: Values) -> tuple[Array, Array]:
    """Return pressure and flow through the valve: a quadratic equation in the root of the pressure."""
    area, gain = q["A_piston"], 1.0 + q["pressure"]
    force = u["F_load"] + q["k_spring"] * x["x"] + q["F_resist"] + q["D"] * q["q_pump"] / area + q["force"]
    damping = gain * q["D"] * u["A_valve"] * np.sqrt(2.0 / q["rho"]) / area**2
    root = np.sqrt(0.25 * damping**2 + np.maximum(gain * force / area, 0.0)) - 0.5 * damping
    return root**2, u["A_valve"] * root * np.sqrt(2.0 / q["rho"]) + q["flow"]


def _lift_rates(x: Values, u: Values, q: Values) -> Values:
    return {"x": (q["q_pump"] - _lift_pressure(x, u, q)[1]) / q["A_piston"]}


def _lift_outputs(x: Values, u: Values, q: Values) -> Values:
    return {"x": x["x"], "p": _lift_pressure(x, u, q)[0]}


def _lift_operation(random: Random, times: Array) -> Values:
    return {
        "F_load": smooth(random, times, 8000.0, 12000.0, 4.0),
        "A_valve": smooth(random, times, 55e-6, 71e-6, 2.0),
    }


HYDRAULIC_ACTUATOR = Plant(
    name="hydraulic_actuator",
    twin="hydraulic_actuator",
    period=0.05,
    steps=2,
    parameters={
        "D": 100.0,
        "k_spring": 200.0,
        "q_pump": 0.02,
        "A_piston": 0.196349375,
        "rho": 1.0,
        "F_resist": 0.0,
    },
    sites=("pressure", "flow", "force"),
    initial={"x": 1.0},
    rates=_lift_rates,
    outputs=_lift_outputs,
    operate=_lift_operation,
    held=(),
)


def _fan_rates(x: Values, u: Values, q: Values) -> Values:
    air = q["k_air"] * x["omega"] * np.abs(x["omega"]) * (1.0 + q["air"])
    return {"omega": (u["T_m"] - air - q["T_c"] * np.tanh(x["omega"] / q["omega_s"]) + q["shaft"]) / q["J"]}


def _fan_operation(random: Random, times: Array) -> Values:
    return {"T_m": levels(random, times, 1.5, 10.0, 4.0)}


FAN = Plant(
    name="fan",
    twin="fan",
    period=0.05,
    records=400,
    parameters={"k_air": 4e-4, "T_c": 0.6, "J": 0.08, "omega_s": 0.5},
    sites=("shaft", "air"),
    initial={"omega": 80.0},
    rates=_fan_rates,
    operate=_fan_operation,
    held=("T_m",),
)


def _electrical_speed(x: Values, u: Values, q: Values) -> Array:
    speed: Array = q["n_p"] * x["omega"] + q["R_r"] * u["i_q"] / x["psi_r"]
    return speed


def _induction_rates(x: Values, u: Values, q: Values) -> Values:
    torque = 1.5 * q["n_p"] * x["psi_r"] * u["i_q"] * (1.0 + q["torque"])
    friction = (q["D"] * x["omega"] + q["T_c"] * np.tanh(x["omega"] / q["omega_s"])) * (1.0 + q["friction"])
    return {
        "psi_r": q["R_r"] * (u["i_d"] - x["psi_r"] / q["L_m"]),
        "omega": (torque - u["T_load"] - friction + q["shaft"]) / q["J"],
    }


def _induction_outputs(x: Values, u: Values, q: Values) -> Values:
    speed = _electrical_speed(x, u, q)
    induced = q["R_r"] * (u["i_d"] - x["psi_r"] / q["L_m"])
    direct = q["R_s"] * u["i_d"] - speed * q["L_sigma"] * u["i_q"] + induced
    quadrature = q["R_s"] * u["i_q"] + speed * (q["L_sigma"] * u["i_d"] + x["psi_r"])
    return {"omega": x["omega"], "f_s": speed / (2.0 * np.pi), "v_s": np.hypot(direct, quadrature)}


def _induction_operation(random: Random, times: Array) -> Values:
    """Currents that a speed controller would give, for a load that varies: the speed stays within its range."""
    swing = smooth(random, times, -1.5, 1.5, 0.8)
    return {
        "i_d": smooth(random, times, 3.6, 4.2, 4.0),
        "i_q": 2.3 + swing,
        "T_load": 5.0 + smooth(random, times, -0.5, 0.5, 1.0),
    }


INDUCTION_MOTOR = Plant(
    name="induction_motor",
    twin="induction_motor",
    parameters={
        "R_s": 3.7,
        "R_r": 2.1,
        "L_m": 0.224,
        "L_sigma": 0.021,
        "n_p": 2.0,
        "J": 0.0155,
        "D": 0.001,
        "T_c": 0.3,
        "omega_s": 0.5,
    },
    sites=("shaft", "torque", "friction"),
    initial={"psi_r": 0.88, "omega": 100.0},
    rates=_induction_rates,
    outputs=_induction_outputs,
    operate=_induction_operation,
    held=(),
)

LIBRARY_PLANTS = {
    plant.name: plant
    for plant in (
        *(DC_MOTOR, DC_MOTOR_COULOMB, PUMP, HYDRAULIC_ACTUATOR),
        *(PMSM, SERVO_AXIS, SERVO_AXIS_DIRECTIONAL, TWO_MASS, FAN, INDUCTION_MOTOR),
    )
}


def twin_of(plant: Plant) -> Definition:
    """Return the twin of the machine."""
    return find_twin(plant.twin) if plant.twin in library_twins() else load_twin(TWINS / f"{plant.twin}.toml")


def in_twin_units(twin: Definition, name: str, value: float) -> float:
    """Return the value of a parameter of the plant, which has coherent units, in the unit of the twin."""
    return value / to_base(twin.parameter(name).unit)[0]


def problem_of(plant: Plant, free: tuple[str, ...] = ()) -> Problem:
    """Return the problem of the healthy machine with the sensors' true noise; by default, what the twin estimates."""
    twin = twin_of(plant)
    names = free or tuple(item.name for item in twin.parameters if item.role is Role.ESTIMATED)
    values = {item.name: in_twin_units(twin, item.name, plant.parameters[item.name]) for item in twin.parameters}
    return Problem(
        twin=twin,
        known=tuple((name, value) for name, value in values.items() if name not in names),
        free=tuple(item for item in twin.parameters if item.name in names),
        noise=tuple(output.noise for output in twin.outputs),
        window=WindowOptions(plant.records, plant.records, plant.records, plant.period),
    )
