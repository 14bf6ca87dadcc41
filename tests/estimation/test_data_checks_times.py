"""Spikes and repeated records among samples at times of their own, some of them missing."""

from dataclasses import replace

import numpy as np
import pytest

from otolith.acquisition.samples import Check
from otolith.acquisition.window import Array, TimeGrid, Window
from otolith.estimation.data_checks import check_window, drop_repeats, drop_spikes, repeated_records, spike_records
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

TWIN = find_twin("dc_motor")
NOISE = (0.005, 0.02)
SENSORS = np.isin(TWIN.signals, ["i", "omega"])
RECORDS, PERIOD = 200, 0.01
LENGTH = RECORDS * PERIOD
UNIFORM = PERIOD * np.arange(RECORDS, dtype=np.float64)
SPIKES = [40, 121]


def curve(times: Array) -> Array:
    """A current with the kink of a voltage step, in A."""
    return 1.0 + 0.3 * np.sin(5.0 * times) + np.where(times > 1.0, 0.5 * -np.expm1(-20.0 * (times - 1.0)), 0.0)


def window_at(times: Array, seed: int) -> Window:
    """A window of the curve in every signal, sampled at ``times``."""
    random = np.random.default_rng(seed)
    values = np.column_stack([curve(times) + level * random.normal(size=len(times)) for level in (0.0, 1e-3, *NOISE)])
    uniform = Window.whole(0, 0.0, PERIOD, ("V_a", "T_load", "i", "omega"), values)
    return replace(uniform, grid=TimeGrid.at(times - times[0], LENGTH))


def random_times(seed: int) -> Array:
    """Times with as much jitter as order allows, and gaps: 30 % of the samples are lost."""
    random = np.random.default_rng(seed)
    times = PERIOD * (np.arange(RECORDS) + random.uniform(0.0, 0.9, RECORDS))
    return np.asarray(times[np.sort(random.choice(RECORDS, 140, replace=False))])


@pytest.mark.parametrize("seed", range(20))
def test_irregular_times_and_gaps_are_no_spikes(seed: int) -> None:
    for level in (0.0, 1e-4, 5e-3):
        times = random_times(seed)
        values = curve(times) + level * np.random.default_rng(seed).normal(size=len(times))
        assert not spike_records(values, level, times).any()
        assert not spike_records(np.maximum(times - 1.0, 0.0) * 50.0, level, times).any()


@pytest.mark.parametrize("seed", range(20))
def test_spikes_at_irregular_times_are_excluded_and_counted(seed: int) -> None:
    window = window_at(random_times(seed), seed)
    values = window.values.copy()
    values[[40, 90], 2] += [2.0, -5.0]
    cleaned, notes, faulty = drop_spikes(replace(window, values=values), TWIN, NOISE)
    assert np.flatnonzero(cleaned.missing_in("i")).tolist() == [40, 90]
    assert (notes, faulty) == (["i has 2 spikes, left out"], [])
    assert np.abs(cleaned.column("i") - window.column("i")).max() < 0.2


@pytest.mark.parametrize("kept", [2, 3])
def test_values_where_nothing_was_measured_are_not_looked_at(kept: int) -> None:
    """Spikes between samples are no measurements; spikes of samples are found although no record is beside them."""
    window = window_at(UNIFORM, 1)
    window = replace(window, grid=TimeGrid.uniform(RECORDS, PERIOD))
    missing, values = window.missing.copy(), window.values.copy()
    missing[:, 2] = np.arange(RECORDS) % kept != 0
    values[missing[:, 2], 2] = 99.0
    assert drop_spikes(replace(window, values=values, missing=missing), TWIN, NOISE)[1] == []
    values[30 * kept, 2] += 3.0
    cleaned, notes, _ = drop_spikes(replace(window, values=values, missing=missing), TWIN, NOISE)
    assert notes == ["i has 1 spike, left out"]
    assert np.flatnonzero(cleaned.missing_in("i") & ~missing[:, 2]).tolist() == [30 * kept]


