"""Friction that is larger at rest than the twin's: it is named as such, and takes neither a delay nor an inertia."""

from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.problem import Problem
from otolith.twin.language import read_twin
from otolith_drivers.config_files import read
from tests.adaptation.measured_like import cut

RESISTANCE, CONSTANT, INERTIA = 2.0, 0.046, 4e-5  # ohm, V*s/rad, kg*m^2
FRICTION, STICTION, STRIBECK_SPEED = 0.010, 0.013, 1.0  # N*m, N*m, rad/s
AT_REST = 0.05  # rad/s: below it friction holds the rotor
NOISE, PROCESS_NOISE = 0.3, 1.5  # rad/s, rad/s/s^0.5: the second as identified from such a record
PERIOD, SUBSTEPS, RECORDS, WINDOWS = 0.01, 100, 200, 8
AMPLITUDE, FREQUENCY = 6.0, 0.4  # V, Hz
SDS = 4.0
TWIN = """
[twin]
name = "stiction"
title = "motor without inductance"
source = "moment of momentum"
validity = "turning"
[states]
omega = { unit = "rad/s", meaning = "speed", bounds = [-400, 400] }
[inputs]
u = { unit = "V", hold = "zoh", range = [-12, 12], meaning = "voltage" }
[outputs]
omega = { unit = "rad/s", noise = "0.3 rad/s", meaning = "speed" }
[parameters]
K = { unit = "V*s/rad", nominal = 0.03, bounds = [0.005, 0.2], role = "estimated", meaning = "motor constant" }
J = { unit = "kg*m^2", nominal = 2e-5, bounds = [1e-6, 1e-3], role = "estimated", meaning = "inertia" }
T_c = { unit = "N*m", nominal = 0.005, bounds = [0, 0.1], role = "estimated", meaning = "dry friction" }
[constants]
R = { unit = "ohm", value = 2.0, meaning = "resistance" }
omega_s = { unit = "rad/s", value = 0.5, meaning = "speed within which friction changes sign" }
[equations]
"der(omega)" = "(K*(u - K*omega)/R - T_c*tanh(omega/omega_s)) / J"
[sites]
shaft = { into = "der(omega)", mode = "additive", through = "1/J", unit = "N*m", meaning = "torque on the shaft" }
"""


def sine_windows(seed: int) -> list[Window]:
    """Return windows of a motor on a sine of its voltage; friction holds it each time it comes to rest."""
    random, step, speed = np.random.default_rng(seed), PERIOD / SUBSTEPS, 0.0
    values = np.empty((WINDOWS * RECORDS, 2))
    for record in range(len(values)):
        voltage = AMPLITUDE * np.sin(2.0 * np.pi * FREQUENCY * record * PERIOD)
        values[record] = voltage, speed + NOISE * random.normal()
        for _ in range(SUBSTEPS):
            drive = CONSTANT * (voltage - CONSTANT * speed) / RESISTANCE
            if abs(speed) < AT_REST and abs(drive) < STICTION:
                speed = 0.0
                continue
            direction = np.sign(speed if abs(speed) >= AT_REST else drive)
            friction = FRICTION + (STICTION - FRICTION) * np.exp(-((speed / STRIBECK_SPEED) ** 2))
            speed += step * (drive - friction * direction) / INERTIA
    return cut(("u", "omega"), values, RECORDS, PERIOD)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(10))
def test_stiction_is_neither_a_delay_nor_another_inertia(tmp_path: Path, seed: int) -> None:
    file = tmp_path / "stiction.toml"
    file.write_text(TWIN, encoding="utf-8")
    twin = read_twin(read(file))
    state = initial_state(
        "motor", "bench", Problem(twin, (), twin.parameters, (NOISE,), process_noise=(PROCESS_NOISE,))
    )
    adopted, late = False, 0
    for window in sine_windows(seed):
        state, report = adapt(state, window)
        document = report.document
        late += document.decision is WindowDecision.TIMING
        inertia = document.parameters["J"]
        if inertia.value is not None and inertia.sd is not None:
            assert abs(inertia.value - INERTIA) < SDS * inertia.sd, window.index
        adopted |= any(component.family == "Stribeck" for component in document.components)
    assert adopted
    assert late <= 1, "the first windows alone do not distinguish a delay"
