"""Sensors that are noisier than stated are named, and everything goes on being estimated."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.discovery.motor import Faults

from otolith.acquisition.window import Window
from otolith.discovery.decision import WindowDecision
from otolith.health.schema import Status
from tests.discovery.test_search import initial, run, simulated

STATED = {"i": 0.005, "omega": 0.02}  # A, rad/s
WHITE = {WindowDecision.LEARNED, WindowDecision.SUSPECTED, WindowDecision.NOISIER}


def noisier(windows: list[Window], factors: dict[str, float], smooth: int = 1, seed: int = 3) -> list[Window]:
    """Return the windows with more noise of some signals, by factors; the addition is a moving mean of ``smooth``."""
    random, changed = np.random.default_rng(seed), []
    for window in windows:
        values = window.values.copy()
        for name, factor in factors.items():
            white = random.normal(size=window.records + smooth - 1)
            added = np.convolve(white, np.full(smooth, smooth**-0.5), "valid")
            values[:, window.signals.index(name)] += STATED[name] * np.sqrt(factor**2 - 1.0) * added
        changed.append(replace(window, values=values))
    return changed


@pytest.mark.parametrize("factor", [1.9, 3.8])
@pytest.mark.parametrize("names", [("i",), ("omega",), ("i", "omega")], ids="-".join)
def test_a_noisier_sensor_is_named_and_windows_are_learned(names: tuple[str, ...], factor: float) -> None:
    windows = noisier(simulated("steps", 20, Faults()), dict.fromkeys(names, factor))
    state, documents = run(initial("R_a", "D"), windows)
    decisions = [document.decision for document in documents]
    assert set(decisions) <= WHITE
    assert WindowDecision.NOISIER in decisions[:5]
    assert all(decision is WindowDecision.LEARNED for decision in decisions[6:])
    last = documents[-1]
    (finding,) = last.findings
    for name, noise in zip(STATED, state.problem.noise, strict=True):
        assert noise == pytest.approx(STATED[name] * (factor if name in names else 1.0), rel=0.15)
        assert (f"{name} is noisier" in finding.text) == (name in names)
    resistance = last.parameters["R_a"]
    assert resistance.status is Status.ESTIMATED
    assert resistance.value == pytest.approx(6.5, abs=4.0 * (resistance.sd or 0.0))


def test_smooth_errors_are_no_noise() -> None:
    windows = noisier(simulated("steps", 14, Faults()), {"omega": 3.0}, smooth=8)
    state, documents = run(initial("R_a", "D"), windows)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)
    assert state.problem.noise == (0.005, 0.02)


def test_a_step_of_a_parameter_is_no_noise() -> None:
    before, after = simulated("steps", 6, Faults()), simulated("steps", 14, Faults(resistance=6.7))
    _, documents = run(initial("R_a", "D"), [*before, *after[len(before) :]])
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.7, rel=2e-3)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)
