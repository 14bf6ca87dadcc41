"""A hypothesis on which windows agreed, and which a later window excludes: what it has learned of parameters stays."""

from functools import partial

import numpy as np
import pytest
from benchmarks.changes.machines import DC_MOTOR
from benchmarks.changes.observe import Case, observe
from benchmarks.changes.plants import HEALTHY, Plant

from otolith.acquisition.window import Array
from otolith.discovery.alternatives import WindowDecision
from tests.variants import often

AGREED, AFTER = 6, 3  # windows with the first delay, and with the second


def late(_: np.random.Generator, plant: Plant, rows: dict[str, Array], first: int, then: int) -> None:
    """Show the speed late by ``first`` records, and from window ``AGREED`` on by ``then``."""
    records, own = np.arange(len(rows["omega"])), rows["omega"].copy()
    delays = np.where(records < AGREED * plant.records, first, then)
    rows["omega"][:] = own[np.maximum(records - delays, 0)]


@pytest.mark.parametrize("then", often([12], [12, 0]))
def test_what_was_learned_beside_a_delay_stays_when_the_delay_changes(then: int) -> None:
    """The delay is there from the first window on: without it nothing but the bounds is known of the inertia."""
    disturb = partial(late, first=5, then=then)
    case = Case("late", DC_MOTOR, HEALTHY, ("R_a", "J"), healthy=AGREED + AFTER, changed=0, disturb=disturb)
    for reports in observe(case, range(2), 1):
        assert all(report.decision is WindowDecision.TIMING for report in reports[2:AGREED])
        widths = []
        for report in reports[2:]:
            known = report.parameters["J"]
            assert known.holds_truth
            assert known.low is not None
            assert known.high is not None
            widths.append(known.high - known.low)
        learned = widths[AGREED - 3]
        assert widths[AGREED - 2] < (30.0 if then else 2.0) * learned  # two delays may have been wrong windows
        assert max(widths[AGREED - 1 :]) < 3.0 * learned
