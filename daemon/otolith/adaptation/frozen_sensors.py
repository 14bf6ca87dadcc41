"""A sensor that was frozen is so until its reading changes.

Where the other signals no longer determine what it should read, as their parameters have become uncertain, the twin can
follow a frozen reading with other values. What the sensor reads has not changed by that.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.data_checks import CheckedWindow, FaultySensor


@dataclass(frozen=True, slots=True)
class FrozenReading:
    """What a frozen sensor reads."""

    sensor: FaultySensor
    value: float  # In the unit of the twin


def with_still_frozen(checked: CheckedWindow, frozen: Mapping[str, FrozenReading], window: Window) -> CheckedWindow:
    """Return the checks of ``window`` with the sensors of ``frozen`` that read nothing but the value of before."""
    if not checked.is_usable:
        return checked
    still = tuple(
        item.sensor for name, item in frozen.items() if set(np.unique(_samples(window, name))) == {item.value}
    )
    return replace(checked, faulty_sensors=still)


def frozen_readings(faulty: tuple[FaultySensor, ...], window: Window) -> dict[str, FrozenReading]:
    """Return the sensors that are ``faulty`` in ``window`` and keep one value in all of it."""
    readings = {}
    for sensor in faulty:
        samples = _samples(window, sensor.signal)
        if len(samples) and np.ptp(samples) == 0.0:
            readings[sensor.signal] = FrozenReading(sensor, float(samples[0]))
    return readings


def _samples(window: Window, name: str) -> Array:
    return window.column(name)[~window.missing_in(name)]
