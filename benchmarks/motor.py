"""Windows of the simulated motor, as the daemon cuts them, without a clock."""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from otolith.acquisition.window import Window
from otolith_drivers.plant.scenario import Scenario, simulate

CONFIG = Path(__file__).parents[1] / "config"
SIGNALS = {"V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed"}
RECORDS = 200


def windows(scenario: Scenario, count: int) -> Iterator[Window]:
    samples = simulate(scenario)
    for index in range(count):
        chunk = list(islice(samples, RECORDS))
        values = np.array([[sample.measured[name] for name in SIGNALS.values()] for sample in chunk])
        yield Window.whole(index, chunk[0].time, scenario.sample_period, tuple(SIGNALS), values)
