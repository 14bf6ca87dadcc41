"""Single records that no machine makes: spikes are taken for missing, and a channel full of them is not believed.

A spike goes up and comes down within two sampling periods, so the second difference around it reads -1/2, 1, -1/2; the
kink that a step of voltage leaves in a current does not (compare F. R. Hampel, The influence curve and its role in
robust estimation, Journal of the American Statistical Association 69, 1974).
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.twin.definition import Definition

HEIGHT = 12.0  # in units of what the channel's second difference usually is: a spike is at least this high
SHAPE = 0.35  # how far the neighbours' share may be from a half
SPIKING = 0.05  # share of records beyond which the channel is not believed
USUAL = 1.4826  # median absolute deviation of a normal distribution of unit variance, inverted
SECOND = 1.2247  # standard deviation of the second difference of unit noise: the root of 3/2


def without_spikes(window: Window, twin: Definition, noise: tuple[float, ...]) -> tuple[Window, list[str], list[str]]:
    """The window with spikes missing; what there is to say of it; and why it should not be estimated from.

    ``noise`` is of the outputs. Commands (``zoh`` inputs) may jump as they like.
    """
    levels = {entry.name: level for entry, level in zip(twin.outputs, noise, strict=True)}
    levels |= {entry.name: 0.0 for entry in twin.inputs if entry.hold == "foh"}
    values, missing = window.values, window.missing
    notes, vetoes = [], []
    for name, level in levels.items():
        column = window.signals.index(name)
        found = spikes(window.values[:, column], level) & ~window.missing[:, column]
        count = int(found.sum())
        if not count:
            continue
        if count > SPIKING * window.records:
            vetoes.append(f"{name} spikes in {count} of {window.records} records: look at its cable and its connector")
            continue
        if values is window.values:
            values, missing = values.copy(), missing.copy()
        values[:, column] = _bridged(values[:, column], found)
        missing[:, column] |= found
        notes.append(f"{name} has {count} spike{'s' if count > 1 else ''}, left out")
    return (window if values is window.values else replace(window, values=values, missing=missing)), notes, vetoes


def spikes(values: Array, noise: float) -> Mask:
    """(records,) which of ``values`` (records,) are spikes over a ``noise`` of this standard deviation."""
    found = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 5:
        return found
    second = values[1:-1] - 0.5 * (values[:-2] + values[2:])
    usual = max(USUAL * float(np.median(np.abs(second))), SECOND * noise)
    high = np.abs(second[1:-1]) > HEIGHT * max(usual, float(np.finfo(float).tiny))
    if not high.any():
        return found
    with np.errstate(divide="ignore", invalid="ignore"):
        before, after = second[:-2] / second[1:-1], second[2:] / second[1:-1]
    found[2:-2] = high & (np.abs(before + 0.5) < SHAPE) & (np.abs(after + 0.5) < SHAPE)
    return found


def _bridged(values: Array, gaps: Mask) -> Array:
    known = np.flatnonzero(~gaps)
    return np.interp(np.arange(len(values)), known, values[known])
