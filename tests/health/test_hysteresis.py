"""Hysteresis: a state is held by the limit that was passed, and by no other."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.health.events import HealthState, assess
from otolith.health.limits import Level, Limit
from tests.health.test_events import ACT, NOMINAL, PLAN, RESISTANCE, WATCH, assessed, report, state_of


def test_a_value_that_falls_from_beyond_one_limit_is_not_held_by_one_on_the_other_side() -> None:
    fallen = assessed(report(index, 8.5 if index < 6 else WATCH + 0.01, 1e-4) for index in range(12))
    assert state_of(fallen[5], "winding") is Level.ACT
    assert state_of(fallen[-1], "winding") is Level.OK


@pytest.mark.parametrize("seed", range(20))
def test_every_state_is_explained_by_a_limit_that_was_passed(seed: int) -> None:
    """On random paths between random limits; its own limit is passed again in each window, or held by hysteresis."""
    random = np.random.default_rng(seed)
    below, above = random.uniform(0.1, 2.0, (2, 2)).cumsum(axis=1)
    limits = (
        *map(Limit, (Level.WATCH, Level.ACT), (NOMINAL - below).tolist(), (True, True)),
        *map(Limit, (Level.WATCH, Level.ACT), (NOMINAL + above).tolist(), (False, False)),
    )
    plan = replace(PLAN, parameters={"R_a": replace(RESISTANCE, limits=limits)})
    state, sd, passed = HealthState(), float(random.choice([1e-4, 0.1, 0.5])), set[float]()
    for index, value in enumerate(np.repeat(random.uniform(NOMINAL - 4.0, NOMINAL + 4.0, 12), 5).tolist()):
        passed |= {limit.value for limit in limits if limit.excess(value) > 1.96 * sd}
        state, document = assess(plan, state, report(index, value, sd))
        for event in document.events:
            assert event.state is Level.OK or event.evidence.limit in passed


@pytest.mark.parametrize("held", [None, WATCH, ACT, 8.0])
@pytest.mark.parametrize("sd", [1e-4, 0.05])
def test_a_level_rises_with_the_distance_from_the_nominal_value(held: float | None, sd: float) -> None:
    for before in (Level.OK, Level.WATCH, Level.ACT):
        for end in (5.0, 9.0):
            values = np.linspace(NOMINAL, end, 200).tolist()
            ranks = [RESISTANCE.level(value, sd, before, held)[0].rank for value in values]
            assert ranks == sorted(ranks)
