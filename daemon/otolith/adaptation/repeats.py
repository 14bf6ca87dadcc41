"""Records that only repeat the one before, bit for bit in every channel: an old image, read or sent again.

The errors of such records are one and the same error, so they say together what one of them says. Taken for as many
measurements, the noise of a single reading becomes an offset that nothing but a component could explain.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Mask, Window
from otolith.twin.definition import Definition

SHORTEST = 10  # records: coarse converters show shorter repetitions by chance


def counted_once(window: Window, twin: Definition) -> tuple[Window, list[str]]:
    """The window with the outputs of repeated records missing, and what there is to say of it."""
    repeated = repeats(window)
    count = int(repeated.sum())
    if not count:
        return window, []
    missing = window.missing.copy()
    measured = np.isin(window.signals, [entry.name for entry in twin.outputs])
    missing |= repeated[:, None] & measured
    note = f"{count} of {window.records} records repeat the one before in every signal, bit for bit: counted once"
    return replace(window, missing=missing), [note]


def repeats(window: Window) -> Mask:
    """(records,) which records repeat the one before them, in long runs."""
    same = np.concatenate([[False], (np.diff(window.values, axis=0) == 0.0).all(axis=1), [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same))
    found = np.zeros(window.records, dtype=np.bool_)
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if last - first >= SHORTEST:
            found[first + 1 : last + 1] = True
    return found
