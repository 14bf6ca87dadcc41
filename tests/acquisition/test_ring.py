"""A ring counts what it loses, whenever it is asked."""

import math

from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.ring import Ring

CAPACITY = 8


@given(st.lists(st.tuples(st.integers(1, 6), st.integers(-3, 12), st.booleans()), max_size=30))
def test_a_loss_is_counted_the_same_whenever_it_is_asked_for(steps: list[tuple[int, int, bool]]) -> None:
    """Each step appends samples, of which some may be old, and may have a window read the older ones."""
    asked, gathered, time = Ring(CAPACITY), Ring(CAPACITY), 0.0
    for count, back, is_read in steps:
        for number in range(count):
            time += 1.0
            for ring in (asked, gathered):
                ring.new_times.append(time - max(0, back) * (number == 0))
                ring.new_values.append(1.0)
        counted = asked.overwritten
        if is_read:
            for ring in (asked, gathered):
                ring.around(-math.inf, time - 2.0, time - 2.0)
            assert counted <= asked.overwritten
        gathered.gather()
        assert asked.overwritten == gathered.overwritten
