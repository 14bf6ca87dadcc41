"""Noise identification: simulated levels are identified, and remarks name levels that are not observable."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.quality import time_text
from otolith.acquisition.window import Array, Quality, TimeGrid, Verdict, Window
from otolith.commissioning import identification as text
from otolith.commissioning.identification import IdentifiedNoise, identify_noise, observable_states, sample_noise
from otolith.estimation.information import initial_prior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import estimate
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of
from tests.variants import often

TWIN = find_twin("dc_motor")
TRUTH = {parameter.name: parameter.nominal for parameter in TWIN.parameters}
SENSORS = np.array([0.005, 0.02])  # A, rad/s
PERIOD, RECORDS = 0.01, 200
FREE = ("R_a", "D")
PROBLEM = Problem(
    TWIN,
    known=tuple((name, value) for name, value in TRUTH.items() if name not in FREE),
    free=tuple(parameter for parameter in TWIN.parameters if parameter.name in FREE),
    noise=(0.05, 0.01),  # A, rad/s: wrong levels, one too large and one too small
)


def window(
    random: np.random.Generator,
    index: int,
    process: Sequence[float] = (0.0, 0.0),
    voltage: tuple[float, float] = (4.0, 20.0),
    hidden: float = 0.0,
    **changed: float,
) -> Window:
    """Random voltage steps and a sinusoidal load, simulated with process noise ``process`` per square root of a second.

    ``hidden`` (N*m) is the amplitude of a slow, unmeasured load; ``changed`` parameters differ from those of the twin.
    """
    times = PERIOD * np.arange(RECORDS)
    volts = np.repeat(random.uniform(*voltage, 4), RECORDS // 4)
    load = (0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * times)) if volts.any() else np.zeros(RECORDS)
    slow = hidden * np.sin(random.uniform(0.5, 2.0) * times + random.uniform(0.0, 6.3))
    parameters = np.array([list((TRUTH | changed).values())])
    state = np.array([1.0, 10.0]) if volts.any() else np.zeros(2)
    outputs = np.zeros((RECORDS, 2))
    inputs = np.column_stack([volts, load + slow])
    for record in range(RECORDS):
        outputs[record] = state
        excitation = Excitation.uniform(inputs[record : record + 2], PERIOD, 4)
        if record + 1 < RECORDS:
            state = kernel_of(TWIN).simulate(parameters, state[None], excitation)[0, 1]
            state = state + np.array(process) * np.sqrt(PERIOD) * random.normal(size=2)
    values = np.column_stack([volts, load, outputs + random.normal(size=outputs.shape) * SENSORS])
    return Window.whole(index, 2.0 * index, PERIOD, TWIN.signals, values)


def levels(noise: IdentifiedNoise) -> Array:
    return np.array([level.value for level in (*noise.outputs, *noise.states)])


def identified(seed: int, count: int = 20, **options: object) -> IdentifiedNoise:
    random = np.random.default_rng(seed)
    return identify_noise(PROBLEM, [window(random, index, **options) for index in range(count)])  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", often([0], range(4)))
def test_sensor_noise_without_process_noise(seed: int) -> None:
    noise = identified(seed)
    assert levels(noise)[:2] == pytest.approx(SENSORS, rel=0.05)
    for level, truth in zip(noise.outputs, SENSORS, strict=True):
        assert level.sd is not None
        assert abs(level.value - truth) < 4.0 * level.sd
    assert levels(noise)[2:] * np.sqrt(PERIOD) == pytest.approx(0.0, abs=0.02 * SENSORS.min())


@pytest.mark.parametrize("process", often([(0.05, 0.3)], [(0.0, 0.3), (0.05, 0.0), (0.05, 0.3)]))
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
def test_process_noise_beside_sensor_noise(process: tuple[float, float], seed: int) -> None:
    noise = identified(seed, 30, process=process)
    assert levels(noise)[:2] == pytest.approx(SENSORS, rel=0.15)
    assert levels(noise)[2:] == pytest.approx(process, rel=0.15, abs=0.1 * np.sqrt(PERIOD) * SENSORS.min())
    assert noise.consistency.factor == 1.0


@pytest.mark.parametrize("process", often([1e-3], [1e-3, 4e-3]))
def test_a_level_far_below_its_first_guess_is_found_with_few_fits(process: float) -> None:
    """The first guess shows from record to record: at 1 kHz it is a hundred times what windows show as a whole."""
    twin, random, period, records = find_twin("servo_axis"), np.random.default_rng(4), 1e-3, 1000
    times = period * np.arange(4 * records)
    forces = 150.0 * np.sin(4.4 * times) + 90.0 * np.sin(14.4 * times)
    position = velocity = 0.0
    positions = []

    def acceleration(force: float, speed: float) -> float:
        return float(force - 200.0 * speed - 20.0 * np.tanh(speed / 0.002)) / 95.0

    for force in forces:
        positions.append(position)
        middle = velocity + 0.5 * period * acceleration(force, velocity)
        position += period * middle
        velocity += period * acceleration(force, middle) + process * np.sqrt(period) * random.normal()
    values = np.column_stack([forces, positions + 1e-5 * random.normal(size=len(times))])
    parts = [values[first : first + records] for first in range(0, len(values), records)]
    windows = [Window.whole(index, float(index), period, twin.signals, part) for index, part in enumerate(parts)]
    free = tuple(parameter for parameter in twin.parameters if parameter.name != "v_s")
    noise = identify_noise(Problem(twin, (("v_s", 0.002),), free, (1e-6,)), windows)
    assert levels(noise) == pytest.approx([1e-5, 0.0, process], rel=0.2)
    assert noise.evaluations < 130 * len(windows)


def thinned(random: np.random.Generator, whole: Window, missing: float, rows: float = 0.0) -> Window:
    """The window without a share of the samples of its outputs, and without a share of its rows."""
    kept = np.flatnonzero(random.random(whole.records) >= rows)
    kept[0] = 0
    grid = TimeGrid.at(whole.grid.offsets[kept], whole.grid.length) if rows else whole.grid
    absent = np.zeros((len(kept), 4), dtype=np.bool_)
    absent[:, 2:] = random.random((len(kept), 2)) < missing
    values = np.where(absent, np.nan, whole.values[kept])
    return replace(whole, grid=grid, values=values, missing=absent)


@pytest.mark.parametrize(("missing", "rows"), [(0.5, 0.0), (0.0, 0.5), (0.5, 0.5)])
def test_a_cubic_leaves_no_noise_at_any_times(missing: float, rows: float) -> None:
    random = np.random.default_rng(20)
    times = PERIOD * np.arange(RECORDS)
    cubic = 3.0 - 40.0 * times + 50.0 * times**2 - 20.0 * times**3
    levels_of_noise = []
    for noise in (0.0, 0.01):
        values = np.tile(cubic[:, None], (1, 4)) + noise * random.normal(size=(RECORDS, 4))
        whole = [Window.whole(index, 0.0, PERIOD, TWIN.signals, values) for index in range(30)]
        levels_of_noise.append(sample_noise("omega", [thinned(random, window, missing, rows) for window in whole]))
    assert levels_of_noise[0] < 1e-9
    assert levels_of_noise[1] == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize("rows", [0.0, 0.3])
def test_a_coarse_signal_that_mostly_rests_is_as_noisy_as_where_it_moves(rows: float) -> None:
    """At irregular times five equal values differ by rounding; that is not the noise of the sensor."""
    random, step = np.random.default_rng(22), 0.1
    times = PERIOD * np.arange(RECORDS)
    motions = [3.0 * times, np.maximum(0.3 - times, 0.0), 0.0 * times, 0.0 * times]  # most of them at rest
    windows = []
    for index, motion in enumerate(motions):
        coarse = 0.7 + step * np.rint(motion / step)
        whole = Window.whole(index, 0.0, PERIOD, TWIN.signals, np.tile(coarse[:, None], (1, 4)))
        windows.append(thinned(random, whole, 0.0, rows))
    assert 0.1 * step < sample_noise("omega", windows) < step
    assert sample_noise("omega", windows[2:]) == 0.0


@pytest.mark.parametrize(("missing", "rows"), [(0.5, 0.0), (0.0, 0.3)])
def test_noise_at_irregular_records(missing: float, rows: float) -> None:
    """Rows may be dropped only if no input changes in between, so the voltage is constant."""
    random, process = np.random.default_rng(21), (0.05, 0.3)
    changing = (4.0, 20.0) if not rows else (12.0, 12.0)
    whole = [window(random, index, process, changing) for index in range(30)]
    problem = replace(PROBLEM, window=replace(PROBLEM.window, sample_period=PERIOD))
    noise = identify_noise(problem, [thinned(random, item, missing, rows) for item in whole])
    assert levels(noise)[:2] == pytest.approx(SENSORS, rel=0.2)
    assert levels(noise)[2:] == pytest.approx(process, rel=0.2)


def test_windows_at_rest_identify_sensor_noise_only() -> None:
    noise = identified(5, 6, voltage=(0.0, 0.0))
    assert levels(noise)[:2] == pytest.approx(SENSORS, rel=0.1)
    assert [(level.value, level.sd, level.remark) for level in noise.states] == 2 * [(0.0, None, text.AT_REST)]
    assert noise.consistency.remark == text.NOT_COMPARABLE


def test_windows_at_rest_are_excluded_if_others_move() -> None:
    random = np.random.default_rng(6)
    moving = [window(random, index, process=(0.0, 0.3)) for index in range(10)]
    resting = [window(random, 10 + index, voltage=(0.0, 0.0)) for index in range(10)]
    noise = identify_noise(PROBLEM, [*moving, *resting])
    assert levels(noise)[[0, 1, 3]] == pytest.approx(levels(identify_noise(PROBLEM, moving))[[0, 1, 3]], rel=0.01)
    assert noise.remarks == (text.EXCLUDED_AT_REST.format(10, 20),)


def test_one_window_has_a_likelihood_but_no_consistency_test() -> None:
    noise = identified(7, 1, process=(0.0, 0.3))
    assert levels(noise)[[0, 1, 3]] == pytest.approx([*SENSORS, 0.3], rel=0.3)
    assert noise.consistency.remark == text.ONE_WINDOW
    assert noise.consistency.after is None


def test_levels_are_unchanged_without_a_usable_window() -> None:
    bad = Quality(Verdict.BAD, 1.0, 2.0, 0.0, 0.0, ("no samples of i",))
    whole = window(np.random.default_rng(8), 0)
    for windows in ([], [replace(whole, quality=bad)], [replace(whole, values=whole.values * np.nan)]):
        noise = identify_noise(PROBLEM, windows)
        assert noise.applied(PROBLEM).noise == PROBLEM.noise
        assert {level.remark for level in (*noise.outputs, *noise.states)} == {text.NO_WINDOW}
        assert noise.log_likelihood is None
        assert bool(noise.remarks) == bool(windows)


def test_gaps_and_an_output_that_is_never_measured() -> None:
    random = np.random.default_rng(9)
    windows = []
    for index in range(20):
        whole = window(random, index, process=(0.0, 0.3))
        missing, values = whole.missing.copy(), whole.values.copy()
        missing[random.random(RECORDS) < 0.1, 3] = True
        missing[:, 2] = True
        values[missing] = 99.0
        windows.append(replace(whole, missing=missing, values=values))
    noise = identify_noise(PROBLEM, windows)
    assert noise.outputs[0].remark == text.NEVER_MEASURED
    assert (noise.outputs[0].value, noise.outputs[0].sd) == (0.05, None)
    assert levels(noise)[[1, 3]] == pytest.approx([SENSORS[1], 0.3], rel=0.15)


def test_a_constant_output_is_not_identified() -> None:
    windows = []
    for index in range(3):
        whole = window(np.random.default_rng(10), index, voltage=(0.0, 0.0))
        values = whole.values.copy()
        values[:, 2] = 0.0
        windows.append(replace(whole, values=values))
    noise = identify_noise(PROBLEM, windows)
    assert (noise.outputs[0].value, noise.outputs[0].remark) == (0.05, text.CONSTANT)
    assert noise.outputs[1].value == pytest.approx(SENSORS[1], rel=0.15)


def test_inconsistent_windows_inflate_process_noise() -> None:
    """A slow unmeasured load beside fast process noise: the likelihood identifies the fast part only."""
    noise = identified(11, 16, process=(0.0, 0.3), hidden=0.002)
    consistency = noise.consistency
    assert consistency.remark == text.INFLATED
    assert consistency.before is not None
    assert consistency.after is not None
    assert consistency.factor is not None
    assert consistency.before > 2.0
    assert consistency.after == pytest.approx(1.0, abs=0.1)
    assert 1.3 < consistency.factor < 10.0
    assert noise.states[1].value > 0.4


def test_inconsistent_windows_without_process_noise_add_it() -> None:
    random = np.random.default_rng(12)
    windows = [window(random, index, R_a=6.5 + 0.1 * float(random.normal())) for index in range(12)]
    noise = identify_noise(PROBLEM, windows)
    assert noise.consistency.remark == text.ADDED
    assert noise.consistency.factor is None
    assert noise.consistency.after == pytest.approx(1.0, abs=0.1)
    assert (levels(noise)[2:] > 0.0).all()


def test_process_noise_is_enlarged_as_far_as_it_helps() -> None:
    """A slow load makes the damping scatter; the resistance differs between windows, which noise of the speed is not.

    So no factor makes the windows consistent, but the damping's interval holds the truth as often as it says.
    """
    random = np.random.default_rng(14)

    def windows(count: int) -> list[Window]:
        resistances = 6.5 + 0.003 * random.normal(size=count)
        return [window(random, at, (0.0, 0.3), hidden=0.006, R_a=float(value)) for at, value in enumerate(resistances)]

    noise = identify_noise(PROBLEM, windows(10))
    consistency = noise.consistency
    assert consistency.before is not None
    assert consistency.after is not None
    assert consistency.remark.startswith(text.PARTLY)
    assert 1.3 < consistency.after < 0.5 * consistency.before
    problem = noise.applied(PROBLEM)
    rows = [estimate(problem, own, initial_prior(problem), problem.nominal).parameters[1] for own in windows(20)]
    deviates = [(row.value - TRUTH["D"]) / row.sd for row in rows]
    assert np.mean(np.square(deviates)) < 2.0


def test_inconsistency_that_process_noise_cannot_explain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "otolith.commissioning.identification.observable_states",
        lambda twin: np.zeros(len(twin.states), dtype=np.bool_),
    )
    random = np.random.default_rng(13)
    windows = [window(random, index, R_a=6.5 + 0.1 * float(random.normal())) for index in range(4)]
    noise = identify_noise(PROBLEM, windows)
    assert noise.consistency.remark == text.NOT_INFLATED
    assert noise.consistency.after == noise.consistency.before
    assert (levels(noise)[2:] == 0.0).all()


@pytest.mark.parametrize("disturbed", [(4,), (0, 7)])
def test_a_few_windows_that_contradict_all_others_are_left_out(disturbed: tuple[int, ...]) -> None:
    """Somebody brakes the shaft in one or two of ten windows: that is not the noise of the others."""
    random = np.random.default_rng(31)
    windows = [window(random, index, D=0.02 if index in disturbed else TRUTH["D"]) for index in range(10)]
    noise = identify_noise(PROBLEM, windows)
    assert noise.windows == 10 - len(disturbed)
    assert levels(noise)[:2] == pytest.approx(SENSORS, rel=0.1)
    assert levels(noise)[2:] * np.sqrt(PERIOD) == pytest.approx(0.0, abs=0.05 * SENSORS.min())
    starts = ", ".join(time_text(2.0 * index) for index in disturbed)
    assert text.EXCLUDED_OUTLYING.format(len(disturbed), 10, starts) in noise.remarks


def test_a_third_of_the_windows_is_no_exception() -> None:
    random = np.random.default_rng(32)
    windows = [window(random, index, D=0.02 if index in {1, 4, 7} else TRUTH["D"]) for index in range(9)]
    noise = identify_noise(PROBLEM, windows)
    assert noise.windows >= 8
    assert (noise.consistency.factor or np.inf) > 1.0  # None if process noise was added


def test_observable_states_are_measured_or_driven() -> None:
    assert observable_states(TWIN).tolist() == [True, True]
    two_mass = find_twin("two_mass")
    names = [
        level.name
        for level, is_observable in zip(two_mass.states, observable_states(two_mass), strict=True)
        if is_observable
    ]
    assert names == ["omega_m", "omega_l"]  # the twist is neither measured nor driven


def test_noise_identification_is_deterministic() -> None:
    assert identified(14, 4) == identified(14, 4)


@pytest.mark.parametrize(
    ("name", "factor", "changes"), [("D", 1.3, (20,)), ("R_a", 1.1, (20,)), ("R_a", 1.1, (12, 26))]
)
def test_a_machine_that_changes_in_the_record_is_no_process_noise(
    name: str, factor: float, changes: tuple[int, ...]
) -> None:
    random, windows = np.random.default_rng(7), []
    for index in range(20):
        own = TRUTH[name] * (factor if sum(2 * index >= change for change in changes) % 2 else 1.0)
        windows.append(window(random, index, D=own) if name == "D" else window(random, index, R_a=own))
    noise = identify_noise(PROBLEM, windows)
    assert noise.consistency.remark == text.CONSISTENT
    assert noise.remarks == (text.CHANGED.format(", ".join(map(time_text, changes))),)
    assert levels(noise)[:2] == pytest.approx(SENSORS, rel=0.05)
    assert levels(noise)[2:] * np.sqrt(PERIOD) == pytest.approx(0.0, abs=0.05 * SENSORS.min())


def test_a_change_within_a_window_excludes_that_window() -> None:
    random = np.random.default_rng(8)
    windows = [window(random, index, R_a=(1.1 if index > 6 else 1.0) * TRUTH["R_a"]) for index in range(16)]
    windows[7] = window(random, 7, R_a=1.05 * TRUTH["R_a"], hidden=0.01)
    noise = identify_noise(PROBLEM, windows)
    assert text.EXCLUDED_OUTLYING.format(1, 16, time_text(14.0)) in noise.remarks
    assert noise.consistency.remark == text.CONSISTENT
    assert levels(noise)[2:] * np.sqrt(PERIOD) == pytest.approx(0.0, abs=0.1 * SENSORS.min())
