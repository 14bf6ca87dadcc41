"""Kernels at records of any times, against dense uniform grids, differences and simulated noise."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from otolith.acquisition.window import Array, TimeGrid
from otolith.machine import find_twin
from otolith.twin.components import augmented_model
from otolith.twin.kernel import Excitation, InnovationModel, NoiseModel, kernel_of

TWIN = find_twin("dc_motor")  # V_a is held between records, T_load runs straight to the next
AUGMENTED = augmented_model(TWIN)
KERNEL = kernel_of(TWIN)
PARAMETERS = np.array([parameter.nominal for parameter in TWIN.parameters])
INITIAL = np.array([1.0, 10.0])
PERIOD, DENSE = 1e-3, 2001  # of the dense grid
SUBSTEPS = 64  # on the longest step: no truncation error
SENSORS, PROCESS = np.array([0.005, 0.02]), np.array([0.02, 0.2])
NONE = np.zeros(2)


def uniform_noise(outputs: Array, inputs: Array, states: Array, records: int) -> NoiseModel:
    every = np.tile(inputs, (records, 1))
    return NoiseModel(outputs, every, every, states)


def chosen(seed: int, share: float = 0.05) -> list[int]:
    """Some records of the dense grid, from the first to the last."""
    inner = np.flatnonzero(np.random.default_rng(seed).random(DENSE - 2) < share) + 1
    return [0, *inner.tolist(), DENSE - 1]


def grid_at(records: list[int]) -> TimeGrid:
    """A grid that ends at its last record."""
    return TimeGrid.at(PERIOD * np.array(records, dtype=np.float64), PERIOD * records[-1])


def dense_inputs(records: list[int], values: Array) -> Array:
    """(DENSE, inputs) of the values (records, inputs): a voltage that is held, a load that is interpolated."""
    held = np.searchsorted(records, np.arange(DENSE), side="right") - 1
    return np.column_stack([values[held, 0], np.interp(np.arange(DENSE), records, values[:, 1])])


def random_inputs(records: list[int], seed: int = 1) -> Array:
    random = np.random.default_rng(seed)
    return np.column_stack([random.uniform(4.0, 20.0, len(records)), random.uniform(0.0, 0.1, len(records))])


def correction(records: list[int], seed: int = 2) -> tuple[Array, Array]:
    """Random measurements (records, outputs), some missing, and gains (records, states, outputs)."""
    random = np.random.default_rng(seed)
    measured = random.normal(size=(len(records), 2))
    measured[random.random(measured.shape) < 0.3] = np.nan
    return measured, random.uniform(-0.3, 0.3, (len(records), 2, 2))


def merged_and_dense(seed: int) -> tuple[Excitation, Excitation, list[int]]:
    """The same experiment at its records alone, and on the dense grid, where nothing is measured between them."""
    records = chosen(seed)
    inputs, (measured, gain) = random_inputs(records), correction(records)
    dense_measured, dense_gain = np.full((DENSE, 2), np.nan), np.zeros((DENSE, 2, 2))
    dense_measured[records], dense_gain[records] = measured, gain
    merged = Excitation(inputs, grid_at(records), SUBSTEPS, measured, gain)
    dense = Excitation.uniform(dense_inputs(records, inputs), PERIOD, 2)
    return merged, replace(dense, measured=dense_measured, gain=dense_gain), records


@pytest.mark.parametrize("seed", range(3))
def test_prediction_and_sensitivities_equal_those_of_a_dense_grid(seed: int) -> None:
    merged, dense, records = merged_and_dense(seed)
    predicted = KERNEL.simulate(PARAMETERS[None], INITIAL[None], merged)[0]
    assert predicted == pytest.approx(KERNEL.simulate(PARAMETERS[None], INITIAL[None], dense)[0, records], abs=1e-7)
    own, other = (KERNEL.sensitivities(PARAMETERS, INITIAL, drive, drifts=True) for drive in (merged, dense))
    size = np.abs(other.slopes).max(axis=(0, 1))
    assert own.outputs == pytest.approx(predicted, abs=1e-9)
    assert (np.abs(own.slopes - other.slopes[records]).max(axis=(0, 1)) <= 1e-6 * size).all()
    assert own.last == pytest.approx(other.last, abs=1e-7)
    assert (np.abs(own.last_slopes - other.last_slopes).max(axis=0) <= 1e-6 * size).all()


def test_sensitivities_are_differences_of_the_simulation() -> None:
    drive, _, _ = merged_and_dense(4)
    slopes = KERNEL.sensitivities(PARAMETERS, INITIAL, drive).slopes
    point, split = np.concatenate([PARAMETERS, INITIAL]), len(PARAMETERS)
    for column in range(len(point)):
        step = np.zeros(len(point))
        step[column] = 1e-6 * point[column]
        ahead, behind = (
            KERNEL.simulate(p[None, :split], p[None, split:], drive)[0] for p in (point + step, point - step)
        )
        change = (ahead - behind) / (2.0 * step[column])
        assert slopes[:, :, column] == pytest.approx(change, rel=1e-5, abs=1e-6 * np.abs(change).max())


def test_linearised_model_equals_the_products_of_a_dense_one() -> None:
    """The transition over a step is the product of those in it; so is the effect of an input that is held for it."""
    merged, dense, records = merged_and_dense(5)
    kernel = kernel_of(AUGMENTED)

    def linear(drive: Excitation) -> tuple[Array, Array]:
        extra = np.zeros((len(drive.inputs), len(AUGMENTED.inputs) - 2))
        start = np.concatenate([INITIAL, np.zeros(len(AUGMENTED.states) - 2)])
        values = np.concatenate([PARAMETERS, np.zeros(len(AUGMENTED.parameters) - len(PARAMETERS))])
        free = replace(drive, inputs=np.hstack([drive.inputs, extra]), gain=None)
        model = kernel.linearise(values, start, free)
        return model.transition, model.input_now + model.input_next

    transition, held = linear(merged)
    dense_transition, dense_held = linear(dense)
    for index, (begin, end) in enumerate(pairwise(records)):
        product, effect = np.eye(len(AUGMENTED.states)), np.zeros(held.shape[1:])
        for record in range(begin, end):
            effect = dense_transition[record] @ effect + dense_held[record]
            product = dense_transition[record] @ product
        assert transition[index] == pytest.approx(product, rel=1e-5, abs=1e-7)
        assert held[index] == pytest.approx(effect, rel=1e-4, abs=1e-6 * np.abs(dense_held).max())


def test_wanted_columns_are_those_of_all_sensitivities() -> None:
    merged, _, _ = merged_and_dense(6)
    every = KERNEL.sensitivities(PARAMETERS, INITIAL, merged, drifts=True)
    columns = [1, 4, 6, 8]  # two parameters, an initial state, a drift
    some = KERNEL.sensitivities(PARAMETERS, INITIAL, merged, columns)
    assert some.outputs == pytest.approx(every.outputs, rel=1e-12)
    assert some.slopes == pytest.approx(every.slopes[:, :, columns], rel=1e-12)
    assert some.last_slopes == pytest.approx(every.last_slopes[:, columns], rel=1e-12)


@pytest.mark.parametrize("name", ["dc_motor", "servo_axis", "pump"])
def test_linearised_model_equals_differences_of_the_simulation(name: str) -> None:
    """Each site in turn gets a random curve; additive and multiplicative sites, and sensors of outputs and inputs."""
    base = find_twin(name)
    twin, random, count = augmented_model(base), np.random.default_rng(7), 40
    kernel, own = kernel_of(twin), len(base.inputs)
    values = np.array([parameter.nominal for parameter in twin.parameters])
    start = np.array([0.5 if index < len(base.states) else 0.0 for index in range(len(twin.states))])
    grid = TimeGrid.at(np.cumsum(random.uniform(0.002, 0.01, count)) - 0.002, 0.5)
    inputs = np.zeros((count, len(twin.inputs)))
    inputs[:, :own] = random.uniform(0.5, 1.0, (count, own))
    drive = Excitation(inputs, grid, substeps=4)
    model = kernel.linearise(values, start, drive)
    for site, index in enumerate(range(own + 1, len(twin.inputs))):
        curve, size = random.standard_normal(count), 1e-5
        shifted = []
        for sign in (1.0, -1.0):
            moved = inputs.copy()
            moved[:, index] += sign * size * curve
            shifted.append(kernel.simulate(values[None], start[None], replace(drive, inputs=moved))[0])
        expected = (shifted[0] - shifted[1]) / (2.0 * size)
        state, responses = np.zeros(len(twin.states)), []
        for record in range(count):
            responses.append(model.output[record] @ state + model.feedthrough[record, :, site] * curve[record])
            following = curve[min(record + 1, count - 1)]
            added = model.input_now[record, :, site] * curve[record] + model.input_next[record, :, site] * following
            state = model.transition[record] @ state + added
        assert np.array(responses) == pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(expected).max() + 1e-12)


def innovation_model(drive: Excitation, noise: NoiseModel) -> InnovationModel:
    model = KERNEL.innovation_model(PARAMETERS, INITIAL, drive, noise)
    assert np.isfinite(model.gain).all()
    return model


def test_gains_equal_those_of_a_dense_filter_with_missing_measurements() -> None:
    """Records every 10 ms of which one in five is measured, against steps of 50 ms and of other lengths."""
    period, count = 0.01, 201
    noise = uniform_noise(SENSORS, NONE, PROCESS, count)
    drawn = np.random.default_rng(6).permutation(count - 2)[:40] + 1
    for records in (list(range(0, count, 5)), [0, *sorted(drawn.tolist()), count - 1]):
        inputs = np.tile([12.0, 0.05], (count, 1))
        measured = np.full((count, 2), np.nan)
        outputs = KERNEL.simulate(PARAMETERS[None], INITIAL[None], Excitation.uniform(inputs, period, 8))[0]
        measured[records] = outputs[records]
        expected = innovation_model(replace(Excitation.uniform(inputs, period, 8), measured=measured), noise)
        grid = TimeGrid.at(period * np.array(records, dtype=np.float64), period * count)
        steps = 8 * round(float(grid.steps[:-1].max()) / period)
        merged = Excitation(inputs[records], grid, steps, measured[records])
        own = uniform_noise(SENSORS, NONE, PROCESS, len(records))
        model = innovation_model(merged, replace(own, period=period))
        assert model.gain == pytest.approx(expected.gain[records], rel=1e-6, abs=1e-9)
        assert model.whitening == pytest.approx(expected.whitening[records], rel=1e-6, abs=1e-6)
        assert model.log_determinant == pytest.approx(expected.log_determinant, rel=1e-9)


def test_innovations_have_the_covariance_of_simulated_noise() -> None:
    """Monte Carlo: whitened innovations of a disturbed motor at irregular records have unit variance and no mean."""
    random, records = np.random.default_rng(7), chosen(8, share=0.02)
    grid = grid_at(records)
    deviation = 0.3 * random.random((len(records), 1)) * np.array([1.0, 0.05])  # of the inputs, another in each record
    noise = NoiseModel(SENSORS, np.zeros((len(records), 2)), deviation, PROCESS, PERIOD)
    inputs, paths = np.tile([12.0, 0.05], (len(records), 1)), 300
    counts = np.rint(grid.steps / PERIOD).astype(int)
    state = np.tile(INITIAL, (paths, 1))
    measured = np.empty((paths, len(records), 2))
    for record in range(len(records)):
        measured[:, record] = state + SENSORS * random.normal(size=state.shape)
        if record + 1 == len(records):
            break
        errors = deviation[record] * random.normal(size=(paths, 2))
        for _ in range(counts[record]):
            state = moved(state, inputs[record] + errors)
            state += PROCESS * np.sqrt(PERIOD) * random.normal(size=state.shape)
    model = innovation_model(Excitation(inputs, grid, SUBSTEPS, measured[0]), noise)
    whitened = np.empty_like(measured)
    for path in range(paths):
        drive = Excitation(inputs, grid, SUBSTEPS, measured[path], model.gain)
        innovations = measured[path] - KERNEL.simulate(PARAMETERS[None], INITIAL[None], drive)[0]
        whitened[path] = np.einsum("rop,rp->ro", model.whitening, innovations)
    covariance = np.einsum("pro,prq->roq", whitened, whitened) / paths
    assert covariance.mean(axis=0) == pytest.approx(np.eye(2), abs=5.0 / np.sqrt(paths * len(records)))
    assert covariance == pytest.approx(np.broadcast_to(np.eye(2), covariance.shape), abs=5.5 * np.sqrt(2.0 / paths))


def moved(states: Array, inputs: Array) -> Array:
    """(paths, states) after a period of the dense grid; the motor is linear, so two matrices do it."""
    transition, effect, constant = _matrices()
    return np.asarray(states @ transition.T + inputs @ effect.T + constant)


@cache
def _matrices() -> tuple[Array, Array, Array]:
    def after(state: Array, driving: Array) -> Array:
        drive = Excitation.uniform(np.tile(driving, (2, 1)), PERIOD, 2)
        return np.asarray(KERNEL.simulate(PARAMETERS[None], state[None], drive)[0, 1])

    rest = after(np.zeros(2), np.zeros(2))
    transition = np.column_stack([after(unit, np.zeros(2)) - rest for unit in np.eye(2)])
    effect = np.column_stack([after(np.zeros(2), unit) - rest for unit in np.eye(2)])
    return transition, effect, rest


def test_records_without_measurements_change_nothing() -> None:
    records, random = chosen(9, share=0.02), np.random.default_rng(10)
    whole = Excitation(random_inputs(records), grid_at(records), SUBSTEPS)
    predicted = KERNEL.simulate(PARAMETERS[None], INITIAL[None], whole)[0]
    measured = predicted + SENSORS * random.normal(size=predicted.shape)
    both = np.union1d(records, random.choice(DENSE, 60, replace=False)).tolist()
    at = np.searchsorted(both, records)
    split_measured = np.full((len(both), 2), np.nan)
    split_measured[at] = measured
    split = Excitation(dense_inputs(records, whole.inputs)[both], grid_at(both), SUBSTEPS)
    assert KERNEL.simulate(PARAMETERS[None], INITIAL[None], split)[0, at] == pytest.approx(predicted, abs=1e-7)
    expected, own = (
        innovation_model(
            replace(drive, measured=values),
            replace(uniform_noise(SENSORS, NONE, PROCESS, len(values)), period=PERIOD),
        )
        for drive, values in ((whole, measured), (split, split_measured))
    )
    assert own.gain[at] == pytest.approx(expected.gain, rel=1e-6, abs=1e-9)
    assert own.whitening[at] == pytest.approx(expected.whitening, rel=1e-6, abs=1e-6)


def test_noise_of_a_split_step_is_that_of_the_whole_one() -> None:
    """An error that is held over a step of n parts counts n times in each: the same covariance for slow states."""
    parts, steps, length = 10, 40, 2e-4  # short steps: the states hardly forget within one
    deviation = np.array([0.3, 0.01])
    whole = TimeGrid.at(length * np.arange(steps, dtype=np.float64), length * steps)
    offsets = length / parts * np.arange(steps * parts, dtype=np.float64)
    split = TimeGrid(offsets, np.full(len(offsets), length / parts))
    measured = np.tile(INITIAL, (steps, 1))
    split_measured = np.full((len(offsets), 2), np.nan)
    split_measured[::parts] = measured
    held, ratio = np.tile(deviation, (steps, 1)), np.sqrt(float(parts))
    coarse = NoiseModel(SENSORS, np.zeros_like(held), held, NONE)
    fine_held = ratio * np.tile(deviation, (len(offsets), 1))
    fine = NoiseModel(SENSORS, np.zeros_like(fine_held), fine_held, NONE)
    drive = np.array([12.0, 0.05])
    one = innovation_model(Excitation(np.tile(drive, (steps, 1)), whole, 1, measured), coarse)
    many = innovation_model(Excitation(np.tile(drive, (len(offsets), 1)), split, 1, split_measured), fine)
    assert many.whitening[::parts] == pytest.approx(one.whitening, rel=1e-3, abs=1e-3)
    assert many.gain[::parts] == pytest.approx(one.gain, rel=0.02, abs=1e-5)


def test_irregular_grid_of_equal_steps_gives_the_numbers_of_a_uniform_one() -> None:
    uniform = Excitation.uniform(np.tile([12.0, 0.05], (50, 1)), 0.01, 4)
    grid = TimeGrid(uniform.grid.offsets, uniform.grid.steps)
    drives = (uniform, replace(uniform, grid=grid))
    first, second = (KERNEL.simulate(PARAMETERS[None], INITIAL[None], drive) for drive in drives)
    assert np.array_equal(first, second)
    assert drives[1].counts.tolist() == drives[0].counts.tolist()


def test_a_long_gap_does_not_coarsen_the_other_steps() -> None:
    """No substep is longer than those of the gap, and the limit of their number is that of an ordinary step."""
    offsets = np.concatenate([0.01 * np.arange(50), 3.0 + 0.01 * np.arange(50)])
    voltage = np.repeat(np.random.default_rng(11).uniform(4.0, 20.0, 20), 5)
    drive = Excitation(np.column_stack([voltage, np.zeros(100)]), TimeGrid.at(offsets, 3.5))
    limit = 8
    count = KERNEL.substeps(PARAMETERS, INITIAL, drive, np.full(2, 1e-12), limit)
    counts = replace(drive, substeps=count).counts
    assert limit <= counts[0] <= 2 * limit
    assert counts[49] == count
    tolerance = np.array([1e-5, 1e-4])
    count = KERNEL.substeps(PARAMETERS, INITIAL, drive, tolerance)
    enough, exact = (
        KERNEL.simulate(PARAMETERS[None], INITIAL[None], replace(drive, substeps=n))[0] for n in (count, 64 * count)
    )
    assert (np.abs(enough - exact).max(axis=0) <= tolerance).all()


def test_paper_equations_need_a_uniform_grid() -> None:
    drive = Excitation(np.zeros((3, 2)), TimeGrid.at(np.array([0.0, 0.01, 0.03]), 0.04))
    with pytest.raises(ValueError, match="uniform"):
        KERNEL.euler(PARAMETERS[None], INITIAL[None], drive, 1e-4)


def test_inputs_need_as_many_records_as_the_grid() -> None:
    with pytest.raises(ValueError, match="3 records of inputs at 4 times"):
        KERNEL.simulate(PARAMETERS[None], INITIAL[None], Excitation(np.zeros((3, 2)), TimeGrid.uniform(4, 0.01)))
