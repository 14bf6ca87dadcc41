"""Records that only repeat the one before, bit for bit in every channel: an old image, read or sent again.

The errors of such records are one and the same error, so many of them say no more than a few. Taken for as many
measurements, the noise of a single reading becomes an offset that nothing but a component could explain. The first and
the last of a run count: coarse channels repeat while the machine moves slowly, and their first record, which has just
changed, is off by half a step in the direction of the motion, their last one by as much the other way.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Mask, Window
from otolith.twin.definition import Definition

SHORTEST = 10  # records


def counted_twice(window: Window, twin: Definition) -> tuple[Window, list[str]]:
    """The window with the outputs of repeated records missing, and what there is to say of it."""
    repeated = repeats(window)
    count = int(repeated.sum())
    if not count:
        return window, []
    measured = np.isin(window.signals, [entry.name for entry in twin.outputs])
    note = f"{count} of {window.records} records repeat the one before in every signal, bit for bit, and do not count"
    return replace(window, missing=window.missing | (repeated[:, None] & measured)), [note]


def repeats(window: Window) -> Mask:
    """(records,) which records are within a long run of the same; neither its first nor its last."""
    same = (np.diff(window.values, axis=0) == 0.0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    found = np.zeros(window.records, dtype=np.bool_)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= SHORTEST:
            found[first + 1 : last] = True
    return found
