"""Jitter of the rows of a log is no noise of the machine: the recorded times are used, not slots of a grid."""

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from otolith.acquisition.window import Array
from otolith.commissioning.identification import identify_noise
from otolith.machine import load_machine
from otolith.runtime.replay import Replay, open_recorded

PERIOD, JITTER, LENGTH = 0.005, 0.0007, 20.0  # s
NOISE_Q, NOISE_QD = 1e-4, 5e-3  # rad, rad/s
DAMPING = 3.0  # 1/s

TWIN = """
[twin]
name = "joint"
title = "joint of a robot"
source = "moment of momentum"

[states]
q = { unit = "rad", bounds = [-10, 10], meaning = "angle" }
qd = { unit = "rad/s", bounds = [-50, 50], meaning = "speed" }

[inputs]
u = { unit = "rad/s^2", hold = "foh", range = [-20, 20], meaning = "torque over inertia" }

[outputs]
q = { unit = "rad", noise = 1e-4, meaning = "angle" }
qd = { unit = "rad/s", noise = 5e-3, meaning = "speed" }

[parameters]
d = { unit = "1/s", nominal = 2.5, bounds = [0.1, 20], role = "estimated", meaning = "damping over inertia" }

[equations]
"der(q)" = "qd"
"der(qd)" = "u - d*qd"

[sites]
joint = { into = "der(qd)", mode = "additive", unit = "rad/s^2", meaning = "torque over inertia" }
"""
MACHINE = '[machine]\nname = "joint"\n[twin]\nfile = "joint.toml"\n[window]\nsample_period = "5 ms"\n'


def drive(time: Array | float) -> Array | float:
    return 8.0 * np.sin(2.1 * time) + 5.0 * np.sin(5.7 * time + 1.0)


def write_log(folder: Path) -> Path:
    """Write a log whose rows were taken up to a seventh of the period before or after the beat, at the stated times."""
    random = np.random.default_rng(4)
    times = np.arange(0.0, LENGTH, PERIOD)
    times = np.sort(times + random.normal(size=len(times)).clip(-3.0, 3.0) * JITTER)
    times -= times[0]
    motion = solve_ivp(
        lambda time, state: [state[1], drive(time) - DAMPING * state[1]],
        (0.0, LENGTH),
        [0.1, 0.5],
        t_eval=times,
        rtol=1e-10,
        atol=1e-12,
    ).y
    q, qd = motion + random.normal(size=motion.shape) * np.array([[NOISE_Q], [NOISE_QD]])
    rows = np.column_stack([times[: len(q)], drive(times[: len(q)]), q, qd])
    path = folder / "log.csv"
    np.savetxt(path, rows, delimiter=",", header="t,u,q,qd", comments="", fmt="%.9g")
    return path


@pytest.mark.full
def test_jitter_of_the_rows_is_no_process_noise(tmp_path: Path) -> None:
    (tmp_path / "joint.toml").write_text(TWIN, encoding="utf-8")
    (tmp_path / "machine.toml").write_text(MACHINE, encoding="utf-8")
    machine = load_machine(tmp_path / "machine.toml", with_driver=False)
    with open_recorded(machine, write_log(tmp_path)) as data:
        windows = list(Replay(machine, data).windows())
    identified = identify_noise(machine.problem, windows)
    q, qd = identified.outputs
    assert abs(q.value / NOISE_Q - 1.0) < 0.1
    assert abs(qd.value / NOISE_QD - 1.0) < 0.1
    # On slots of a grid the angle would be off by jitter times speed, some 2 mrad.
    assert identified.states[0].value * np.sqrt(PERIOD) < 0.1 * NOISE_Q
