"""Winch, lab motor and robot joint as they are logged: what they lack is no sensor fault, and a change is followed.

They are integrated here, with dry friction that sticks, apart from the kernels of the twins.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.commissioning.identification import identify_noise
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.information import initial_prior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import fit
from otolith.machine import load_machine
from otolith.twin.kernel import Excitation, kernel_of
from tests.adaptation.measured_like import blamed, cut, reports
from tests.variants import often, often_rows

PERIOD, RECORDS, SUBSTEPS = 0.02, 100, 20
WINDOWS, FEW = 14, 6
SEEDS = pytest.mark.parametrize("seed", often([1], range(1, 9)))
EXCITATIONS = pytest.mark.parametrize("excitation", often(["steps"], ["sine", "steps", "stops"]))
TRUTH = {"K": 0.046, "J": 6e-5, "T_c": 0.009}  # of the motor
RESISTANCE = 2.0  # ohm
CARRIED, LEFT = 0.98, 0.20  # N*m: load of the winch before and after the window in the middle
HEADER = '[twin]\nname = "{0}"\ntitle = "{0}"\nsource = "moment of momentum"\nvalidity = "everywhere"\n'
WINCH = """
[states]
omega = { unit = "rad/s", bounds = [-400, 400], meaning = "speed of the drum" }
[inputs]
T_m = { unit = "N*m", hold = "zoh", range = [-4, 4], meaning = "torque of the motor" }
[outputs]
omega = { unit = "rad/s", noise = "0.1 rad/s", meaning = "speed of the drum" }
[parameters]
J = { unit = "kg*m^2", nominal = 0.02, bounds = [0.001, 0.5], role = "estimated", meaning = "moment of inertia" }
D = { unit = "N*m*s/rad", nominal = 0.02, bounds = [0, 0.5], meaning = "viscous friction" }
T_l = { unit = "N*m", nominal = 0.8, bounds = [0, 5], role = "estimated", meaning = "load torque" }
[equations]
"der(omega)" = "(T_m - T_l - D*omega)/J"
[sites]
drum = { into = "der(omega)", mode = "additive", through = "1/J", unit = "N*m", meaning = "torque on the drum" }
"""
MOTOR = """
[states]
omega = { unit = "rad/s", bounds = [-400, 400], meaning = "speed of the shaft" }
[inputs]
u = { unit = "V", hold = "zoh", range = [-12, 12], meaning = "voltage" }
[outputs]
omega = { unit = "rad/s", noise = "0.3 rad/s", meaning = "speed of the shaft" }
[parameters]
K = { unit = "V*s/rad", nominal = 0.05, bounds = [0.005, 0.5], role = "estimated", meaning = "motor constant" }
R = { unit = "ohm", nominal = 2, bounds = [0.5, 50], meaning = "resistance" }
J = { unit = "kg*m^2", nominal = 0.0001, bounds = [5e-6, 0.01], role = "estimated", meaning = "moment of inertia" }
T_c = { unit = "N*m", nominal = 0.01, bounds = [0, 0.2], role = "estimated", meaning = "dry friction" }
[constants]
slow = { unit = "rad/s", value = 0.5, meaning = "speed within which dry friction changes sign" }
[equations]
"der(omega)" = "(K*(u - K*omega)/R - T_c*tanh(omega/slow))/J"
[sites]
shaft = { into = "der(omega)", mode = "additive", through = "1/J", unit = "N*m", meaning = "torque on the shaft" }
"""
JOINT = """
[states]
q = { unit = "rad", bounds = [-100, 100], meaning = "angle" }
qd = { unit = "rad/s", bounds = [-50, 50], meaning = "speed" }
[inputs]
T_m = { unit = "N*m", hold = "zoh", range = [-10, 10], meaning = "measured torque" }
[outputs]
q = { unit = "rad", noise = "0.0005 rad", meaning = "angle" }
[parameters]
J = { unit = "kg*m^2", nominal = 0.5, bounds = [0.02, 10], role = "estimated", meaning = "moment of inertia" }
D = { unit = "N*m*s/rad", nominal = 1, bounds = [0, 20], role = "estimated", meaning = "viscous friction" }
T_c = { unit = "N*m", nominal = 1, bounds = [0, 20], role = "estimated", meaning = "dry friction" }
[constants]
slow = { unit = "rad/s", value = 0.01, meaning = "speed within which dry friction changes sign" }
[equations]
"der(q)" = "qd"
"der(qd)" = "(T_m - D*qd - T_c*tanh(qd/slow))/J"
[sites]
joint = { into = "der(qd)", mode = "additive", through = "1/J", unit = "N*m", meaning = "torque on the joint" }
"""


def problem(folder: Path, name: str, text: str, extra: str = "") -> Problem:
    (folder / f"{name}.toml").write_text(HEADER.format(name) + text, encoding="utf-8")
    machine = folder / "machine.toml"
    window = f'length = "{RECORDS * PERIOD} s"\nsample_period = "{PERIOD} s"'
    tables = f'[machine]\nname = "{name}"\n[twin]\nfile = "{name}.toml"\n[window]\n{window}\n{extra}'
    machine.write_text(tables, encoding="utf-8")
    return load_machine(machine, with_driver=False).problem


def excited(excitation: str, size: float, random: np.random.Generator) -> Array:
    """A command (records,) of magnitude up to ``size``."""
    times = PERIOD * np.arange(WINDOWS * RECORDS)
    if excitation == "sine":
        return np.asarray(size * np.sin(2.0 * np.pi * 0.5 * times + random.uniform(0.0, 6.3)))
    lengths = random.integers(20, 80, len(times))
    levels = random.uniform(0.4, 1.0, len(times)) * size * random.choice([-1.0, 1.0], len(times))
    if excitation == "stops":
        levels[::2] = 0.0
    return np.asarray(np.repeat(levels, lengths)[: len(times)])


def moved(
    command: Array, inertia: float, friction: float, torque: Callable[[float, float, float], float]
) -> tuple[Array, Array]:
    """Angle and speed (records,) under ``torque`` of command, angle and speed; dry friction holds at standstill."""
    step, angle, speed, rows = PERIOD / SUBSTEPS, 0.0, 0.0, []
    for held in command.tolist():
        rows.append((angle, speed))
        for _ in range(SUBSTEPS):
            net = torque(held, angle, speed)
            stopping = net + inertia * speed / step
            speed += step * (net - min(max(stopping, -friction), friction)) / inertia
            angle += step * speed
    return np.array(rows)[:, 0], np.array(rows)[:, 1]


@SEEDS
@pytest.mark.parametrize("is_sure", often([True], [False, True]), ids=("any sensor", "no sensor"))
def test_a_load_that_is_put_down_in_the_record_is_followed(tmp_path: Path, seed: int, is_sure: bool) -> None:
    """The noise is that of the same record. An offset of either sensor is the same as another load."""
    extra = "[discovery]\nsensors = []" if is_sure else ""
    random, rig = np.random.default_rng(seed), problem(tmp_path, "winch", WINCH, extra)
    motion = excited("steps", 0.6, random)
    change = WINDOWS // 2 * RECORDS + RECORDS // 3
    load = np.where(np.arange(len(motion)) < change, CARRIED, LEFT)
    command = load + 0.4 + motion  # as a speed controller gives it
    speed = moved(command - load, 0.015, 0.0, lambda held, _, omega: held - 0.02 * omega)[1]
    values = np.column_stack([command, speed + 0.1 * random.normal(size=len(speed))])
    windows = cut(("T_m", "omega"), values, RECORDS, PERIOD)
    documents = reports(identify_noise(rig, windows).applied(rig), windows)
    middle = WINDOWS // 2
    for document in [*documents[2:middle], *documents[middle + 3 :]]:
        truth, known = CARRIED if document.window.index < middle else LEFT, document.parameters["T_l"]
        assert known.low is not None
        assert known.high is not None
        assert known.low - 0.01 <= truth <= known.high + 0.01
    assert not blamed(documents) or not is_sure


@pytest.mark.full
@SEEDS
@EXCITATIONS
def test_a_lab_motor_without_a_current_sensor_has_no_sensor_fault(tmp_path: Path, seed: int, excitation: str) -> None:
    random, rig = np.random.default_rng(seed), problem(tmp_path, "lab_motor", MOTOR)
    command, constant = excited(excitation, 8.0, random), TRUTH["K"]
    speed = moved(command, TRUTH["J"], TRUTH["T_c"], lambda u, _, w: constant * (u - constant * w) / RESISTANCE)[1]
    values = np.column_stack([command, speed + 0.3 * random.normal(size=len(speed))])
    documents = reports(rig, cut(("u", "omega"), values, RECORDS, PERIOD))
    assert not blamed(documents)
    for name, truth in TRUTH.items():
        assert documents[-1].parameters[name].value == pytest.approx(truth, rel=0.03)


@pytest.mark.parametrize("share", [0.5, 0.6, 0.8, 1.0, 1.1])
@SEEDS
def test_motors_that_move_alike_do_not_exclude_each_other(tmp_path: Path, seed: int, share: float) -> None:
    """One step tells final speed and time constant: K, J and T_c lie on a long curved ridge, and a fit ends anywhere.

    ``share`` is the inertia of another motor on the ridge, in that of the true one.
    """
    rig, voltage, constant = problem(tmp_path, "lab_motor", MOTOR), 6.8, TRUTH["K"] * np.sqrt(share)
    final = (voltage - TRUTH["T_c"] * RESISTANCE / TRUTH["K"]) / TRUTH["K"]
    other = np.array([constant, share * TRUTH["J"], constant * (voltage - constant * final) / RESISTANCE])
    truth = np.array([TRUTH[parameter.name] for parameter in rig.free])
    random, command = np.random.default_rng(seed), np.repeat([0.0, voltage], [75, 25])
    every = np.array([[TRUTH["K"], RESISTANCE, TRUTH["J"], TRUTH["T_c"]]])
    drive = Excitation.uniform(command[:, None], PERIOD, SUBSTEPS)
    speed = kernel_of(rig.twin).simulate(every, np.zeros((1, 1)), drive)[0, :, 0]
    values = np.column_stack([command, speed + 0.3 * random.normal(size=RECORDS)])
    (window,) = cut(("u", "omega"), values, RECORDS, PERIOD)
    fitted = fit(rig, window, initial_prior(rig), other, 0)
    assert fitted.cost < 1.1
    evidence = fitted.evidence()
    misfit = evidence.residual + evidence.sqrt_information @ (np.append(truth, np.zeros(3)) - evidence.point)
    assert misfit @ misfit < 27.9  # χ² with six degrees of freedom: one in 10,000


@pytest.mark.full
@SEEDS
@EXCITATIONS
def test_torque_ripple_of_a_joint_is_no_sensor_fault(tmp_path: Path, seed: int, excitation: str) -> None:
    """Its gears cause it, 18 times a turn; the torque is measured with noise, the angle by an encoder."""
    random, rig = np.random.default_rng(seed), problem(tmp_path, "joint", JOINT)
    command = excited(excitation, 4.5, random)
    angle = moved(command, 0.4, 1.2, lambda u, q, w: u - 0.8 * w + 0.4 * np.sin(18.0 * q + 1.0))[0]
    step = 2.0 * np.pi / 16384
    values = np.column_stack([command + 0.05 * random.normal(size=len(angle)), step * np.rint(angle / step)])
    documents = reports(rig, cut(("T_m", "q"), values, RECORDS, PERIOD)[:FEW])
    assert not blamed(documents) & {"T_m", "q"}


@pytest.mark.full
@SEEDS
@pytest.mark.parametrize(
    ("excitation", "level"), often_rows([("sine", 0.3)], [("sine", 0.3), ("stops", 0.3), ("sine", 0.05)])
)
def test_noise_of_a_measured_torque_is_named_and_is_no_component(
    tmp_path: Path, seed: int, excitation: str, level: float
) -> None:
    """The noise of the angle is stated as about one step of its encoder, which is four times too large."""
    random, rig = np.random.default_rng(seed), problem(tmp_path, "joint", JOINT)
    command = excited(excitation, 4.5, random)
    angle = moved(command, 0.4, 1.2, lambda u, _, w: u - 0.8 * w)[0]
    step = 2.0 * np.pi / 16384
    values = np.column_stack([command + level * random.normal(size=len(angle)), step * np.rint(angle / step)])
    documents = reports(rig, cut(("T_m", "q"), values, RECORDS, PERIOD))
    assert not any(document.components for document in documents)
    decisions = [document.decision for document in documents]
    after = decisions[decisions.index(WindowDecision.NOISIER) + 1 :]
    assert after.count(WindowDecision.LEARNED) >= len(after) - 1  # a window may be suspected by chance
    assert documents[-1].findings[0].text.startswith("T_m is noisier than stated")
    for name, truth in (("J", 0.4), ("D", 0.8), ("T_c", 1.2)):
        known = documents[-1].parameters[name]
        assert known.sd is not None
        assert known.value == pytest.approx(truth, abs=4.0 * known.sd)
