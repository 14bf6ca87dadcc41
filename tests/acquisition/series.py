"""Times and values for tests of acquisition, and windows as they are taken and cut."""

import numpy as np

from otolith.acquisition.cutting import cut
from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import Series, SignalPlan
from otolith.acquisition.window import Array, GridSpan, Window
from otolith.acquisition.windower import AlignedSamples, RawWindow, Windower


def ramp(count: int) -> Array:
    """Return 0, 1, 2 and so on, (count,)."""
    return np.arange(count, dtype=np.float64)


def cut_next(windower: Windower, rings: Rings, offset: float = 0.0) -> Window:
    """Return the next window of ``rings``."""
    return cut(windower.take(rings, offset)).window


def uncut(window: Window) -> RawWindow:
    """Return the samples from which ``window``, which is whole, is cut."""
    times = window.start + window.grid.offsets
    series = {name: Series(times, window.column(name)) for name in window.signals}
    plans = {name: SignalPlan(name) for name in window.signals}
    span, samples = GridSpan(window.start, window.records, window.sample_period), AlignedSamples(series, {}, 0, {})
    return RawWindow(window.index, span, 0.0, window.ahead, samples, plans, QualityLimits(), window.observed)
