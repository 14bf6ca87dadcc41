"""How long the next window should be: long enough for its noise, short enough for what drifts within it.

The paper leaves this open (section 6). What a window alone says of a parameter is about its middle: against the value
at its end it is off by trend * length / 2, and its variance falls with its length. The sum of squares is least where
length³ = 2 * variance * length now / trend².
"""

from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.problem import WindowOptions

MOST_CHANGE = 1.5  # from one window to the next
WORTH = 1.2  # a change smaller than this is not made
SHORTENED = 0.5  # after a window in which something happened that the twin cannot explain


@dataclass(frozen=True, slots=True, eq=False)
class WindowExcitation:
    """What a window showed."""

    sd: Array
    """(free,) to which it alone knows each parameter; infinite for nothing."""
    trend: Array
    """(free,) how fast each may change: root mean square, per second."""
    explained: bool
    """Whether the twin leaves nothing but noise."""


def next_records(options: WindowOptions, records: int, sample_period: float, need: WindowExcitation) -> int:
    """Records of the next window, after one of ``records`` that showed ``need``."""
    sd, trend, explained = need.sd, need.trend, need.explained
    if options.shortest >= options.longest:
        return options.records
    now = records * sample_period
    seen = np.isfinite(sd) & (trend > 0.0)
    if not explained:
        wanted = SHORTENED * now
    elif not seen.any():
        wanted = MOST_CHANGE * now
    else:
        wanted = float(np.cbrt(2.0 * sd[seen] ** 2 * now / trend[seen] ** 2).min())
    wanted = float(np.clip(wanted, now / MOST_CHANGE if explained else SHORTENED * now, MOST_CHANGE * now))
    if 1.0 / WORTH < wanted / now < WORTH:
        return int(np.clip(records, options.shortest, options.longest))
    return int(np.clip(round(wanted / sample_period), options.shortest, options.longest))
