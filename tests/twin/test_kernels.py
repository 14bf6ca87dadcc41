"""Compiled kernels of every library twin: predictions, order, derivatives and Kalman gains against references."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Array, TimeGrid
from otolith.machine import find_twin
from otolith.machine import library_twins as library
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation, NoiseModel, kernel_of
from otolith.twin.language import read_twin
from otolith_drivers.config_files import SourceFile
from tests.twin.reference import Reference

PERIODS = {"dc_motor": 0.01, "dc_motor_coulomb": 0.01, "fan": 0.05, "hydraulic_actuator": 0.01,
           "induction_motor": 0.01, "pmsm": 5e-4, "pump": 0.02,
           "servo_axis": 1e-3, "servo_axis_directional": 1e-3, "two_mass": 2e-3}  # fmt: skip
RECORDS = 60


def nominal(definition: Definition) -> Array:
    return np.array([parameter.nominal for parameter in definition.parameters])


def initial(definition: Definition) -> Array:
    return np.array([state.initial for state in definition.states])


def excitation(definition: Definition, records: int = RECORDS, seed: int = 5) -> Excitation:
    """Random levels within the inputs' ranges, each held for ten records or interpolated."""
    random = np.random.default_rng(seed)
    columns = [np.repeat(random.uniform(e.low, e.high, records // 10 + 1), 10)[:records] for e in definition.inputs]
    return Excitation.uniform(np.column_stack(columns), PERIODS[definition.name])


@pytest.fixture(params=library())
def twin(request: pytest.FixtureRequest) -> Definition:
    return find_twin(request.param)


def resolved(twin: Definition, drive: Excitation) -> tuple[Excitation, Array, Array]:
    """The excitation with substeps for errors of 1e-7 of a signal's range, the reference prediction, the ranges."""
    expected = Reference(twin, nominal(twin)).simulate(initial(twin), drive.inputs, PERIODS[twin.name])
    extent = np.ptp(expected, axis=0)
    assert (extent > 0.0).all(), "the excitation does not move every signal"
    substeps = kernel_of(twin).substeps(nominal(twin), initial(twin), drive, 1e-7 * extent)
    return replace(drive, substeps=substeps), expected, extent


def test_prediction_agrees_with_independent_integrator(twin: Definition) -> None:
    drive, expected, extent = resolved(twin, excitation(twin))
    predicted = kernel_of(twin).simulate(nominal(twin)[None], initial(twin)[None], drive)[0]
    assert (np.abs(predicted - expected).max(axis=0) / extent).max() < 1e-6


def test_sensitivities_are_derivatives_of_the_reference(twin: Definition) -> None:
    drive, expected, _ = resolved(twin, excitation(twin, records=30))
    drive = replace(drive, substeps=8 * drive.substeps)  # a derivative is less smooth than what it is the derivative of
    predicted, slopes, _, _ = kernel_of(twin).sensitivities(nominal(twin), initial(twin), drive)
    assert predicted == pytest.approx(expected, rel=1e-5, abs=1e-6 * np.ptp(expected))
    widths = [e.high - e.low for e in twin.parameters] + [e.high - e.low for e in twin.states]
    point = np.concatenate([nominal(twin), initial(twin)])
    split = len(twin.parameters)
    for column, width in enumerate(widths):
        step = np.zeros(len(point))
        step[column] = 1e-5 * min(width, max(abs(point[column]), 1e-2 * width))
        ahead, behind = (
            Reference(twin, p[:split]).simulate(p[split:], drive.inputs, PERIODS[twin.name])
            for p in (point + step, point - step)
        )
        change = (ahead - behind) / (2.0 * step[column])
        largest = np.abs(change).max(axis=0)
        wrong = np.abs(slopes[:, :, column] - change).max(axis=0)
        floor = 1e-9 * np.ptp(expected, axis=0) / width
        assert (wrong <= 1e-5 * np.maximum(largest, floor)).all(), (column, wrong, largest)


@pytest.mark.parametrize("name", ["dc_motor", "hydraulic_actuator", "pmsm"])
def test_drifts_are_derivatives_by_a_moving_parameter(name: str) -> None:
    """Against the reference with a parameter that moves linearly to its value at the last record."""
    twin = find_twin(name)
    drive, _, _ = resolved(twin, excitation(twin, records=20))
    drive = replace(drive, substeps=8 * drive.substeps)
    slopes = kernel_of(twin).sensitivities(nominal(twin), initial(twin), drive, drifts=True).slopes
    base = len(twin.parameters) + len(twin.states)
    for index, parameter in enumerate(twin.parameters):
        width = parameter.high - parameter.low
        reach = min(width, max(abs(parameter.nominal), 0.01 * width))
        rate = 1e-4 * reach / (20 * PERIODS[name])
        ahead, behind = (
            Reference(twin, nominal(twin)).simulate(initial(twin), drive.inputs, PERIODS[name], {parameter.name: r})
            for r in (rate, -rate)
        )
        change = (ahead - behind) / (2.0 * rate)
        floor = 1e-6 * np.abs(slopes[:, :, base + index]).max(axis=0)
        assert slopes[:, :, base + index] == pytest.approx(change, rel=1e-4, abs=max(floor.max(), 1e-12))


@pytest.mark.parametrize("name", ["dc_motor", "two_mass", "pmsm"])
def test_integrator_has_order_four(name: str) -> None:
    """Halving the step divides the error by sixteen."""
    twin = find_twin(name)
    drive = excitation(twin, records=20)
    drive = Excitation.uniform(drive.inputs, 4 * PERIODS[name])
    coarse, fine, finest = (
        kernel_of(twin).simulate(nominal(twin)[None], initial(twin)[None], replace(drive, substeps=n))
        for n in (2, 4, 64)
    )
    order = np.log2(np.abs(coarse - finest).max() / np.abs(fine - finest).max())
    assert order == pytest.approx(4.0, abs=0.4)


def test_euler_is_the_papers_equations() -> None:
    twin = find_twin("dc_motor")
    drive = excitation(twin)
    held = replace(drive, inputs=np.repeat(drive.inputs[::10], 10, axis=0)[: len(drive.inputs)])
    held.inputs[:, 1] = 0.05  # the paper holds the load torque too
    predicted = kernel_of(twin).euler(nominal(twin)[None], initial(twin)[None], held, 1e-4)[0]
    R_a, L_a, J, K_e, K_t, D = nominal(twin)  # noqa: N806 - as in the source equation
    i = w = 0.0
    for record in range(RECORDS):
        assert predicted[record] == pytest.approx([i, w], rel=1e-11, abs=1e-13)
        for _ in range(100):
            i += 1e-4 * (held.inputs[record, 0] - R_a * i - K_e * w) / L_a
            w += 1e-4 * (i * K_t - 0.05 - D * w) / J


def test_swarm_equals_its_particles_one_by_one(twin: Definition) -> None:
    random = np.random.default_rng(1)
    swarm = nominal(twin) * random.uniform(0.95, 1.05, (5, len(twin.parameters)))
    starts = np.tile(initial(twin), (5, 1))
    kernel, drive = kernel_of(twin), excitation(twin)
    together = kernel.simulate(swarm, starts, drive)
    alone = [kernel.simulate(swarm[k : k + 1], starts[k : k + 1], drive)[0] for k in range(5)]
    assert np.array_equal(together, np.array(alone), equal_nan=True)


def test_innovation_form_is_a_kalman_prediction() -> None:
    """Predict, compare and correct record by record; a missing measurement corrects nothing."""
    twin = find_twin("dc_motor")
    kernel, drive = kernel_of(twin), excitation(twin)
    random = np.random.default_rng(2)
    measured = random.normal(size=(RECORDS, 2))
    measured[7, 0] = np.nan
    gain = random.uniform(-0.3, 0.3, (RECORDS, 2, 2))
    corrected = replace(drive, measured=measured, gain=gain)
    predicted = kernel.simulate(nominal(twin)[None], initial(twin)[None], corrected)[0]
    state = initial(twin)
    for record in range(RECORDS - 1):
        assert predicted[record] == pytest.approx(state, rel=1e-12)
        state = state + gain[record] @ np.nan_to_num(measured[record] - state)
        piece = Excitation.uniform(drive.inputs[record : record + 2], PERIODS[twin.name])
        state = kernel.simulate(nominal(twin)[None], state[None], piece)[0, 1]


def test_innovation_form_sensitivities_are_derivatives() -> None:
    twin = find_twin("dc_motor")
    kernel, drive = kernel_of(twin), excitation(twin)
    random = np.random.default_rng(2)
    measured = random.normal(size=(RECORDS, 2))
    measured[7, 0] = np.nan
    drive = replace(drive, measured=measured, gain=random.uniform(-0.3, 0.3, (RECORDS, 2, 2)))
    slopes = kernel.sensitivities(nominal(twin), initial(twin), drive).slopes
    point = np.concatenate([nominal(twin), initial(twin)])
    for column in range(len(point)):
        step = np.zeros(len(point))
        step[column] = 1e-6 * max(abs(point[column]), 1e-2)
        ahead, behind = (kernel.simulate(p[None, :6], p[None, 6:], drive)[0] for p in (point + step, point - step))
        change = (ahead - behind) / (2.0 * step[column])
        assert slopes[:, :, column] == pytest.approx(change, rel=1e-5, abs=1e-6 * np.abs(change).max())


def test_gain_is_that_of_an_extended_kalman_filter() -> None:
    """Against the textbook's matrices, record by record, with a missing measurement and a noisy input."""
    twin = find_twin("dc_motor")
    kernel, drive = kernel_of(twin), excitation(twin)
    random = np.random.default_rng(4)
    measured = kernel.simulate(nominal(twin)[None], initial(twin)[None], drive)[0] + random.normal(size=(RECORDS, 2))
    measured[7, 0] = np.nan
    noisy = np.array([0.0, 0.01])
    every = np.tile(noisy, (RECORDS, 1))
    noise = NoiseModel(np.array([0.5, 1.0]), every, every, np.array([0.2, 3.0]))
    model = kernel.innovation_model(nominal(twin), initial(twin), replace(drive, measured=measured), noise)
    state, covariance, log_determinant = initial(twin), np.zeros((2, 2)), 0.0
    for record in range(RECORDS):
        seen = np.flatnonzero(np.isfinite(measured[record]))
        output = np.eye(2)[seen]
        innovation = output @ covariance @ output.T + np.diag(noise.outputs**2)[np.ix_(seen, seen)]
        gain = covariance @ output.T @ np.linalg.inv(innovation)
        log_determinant += np.linalg.slogdet(innovation)[1]
        assert model.gain[record][:, seen] == pytest.approx(gain, rel=1e-6, abs=1e-12)
        whitening = model.whitening[record][np.ix_(seen, seen)]
        assert whitening @ innovation @ whitening.T == pytest.approx(np.eye(len(seen)), abs=1e-9)
        if record + 1 == RECORDS:
            break
        state = state + gain @ (measured[record, seen] - state[seen])
        covariance = covariance - gain @ innovation @ gain.T
        piece = Excitation.uniform(drive.inputs[record : record + 2], PERIODS[twin.name])
        step = kernel.sensitivities(nominal(twin), state, piece)
        nudged = piece.inputs + noisy
        driven = kernel.sensitivities(nominal(twin), state, replace(piece, inputs=nudged)).last - step.last
        transition = step.last_slopes[:, 6:]
        strays = np.diag(noise.states**2 * PERIODS[twin.name]) + np.outer(driven, driven)
        state, covariance = step.last, transition @ covariance @ transition.T + strays
    assert model.log_determinant == pytest.approx(log_determinant, rel=1e-6)


def test_substeps_are_the_fewest_that_suffice() -> None:
    twin = find_twin("pmsm")
    drive = excitation(twin)
    tolerance = np.array([1e-6, 1e-6, 1e-6])
    count = kernel_of(twin).substeps(nominal(twin), initial(twin), drive, tolerance)
    assert count > 1
    exact, enough, fewer = (
        kernel_of(twin).simulate(nominal(twin)[None], initial(twin)[None], replace(drive, substeps=n))
        for n in (16 * count, count, count // 2)
    )
    assert np.abs(enough - exact).max() <= 1e-6 < np.abs(fewer - exact).max()


def test_the_search_for_substeps_costs_as_much_per_record_at_any_times() -> None:
    """Samples of two sources come in pairs a microsecond apart, and no number of substeps is enough."""
    twin = find_twin("servo_axis")
    grid = TimeGrid.at(
        np.sort(np.concatenate([[0.0, 1e-6, 2e-6], np.add.outer(np.arange(1, 20), [0.0, 1e-6]).ravel()])), 20.0
    )
    drive = Excitation(np.full((grid.records, 1), 1e6), grid)
    unreachable = np.zeros(len(twin.outputs))
    count = kernel_of(twin).substeps(nominal(twin), initial(twin), drive, unreachable, limit=8)
    # The search goes in powers of two, and an ordinary step is at least half the mean one.
    assert replace(drive, substeps=count).counts.sum() <= (4 * 8 + 1) * grid.records


def test_rounding_errors_end_the_search_for_substeps() -> None:
    """A position in the wrong unit is so large that its rounding errors exceed the truncation error that is allowed."""
    twin = find_twin("servo_axis")
    drive = Excitation.uniform(np.zeros((RECORDS, 1)), 0.001)
    far = np.array([3.0e8, 1.0e8])
    assert kernel_of(twin).substeps(nominal(twin), far, drive, np.array([1e-9])) <= 8


def test_a_twin_with_many_slopes_compiles() -> None:
    """Each of its states depends on all others: 36 slopes, of which CPython makes no tuple at once."""
    names = [f"x_{index}" for index in range(6)]
    total = " + ".join(names)
    text = '[twin]\nname = "chain"\ntitle = "chain"\nsource = "none"\n[states]\n'
    text += "".join(f'{name} = {{ unit = "1", meaning = "{name}" }}\n' for name in names) + "[outputs]\n"
    text += "".join(f'{name} = {{ unit = "1", noise = 1, meaning = "{name}" }}\n' for name in names)
    text += '[parameters]\nk = { unit = "1/s", nominal = 0.3, bounds = [0, 1], role = "estimated", meaning = "rate" }\n'
    text += "[equations]\n" + "".join(f'"der({name})" = "-k*{name}*({total})"\n' for name in names)
    twin = read_twin(SourceFile(Path("chain.toml"), text))
    drive, start = Excitation.uniform(np.zeros((20, 0)), 0.01), np.linspace(0.5, 1.0, 6)
    slopes = kernel_of(twin).sensitivities(nominal(twin), start, drive).slopes
    ahead, behind = (
        kernel_of(twin).simulate(np.array([[0.3 + step]]), start[None], drive)[0] for step in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(slopes[:, :, 0], (ahead - behind) / 2e-5, rtol=1e-6, atol=1e-9)
