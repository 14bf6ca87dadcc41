"""Times and values for tests of acquisition."""

import numpy as np

from otolith.acquisition.window import Array


def ramp(count: int) -> Array:
    """Return 0, 1, 2 and so on, (count,)."""
    return np.arange(count, dtype=np.float64)
