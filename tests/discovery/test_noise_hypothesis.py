"""Sensors that are noisier than stated are named, and everything goes on being estimated."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benchmarks.changes.healthy import MACHINES, Ageing, cases
from benchmarks.changes.machines import DC_MOTOR, SERVO_AXIS, SERVO_AXIS_DIRECTIONAL
from benchmarks.changes.observe import Case, recordings
from benchmarks.changes.plants import HEALTHY, Change, Plant, Values
from benchmarks.discovery.motor import Faults

from otolith.acquisition.window import Array, Window
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision, describe_noise
from otolith.discovery.hypotheses import FittedHypothesis, nothing_happened
from otolith.discovery.noise_hypothesis import noisier_signals, prior_inflation
from otolith.discovery.screening import linearised
from otolith.estimation.information import initial_prior
from otolith.estimation.window_fit import estimate
from otolith.health.schema import Status
from tests.discovery.test_search import initial, run, simulated
from tests.messages import assert_says
from tests.variants import often

STATED = {"i": 0.005, "omega": 0.02}  # A, rad/s
(LOAD_NOISE,) = (machine.load_noise for machine in MACHINES if machine.plant.name == "pump")
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


@pytest.mark.parametrize("factor", often([3.8], [1.9, 3.8, 15.0]))
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


@pytest.mark.full
def test_smooth_errors_are_no_noise() -> None:
    windows = noisier(simulated("steps", 14, Faults()), {"omega": 3.0}, smooth=8)
    state, documents = run(initial("R_a", "D"), windows)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)
    assert state.problem.noise == (0.005, 0.02)


def test_a_twin_that_diverges_has_no_noise_hypothesis() -> None:
    problem = initial("J").problem
    (inertia,) = problem.free
    problem = replace(problem, free=(replace(inertia, low=1e-9),))
    unchanged = nothing_happened(problem, initial_prior(problem))
    diverged = linearised(problem, simulated("steps", 4, Faults())[0], unchanged.prior, np.array([1e-9, 0.0]))
    assert noisier_signals(FittedHypothesis(unchanged.hypothesis, diverged), least=400.0) == []


def test_a_step_of_a_parameter_is_no_noise() -> None:
    before, after = simulated("steps", 6, Faults()), simulated("steps", 14, Faults(resistance=6.7))
    _, documents = run(initial("R_a", "D"), [*before, *after[len(before) :]])
    assert documents[-1].parameters["R_a"].value == pytest.approx(6.7, rel=2e-3)
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)


@pytest.mark.full
def test_noise_of_a_measured_input_is_named_and_no_component_is_adopted() -> None:
    """The noise of the pump's throttle position, which nothing states, colours the innovations."""
    (case,) = cases(24, ["pump: load noise"])
    (windows,) = recordings(case, case.problem, [0], seed=1)
    state, documents = run(initial_state("pump", "test", case.problem), windows)
    decisions = [document.decision for document in documents]
    assert set(decisions) <= WHITE
    assert WindowDecision.NOISIER in decisions[:6]
    assert set(decisions[6:]) == {WindowDecision.LEARNED}
    assert not state.adopted
    (finding,) = documents[-1].findings
    assert finding.text.startswith("u is noisier than stated: 0.00")
    torque, throttle = state.problem.input_noise
    assert torque == 0.0
    assert throttle == pytest.approx(LOAD_NOISE, rel=0.35)


