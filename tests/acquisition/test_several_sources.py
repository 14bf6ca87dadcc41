"""Signals of several sources in one window: each source has a clock of its own."""

import numpy as np
import pytest

from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Array, Window
from otolith.acquisition.windower import Windower
from otolith_drivers.base import Sampling
from tests.acquisition.series import cut_next

RECORDS, PERIOD = 200, 0.01
PHASE = 0.0043  # s by which the second node samples after the first
CYCLIC = tuple(SignalPlan(name, sampling=Sampling.CYCLIC, source=source) for name, source in ("a1", "b2", "c2"))


def test_cyclic_sources_keep_their_phases() -> None:
    """The values are the times at which they were true, so each record shows by how much its sample was moved."""
    random = np.random.default_rng(3)
    for window in cut(CYCLIC, [arrivals(0.0, 0.0, random), *[arrivals(PHASE, 1e-4, random)] * 2]):
        for name in ("a", "b", "c"):
            assert errors(window, name).max() < 5e-4
        assert (window.missing_in("b") == window.missing_in("c")).all()
    assert window.index > 3


def test_a_true_source_does_not_move_the_grid_of_a_cyclic_one() -> None:
    """Times that happen to be on a grid of their own have its phase; the cyclic samples must keep theirs."""
    random = np.random.default_rng(5)
    plans = (CYCLIC[0], SignalPlan("b", sampling=Sampling.TRUE, source="2"))
    times: Array = 100.0 + PHASE + PERIOD * np.arange(2000.0)
    for window in cut(plans, [arrivals(0.0, 0.0, random), (times, times)]):
        assert errors(window, "a").max() < 5e-4
        assert errors(window, "b").max() < 1e-9


@pytest.mark.parametrize("delay", [0.02, 0.0234])
def test_a_declared_delay_of_another_source_is_subtracted(delay: float) -> None:
    random = np.random.default_rng(7)
    plans = (CYCLIC[0], SignalPlan("b", sampling=Sampling.CYCLIC, source="2", delay=delay))
    late = arrivals(PHASE, 0.0, random)
    for window in cut(plans, [arrivals(0.0, 0.0, random), (late[0] + delay, late[1])]):
        assert errors(window, "b").max() < 5e-4


def arrivals(phase: float, drift: float, random: np.random.Generator) -> tuple[Array, Array]:
    """Times of arrival and of sampling of a node with a clock of its own; arrivals are late by about 0.2 ms."""
    true: Array = 100.0 + phase + PERIOD * (1.0 + drift) * np.arange(2000.0)
    return true + random.exponential(2e-4, len(true)), true


def cut(plans: tuple[SignalPlan, ...], samples: list[tuple[Array, Array]]) -> list[Window]:
    """The windows of ``samples``, each with its times of arrival and its values."""
    windower = Windower(plans, RECORDS, PERIOD)
    rings = Rings(windower.signals, 10_000)
    rings.deliver_columns(dict(zip(windower.signals, samples, strict=True)))
    windows = []
    assert windower.begin(rings, 0.0, 0.0)
    while windower.due(rings, 0.0):
        windows.append(cut_next(windower, rings))
    return windows


def errors(window: Window, name: str) -> Array:
    """By how much each sample was moved in time, s."""
    present = ~window.missing_in(name)
    assert RECORDS - 2 <= present.sum() <= RECORDS + 2
    return np.abs(window.start + window.grid.offsets - window.column(name))[present]
