"""Predictions of the adapted twin hold what a machine then does; they are reproducible and always finite."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.changes.machines import DC_MOTOR
from benchmarks.changes.plants import HEALTHY, Change
from benchmarks.changes.plants import simulate as simulate_plant
from scipy.stats import norm

from otolith.acquisition.window import Window
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Component, augment
from otolith.machine import library_twins
from otolith.simulation.draws import root_of
from otolith.simulation.initial_state import last_state, state_covariance
from otolith.simulation.orders import with_whole_orders
from otolith.simulation.plan import planned_window
from otolith.simulation.prediction import Prediction
from otolith.simulation.simulate import simulate
from otolith.simulation.what_if import with_value, without_component
from otolith.twin.kernel import Excitation, kernel_of
from tests.simulation.motors import NOISE, PERIOD, TWIN, library_state, plan, posterior, problem
from tests.variants import often, often_rows

SENSORS = np.array(list(NOISE.values()))


def test_the_same_seed_gives_the_same_numbers_bit_for_bit() -> None:
    first, again, other = (simulate(posterior(), plan(0.5), seed) for seed in (7, 7, 8))
    for name in ("values", "low", "high"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    assert first.low.tobytes() != other.low.tobytes()


def test_a_twin_that_is_known_exactly_is_predicted_as_its_kernel_simulates_it() -> None:
    known = with_value(posterior(), "R_a", 6.5)
    known = replace(known, problem=replace(known.problem, noise=(1e-9, 1e-9)))  # so the initial state is known as well
    predicted = simulate(known, plan(1.0))
    parameters = np.array([[item.nominal for item in TWIN.parameters]])
    excitation = Excitation(predicted.driving, plan(1.0).grid, substeps=8)
    exact = kernel_of(TWIN).simulate(parameters, np.array([[1.0, 10.0]]), excitation)[0]
    np.testing.assert_allclose(predicted.values, exact, rtol=0.0, atol=1e-7)


def test_of_what_is_known_exactly_the_band_is_that_of_the_sensors() -> None:
    predicted = simulate(with_value(posterior(), "R_a", 6.5), plan(2.0))
    half = 0.5 * (predicted.high - predicted.low)[-1]  # by then nothing is left of the initial state
    np.testing.assert_allclose(half, QUANTILE * SENSORS, rtol=1e-3)


@pytest.mark.parametrize("trend", [0.0, -0.05])
def test_bands_widen_with_the_horizon(trend: float) -> None:
    drifting = posterior(sd=0.005, trend=trend).reset_value(1, trend, 0.02)
    found = simulate(drifting, plan(6.0))
    width = found.high - found.low
    seconds = [int(at / PERIOD) for at in (0.0, 1.0, 2.0, 4.0, 6.0)]
    assert (np.diff(width[seconds, 1]) > 0.0).all()


def test_a_trend_goes_on() -> None:
    rate = 0.1  # ohm/s
    ramp = Change(ramps={"R_a": rate / 6.5})
    rows = simulate_plant(DC_MOTOR, [np.random.default_rng(3)], 400, ramp, HEALTHY, 400)
    window = Window.whole(0, 0.0, PERIOD, TWIN.signals, np.column_stack([rows[name][0] for name in TWIN.signals]))
    start = float(rows["i"][0, 0]), float(rows["omega"][0, 0])
    rising, constant = (simulate(posterior(trend=trend, state=start), window) for trend in (rate, 0.0))
    assert rising.rmse("omega") == pytest.approx(0.0, abs=SENSORS[1])
    assert (constant.rmse("omega") or 0.0) > 5.0 * SENSORS[1]


@pytest.mark.parametrize(
    ("runs", "records", "tolerance"), often_rows([(10, 150, 0.04)], [(10, 150, 0.04), (60, 600, 0.02)])
)
def test_bands_hold_95_percent_of_what_a_machine_shows(runs: int, records: int, tolerance: float) -> None:
    """The resistances of the machines are spread over their interval; their loads are measured with noise."""
    random, sd = np.random.default_rng(11), 0.03
    true = 6.5 + sd * norm.ppf((np.arange(runs) + 0.5) / runs)
    each = [np.random.default_rng([11, run]) for run in range(runs)]
    rows = simulate_plant(DC_MOTOR, each, records, Change(parameters={"R_a": true}), HEALTHY, records)
    names = ("V_a", "T_load", "i", "omega")
    levels = np.array([0.0, 2e-4, *SENSORS])
    held: list[float] = []
    for run in range(runs):
        truth = np.column_stack([rows[name][run] for name in names])
        window = Window.whole(0, 0.0, PERIOD, TWIN.signals, truth + levels * random.standard_normal(truth.shape))
        start = posterior(sd, state=(float(truth[0, 2]), float(truth[0, 3])))
        parameters = np.array([item.nominal for item in TWIN.parameters])
        covariance = state_covariance(start, kernel_of(TWIN), parameters, truth[0, :2], 2)
        off = last_state(start) + root_of(covariance) @ random.standard_normal(2)
        predicted = simulate(posterior(sd, state=(float(off[0]), float(off[1]))), window, seed=run)
        held += [predicted.coverage(name) or 0.0 for name in predicted.outputs]
    assert np.mean(held) == pytest.approx(0.95, abs=tolerance)


@pytest.mark.parametrize("name", often([], library_twins()))
def test_each_twin_of_the_library_is_predicted_with_finite_bands(name: str) -> None:
    state = library_state(name)
    first, times = state.problem.free[0], PERIOD * np.arange(200, dtype=np.float64)
    halves = np.arange(200) // 50 % 2
    columns = {item.name: np.where(halves, 0.5, 0.1) * item.high for item in state.problem.twin.inputs}
    window = planned_window(state.problem.twin, times, columns, PERIOD, 0.0)
    uncertain = state.reset_value(0, first.nominal, 0.02 * abs(first.nominal) + 1e-6)
    found = simulate(uncertain, window)
    assert found.diverges is None
    assert np.isfinite(found.low).all()
    assert (found.high - found.low >= 2.0 * QUANTILE * 0.999 * np.array(state.problem.noise)).all()


def test_process_noise_widens_the_band_as_theory_says() -> None:
    """A disturbed speed is an Ornstein-Uhlenbeck process, once the current follows it."""
    level = 0.3
    disturbed = replace(problem(), process_noise=(0.0, level))
    found = simulate(with_value(posterior(own=disturbed), "R_a", 6.5), plan(8.0))
    assert speed_variance(found) == pytest.approx(stationary_variance(level), rel=0.15)


def test_the_noise_of_a_measured_load_widens_the_band_as_theory_says() -> None:
    """The rotor integrates it: noise of 0.2 mN·m in each record is white noise of that times the root of a period."""
    values = np.tile([20.0, 0.02, 1.0, 10.0], (801, 1))
    driven = Window.whole(0, 0.0, PERIOD, TWIN.signals, values)
    found = simulate(with_value(posterior(), "R_a", 6.5), driven)
    expected = stationary_variance(2e-4 / 0.001171 * np.sqrt(PERIOD))
    assert speed_variance(found) == pytest.approx(expected, rel=0.15)
    assert np.sqrt(1.0 + expected / SENSORS[1] ** 2) == pytest.approx(1.11, abs=0.02)  # as docs/simulate.md says


def speed_variance(found: Prediction) -> float:
    """The variance of the speed in the last seconds, without the noise of its sensor."""
    sd = (found.high - found.low)[-300:, 1] / (2.0 * QUANTILE)
    return float(np.mean(sd**2) - SENSORS[1] ** 2)


def stationary_variance(level: float) -> float:
    """The variance of a speed that white noise disturbs: P of dx = A x dt + dw, with A P + P A' = -Q."""
    a = np.array([[-6.5 / 0.673, -0.038 / 0.673], [0.038 / 0.001171, -0.00143 / 0.001171]])
    lyapunov = np.kron(np.eye(2), a) + np.kron(a, np.eye(2))
    return float(np.linalg.solve(lyapunov, -np.diag([0.0, level**2]).ravel())[3])


