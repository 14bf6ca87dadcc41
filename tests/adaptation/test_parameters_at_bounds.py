"""What is traded with a parameter at its bound is not estimated: it holds what the other lacks beyond its bound."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.schema import Status
from otolith.machine import load_machine

TWIN = """
[twin]
name = "servo"
title = "servo with viscous and dry friction"
source = "Newton"
validity = "rigid shaft"

[states]
w = { unit = "rad/s", bounds = [-500, 500], meaning = "speed" }

[inputs]
T = { unit = "N*m", hold = "zoh", range = [-2, 2], meaning = "torque" }

[outputs]
w = { unit = "rad/s", noise = "0.5 rad/s", meaning = "speed" }

[parameters]
J = { unit = "kg*m^2", nominal = 1e-4, bounds = [5e-5, 2e-4], role = "estimated", meaning = "inertia" }
B = { unit = "N*m*s/rad", nominal = 5e-5, bounds = [1e-5, 1e-4], role = "estimated", meaning = "viscous friction" }
T_c = { unit = "N*m", nominal = 0.05, bounds = [0, 0.2], role = "estimated", meaning = "dry friction" }

[constants]
w_s = { unit = "rad/s", value = 2, meaning = "speed within which dry friction changes sign" }

[equations]
"der(w)" = "(T - B*w - T_c*tanh(w/w_s))/J"

[sites]
shaft = { into = "der(w)", mode = "additive", through = "1/J", unit = "N*m", meaning = "torque on the shaft" }
"""
MACHINE = """
[machine]
name = "servo"
[twin]
file = "servo.toml"
[window]
length = "5 s"
[discovery]
enabled = false
"""
PERIOD, RECORDS, SUBSTEPS, NOISE = 0.01, 500, 20, 0.5
DRY, BEYOND = 0.0366, 1.6e-4  # N*m; N*m*s/rad, beyond the bounds of B


def torques(kind: str, time: Array) -> Array:
    return np.asarray(0.1 + 0.004 * np.sin(0.5 * time) if kind == "slow" else np.where(time % 20.0 < 10.0, 0.1, 0.07))


def servo_record(torque: str, inertia: float, viscous: float, windows: int) -> Array:
    """Torque and speed of a servo, by Euler's method with fine steps."""
    random, time = np.random.default_rng(1), PERIOD * np.arange(windows * RECORDS, dtype=np.float64)
    speed, rows = 0.0, []
    for drive in torques(torque, time).tolist():
        rows.append((drive, speed + NOISE * random.normal()))
        for _ in range(SUBSTEPS):
            speed += PERIOD / SUBSTEPS * (drive - viscous * speed - DRY * np.tanh(speed / 2.0)) / inertia
    return np.array(rows)


@pytest.mark.parametrize(("torque", "inertia"), [("slow", 1e-4), ("steps", 3e-4)])
def test_what_is_traded_with_a_parameter_at_its_bound_is_not_estimated(
    tmp_path: Path, torque: str, inertia: float
) -> None:
    """Viscous friction is larger than its bounds allow: dry friction took its part, with an interval of 7 %."""
    (tmp_path / "servo.toml").write_text(TWIN, encoding="utf-8")
    (tmp_path / "m.toml").write_text(MACHINE, encoding="utf-8")
    state = initial_state("servo", "here", load_machine(tmp_path / "m.toml", with_driver=False).problem)
    values, reasons = servo_record(torque, inertia, BEYOND, 3), []
    for index in range(3):
        part = values[index * RECORDS : (index + 1) * RECORDS]
        state, report = adapt(state, Window.whole(index, index * RECORDS * PERIOD, PERIOD, ("T", "w"), part))
        friction, viscous = (report.document.parameters[name] for name in ("T_c", "B"))
        if viscous.status is Status.INVALID:
            assert friction.status is not Status.ESTIMATED
        reasons.append(friction.reason if friction.status is Status.INVALID else "")
        assert state.previous["T_c"].status is friction.status
    assert any("B" in reason and "bound" in reason for reason in reasons)


def test_without_a_bound_in_the_way_all_are_estimated(tmp_path: Path) -> None:
    (tmp_path / "servo.toml").write_text(TWIN, encoding="utf-8")
    (tmp_path / "m.toml").write_text(MACHINE, encoding="utf-8")
    problem = load_machine(tmp_path / "m.toml", with_driver=False).problem
    free = tuple(replace(each, high=5e-4) if each.name == "B" else each for each in problem.free)
    state = initial_state("servo", "here", replace(problem, free=free))
    values = servo_record("steps", 1e-4, BEYOND, 4)
    for index in range(4):
        part = values[index * RECORDS : (index + 1) * RECORDS]
        state, report = adapt(state, Window.whole(index, index * RECORDS * PERIOD, PERIOD, ("T", "w"), part))
    assert Status.INVALID not in {item.status for item in report.document.parameters.values()}
