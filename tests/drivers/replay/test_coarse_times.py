"""Rows of a coarse clock: regular ones are spread evenly, others keep their times."""

from collections.abc import Callable

import numpy as np
import pytest

from otolith_drivers.replay.cleaning import EvenTimes
from otolith_drivers.replay.readers import Array, Rows

ROWS = 6000
SEED = 5


def signals(times: Array, random: np.random.Generator) -> dict[str, Array]:
    """A command that is held for 0.2 s, and a measured quantity with noise."""
    command = np.floor(times / 0.2) % 7.0
    return {"u": command, "y": np.sin(3.0 * times) + 0.01 * random.normal(size=len(times))}


def rows_at(times: Array, columns: dict[str, Array]) -> Rows:
    lines = np.arange(2, len(times) + 2)
    return Rows(times, columns, lines, np.zeros(len(times), dtype=np.int64))


def spread(rows: Rows, size: int = ROWS) -> tuple[Array, EvenTimes]:
    clock = EvenTimes()
    parts = [
        part for first in range(0, len(rows.times), size) for part in clock.of(rows.part(slice(first, first + size)))
    ]
    parts += clock.rest()
    assert np.concatenate([part.lines for part in parts]).tolist() == rows.lines.tolist()
    return np.concatenate([part.times for part in parts]), clock


def regular(interval: float) -> tuple[Array, dict[str, Array]]:
    times = 3.0 + interval * np.arange(ROWS, dtype=np.float64)
    return times, signals(times, np.random.default_rng(SEED))


STEPS: dict[str, tuple[float, Callable[[Array], Array]]] = {
    "ten rows per step": (0.01, lambda times: np.floor(times / 0.1 + 1e-6) * 0.1),
    "rounded to the nearest step": (0.01, lambda times: np.rint(times / 0.05) * 0.05),
    "clock of a PC": (0.01, lambda times: np.floor(times / 0.015625 + 1e-6) * 0.015625),
    "clock of a PC, in milliseconds": (0.0107, lambda times: np.round(np.floor(times / 0.015625) * 0.015625, 3)),
    "whole seconds": (0.01, np.floor),
    "Unix time in seconds": (0.0107, lambda times: np.floor(times) + 1.7e9),
}


@pytest.mark.parametrize("name", STEPS)
def test_rows_of_a_coarse_clock_are_spread_evenly(name: str) -> None:
    """All rows are off by one and the same time, which no estimate depends on."""
    interval, coarse = STEPS[name]
    times, columns = regular(interval)
    even, clock = spread(rows_at(coarse(times), columns))
    off = even - times
    assert np.ptp(off) < 0.25 * interval
    assert np.ptp(np.diff(even)) < 0.3 * interval
    assert (clock.text() or "").startswith(
        f"rows of a coarse clock: {ROWS} were spread evenly; from line 2 on t has steps"
    )


ROUNDED: dict[str, tuple[float, float]] = {
    "3.5 ms in ms": (0.0035, 0.001),
    "300 Hz in ms": (1.0 / 300.0, 0.001),
    "60 Hz in ms": (1.0 / 60.0, 0.001),
    "10.7 ms in 10 ms": (0.0107, 0.01),
    "clock of a PC": (0.02, 0.015625),
}


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("name", ROUNDED)
def test_times_rounded_to_steps_below_the_interval_are_spread_evenly(name: str, start: float) -> None:
    """Half a millisecond of a step of 10 V is more than the noise of a current."""
    interval, step = ROUNDED[name]
    times, columns = regular(interval)
    even, clock = spread(rows_at(np.rint(times / step) * step + start, columns))
    off = even - start - times
    assert np.ptp(off) < 0.1 * step
    assert f"t has steps of {1e3 * step:.4g} ms, but a row comes every" in (clock.text() or "")


@pytest.mark.parametrize("kind", ["two intervals at random", "about a clock", "rows missing", "on the grid"])
def test_times_that_no_regular_clock_rounds_are_kept(kind: str) -> None:
    random = np.random.default_rng(SEED)
    times: Array = 0.01 * np.arange(ROWS, dtype=np.float64)
    match kind:
        case "two intervals at random":
            times = np.asarray(np.cumsum(random.choice([0.015, 0.016], ROWS)))
        case "about a clock":
            times = np.round(times + random.uniform(-0.002, 0.002, ROWS), 3)
        case "rows missing":
            times = times[random.uniform(size=ROWS) > 0.05]
    even, clock = spread(rows_at(times, signals(times, random)), len(times))
    assert even.tolist() == times.tolist()
    assert clock.text() is None


