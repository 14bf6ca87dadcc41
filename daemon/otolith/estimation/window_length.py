"""The length of the next window: long enough for its noise, short enough for what drifts within it.

The paper leaves this open (section 6). The estimate from a window alone is about its middle: against the value at its
end it is off by trend * length / 2, and its variance falls with its length. The sum of squared bias and variance is
least where length³ = 2 * variance * length now / trend².
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.problem import WindowOptions

MAX_CHANGE = 1.5  # ratio of two consecutive lengths
MIN_CHANGE = 1.2  # ratio below which the length stays as it is
SHORTENED = 0.5  # ratio after a window that the twin does not explain


@dataclass(frozen=True, slots=True, eq=False)
class WindowExcitation:
    """What a window showed of the parameters."""

    sd: Array
    """(free,) standard deviation of each parameter from the window alone; infinite for none."""
    trend: Array
    """(free,) root mean square of each parameter's trend, per second."""
    explained: bool
    """Whether the twin leaves nothing but noise."""


def next_records(options: WindowOptions, length: float, sample_period: float, excitation: WindowExcitation) -> int:
    """Return the records of the window after one of ``length`` (s) that showed ``excitation``.

    Records are nominal ones, ``sample_period`` s apart, however many samples come.
    """
    sd, trend, explained = excitation.sd, excitation.trend, excitation.explained
    determined = np.isfinite(sd) & (trend > 0.0)
    if not explained:
        wanted = SHORTENED * length
    elif not determined.any():
        wanted = MAX_CHANGE * length
    else:
        wanted = float(np.cbrt(2.0 * sd[determined] ** 2 * length / trend[determined] ** 2).min())
    wanted = float(np.clip(wanted, length / MAX_CHANGE if explained else SHORTENED * length, MAX_CHANGE * length))
    if 1.0 / MIN_CHANGE < wanted / length < MIN_CHANGE:
        return int(np.clip(round(length / sample_period), options.shortest, options.longest))
    return int(np.clip(round(wanted / sample_period), options.shortest, options.longest))
