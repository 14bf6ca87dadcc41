"""Waiting for conditions, and the durations that tests promise.

A computer that is busy with something else must not fail a test. A test waits for a condition with a deadline that only
a hang reaches. A test that asserts a duration is marked ``timed`` and takes its limit from `within`. ``make test-full``
runs these tests one by one with the limit itself; whoever runs one beside other work has five times the limit.
"""

import os
import time
from collections.abc import Callable

PATIENCE = 60.0  # s: nothing that tests wait for takes longer unless it hangs
EXACT = os.environ.get("OTOLITH_TIMING") == "exact"  # set by make test-full for the tests that run one by one
SLACK = 1.0 if EXACT else 5.0


def within(limit: float) -> float:
    """The limit, in its own unit, that a duration or a share of late samples must keep in this run."""
    return SLACK * limit


def wait_for(condition: Callable[[], bool], seconds: float = PATIENCE) -> None:
    """Return when ``condition`` holds.

    Raises:
        AssertionError: it does not hold within ``seconds``.
    """
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, f"not fulfilled within {seconds} s"
        time.sleep(0.005)
