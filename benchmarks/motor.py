"""Windows of the simulated motor, as the daemon would cut them, without any clock."""

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
    ticks = simulate(scenario)
    for index in range(count):
        part = list(islice(ticks, RECORDS))
        values = np.array([[tick.measured[name] for name in SIGNALS.values()] for tick in part])
        yield Window.whole(index, part[0].time, scenario.sample_period, tuple(SIGNALS), values)
