"""The noise of a measured input that no window shows alone is learned from all windows together."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.changes.healthy import MACHINES, cases
from benchmarks.changes.observe import recordings

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.decision import WindowDecision
from otolith.health.schema import ReportDocument
from tests.noisy_axis import recorded

RUNS, WINDOWS = 4, 40
(LOAD_NOISE,) = (machine.load_noise for machine in MACHINES if machine.plant.name == "two_mass")


def run(state: AdaptationState, windows: list[Window]) -> tuple[AdaptationState, list[ReportDocument]]:
    documents = []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(report.document)
    return state, documents


def test_noise_of_a_load_is_learned_and_intervals_hold_the_truth() -> None:
    """Without it, windows of a healthy machine differ by 2.5 times what they state: steps and torques are seen."""
    (case,) = cases(WINDOWS, ["two_mass: load noise"])
    held, decisions = [], []
    for windows in recordings(case, case.problem, range(RUNS), seed=7):
        state, documents = run(initial_state("two_mass", "test", case.problem), windows)
        torque, load = state.problem.input_noise
        assert torque == 0.0
        assert load == pytest.approx(LOAD_NOISE, rel=0.35)
        assert not state.adopted
        own = [document.decision for document in documents]
        first = own.index(WindowDecision.NOISIER)
        assert first < 0.6 * WINDOWS
        assert {item.text[:27] for item in documents[-1].findings} == {"T_load is noisier than stat"}
        decisions += own[first + 1 :]
        for document in documents[first:]:
            truth = case.plant.parameters
            rows = document.parameters.items()
            held.append([row.low <= truth[name] <= row.high for name, row in rows if row.low and row.high])
    assert np.mean([decision is WindowDecision.LEARNED for decision in decisions]) >= 0.97
    assert (np.mean(held, axis=0) >= 0.90).all()


@pytest.mark.parametrize("feedback", [0.0, 5e4, 2e5])
def test_fast_changes_that_drive_the_machine_are_no_noise(feedback: float) -> None:
    """A controller that feeds the noise of the position back moves the force by up to a third."""
    problem, windows, _ = recorded(1e-6, 1, roughness=0.0 if feedback else 0.5, feedback=feedback)
    state, documents = run(initial_state("axis", "test", replace(problem, input_noise=())), windows)
    assert not any(state.problem.input_noise)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)
