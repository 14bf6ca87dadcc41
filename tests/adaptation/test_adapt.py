"""adapt: a pure function with few calls for a healthy window."""

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType

import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.discovery.alternatives import ACCEPTED, UPDATES, PosteriorUpdate, WindowDecision
from otolith.estimation import data_checks
from otolith.estimation.information import QUANTILE, Identifiability
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.health.schema import ParameterDocument
from otolith.machine import find_twin, load_machine
from otolith.twin.kernel import Kernel
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import load_scenario
from tests.messages import assert_says

CONFIG = Path(__file__).parents[2] / "config"
Cut = Callable[..., list[tuple[Window, float]]]
PACKAGES = ("otolith.estimation.", "otolith.discovery.", "otolith.adaptation.")
MAX_MODULES = 12
DC_MOTOR = find_twin("dc_motor")


def healthy(scenario: MotorScenario, windows: Cut) -> tuple[AdaptationState, Window]:
    """State after eleven windows of a healthy motor, and the next window."""
    free = (DC_MOTOR.parameter("R_a"),)
    known = tuple((parameter.name, parameter.nominal) for parameter in DC_MOTOR.parameters if parameter.name != "R_a")
    problem = Problem(DC_MOTOR, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))
    state = initial_state("motor", "here", problem)
    *first, (last, _) = windows(scenario.model_copy(update={"faults": ()}), 12)
    for window, _ in first:
        state, _ = adapt(state, window)
    return state, last


def test_healthy_window_passes_at_most_twelve_modules(windows: Cut) -> None:
    """Counts the core modules in which a function is called, other than the generated ones of dataclasses."""
    state = initial_state("motor", "bench", load_machine(CONFIG / "dc-motor.toml").problem)
    scenario = load_scenario(CONFIG / "scenarios" / "demo.toml")
    assert isinstance(scenario, MotorScenario)
    *first, (last, _) = windows(scenario, 12)
    for window, _ in first:
        state, _ = adapt(state, window)
    called: set[str] = set()

    def record(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename == frame.f_globals.get("__file__"):
            called.add(str(frame.f_globals.get("__name__")))

    sys.setprofile(record)
    try:
        _, report = adapt(state, last)
    finally:
        sys.setprofile(None)
    assert report.document.decision is WindowDecision.LEARNED
    core = {name for name in called if name.startswith(PACKAGES)}
    assert len(core) <= MAX_MODULES, " ".join(sorted(core))


@pytest.mark.parametrize("margin", [1.2, 0.8])
def test_whether_a_parameter_is_determined_does_not_depend_on_the_guess(
    scenario: MotorScenario, windows: Cut, margin: float
) -> None:
    """The rows are the same, and so are value and interval; only the value in the machine file differs."""
    (window, _), *_ = windows(scenario.model_copy(update={"faults": ()}), 1)
    known = tuple((own.name, own.nominal) for own in DC_MOTOR.parameters if own.name != "R_a")
    true = DC_MOTOR.parameter("R_a").nominal

    def published(guess: float, within: float) -> ParameterDocument:
        free = replace(DC_MOTOR.parameter("R_a"), nominal=guess, low=0.2 * true, high=5.0 * true)
        problem = Problem(DC_MOTOR, known, (free,), (0.005, 0.02), input_noise=(0.0, 0.0002), determined_within=within)
        return adapt(initial_state("motor", "here", problem), window)[1].document.parameters["R_a"]

    first = published(true, 1.0)
    assert first.value is not None
    assert first.sd is not None
    own = margin * QUANTILE * first.sd / first.value
    found = [published(factor * true, own) for factor in (0.5, 1.0, 2.0)]
    assert {item.value is not None for item in found} == {margin > 1.0}
    assert {item.identifiability for item in found} == {
        Identifiability.DETERMINED if margin > 1.0 else Identifiability.WEAK
    }


def test_healthy_window_has_one_objective_and_kalman_pass(scenario: MotorScenario, windows: Cut) -> None:
    state, window = healthy(scenario, windows)
    calls: list[str] = []

    def record(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code in (Objective.__init__.__code__, Kernel.innovation_model.__code__):
            calls.append(frame.f_code.co_qualname)

    sys.setprofile(record)
    try:
        adapt(state, window)
    finally:
        sys.setprofile(None)
    assert calls.count("Objective.__init__") == 1
    assert calls.count("Kernel.innovation_model") <= 2  # a second time if the first pass needs finer sub-steps


def test_adapt_is_deterministic(scenario: MotorScenario, windows: Cut) -> None:
    state, window = healthy(scenario, windows)
    first, second = (adapt(state, window)[1].document.to_json() for _ in range(2))
    assert first == second


def test_every_decision_has_an_update() -> None:
    assert set(UPDATES) == set(WindowDecision)
    assert {decision for decision, update in UPDATES.items() if update is not PosteriorUpdate.NONE} == ACCEPTED


def test_of_a_window_that_memory_does_not_suffice_for_the_last_records_are_estimated_from(
    scenario: MotorScenario, windows: Cut, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, last = healthy(scenario, windows)
    assert last.records == 200
    monkeypatch.setattr(data_checks, "MAX_RECORDS", 150)
    after_part, of_part = adapt(state, last.since(50))
    after_whole, of_whole = adapt(state, last)
    (part,), (whole,) = of_part.document.parameters.values(), of_whole.document.parameters.values()
    assert (whole.value, whole.sd) == (part.value, part.sd)
    assert (of_whole.document.window.start, of_whole.document.window.records) == (last.start, 200)
    assert of_whole.document.window.end == of_part.document.window.end
    assert (after_whole.posterior.prior().mean == after_part.posterior.prior().mean).all()
    assert_says(whole.reason, "150", "200", "1.5 s", "length", "[window]", "sample_period")
    assert not part.reason
