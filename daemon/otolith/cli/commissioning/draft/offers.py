"""What a recording or a bus offers: signals with their names, units and values. Nothing is read or asked in here."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from otolith.acquisition.samples import MAD_TO_SD
from otolith.acquisition.window import Array
from otolith.cli.commissioning.draft.words import LEVELS
from otolith.estimation.objective import adc_step
from otolith_drivers.units import is_unit

BEHIND_IN = re.compile(r"\bin\s+\[?([^\s\]]+)\]?$")
MIN_SAMPLES = 20  # values from which a noise level is taken
UNIT_ENDINGS = ("rpm", "upm", "V", "mV", "A", "mA", "Nm", "N", "Hz", "bar", "kPa", "Pa", "m", "mm", "rad", "deg")
"""Units that stand at the end of a name, as in ``speed_rpm``; others would be words or symbols."""


@dataclass(frozen=True, slots=True, eq=False)
class Offer:
    """One signal of a source."""

    name: str
    unit: str | None  # None if the source states none that is known
    keys: Mapping[str, Any]  # By which a machine file names it, without the unit
    values: Array = field(default_factory=lambda: np.zeros(0))  # (n,) in its unit, finite, in the order of time
    interval: float | None = None  # s; median from sample to sample

    @property
    def moves(self) -> bool:
        """Whether it has had more than one value."""
        return len(self.values) > 1 and bool(np.ptp(self.values) > 0.0)

    @property
    def noise(self) -> float | None:
        """Standard deviation of its noise in its unit; None if the values do not show it."""
        return noise_level(self.values)


@dataclass(frozen=True, slots=True, eq=False)
class OfferedSource:
    """A recording or a bus with what it offers."""

    title: str
    driver: Sequence[str]  # Lines of the table [driver]
    offers: Sequence[Offer]
    duration: float  # s
    check: str = ""  # What 'otolith check' needs behind the machine file
    remarks: Sequence[str] = ()
    period: str = "that of the fastest signal"  # What the sample period is, if an interval shows it
    still: Mapping[str, float] = field(default_factory=dict)  # What never changed and is no offer, by name
    doubt: str = ""  # What each proposal is in need of, as the source was not there


def noise_level(values: Array) -> float | None:
    """Return the standard deviation of the noise of ``values`` (n,), sampled far faster than they move.

    Third differences leave noise alone, and their median is not moved by steps. None if there is no noise, or there
    are too few values.
    """
    if len(values) < MIN_SAMPLES:
        return None
    differences = np.diff(values, 3)
    deviation = MAD_TO_SD * float(np.median(np.abs(differences))) / np.sqrt(20.0)
    level = max(deviation, adc_step(values) / np.sqrt(12.0))
    return float(level) if level > 0.0 and np.isfinite(level) else None


def unit_in(name: str) -> str | None:
    """Return the unit at the end of a name, as in ``speed_rpm`` or ``n in 1/min``; None if there is none.

    Of a path, as ``drive/rpm``, the last name may be that of a unit.
    """
    if (written := BEHIND_IN.search(name)) and is_unit(written[1]):
        return written[1]
    whole, ending = LEVELS.split(name)[-1], name.rpartition("_")[2]
    if len(whole) > 1 and whole != name and whole in UNIT_ENDINGS:  # a letter alone is a name, as that of a phase
        return whole
    return ending if ending != name and ending in UNIT_ENDINGS and is_unit(ending) else None
