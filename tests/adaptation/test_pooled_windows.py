"""A force that depends on position, too weak for one window: the last windows together decide."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from benchmarks.changes.machines import SERVO_AXIS, SERVO_AXIS_DIRECTIONAL
from benchmarks.changes.observe import Case, recordings
from benchmarks.changes.plants import HEALTHY

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.commissioning import structure as module
from otolith.commissioning.structure import MAX_PAUSE, MAX_WINDOWS, PooledWindows, Structure
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.information import initial_prior
from otolith.estimation.problem import Component, Problem
from otolith.estimation.window_fit import Fit, fit
from otolith.health.schema import ReportDocument
from tests.cogging_axis import AMPLITUDE, PITCH, PROBLEM, UNEVENNESS, record
from tests.variants import often, often_rows

STATED = replace(PROBLEM, process_noise=(0.0, UNEVENNESS))
WINDOWS = 18
WANDER = 1.0  # N
ENCODER_ERROR = 3e-6  # m
MORE_NOISE = 8.0  # by which levels are stated too large


def run(problem: Problem, windows: Sequence[Window]) -> tuple[AdaptationState, list[ReportDocument]]:
    state, documents = initial_state("axis", "lab", problem), []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(report.document)
    return state, documents


def with_noise(factor: float) -> Problem:
    return replace(STATED, process_noise=(0.0, factor * UNEVENNESS))


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.full)])
@pytest.mark.parametrize(
    ("stated", "wander"), often_rows([(1.0, WANDER)], [(1.0, 0.0), (1.0, WANDER), (MORE_NOISE, WANDER)])
)
def test_windows_together_adopt_what_none_of_them_shows(seed: int, stated: float, wander: float) -> None:
    _, documents = run(with_noise(stated), record(WINDOWS, AMPLITUDE, seed, wander=wander))
    decisions = [document.decision for document in documents]
    assert decisions.count(WindowDecision.DISCOVERED) == 1
    assert set(decisions) == {WindowDecision.LEARNED, WindowDecision.DISCOVERED}  # no test was opened
    first = decisions.index(WindowDecision.DISCOVERED)
    assert documents[first - 1].components == ()
    for document in documents[first:]:
        (component,) = document.components
        assert component.id == "carriage/periodic/x"
        assert 2.0 * np.pi / component.values["order"].value == pytest.approx(PITCH, rel=5e-3)
        amplitude = component.values["amplitude"]
        assert abs(amplitude.value - AMPLITUDE) < 4.0 * amplitude.sd
    assert component.values["amplitude"].value == pytest.approx(AMPLITUDE, rel=0.25)
    assert component.probability > 0.99


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in range(1, 10))])
@pytest.mark.parametrize("stated", often([MORE_NOISE], [1.0, MORE_NOISE]))
def test_a_healthy_axis_whose_load_wanders_adopts_nothing(seed: int, stated: float) -> None:
    """Its encoder has steps, and its controller responds to them."""
    _, documents = run(with_noise(stated), record(28, 0.0, seed, wander=WANDER))
    assert not any(document.components for document in documents)


@pytest.mark.parametrize(
    ("axis", "number", "windows"),
    often_rows(
        [("directional", 0, 6)], [("directional", 0, 6), ("directional", 4, 18), ("any", 4, 11), ("any", 17, 10)]
    ),
)
def test_healthy_axes_adopt_nothing(axis: str, number: int, windows: int) -> None:
    """Of some hundred frequencies, one agrees by chance in two searches in a row, which share all windows but one."""
    plant = SERVO_AXIS_DIRECTIONAL if axis == "by way" else SERVO_AXIS
    case = Case("noise alone", plant, HEALTHY, healthy=windows, changed=0)
    (of_run,) = recordings(case, case.problem, [number], 1)
    assert not any(document.components for document in run(case.problem, of_run)[1])


@pytest.mark.parametrize("seed", [2, pytest.param(1, marks=pytest.mark.full)])
def test_an_error_of_the_encoder_is_no_force(seed: int) -> None:
    """It depends on the position as well."""
    _, documents = run(STATED, record(WINDOWS, 0.0, seed, encoder_error=ENCODER_ERROR))
    assert not any(document.components for document in documents)


def test_few_windows_are_kept_and_only_before_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "lacking_component", lambda *_: None)
    fits, records = fitted(), []
    pooled = PooledWindows()
    for _ in range(40):
        pooled = pooled.after(fits, fits.parameters)
        records.append(len(pooled.windows))
    assert max(records) == MAX_WINDOWS
    assert records[:8] == [1, 2, 3, 4, 5, 6, 7, 8]
    assert 0 in records[16:32]  # the next search is far off
    pooled = PooledWindows()
    monkeypatch.setattr(module, "MAX_TOTAL_RECORDS", 5 * fits.window.records)
    for _ in range(8):
        pooled = pooled.after(fits, fits.parameters)
    assert len(pooled.windows) == 5


def test_searches_become_rare(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = fitted()
    searched: list[int] = []
    pooled = PooledWindows()
    for number in range(1, 1100):
        monkeypatch.setattr(module, "lacking_component", lambda *_, at=number: searched.append(at))
        pooled = pooled.after(fits, fits.parameters)
    assert searched == [4, 8, 16, 32, 64, 128, 256, 512, 768, 1024]
    assert MAX_PAUSE == 256


@pytest.mark.parametrize(("second", "agrees"), [(1.0, True), (1.015, True), (1.03, False)])
def test_two_searches_must_find_the_same(monkeypatch: pytest.MonkeyPatch, second: float, agrees: bool) -> None:
    fits = fitted()
    component = Component("carriage", "periodic", "x", AMPLITUDE, 2.0 * np.pi / PITCH)
    structures = [
        Structure(replace(component, inner=factor * component.inner), 0.1, 1.0, 50.0, False, chance=1e-7)
        for factor in (1.0, second)
    ]
    monkeypatch.setattr(module, "lacking_component", lambda *_: structures.pop(0))
    pooled = PooledWindows()
    for _ in range(4):
        pooled = pooled.after(fits, fits.parameters)
    assert pooled.confirmed is None
    assert (pooled.after(fits, fits.parameters).confirmed is not None) is agrees


def fitted() -> Fit:
    (window,) = record(1, 0.0, 0)
    return fit(STATED, window, initial_prior(STATED), STATED.nominal)
