"""Hysteresis: a state is held by the limit that was passed, and by no other."""

from dataclasses import replace

import numpy as np
import pytest
from pydantic import TypeAdapter

from otolith.health.events import HealthState, assess
from otolith.health.limits import Level, Limit
from tests.health.test_events import ACT, NOMINAL, PLAN, RESISTANCE, WATCH, assessed, report, state_of

STATE = TypeAdapter(HealthState)


def test_a_value_that_falls_from_beyond_one_limit_is_not_held_by_one_on_the_other_side() -> None:
    fallen = assessed(report(index, 8.5 if index < 6 else WATCH + 0.01, 1e-4) for index in range(12))
    assert state_of(fallen[5], "winding") is Level.ACT
    assert state_of(fallen[-1], "winding") is Level.OK


@pytest.mark.parametrize("saved", [False, True])
def test_one_window_at_watch_does_not_end_the_hysteresis_of_act(*, saved: bool) -> None:
    """What decides the level is held with it, also by a state that was saved, whatever the last window showed."""
    distance = NOMINAL - ACT
    inside, beside = ACT + 0.05 * distance, ACT + 0.2 * distance  # within the release of ACT, and between both limits
    values = [*[ACT - 0.1] * 5, beside, *[inside] * 20]
    state, levels = HealthState(), list[Level]()
    for index, value in enumerate(values):
        if saved:
            state = STATE.validate_json(STATE.dump_json(state))
        state, document = assess(PLAN, state, report(index, value, 1e-4))
        levels.append(state_of(document, "winding"))
    assert set(levels[5:]) == {Level.ACT}


def test_a_state_of_an_earlier_format_holds_by_the_limit_of_its_event() -> None:
    state = HealthState()
    for index in range(5):
        state, _ = assess(PLAN, state, report(index, ACT - 0.1, 1e-4))
    content = STATE.dump_python(state, mode="json")
    for record in content["records"].values():
        del record["limit"]
    state = STATE.validate_python(content, strict=False)
    for index in range(5, 15):
        state, document = assess(PLAN, state, report(index, ACT + 0.05 * (NOMINAL - ACT), 1e-4))
        assert state_of(document, "winding") is Level.ACT


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
