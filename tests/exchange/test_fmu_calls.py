"""What the C functions of an FMU are called with."""

import ctypes

import numpy as np
import pytest

from otolith.fmu import calls

STEP = {
    False: (ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_int),
    True: (ctypes.c_void_p, ctypes.c_double, ctypes.c_double, ctypes.c_bool, *[ctypes.c_void_p] * 4),
}
"""Arguments of ``DoStep`` of FMI 2 and 3."""


@pytest.mark.parametrize("is_third", STEP)
@pytest.mark.parametrize("saved", [0, 1])
def test_an_fmu_keeps_its_past_if_it_is_brought_back_by_its_saved_state(*, is_third: bool, saved: int) -> None:
    """``noSetFMUStatePriorToCurrentPoint`` lets it forget what lies before: it is true only without such a state."""
    given: list[tuple[float, ...]] = []

    def step(*arguments: float) -> int:
        given.append(arguments[1:4])
        return 0

    function = ctypes.CFUNCTYPE(ctypes.c_int, *STEP[is_third])(step)
    event, table = np.zeros(calls.EVENT_BYTES, dtype=np.uint8), np.zeros(calls.ENTRIES, dtype=np.int64)
    table[calls.DO_STEP] = ctypes.cast(function, ctypes.c_void_p).value or 0
    table[calls.IS_THIRD], table[calls.SAVED], table[calls.EVENT_AT] = is_third, saved, event.ctypes.data
    assert calls.made_step(table.ctypes.data, 0.25, 0.5) == 0
    assert given == [(0.25, 0.5, not saved)]