def test_a_twin_that_diverges_is_predicted_up_to_there_and_never_beyond() -> None:
    """With an inductance of a thousandth of a nanohenry no number of sub-steps is enough."""
    state = posterior()
    known = tuple((name, 1e-12 if name == "L_a" else value) for name, value in state.problem.known)
    predicted = simulate(replace(state, problem=replace(state.problem, known=known)), plan(1.0))
    assert predicted.diverges is not None
    assert 0 < predicted.records < 101
    for values in (predicted.values, predicted.low, predicted.high):
        assert np.isfinite(values).all()


def test_without_its_component_the_motor_is_the_healthy_one() -> None:
    torque = Component("shaft", "constant", "", 0.01)
    twin = augment(problem(), [torque])
    with_torque = posterior(own=problem()).remap_parameters(twin)
    with_torque = replace(with_torque, phase=replace(posterior().phase, by=(0.0,)))  # type: ignore[type-var]
    index = [item.name for item in twin.free].index("_amplitude_0")
    with_torque = with_torque.reset_value(index, 0.01, 1e-6)
    both = simulate(with_torque, plan(1.0)), simulate(without_component(with_torque, "shaft"), plan(1.0))
    healthy = simulate(posterior(), plan(1.0))
    assert both[0].values[-1, 1] - healthy.values[-1, 1] > 1.0
    assert both[1].values[-1, 1] == pytest.approx(healthy.values[-1, 1], rel=0.005)


