"""The screening test at 1 kHz: spectra scored without their responses, healthy windows not searched, memory bounded."""

import tracemalloc
from functools import cache

import numpy as np
import pytest
from benchmarks.changes.machines import TWO_MASS
from benchmarks.changes.observe import Case, recordings
from benchmarks.changes.plants import Change

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery import search
from otolith.discovery.hypotheses import FaultType, FittedHypothesis
from otolith.discovery.linear_response import PROBES, LinearResponse, basis_functions
from otolith.discovery.screening import (
    COARSE,
    ESTIMATE_SHARE,
    ScreeningResult,
    allowed_forms,
    grid_guesses,
    inner_grid,
    screen_window,
)
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import estimate_window
from otolith.machine import find_twin
from otolith.twin.components import family_code
from otolith.twin.definition import Role
from otolith.twin.kernel import Excitation, kernel_of

PERIOD, RECORDS = 1e-3, 2000
MAX_BYTES = 30e6  # of one healthy window at 1 kHz; all responses of a coarse spectrum together take 140 MB


def drive(name: str, records: int) -> Array:
    """Inputs (records, inputs) that determine the parameters."""
    time = PERIOD * np.arange(records)
    if name == "servo_axis":
        slow, fast = np.sin(2.0 * np.pi * 0.7 * time), np.sin(2.0 * np.pi * 2.3 * time)
        return np.column_stack([60.0 * slow + 30.0 * fast])
    voltage = 6.0 + 3.0 * np.sign(np.sin(2.0 * np.pi * 0.9 * time)) + np.sin(2.0 * np.pi * 3.0 * time)
    return np.column_stack([voltage, np.full(records, 0.01)])


def axis(name: str, count: int, extra: float = 0.0) -> tuple[Problem, list[Window]]:
    """A machine at 1 kHz, simulated with the nominal parameters of its twin, in ``count`` windows of 2 s.

    In the last window its first input is ``extra`` more than it shows, in the unit of the input.
    """
    twin, random = find_twin(name), np.random.default_rng(1)
    nominal = np.array([parameter.nominal for parameter in twin.parameters])
    noise = tuple(output.noise for output in twin.outputs)
    inputs = drive(name, count * RECORDS)
    start = np.zeros((1, len(twin.states)))
    true = inputs.copy()
    true[(count - 1) * RECORDS :, 0] += extra
    outputs = kernel_of(twin).simulate(nominal[None], start, Excitation.uniform(true, PERIOD, substeps=4))[0]
    values = np.hstack([inputs, outputs + random.normal(size=outputs.shape) * noise])
    free = tuple(item for item in twin.parameters if item.role is Role.ESTIMATED)
    known = tuple((item.name, item.nominal) for item in twin.parameters if item not in free)
    signals = (*(item.name for item in twin.inputs), *(item.name for item in twin.outputs))
    parts = [values[first : first + RECORDS] for first in range(0, len(values), RECORDS)]
    windows = [Window.whole(k, k * RECORDS * PERIOD, PERIOD, signals, part) for k, part in enumerate(parts)]
    return Problem(twin, known, free, noise), windows


@cache
def adapted(name: str) -> tuple[AdaptationState, list[Window]]:
    """State after four windows that were not searched, and all six windows."""
    problem, windows = axis(name, 6)
    state = initial_state("axis", "bench", problem)
    for window in windows[:4]:
        state, report = adapt(state, window)
        assert not report.document.cost.searched
    return state, windows


@cache
def response(name: str) -> LinearResponse:
    state, windows = adapted(name)
    predicted: Posterior = state.posterior.predict(windows[4])
    fitted = estimate_window(predicted, windows[4]).fit
    return LinearResponse(fitted.linearised_at_end())


@pytest.mark.parametrize("name", ["dc_motor", "servo_axis"])
def test_adjoint_is_the_transpose_of_the_response(name: str) -> None:
    linear = response(name)
    forms = [form for form in allowed_forms(linear.problem, linear.x) if len(form.model.phases) == 2]
    curves = basis_functions((form, 1.3 * form.bounds[0]) for form in forms)
    responses = linear.responses(curves)
    signals = np.random.default_rng(2).standard_normal((len(responses), 3))
    kernel, model, present = linear._kernel, linear.objective.innovation_model, linear.objective.present
    adjoint = kernel.adjoint(linear._linear, model, present, signals)
    values = kernel.curves(curves.families, linear.x, curves.sources, curves.inner, curves.phases)
    products = np.einsum("rc,rcs->cs", values[:, curves.shapes], adjoint[:, curves.sites])
    expected = responses.T @ signals
    assert np.abs(products - expected).max() < 1e-9 * np.abs(expected).max()


def test_fourier_sums_of_records_at_any_times() -> None:
    random = np.random.default_rng(3)
    x, signals = np.cumsum(random.exponential(size=500)) - 100.0, random.standard_normal((500, 4))
    frequencies = 0.02 + 0.005 * np.arange(301)
    sums = response("dc_motor")._kernel.fourier_sums(x, signals, 0.02, 0.005, 301)
    expected = np.exp(1j * np.outer(frequencies, x)) @ signals
    assert np.abs(sums - expected).max() < 1e-10 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["dc_motor", "servo_axis"])