def test_share_of_spikes_is_that_of_the_samples() -> None:
    """Five spikes are too many among forty samples, but not among two hundred."""
    window = replace(window_at(UNIFORM, 1), grid=TimeGrid.uniform(RECORDS, PERIOD))
    values, missing = window.values.copy(), window.missing.copy()
    values[20:180:35, 2] += 3.0
    assert drop_spikes(replace(window, values=values), TWIN, NOISE)[2] == []
    missing[:, 2] = np.arange(RECORDS) % 5 != 0
    (sensor,) = drop_spikes(replace(window, values=values, missing=missing), TWIN, NOISE)[2]
    assert sensor.signal == "i"
    assert "i spikes in 5 of 40 records" in sensor.text
    assert 'checks = ["frozen", "stale"]' in sensor.setting


def test_measured_input_is_bridged_from_the_samples_beside_a_spike() -> None:
    """The values between a spike and its neighbours come from the spike: they are bridged again."""
    window = replace(window_at(UNIFORM, 1), grid=TimeGrid.uniform(RECORDS, PERIOD))
    present = np.arange(0, RECORDS, 4)
    samples = window.column("T_load")[present].copy()
    samples[20] += 5.0
    values, missing = window.values.copy(), window.missing.copy()
    values[:, 1] = np.interp(np.arange(RECORDS), present, samples)
    missing[:, 1] = True
    missing[present, 1] = False
    cleaned, notes, _ = drop_spikes(replace(window, values=values, missing=missing), TWIN, NOISE)
    assert notes == ["T_load has 1 spike, left out"]
    assert np.abs(cleaned.column("T_load") - window.column("T_load")).max() < 0.2


@pytest.mark.parametrize("check", list(Check))
def test_each_check_is_turned_off_for_one_signal(check: Check) -> None:
    """The current has spikes, and half of the window repeats one image. A check that is off leaves its records."""
    window = replace(window_at(UNIFORM, 1), grid=TimeGrid.uniform(RECORDS, PERIOD))
    values = window.values.copy()
    values[SPIKES, 2] += 2.0
    values[160:190] = values[160]
    off = frozenset({("i", check), ("i", Check.FROZEN), ("omega", Check.FROZEN)})
    known = tuple((each.name, each.nominal) for each in TWIN.parameters if each.name != "R_a")
    free = tuple(each for each in TWIN.parameters if each.name == "R_a")
    posterior = Posterior.initial(Problem(TWIN, known, free, NOISE, unchecked=off))
    checked = check_window(replace(window, values=values), posterior)
    missing = np.flatnonzero(checked.window.missing_in("i")).tolist()
    expected = [] if check is Check.SPIKES else SPIKES
    assert missing == [*expected, *([] if check is Check.STALE else range(161, 189))]
    assert np.flatnonzero(checked.window.missing_in("omega")).tolist() == list(range(161, 189))


def test_records_that_are_no_images_do_not_count_as_repeats() -> None:
    """A record that lacks a sensor ends a run if it shows a change, and is no part of it otherwise."""
    random = np.random.default_rng(4)
    values = random.normal(size=(100, 4))
    values[20:60] = values[20]
    window = Window.whole(0, 0.0, PERIOD, ("V_a", "T_load", "i", "omega"), values)
    missing = window.missing.copy()
    missing[20:60:2, 3] = True
    values[20:60:2, 3] = 5.0  # no measurement
    values[20, 3] = values[21, 3]
    missing[20, 3] = False
    sparse = replace(window, values=values, missing=missing)
    assert np.flatnonzero(repeated_records(sparse, SENSORS)).tolist() == list(range(21, 58, 2))
    changed = values.copy()
    changed[40, 2] += 1.0  # measured, although the other sensor is not
    counted = np.flatnonzero(repeated_records(replace(sparse, values=changed), SENSORS))
    assert 39 not in counted
    missing[20:60, 3] = True
    assert drop_repeats(replace(sparse, missing=missing), TWIN)[1] == []
