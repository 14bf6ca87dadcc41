"""Records that only repeat the one before, bit for bit in every channel: an old image, read or sent again.

The errors of such records are one and the same error, so many of them say no more than a few. Taken for as many
measurements, the noise of a single reading becomes an offset that nothing but a component could explain.

Coarse channels repeat by chance, and then every record counts: those that are left would be the ones that have just
changed. An old image is told from that by its end, where all sensors jump at once and by any amount. The first and the
last of its records count, as the first alone would be off in the direction of the motion.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.twin.definition import Definition

SHORTEST = 10  # records
UNMOVED = 0.3  # share of the records beside the runs in which a sensor repeats, from which on it is coarse
FEW = 2.0  # least steps, that a coarse sensor usually moves by


def counted_twice(window: Window, twin: Definition) -> tuple[Window, list[str]]:
    """The window with the outputs of repeated records missing, and what there is to say of it."""
    measured = np.isin(window.signals, [entry.name for entry in twin.outputs])
    repeated = repeats(window, measured)
    count = int(repeated.sum())
    if not count:
        return window, []
    note = f"{count} of {window.records} records repeat the one before in every signal, bit for bit, and do not count"
    return replace(window, missing=window.missing | (repeated[:, None] & measured)), [note]


def repeats(window: Window, measured: Mask) -> Mask:
    """(records,) which records are within a long run of the same that is no chance; neither its first nor its last.

    ``measured`` (signals,) are the sensors.
    """
    changes = np.abs(np.diff(window.values, axis=0))
    same = (changes == 0.0).all(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    found = np.zeros(window.records, dtype=np.bool_)
    beside = np.ones(len(changes), dtype=np.bool_)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= SHORTEST:
            found[first + 1 : last] = True
            beside[first:last] = False
    if found.any() and _are_coarse(changes[beside][:, measured]):
        found[:] = False
    return found


def _are_coarse(changes: Array) -> bool:
    """Whether sensors with ``changes`` (records, sensors) beside long runs of the same repeat themselves by chance."""
    if not len(changes):
        return False
    steps = [column[column > 0.0] for column in changes.T]
    small = all(not len(column) or float(np.median(column)) <= FEW * float(column.min()) for column in steps)
    return small or bool((changes == 0.0).mean(axis=0).max() > UNMOVED)
