"""Noise that was put in is found again; what the windows do not show is said, and not made up."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.window import Array, Quality, Verdict, Window
from otolith.commissioning import identification as say
from otolith.commissioning.consistency import observable_states
from otolith.commissioning.identification import IdentifiedNoise, identify_noise
from otolith.estimation.problem import Problem
from otolith.machine import find_twin
from otolith.twin.kernel import Excitation, kernel_of

TWIN = find_twin("dc_motor")
TRUTH = {entry.name: entry.nominal for entry in TWIN.parameters}
SENSORS = np.array([0.005, 0.02])  # A, rad/s
PERIOD, RECORDS = 0.01, 200
FREE = ("R_a", "D")
PROBLEM = Problem(
    TWIN,
    known=tuple((name, value) for name, value in TRUTH.items() if name not in FREE),
    free=tuple(entry for entry in TWIN.parameters if entry.name in FREE),
    noise=(0.05, 0.01),  # what the machine file says is wrong both ways
)


def window(
    random: np.random.Generator,
    index: int,
    strays: Sequence[float] = (0.0, 0.0),
    voltage: tuple[float, float] = (4.0, 20.0),
    hidden: float = 0.0,
    **changed: float,
) -> Window:
    """Random voltage steps and a load that swings, from record to record with random kicks per square root of a second.

    ``hidden`` (N*m) is the size of a slow load that nobody measures; ``changed`` parameters are not as the twin has
    them.
    """
    times = PERIOD * np.arange(RECORDS)
    volts = np.repeat(random.uniform(*voltage, 4), RECORDS // 4)
    load = (0.05 + 0.03 * np.sin(random.uniform(1.0, 6.0) * times)) if volts.any() else np.zeros(RECORDS)
    slow = hidden * np.sin(random.uniform(0.5, 2.0) * times + random.uniform(0.0, 6.3))
    parameters = np.array([list((TRUTH | changed).values())])
    state = np.array([1.0, 10.0]) if volts.any() else np.zeros(2)
    outputs = np.zeros((RECORDS, 2))
    driven = np.column_stack([volts, load + slow])
    for record in range(RECORDS):
        outputs[record] = state
        piece = Excitation(driven[record : record + 2], PERIOD, 4)
        if record + 1 < RECORDS:
            state = kernel_of(TWIN).simulate(parameters, state[None], piece)[0, 1]
            state = state + np.array(strays) * np.sqrt(PERIOD) * random.normal(size=2)
    values = np.column_stack([volts, load, outputs + random.normal(size=outputs.shape) * SENSORS])
    return Window.whole(index, 2.0 * index, PERIOD, TWIN.signals, values)


def levels(found: IdentifiedNoise) -> Array:
    return np.array([entry.value for entry in (*found.outputs, *found.states)])


def learned(seed: int, count: int = 20, **options: object) -> IdentifiedNoise:
    random = np.random.default_rng(seed)
    return identify_noise(PROBLEM, [window(random, index, **options) for index in range(count)])  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(4))
def test_the_noise_of_sensors_is_found_and_no_other(seed: int) -> None:
    found = learned(seed)
    assert levels(found)[:2] == pytest.approx(SENSORS, rel=0.05)
    for entry, truth in zip(found.outputs, SENSORS, strict=True):
        assert entry.sd is not None
        assert abs(entry.value - truth) < 4.0 * entry.sd
    assert levels(found)[2:] * np.sqrt(PERIOD) == pytest.approx(0.0, abs=0.02 * SENSORS.min())


@pytest.mark.parametrize("strays", [(0.0, 0.3), (0.05, 0.0), (0.05, 0.3)])
@pytest.mark.parametrize("seed", range(2))
def test_process_noise_is_found_beside_that_of_sensors(strays: tuple[float, float], seed: int) -> None:
    found = learned(seed, 30, strays=strays)
    assert levels(found)[:2] == pytest.approx(SENSORS, rel=0.15)
    assert levels(found)[2:] == pytest.approx(strays, rel=0.15, abs=0.1 * np.sqrt(PERIOD) * SENSORS.min())
    assert found.consistency.factor == 1.0


def test_a_window_at_rest_teaches_the_noise_of_sensors_and_no_more() -> None:
    found = learned(5, 6, voltage=(0.0, 0.0))
    assert levels(found)[:2] == pytest.approx(SENSORS, rel=0.1)
    assert [(entry.value, entry.sd, entry.remark) for entry in found.states] == 2 * [(0.0, None, say.AT_REST)]
    assert found.consistency.remark == say.NOTHING_SHARED


def test_windows_at_rest_among_others_are_left_out() -> None:
    random = np.random.default_rng(6)
    moving = [window(random, index, strays=(0.0, 0.3)) for index in range(10)]
    resting = [window(random, 10 + index, voltage=(0.0, 0.0)) for index in range(10)]
    found = identify_noise(PROBLEM, [*moving, *resting])
    assert levels(found)[[0, 1, 3]] == pytest.approx(levels(identify_noise(PROBLEM, moving))[[0, 1, 3]], rel=0.01)
    assert found.remarks == (say.RESTING.format(10, 20),)


def test_one_window_is_enough_for_the_likelihood_but_agrees_with_nobody() -> None:
    found = learned(7, 1, strays=(0.0, 0.3))
    assert levels(found)[[0, 1, 3]] == pytest.approx([*SENSORS, 0.3], rel=0.3)
    assert found.consistency.remark == say.ALONE
    assert found.consistency.after is None


def test_without_a_usable_window_everything_stays_as_it_was() -> None:
    bad = Quality(Verdict.BAD, 1.0, 2.0, 0.0, 0.0, ("no samples of i",))
    whole = window(np.random.default_rng(8), 0)
    for windows in ([], [replace(whole, quality=bad)], [replace(whole, values=whole.values * np.nan)]):
        found = identify_noise(PROBLEM, windows)
        assert found.applied(PROBLEM).noise == PROBLEM.noise
        assert {entry.remark for entry in (*found.outputs, *found.states)} == {say.NO_WINDOW}
        assert found.log_likelihood is None
        assert bool(found.remarks) == bool(windows)


def test_gaps_do_no_harm_and_an_output_that_is_never_measured_is_named() -> None:
    random = np.random.default_rng(9)
    windows = []
    for index in range(20):
        whole = window(random, index, strays=(0.0, 0.3))
        missing, values = whole.missing.copy(), whole.values.copy()
        missing[random.random(RECORDS) < 0.1, 3] = True
        missing[:, 2] = True
        values[missing] = 99.0
        windows.append(replace(whole, missing=missing, values=values))
    found = identify_noise(PROBLEM, windows)
    assert found.outputs[0].remark == say.NEVER_MEASURED
    assert (found.outputs[0].value, found.outputs[0].sd) == (0.05, None)
    assert levels(found)[[1, 3]] == pytest.approx([SENSORS[1], 0.3], rel=0.15)


def test_an_output_that_never_changes_is_named() -> None:
    windows = []
    for index in range(3):
        whole = window(np.random.default_rng(10), index, voltage=(0.0, 0.0))
        values = whole.values.copy()
        values[:, 2] = 0.0
        windows.append(replace(whole, values=values))
    found = identify_noise(PROBLEM, windows)
    assert (found.outputs[0].value, found.outputs[0].remark) == (0.05, say.CONSTANT)
    assert found.outputs[1].value == pytest.approx(SENSORS[1], rel=0.15)


def test_windows_that_scatter_more_than_they_claim_get_more_process_noise() -> None:
    """A slow load that nobody measures, beside quick kicks: the likelihood sees the kicks."""
    found = learned(11, 16, strays=(0.0, 0.3), hidden=0.002)
    consistency = found.consistency
    assert consistency.remark == say.INFLATED
    assert consistency.before is not None
    assert consistency.after is not None
    assert consistency.factor is not None
    assert consistency.before > 2.0
    assert consistency.after == pytest.approx(1.0, abs=0.1)
    assert 1.3 < consistency.factor < 10.0
    assert found.states[1].value > 0.4


def test_where_no_window_shows_process_noise_itself_it_is_made_up_from_the_scatter_and_said() -> None:
    random = np.random.default_rng(12)
    windows = [window(random, index, R_a=6.5 + 0.1 * float(random.normal())) for index in range(12)]
    found = identify_noise(PROBLEM, windows)
    assert found.consistency.remark == say.FROM_NOTHING
    assert found.consistency.factor is None
    assert found.consistency.after == pytest.approx(1.0, abs=0.1)
    assert (levels(found)[2:] > 0.0).all()


def test_where_no_process_noise_helps_there_is_none_and_that_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "otolith.commissioning.identification.touched", lambda twin: np.zeros(len(twin.states), dtype=np.bool_)
    )
    random = np.random.default_rng(13)
    windows = [window(random, index, R_a=6.5 + 0.1 * float(random.normal())) for index in range(4)]
    found = identify_noise(PROBLEM, windows)
    assert found.consistency.remark == say.HELPLESS
    assert found.consistency.after == found.consistency.before
    assert (levels(found)[2:] == 0.0).all()


def test_what_is_measured_or_driven() -> None:
    assert observable_states(TWIN).tolist() == [True, True]
    two_mass = find_twin("two_mass")
    names = [
        entry.name for entry, is_touched in zip(two_mass.states, observable_states(two_mass), strict=True) if is_touched
    ]
    assert names == ["omega_m", "omega_l"]  # and not the twist between them


def test_the_same_windows_and_seed_give_the_same_bits() -> None:
    assert learned(14, 4) == learned(14, 4)