@pytest.mark.parametrize("machine", [row for row in MACHINES if row.load == "T_load"], ids=lambda row: row.plant.name)
def test_earlier_windows_scatter_by_what_noise_adds_to_their_prior(machine: Ageing) -> None:
    """They were weighted as if the load torque had no noise: the right weights for the noise would be more precise."""
    (case,) = cases(60, [f"{machine.plant.name}: load noise"])
    (windows,) = recordings(case, case.problem, [0], seed=3)
    problem, prior = case.problem, initial_prior(case.problem)
    known = replace(prior, covariance=1e-6 * prior.covariance)  # by earlier windows
    truth = np.array([case.plant.parameters[parameter.name] for parameter in problem.free])
    levels = np.array(problem.levels)
    levels[[source.name for source in problem.base_model.inputs].index(machine.load)] = machine.load_noise
    noisy, deviations = problem.with_levels(levels.tolist()), []
    for window in windows:
        alone, stated = estimate(problem, window, prior, truth), linearised(problem, window, known, truth)
        fitted = replace(stated, problem=noisy).linearised_at_end()
        inflation = prior_inflation(stated, fitted)[: len(truth)]
        sd = np.array([own.sd for own in alone.parameters]) / alone.fit.inflation  # as without any correction
        deviations.append((np.array([own.value for own in alone.parameters]) - truth) / sd / inflation)
    scatter = np.sqrt(np.mean(np.square(deviations), axis=0))
    assert (scatter > 0.73).all()  # three standard deviations of that of 60 windows
    assert (scatter < 1.27).all()
    assert (prior_inflation(linearised(problem, window, prior, truth), fitted) == 1.0).all()  # nothing was known


def test_errors_of_a_sensor_are_no_noise_of_an_input_that_is_smooth() -> None:
    windows = noisier(simulated("steps", 6, Faults()), {"omega": 1.5}, smooth=8)
    before = initial("R_a", "D")
    state, _ = run(before, windows)
    assert state.problem.input_noise == before.problem.input_noise


def disturbed(plant: Plant, noise: Mapping[str, float]) -> Plant:
    """Return the plant with process noise of states: of each state in its unit per root of a second."""

    def operate(random: np.random.Generator, times: Array) -> dict[str, Array]:
        size = plant.period**-0.5
        drawn = {f"noise of {name}": level * size * random.standard_normal(len(times)) for name, level in noise.items()}
        return {**plant.operate(random, times), **drawn}

    def rates(x: Values, u: Values, q: Values) -> dict[str, Any]:
        return {name: rate + u.get(f"noise of {name}", 0.0) for name, rate in plant.rates(x, u, q).items()}

    held = (*plant.held, *(f"noise of {name}" for name in noise))
    return replace(plant, operate=operate, rates=rates, held=held)


@pytest.mark.parametrize("factor", [4.0, *(pytest.param(factor, marks=pytest.mark.full) for factor in (2.0, 10.0))])
def test_process_noise_that_is_stated_too_large_is_no_faulty_sensor(factor: float) -> None:
    """The predictor follows every sample; the gain of the sensor, which mass and friction make up for, calms it."""
    noise = {"v": 1e-3}
    case = Case("too large", disturbed(SERVO_AXIS_DIRECTIONAL, noise), HEALTHY, healthy=10, changed=0)
    problem = replace(case.problem, process_noise=(0.0, factor * noise["v"]))
    (windows,) = recordings(case, problem, [0], seed=1)
    state, documents = run(initial_state("axis", "test", problem), windows)
    assert {document.decision for document in documents} <= {WindowDecision.LEARNED, WindowDecision.SUSPECTED}
    assert [document.decision for document in documents[4:]] == [WindowDecision.LEARNED] * 6
    assert state.problem.process_noise == problem.process_noise
    truth = case.plant.parameters
    for name, parameter in documents[-1].parameters.items():
        assert parameter.low is not None
        assert parameter.high is not None
        assert parameter.low <= truth[name] <= parameter.high


AXIS_NOISE, MOTOR_NOISE = {"v": 1e-3}, {"i": 0.05, "omega": 0.3}
MISSTATED_SEEDS = often([1], range(1, 6))


