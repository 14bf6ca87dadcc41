"""The noise of a measured input that no window shows alone is learned from all windows together."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from benchmarks.changes.healthy import MACHINES, cases
from benchmarks.changes.machines import DC_MOTOR, TWO_MASS
from benchmarks.changes.observe import Case, Disturbance, recordings
from benchmarks.changes.plants import HEALTHY, Plant, Values

from otolith.acquisition.window import Array
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from tests.discovery.test_search import run
from tests.noisy_axis import recorded
from tests.variants import often

RUNS, WINDOWS = 4, 40
(LOAD_NOISE,) = (machine.load_noise for machine in MACHINES if machine.plant.name == "two_mass")


@pytest.mark.full
def test_noise_of_a_load_is_learned_and_intervals_hold_the_truth() -> None:
    """Without it, windows of a healthy machine differ by more than they state: false steps are seen."""
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
        assert documents[-1].findings
        assert all(item.text.startswith("T_load is noisier than stated") for item in documents[-1].findings)
        decisions += own[first + 1 :]
        for document in documents[first:]:
            rows = document.parameters
            truth = np.array([case.plant.parameters[name] for name in rows])
            low, high = (np.array([getattr(row, end) for row in rows.values()], dtype=float) for end in ("low", "high"))
            held.append((low <= truth) & (truth <= high))
    assert np.mean([decision is WindowDecision.LEARNED for decision in decisions]) >= 0.97
    assert (np.mean(held, axis=0) >= 0.90).all()


@pytest.mark.parametrize("feedback", often([2e5], [0.0, 5e4, 2e5]))
def test_fast_changes_that_drive_the_machine_are_no_noise(feedback: float) -> None:
    """A controller that feeds the noise of the position back moves the force by up to a third."""
    problem, windows, _ = recorded(1e-6, 1, roughness=0.0 if feedback else 0.5, feedback=feedback)
    state, documents = run(initial_state("axis", "test", replace(problem, input_noise=())), windows)
    assert not any(state.problem.input_noise)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)


def rough_operation(random: np.random.Generator, times: Array) -> Values:
    operation = TWO_MASS.operate(random, times)
    return {**operation, "T_load": operation["T_load"] + 0.05 * random.standard_normal(len(times))}


def late_load(random: np.random.Generator, plant: Plant, rows: dict[str, Array], by: int) -> None:
    rows["T_load"] = np.r_[np.full(by, rows["T_load"][0]), rows["T_load"][:-by]]


@pytest.mark.parametrize("by", often([1], [1, 3]))
def test_a_late_load_with_fast_changes_is_no_noise(by: int) -> None:
    """Its error correlates with the fast changes of the load as noise does, but the delay explains all of it."""
    plant = replace(TWO_MASS, operate=rough_operation)
    case = Case("late", plant, HEALTHY, healthy=12, changed=0, disturb=partial(late_load, by=by))
    (windows,) = recordings(case, case.problem, range(1), seed=7)
    state, documents = run(initial_state("two_mass", "test", case.problem), windows)
    assert not any(state.problem.input_noise)
    assert {document.decision for document in documents[2:]} == {WindowDecision.TIMING}


def late_at_first(random: np.random.Generator, plant: Plant, rows: dict[str, Array]) -> None:
    half = 12 * plant.records
    rows["T_load"][:half] = np.r_[np.full(2, rows["T_load"][0]), rows["T_load"][: half - 2]]


def gain_error(random: np.random.Generator, plant: Plant, rows: dict[str, Array]) -> None:
    rows["T_load"] *= 1.2


@pytest.mark.parametrize("disturb", often([gain_error], [late_at_first, gain_error]))
def test_an_error_of_a_load_with_fast_changes_is_no_noise(disturb: Disturbance) -> None:
    """A delay that ends leaves nothing in the sums. A gain error changes the torque by its fast changes, too."""
    plant = replace(TWO_MASS, operate=rough_operation)
    case = Case("error", plant, HEALTHY, healthy=24, changed=0, disturb=disturb)
    (windows,) = recordings(case, case.problem, range(1), seed=7)
    state, documents = run(initial_state("two_mass", "test", case.problem), windows)
    assert not any(state.problem.input_noise)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)


def noise_in_one_window(random: np.random.Generator, plant: Plant, rows: dict[str, Array], at: int) -> None:
    noise = 6e-4 * random.standard_normal(len(rows["T_load"]))
    first = at * plant.records
    rows["T_load"][first : first + plant.records] += noise[first : first + plant.records]


@pytest.mark.parametrize("at", often([14], [14, 30]))
def test_noise_that_has_ended_gives_no_level(at: int) -> None:
    """The window after it shows changes of 1e-9 N·m: accepted as its level, they would end the search for noise."""
    case = Case("ended", DC_MOTOR, HEALTHY, healthy=40, changed=0, disturb=partial(noise_in_one_window, at=at))
    (windows,) = recordings(case, case.problem, range(1), seed=7)
    state, documents = run(initial_state("dc_motor", "test", case.problem), windows)
    assert not any(state.problem.input_noise)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)


def later_noise(random: np.random.Generator, plant: Plant, rows: dict[str, Array]) -> None:
    noise = LOAD_NOISE * random.standard_normal(len(rows["T_load"]))
    noise[: 30 * plant.records] = 0.0
    rows["T_load"] += noise


@pytest.mark.full
def test_noise_that_begins_later_has_the_right_level() -> None:
    """Thirty calm windows before it do not lower the level."""
    case = Case("later", TWO_MASS, HEALTHY, healthy=60, changed=0, disturb=later_noise)
    (windows,) = recordings(case, case.problem, range(1), seed=7)
    state, documents = run(initial_state("two_mass", "test", case.problem), windows)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents[:30])
    assert state.problem.input_noise == pytest.approx([0.0, LOAD_NOISE], rel=0.35)
