"""Sentinels and numbers beyond a stated range are left out of a table; no ordinary signal loses a sample."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.base import Setup, Signal
from otolith_drivers.replay.cleaning import NoReadings, is_sentinel_number
from otolith_drivers.replay.readers import Array, Reader
from otolith_drivers.replay.table.options import TableSource
from otolith_drivers.replay.table.reader import TableReader, open_log
from tests.messages import assert_each_says, assert_says

SENTINELS = [-999.0, -9999.0, 9999.9, -999.25, 32767.0, -32768.0, 65535.0, 2147483647.0, 1e30, -9.969e36]
PWM, SUPPLY = (0.0, 65535.0), (-24.0, 24.0)


def motion(rows: int = 400, seed: int = 0) -> Array:
    """A speed about 20, with noise of its sensor."""
    noise = np.random.default_rng(seed).normal(0.0, 0.1, rows)
    return np.asarray(20.0 + 15.0 * np.sin(np.arange(rows) / 30.0) + noise)


@pytest.mark.parametrize("sentinel", SENTINELS)
def test_sentinels_of_a_measurement_are_counted_and_named(sentinel: float) -> None:
    values, at = motion(), np.array([3, 50, 51, 52, 399])
    values[at] = sentinel
    column = NoReadings()
    assert np.flatnonzero(column.among(values)).tolist() == at.tolist()
    (line,) = column.warnings("omega")
    assert f"omega: {sentinel:.12g} in 5 cells is no reading" in line
    assert "omega = { range = [lowest, highest] }" in line


@pytest.mark.parametrize("sentinel", SENTINELS)
def test_sentinels_of_a_command_are_those_far_from_its_ordinary_range(sentinel: float) -> None:
    values = np.where(np.arange(400) // 50 % 2, 24.0, 0.0)
    values[100:105] = sentinel
    assert np.flatnonzero(NoReadings(ordinary=SUPPLY).among(values)).tolist() == [100, 101, 102, 103, 104]


def test_several_sentinels_in_one_column_also_where_nothing_else_comes() -> None:
    column, values = NoReadings(), motion()
    values[10], values[20], values[30] = -9999.0, 32767.0, 65535.0
    assert np.flatnonzero(column.among(values)).tolist() == [10, 20, 30]
    assert column.among(np.full(50, -9999.0)).all()
    assert [line.split()[1] for line in column.warnings("i")] == ["-9999", "32767", "65535"]


def test_a_stated_range_replaces_the_search_for_sentinels() -> None:
    values = motion()
    values[10], values[20] = -9999.0, 36.0
    column = NoReadings(stated=(-1e4, 35.5))
    assert np.flatnonzero(column.among(values)).tolist() == [20]
    assert_each_says(column.warnings("i"), ("i: ", "1 cell", "[-10000.0, 35.5]", "left out"))


def blanks(reader: Reader, name: str) -> list[int]:
    """Rows without a value."""
    return np.flatnonzero(np.isnan(np.concatenate([rows.columns[name] for rows in reader.chunks()]))).tolist()


@st.composite
def ordinary_signals(draw: st.DrawFn) -> tuple[Array, tuple[float, float] | None]:
    """A signal with the ordinary range of an input, or None for an output."""
    rng, rows = np.random.default_rng(draw(st.integers(0, 2**32 - 1))), draw(st.integers(1, 300))
    number = draw(st.sampled_from([abs(value) for value in SENTINELS[:8]]) | st.floats(-1e6, 1e6))
    kind = draw(st.sampled_from(["constant", "levels", "encoder", "duty", "counts", "saturated", "integrator"]))
    if kind == "constant":
        return np.full(rows, number), draw(st.none() | st.just(SUPPLY) | st.just(PWM))
    if kind == "levels":
        levels = np.array([number, *draw(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=4))])
        return rng.choice(levels, rows), draw(st.none() | st.just((float(levels.min()), float(levels.max()))))
    if kind == "duty":
        levels = np.array([65535, *draw(st.lists(st.integers(0, 65535), min_size=1, max_size=40))])
        return rng.choice(levels, rows).astype(np.float64), draw(st.sampled_from([PWM, (-np.inf, np.inf)]))
    step = draw(st.floats(1e-3, 10.0))
    moved = np.cumsum(rng.normal(0.0, draw(st.floats(0.0, 50.0)), rows))
    if kind == "encoder":
        return step * np.rint((number + moved) / step), draw(st.none() | st.just((-np.inf, np.inf)))
    if kind == "counts":  # up to the largest integer and back
        way = np.concatenate([np.arange(0, rows), np.arange(rows, -1, -1)])
        return 65535.0 - step * np.abs(way - way.max()), None
    if kind == "saturated":
        return np.clip(65000.0 + 20.0 * np.abs(moved), 0.0, 65535.0), None
    return number + moved, None


@settings(max_examples=600, deadline=None)
@given(ordinary_signals(), st.integers(1, 300))
def test_no_ordinary_signal_loses_a_sample(signal: tuple[Array, tuple[float, float] | None], part: int) -> None:
    values, ordinary = signal
    column = NoReadings(ordinary=ordinary)
    assert not any(column.among(values[at : at + part]).any() for at in range(0, len(values), part))
    assert column.warnings("x") == []


@given(st.lists(st.floats(), max_size=300), st.none() | st.just(SUPPLY))
def test_any_numbers_are_judged(numbers: list[float], ordinary: tuple[float, float] | None) -> None:
    refused = NoReadings(ordinary=ordinary).among(np.array(numbers))
    assert all(is_sentinel_number(number) for number in np.array(numbers)[refused].tolist())


def test_a_table_has_neither_sentinels_nor_numbers_beyond_a_range(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    speed, volts = [f"{value:.3f}" for value in motion()], ["24000"] * 400
    speed[7], speed[9], volts[8] = "-9999", "80", "-9999999"
    rows = [f"{row / 100},{a},{b}" for row, (a, b) in enumerate(zip(speed, volts, strict=True))]
    path.write_text("\n".join(["t,n [rpm],u [mV]", *rows]) + "\n", encoding="utf-8")
    signals = (
        Signal("omega", "rad/s", TableSource(column="n", range=(-50.0, 50.0))),
        Signal("V_a", "V", TableSource(column="u"), SUPPLY),
    )
    with open_log(path, Setup(signals, tmp_path, 0.01)) as reader:
        assert blanks(reader, "omega") == [7, 9]
    omega, voltage = reader.warnings()
    assert_says(omega, "omega", "2 cells", "[-50.0, 50.0]", "left out")
    assert "V_a: -9999999 in 1 cell is no reading" in voltage
    assert reader.bad == 0
    with TableReader(path, {"omega": "rad/s"}, {"omega": TableSource(column="n")}) as reader:
        assert blanks(reader, "omega") == [7]


def test_the_lower_end_of_a_range_comes_first() -> None:
    with pytest.raises(ValueError, match="the lower end comes first"):
        TableSource(range=(1.0, -1.0))