def test_a_simulation_begins_with_the_phases_of_the_last_record() -> None:
    """The angle went on by 12 rad until the next window, of which the step to it is 0.1 rad."""
    twin = augment(problem(), [Component("shaft", "periodic", "angle(omega)", 0.005, 1.0, 0.3, 0.5, 2.0)])
    state = posterior(own=problem()).remap_parameters(twin)
    state = replace(state, phase=replace(posterior().phase, by=(12.0,)))  # type: ignore[type-var]
    (inner, phase) = ([item.name for item in twin.free].index(name) for name in ("_inner_0", "_phase_0"))
    state = state.reset_value(inner, 1.0, 1e-6).reset_value(phase, 0.3, 1e-3)
    assert np.sin(state.at_last_record().prior().mean[phase]) == pytest.approx(np.sin(0.3 + 11.9), abs=1e-6)


@pytest.mark.parametrize(
    ("order", "sd", "expected"),
    [(1.0003, 3e-4, 1.0), (3.9995, 5e-4, 4.0), (1.003, 3e-4, 1.003), (1.02, 0.05, 1.02), (0.004, 1e-3, 0.004)],
    ids=["once per turn", "four times", "excluded", "not known well enough", "none"],
)
def test_an_order_of_a_whole_number_counts_as_whole(order: float, sd: float, expected: float) -> None:
    twin = augment(problem(), [Component("shaft", "periodic", "angle(omega)", 0.005, 1.0, 0.3, 0.001, 9.0)])
    state = posterior(own=problem()).remap_parameters(twin)
    inner = [item.name for item in twin.free].index("_inner_0")
    found = with_whole_orders(state.reset_value(inner, order, sd)).prior()
    assert found.mean[inner] == pytest.approx(expected, rel=1e-9)
    assert found.sd[inner] == pytest.approx(sd if expected == order else 0.0, abs=1e-12)


def test_before_any_window_the_state_is_not_known() -> None:
    with pytest.raises(ValueError, match="window"):
        simulate(replace(posterior(), phase=None), plan(1.0))