@pytest.mark.parametrize("seed", MISSTATED_SEEDS)
@pytest.mark.parametrize(
    ("plant", "free", "noise", "factors"),
    [
        pytest.param(SERVO_AXIS, (), AXIS_NOISE, (0.1, 0.3), marks=pytest.mark.full),
        pytest.param(SERVO_AXIS, (), AXIS_NOISE, (0.1, 10.0), marks=pytest.mark.full),
        pytest.param(SERVO_AXIS, (), AXIS_NOISE, (10.0, 0.1), marks=pytest.mark.full),
        (DC_MOTOR, ("R_a", "D"), MOTOR_NOISE, (0.1, 0.3)),
    ],
    ids=("axis, less of both", "axis, less process", "axis, more process", "motor, less of both"),
)
def test_process_and_sensor_noise_misstated_together_are_named(
    plant: Plant, free: tuple[str, ...], noise: Mapping[str, float], factors: tuple[float, float], seed: int
) -> None:
    """Both are stated as a multiple of what they are."""
    process, sensors = factors
    case = Case("misstated", disturbed(plant, noise), HEALTHY, free, healthy=8, changed=0)
    true, states = case.problem, [state.name for state in case.problem.twin.states]
    stated = tuple(process * noise.get(name, 0.0) for name in states)
    problem = replace(true, noise=tuple(sensors * level for level in true.noise), process_noise=stated)
    (windows,) = recordings(case, true, [0], seed=seed)
    state, documents = run(initial_state(plant.twin, "test", problem), windows)
    decisions = [document.decision for document in documents]
    assert set(decisions) <= WHITE
    assert WindowDecision.NOISIER in decisions[:4]
    assert set(decisions[4:]) == {WindowDecision.LEARNED}
    assert state.problem.process_noise == pytest.approx([noise.get(name, 0.0) for name in states], rel=0.4)
    for name, parameter in documents[-1].parameters.items():
        assert parameter.value == pytest.approx(plant.parameters[name], abs=4.0 * (parameter.sd or 0.0))


@pytest.mark.full
def test_an_error_that_repeats_with_the_speed_is_no_process_noise() -> None:
    def warp(_: np.random.Generator, __: Plant, signals: dict[str, Array]) -> None:
        signals["omega"] += np.sin(4.0 * signals["omega"])

    case = Case("warped", disturbed(DC_MOTOR, MOTOR_NOISE), HEALTHY, ("R_a", "D"), healthy=0, changed=5, disturb=warp)
    problem = replace(case.problem, process_noise=tuple(MOTOR_NOISE.values()))
    (windows,) = recordings(case, problem, [0], seed=1)
    state, documents = run(initial_state("motor", "test", problem), windows)
    assert state.problem.levels == problem.levels
    assert all(document.decision is not WindowDecision.NOISIER for document in documents)


def test_noise_of_a_state_is_no_hypothesis_where_none_is_stated() -> None:
    case = Case("unstated", disturbed(DC_MOTOR, MOTOR_NOISE), HEALTHY, ("R_a", "D"), healthy=4, changed=0)
    (windows,) = recordings(case, case.problem, [0], seed=1)
    state, documents = run(initial_state("motor", "test", case.problem), windows)
    assert not any(state.problem.process_noise)
    assert not any(document.components for document in documents)


def test_the_text_names_state_and_level() -> None:
    problem = initial("R_a", "D").problem
    text = describe_noise(problem.with_levels((*problem.levels[:4], 0.05, 0.0)))
    assert_says(text, "i ", "0.05 A/√s", " 0")


@pytest.mark.full
def test_a_step_of_the_mass_is_seen_beside_process_noise_that_is_stated_too_large() -> None:
    change = Change(parameters={"M": 76.0})
    case = Case("step", disturbed(SERVO_AXIS_DIRECTIONAL, {"v": 1e-3}), change, healthy=6, changed=8)
    problem = replace(case.problem, process_noise=(0.0, 4e-3))
    (windows,) = recordings(case, problem, [0], seed=1)
    _, documents = run(initial_state("axis", "test", problem), windows)
    assert WindowDecision.SENSOR not in {document.decision for document in documents}
    for document in documents[8:]:
        mass = document.parameters["M"]
        assert mass.low is not None
        assert mass.high is not None
        assert mass.low <= 76.0 <= mass.high