def test_estimated_gains_follow_their_distribution(name: str) -> None:
    """The true gain over the estimate, times PROBES, is χ² distributed with PROBES - 1 degrees of freedom."""
    linear = response(name)
    ratios = []
    for form in allowed_forms(linear.problem, linear.x):
        if len(form.model.phases) == 2:
            grid = inner_grid(form, linear.x, COARSE)
            exact = linear.score([(form, float(inner)) for inner in grid]).gain
            ratios.append(PROBES * exact / linear.estimated_gains(form.source, grid)[form.site])
    ratio = np.concatenate(ratios)
    degrees = PROBES - 1
    assert np.median(ratio) == pytest.approx(degrees * (1.0 - 2.0 / (9.0 * degrees)) ** 3, rel=0.15)
    assert np.quantile(ratio, [0.01, 0.99]) == pytest.approx([5.2, 30.6], rel=0.25)
    assert ratio.max() < PROBES / ESTIMATE_SHARE  # no line that gains enough would be left out


@pytest.mark.parametrize("name", ["dc_motor", "servo_axis"])
def test_estimated_gains_of_other_forms_follow_theirs(name: str) -> None:
    """The true gain over the estimate, times PROBES, is χ² distributed with PROBES degrees of freedom."""
    linear = response(name)
    forms = [form for form in allowed_forms(linear.problem, linear.x) if len(form.model.phases) == 1]
    guesses = grid_guesses(linear, forms, COARSE)
    exact = linear.score(guesses).gain
    gains = linear.estimated_gains_of([(family_code(form.model.name), form.source, b, 0.0) for form, b in guesses])
    ratio = PROBES * exact / gains[np.arange(len(guesses)), [form.site for form, _ in guesses]]
    ratio = ratio[exact > 0.0]  # the others are what a parameter does
    assert len(ratio) > 0.8 * len(guesses)
    assert np.median(ratio) == pytest.approx(PROBES, rel=0.25)
    assert ratio.max() < PROBES / ESTIMATE_SHARE  # none that gains enough would be left out


@pytest.mark.parametrize("name", ["dc_motor", "servo_axis"])
def test_healthy_windows_at_1_khz_are_not_searched(name: str) -> None:
    """The axis measures no velocity, so a window starts at a wrong one, and dry friction makes local minima there."""
    state, windows = adapted(name)
    for window in windows[4:]:
        state, report = adapt(state, window)
        assert not report.document.cost.searched


def test_a_force_that_appears_at_1_khz_is_an_offset() -> None:
    """It may be that of the machine or of the sensor of F: both are fitted, however long the window.

    It is 200 times the noise of a position after 2 s, where 25 steps with one damping do not fit the offset.
    """
    state, _ = adapted("servo_axis")
    _, stepped = axis("servo_axis", 5, extra=3.0)
    state, report = adapt(state, stepped[4])
    assert report.document.cost.searched
    assert state.test is not None
    causes = {
        (item.type, item.hypothesis.name): (item.is_explained, share)
        for item, share in zip(state.test.hypotheses, state.test.probabilities, strict=True)
    }
    is_explained, share = causes[FaultType.PARAMETER, "offset"]
    assert is_explained
    assert causes[FaultType.SENSOR, "sensor of F/constant"][0]
    assert share == pytest.approx(causes[FaultType.SENSOR, "sensor of F/constant"][1], rel=0.05)


@pytest.mark.parametrize("name", ["dc_motor", "servo_axis"])
def test_a_healthy_window_at_1_khz_needs_little_memory(name: str) -> None:
    state, windows = adapted(name)
    adapt(state, windows[5])
    tracemalloc.start()
    try:
        adapt(state, windows[5])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < MAX_BYTES


def test_after_an_onset_the_linear_response_is_that_of_the_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The twist of a shaft is not measured, so that a fit starts far from where it ends."""
    onset = 5.1 * TWO_MASS.records * TWO_MASS.period
    ramp = Change(ramps={"k_s": 0.05}, since=onset)
    case = Case("onset", TWO_MASS, ramp, healthy=5, changed=1)
    (recorded,) = recordings(case, case.problem, [1], 3)
    state = initial_state("two_mass", "bench", case.problem)
    for window in recorded[:-1]:
        state, _ = adapt(state, window)
    predicted = state.posterior.predict(recorded[-1])
    screening = screen_window(predicted, estimate_window(predicted, recorded[-1]), determined=True)
    responses: list[LinearResponse] = []

    whole = search.search

    def searched(again: ScreeningResult) -> list[FittedHypothesis]:
        responses.append(again.response)
        return whole(again)

    monkeypatch.setattr(search, "search", searched)
    _, fitted = search.search_from_onset(predicted, screening)
    assert fitted[0].fit.window.start > onset
    error = responses[0].chi_square - fitted[0].chi_square
    assert error <= DECISIVE * fitted[0].chi_square / fitted[0].fit.count