@pytest.mark.parametrize("lost", [(600,), (300, 301, 1100), (150, 400, 1000, 1900, 3500)])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_a_few_lost_rows_are_no_coarse_clock(start: float, lost: tuple[int, ...]) -> None:
    times, _ = regular(0.01)
    times = np.round(np.delete(times, lost) + start, 3)
    even, clock = spread(rows_at(times, signals(times, np.random.default_rng(SEED))))
    assert even.tolist() == times.tolist()
    assert clock.text() is None


@pytest.mark.parametrize("offset", [0.00348, 0.01 / 3.0, 0.005, 0.008])
def test_signals_that_come_in_turn_keep_their_times(offset: float) -> None:
    """Rows of two signals with one interval alternate: theirs are two intervals, as those of rounded times."""
    times = (3.0 + 0.01 * np.arange(ROWS // 2)[:, np.newaxis] + np.array([0.0, offset])).ravel()
    columns = signals(times, np.random.default_rng(SEED))
    columns["u"][1::2] = columns["y"][::2] = np.nan
    even, clock = spread(rows_at(times, columns))
    assert even.tolist() == times.tolist()
    assert clock.text() is None


def test_rounded_times_with_missing_rows_are_spread_between_them() -> None:
    times, _ = regular(0.0035)
    times = times[np.random.default_rng(SEED).uniform(size=ROWS) > 0.001]
    columns = signals(times, np.random.default_rng(SEED))
    even, _ = spread(rows_at(np.floor(times / 0.001 + 1e-6) * 0.001, columns), len(times))
    assert np.mean(np.abs(even - times - np.median(even - times)) < 0.0003) > 0.95


def test_the_result_does_not_depend_on_chunks() -> None:
    times, columns = regular(0.01)
    rows = rows_at(np.floor(times / 0.1 + 1e-6) * 0.1, columns)
    whole, _ = spread(rows)
    for size in (1, 7, 2048, 2500):
        assert spread(rows, size)[0].tolist() == whole.tolist()


@pytest.mark.parametrize("step", [0.015625, 0.1])
@pytest.mark.parametrize("kind", ["random intervals", "about a clock"])
def test_irregular_rows_keep_their_times(step: float, kind: str) -> None:
    random = np.random.default_rng(SEED)
    times = np.cumsum(random.uniform(0.005, 0.015, ROWS))
    if kind == "about a clock":
        times = np.sort(0.01 * np.arange(1, ROWS + 1) + random.uniform(-0.005, 0.005, ROWS))
    coarse = np.floor(times / step) * step
    even, clock = spread(rows_at(coarse, signals(times, random)))
    assert np.mean(even != coarse) < 0.1
    assert clock.text() is None or step > 0.05


def test_times_of_their_own_are_kept() -> None:
    times = np.cumsum(np.random.default_rng(SEED).uniform(0.005, 0.015, ROWS))
    even, clock = spread(rows_at(times, signals(times, np.random.default_rng(SEED))))
    assert even.tolist() == times.tolist()
    assert clock.text() is None


def test_rows_written_twice_keep_their_times() -> None:
    times, columns = regular(0.01)
    twice = rows_at(np.repeat(times, 2), {name: np.repeat(values, 2) for name, values in columns.items()})
    assert spread(twice)[0].tolist() == twice.times.tolist()


def test_a_few_rows_at_one_time_keep_it() -> None:
    times, columns = regular(0.01)
    times[500::200] = times[499:-1:200]
    even, clock = spread(rows_at(times, columns))
    assert even.tolist() == times.tolist()
    assert clock.text() is None


@pytest.mark.parametrize("other", ["a second machine", "a second reading"])
def test_two_machines_or_rows_recorded_twice_are_not_spread(other: str) -> None:
    """Their times are right, so even ones would be wrong."""
    times, columns = regular(0.02)
    random = np.random.default_rng(SEED + 1)
    second = signals(times + (7.3 if other == "a second machine" else 0.0), random)
    both = {name: np.column_stack([columns[name], second[name]]).ravel() for name in columns}
    rows = rows_at(np.repeat(times, 2), both)
    even, clock = spread(rows)
    assert even.tolist() == rows.times.tolist()
    assert clock.text() is None


def test_rows_after_a_gap_are_spread_anew() -> None:
    times, columns = regular(0.01)
    times[3005:] += 40.0
    coarse = np.floor(times / 0.1 + 1e-6) * 0.1
    even, _ = spread(rows_at(coarse, columns))
    off = even - times
    assert np.ptp(off[:3005]) < 1e-6
    assert np.ptp(off[3005:]) < 1e-6
    assert np.abs(off - off[0]).max() < 0.1


def test_numbers_beyond_reason_are_no_error() -> None:
    times = np.repeat(np.arange(600.0), 10)
    values = np.where(np.arange(ROWS) % 3 == 0, 1e308, -1e308)
    values[::7] = np.nan
    even, _ = spread(rows_at(times, {"u": np.full(ROWS, np.nan), "y": values}))
    assert np.isfinite(even).all()
