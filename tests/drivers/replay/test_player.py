"""The thread that plays all recordings of a process."""

import time
from collections.abc import Iterator

from otolith_drivers.replay.player import Played, player
from tests.waiting import PATIENCE, wait_for


def test_a_recording_that_is_hastened_during_a_step_does_not_wait_for_the_next_one() -> None:
    """So a driver that is closed while it delivers is closed at once."""
    played: list[Played] = []

    def steps() -> Iterator[float]:
        wait_for(lambda: bool(played))
        player.hasten(played[0])
        yield time.monotonic() + PATIENCE

    played.append(player.play(steps()))
    assert played[0].ended.wait(PATIENCE / 4.0)
