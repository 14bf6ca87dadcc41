"""Windows follow one another without gap or overlap, and rings count lost samples."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.quality import QualityLimits
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Verdict, Window
from otolith.acquisition.windower import GRACE_PERIOD, Windower
from otolith_drivers.base import Sample, Sampling
from tests.acquisition.series import cut_next, ramp
from tests.messages import assert_each_says
from tests.variants import often

PERIOD, RECORDS = 0.01, 50
LIMITS = QualityLimits(missing=0.05, gap=0.05)


def plans(*names: str, sampling: Sampling = Sampling.CYCLIC) -> tuple[SignalPlan, ...]:
    return tuple(SignalPlan(name, sampling=sampling) for name in names)


CYCLIC = plans("a", "b")


def feed(rings: Rings, samples: list[tuple[float, float]]) -> None:
    for time, value in samples:
        rings.deliver([Sample("a", time, value), Sample("b", time + 0.0005, -value)])


def cut_all(rings: Rings, samples: list[tuple[float, float]], *, until: float) -> list[Window]:
    """Feed samples at their times and cut whatever is due, as the service does."""
    windower = Windower(CYCLIC, RECORDS, PERIOD, LIMITS)
    windows, now, queue = [], 0.0, list(samples)
    while now < until:
        arrived = [sample for sample in queue if sample[0] <= now]
        queue = queue[len(arrived) :]
        feed(rings, arrived)
        if windower.begin(rings, now, now):
            while windower.due(rings, now):
                windows.append(cut_next(windower, rings, offset=1000.0))
        now += 0.004
    return windows


def test_every_sample_is_in_exactly_one_window() -> None:
    random = np.random.default_rng(3)
    samples = [(0.1 + index * PERIOD + random.uniform(0, 0.002), float(index)) for index in range(1000)]
    windows = cut_all(Rings(("a", "b"), 400), samples, until=10.3)
    assert len(windows) == 20
    assert np.array_equal(np.concatenate([window.column("a") for window in windows]), np.arange(1000.0))
    assert all(window.quality.verdict is Verdict.GOOD for window in windows)
    for before, after in pairwise(windows):
        assert after.start == pytest.approx(before.end, abs=PERIOD / 4)


@pytest.mark.parametrize("off_grid", [0.0, 0.0015])
@pytest.mark.parametrize("repeated", [False, True])
def test_signals_that_come_together_have_the_samples_that_each_has_alone(off_grid: float, repeated: bool) -> None:
    random, names = np.random.default_rng(5), ("a", "b", "c")
    moments = 0.1 + PERIOD * np.arange(4.0 * RECORDS) + off_grid * random.uniform(size=4 * RECORDS)
    moments = np.sort(np.concatenate([moments, moments[70:75]])) if repeated else moments
    samples = [Sample(name, time, float(random.normal())) for time in moments.tolist() for name in names]
    aligned = {}
    for group in (names, *((name,) for name in names)):
        rings, windower = Rings(group, 8 * RECORDS), Windower(plans(*group, sampling=Sampling.TRUE), RECORDS, PERIOD)
        rings.deliver([sample for sample in samples if sample.signal in group])
        assert windower.begin(rings, 0.0, 0.0)
        aligned[group] = [windower.take(rings, 0.0).samples for _ in range(3)]
    for name in names:
        for together, alone in zip(aligned[names], aligned[name,], strict=True):
            assert np.array_equal(together.series[name].times, alone.series[name].times)
            assert np.array_equal(together.series[name].values, alone.series[name].values)
            assert (name in together.cyclic) == (name in alone.cyclic) == (not off_grid)


@pytest.mark.parametrize("drift", often([-2e-3, 2e-4], [-2e-3, -2e-4, 2e-4, 2e-3]))
def test_the_grid_follows_a_source_with_clock_drift(drift: float) -> None:
    samples = [(0.1 + index * PERIOD * (1 + drift), float(index)) for index in range(6000)]
    windows = cut_all(Rings(("a", "b"), 400), samples, until=60.0)
    values = np.concatenate([window.column("a") for window in windows])
    assert np.array_equal(values, np.arange(float(len(values))))
    assert all(window.quality.verdict is Verdict.GOOD for window in windows)


def test_a_burst_across_two_windows_returns_to_its_slots() -> None:
    """The computer stalls for 60 ms around the end of the third window."""
    end = 0.1 + 3 * RECORDS * PERIOD
    moments = [0.1 + index * PERIOD for index in range(300)]
    samples = [(end + 0.03 if end - 0.03 < t < end + 0.03 else t, float(k)) for k, t in enumerate(moments)]
    windows = cut_all(Rings(("a", "b"), 400), samples, until=3.3)
    values = np.concatenate([window.column("a") for window in windows])
    assert np.array_equal(values, np.arange(float(len(values))))


def test_a_late_first_sample_does_not_shift_the_first_window() -> None:
    samples = [(0.1 + index * PERIOD + (0.004 if index == 0 else 0.0), float(index)) for index in range(300)]
    first, second, *_ = cut_all(Rings(("a", "b"), 400), samples, until=3.2)
    assert first.start == pytest.approx(1000.1, abs=0.001)
    assert second.start == pytest.approx(first.end, abs=1e-3)


def test_a_complete_window_is_due_at_once() -> None:
    rings = Rings(("a", "b"), 400)
    windower = Windower(CYCLIC, RECORDS, PERIOD, LIMITS)
    feed(rings, [(index * PERIOD, 1.0) for index in range(RECORDS + 1)])
    assert windower.begin(rings, 0.5, 0.5)
    assert windower.due(rings, windower.next_end)


def test_windows_are_bad_during_an_outage_and_good_after() -> None:
    samples = [(index * PERIOD, 1.0) for index in range(600) if not 200 <= index < 350]
    windows = cut_all(Rings(("a", "b"), 400), samples, until=6.2)
    verdicts = [window.quality.verdict for window in windows]
    assert verdicts[:4] == [Verdict.GOOD] * 4
    assert verdicts[4:7] == [Verdict.BAD] * 3
    assert verdicts[7:11] == [Verdict.GOOD] * 4
    assert_each_says(windows[5].quality.reasons, ("a, b", "1002.50 s", "0.5 s", "source", "[signals]"))


def test_a_silent_machine_gives_bad_windows() -> None:
    windows = cut_all(Rings(("a", "b"), 400), [], until=2.0)
    assert len(windows) >= 2
    assert {window.quality.verdict for window in windows} == {Verdict.BAD}


def test_the_reason_names_an_input_that_never_comes() -> None:
    """An output that never comes costs no window: the others are measured. An input that never comes is unknown."""
    for hold, reason in ((None, ""), ("zoh", "no samples of c from t = 0.5 s for 0.5 s"), ("foh", "no samples of c")):
        rings = Rings(("a", "b", "c"), 400)
        windower = Windower((*CYCLIC, SignalPlan("c", hold, Sampling.CYCLIC)), RECORDS, PERIOD)
        feed(rings, [(index * PERIOD, 1.0) for index in range(100)])
        assert not windower.begin(rings, 0.4, 0.4)
        assert windower.begin(rings, 1.0, 1.0)
        quality = cut_next(windower, rings).quality
        assert quality.verdict is (Verdict.BAD if hold else Verdict.GOOD)
        assert "; ".join(quality.reasons).startswith(reason)


def test_an_incomplete_window_is_due_after_the_grace_period() -> None:
    rings = Rings(("a", "b"), 400)
    windower = Windower(CYCLIC, RECORDS, PERIOD, LIMITS)
    feed(rings, [(index * PERIOD, 1.0) for index in range(RECORDS - 3)])
    assert windower.begin(rings, 0.48, 0.48)
    assert not windower.due(rings, windower.next_end + 0.9 * GRACE_PERIOD)
    assert windower.due(rings, windower.next_end + GRACE_PERIOD)
    windower.latency = 0.5  # of a source that sends its samples twice a second
    assert not windower.due(rings, windower.next_end + 0.5 + 0.9 * GRACE_PERIOD)
    assert windower.due(rings, windower.next_end + 0.5 + GRACE_PERIOD)


def test_the_gap_limit_returns_with_the_fine_grid() -> None:
    windower, rings = Windower(CYCLIC, RECORDS, PERIOD, LIMITS), Rings(("a", "b"), 400)
    windower.regrid(RECORDS, 1.0)
    windower.regrid(RECORDS, PERIOD)
    feed(rings, [(index * PERIOD, 1.0) for index in range(2 * RECORDS) if not 20 <= index < 40])
    assert windower.begin(rings, 1.0, 1.0)
    reasons = cut_next(windower, rings).quality.reasons
    assert "b has no sample for 0.2 s from t = 0.2 s, longer than gap_limit (0.05 s)" in reasons or (
        "a has no sample for 0.2 s from t = 0.2 s, longer than gap_limit (0.05 s)" in reasons
    )


def test_a_sample_without_a_reading_is_not_counted() -> None:
    """The driver counts it as bad."""
    rings = Rings(("a",), 100)
    rings.deliver([Sample("a", 0.0, 1.0), Sample("a", 0.1, float("nan"))])
    rings.deliver_columns({"a": (np.array([0.2, 0.3]), np.array([np.nan, 1.0]))})
    assert rings.counters().received == 2


def test_rings_are_bounded_and_count_overwritten_samples() -> None:
    rings = Rings(("a",), 100)
    rings.deliver([Sample("a", float(index), 0.0) for index in range(130)])
    rings.deliver([Sample("x", 0.0, 0.0)])
    counters = rings.counters()
    assert (counters.received, counters.overwritten, counters.unknown) == (130, 30, 1)
    times, _ = rings.around("a", 0.0, 1000.0, 1000.0)
    assert len(times) == 100
    rings.deliver([Sample("a", 200.0, 0.0)])
    assert rings.counters().overwritten == 30  # samples that were read are not lost


@given(
    st.lists(st.lists(st.floats(-10.0, 10.0), max_size=30), max_size=10),
    st.integers(1, 12),
    st.lists(st.floats(-10.0, 10.0), max_size=10),
)
def test_deliver_columns_equals_deliver(parts: list[list[float]], capacity: int, reads: list[float]) -> None:
    one_by_one, at_once = Rings(("a",), capacity), Rings(("a",), capacity)
    for index, part in enumerate(parts):
        one_by_one.deliver([Sample(name, time, 2.0 * time) for time in part for name in ("a", "x")])
        columns = np.array(part), 2.0 * np.array(part)
        at_once.deliver_columns({"a": columns, "x": columns})
        for rings in (one_by_one, at_once):
            end = reads[index % len(reads)] if reads else -10.0
            rings.around("a", -10.0, end, end)
        assert one_by_one.counters() == at_once.counters()
        assert one_by_one.last_times() == at_once.last_times()
    assert np.array_equal(one_by_one.around("a", -20.0, 20.0, 0.0), at_once.around("a", -20.0, 20.0, 0.0))


def test_a_window_waits_for_a_delayed_signal() -> None:
    """A signal that is late by more than the grace period is complete in every window."""
    delay, rings = 0.35, Rings(("a", "b"), 400)
    windower = Windower((CYCLIC[0], SignalPlan("b", sampling=Sampling.TRUE, delay=delay)), RECORDS, PERIOD)
    windows = list[Window]()
    for now in np.arange(0.0, 4.0, 0.005):
        rings.deliver([Sample("a", now, now), Sample("b", now, now - delay)] if round(now / 0.005) % 2 == 0 else [])
        while windower.begin(rings, now, now) and windower.due(rings, now):
            windows.append(cut_next(windower, rings))
    assert len(windows) >= 6
    for window in windows:
        assert not window.missing.any()
        assert window.column("a") == pytest.approx(window.column("b"), abs=1e-9)


def test_a_window_waits_for_its_last_true_samples() -> None:
    """With 3.5 ms between samples, one that is 4 ms before the end does not complete a window of 10 ms records."""
    times, rings = np.arange(0.0, 4.0, 0.0035), Rings(("a",), 2000)
    windower, windows = Windower(plans("a", sampling=Sampling.TRUE), RECORDS, PERIOD), list[Window]()
    for now in times:
        rings.deliver([Sample("a", now, now)])
        while windower.begin(rings, now, now) and windower.due(rings, now):
            windows.append(cut_next(windower, rings))
    values = np.concatenate([window.column("a")[~window.missing_in("a")] for window in windows])
    assert values == pytest.approx(times[: len(values)])
    assert len(windows) >= 6


def test_samples_of_later_windows_that_are_overwritten_are_counted() -> None:
    """A cut looks at samples after its window, to bridge inputs; that does not count as reading them."""
    rings = Rings(("a",), 100)
    windower = Windower(plans("a"), RECORDS, PERIOD)
    rings.deliver([Sample("a", index * PERIOD, 0.0) for index in range(60)])
    assert windower.begin(rings, 0.6, 0.6)
    cut_next(windower, rings)
    rings.deliver([Sample("a", index * PERIOD, 0.0) for index in range(60, 170)])
    assert rings.counters().overwritten == 170 - 100 - RECORDS


@pytest.mark.parametrize("interval", [0.02, 0.2, 3.0])
def test_the_grace_period_covers_the_next_sample_of_a_slow_input(interval: float) -> None:
    """At most a window's length: an input that comes less often is extrapolated."""
    rings = Rings(("a", "v"), 4000)
    windower = Windower((SignalPlan("a"), SignalPlan("v", "foh")), RECORDS, PERIOD)
    grid = ramp(2000) * PERIOD
    rings.deliver_columns(
        {"a": (grid, grid), "v": (grid[:: round(interval / PERIOD)], grid[:: round(interval / PERIOD)])}
    )
    assert windower.begin(rings, 20.0, 20.0)
    for _ in range(4):
        cut_next(windower, rings)
    expected = min(max(1.5 * interval, GRACE_PERIOD), RECORDS * PERIOD)
    assert windower.grace == pytest.approx(expected if interval < 3.0 * RECORDS * PERIOD else GRACE_PERIOD)


@pytest.mark.parametrize("capacity", [3, 300, 5000])
def test_samples_of_a_ring_are_the_same_one_by_one_and_at_once(capacity: int) -> None:
    """Also if some are older than others, and if the ring is read meanwhile."""
    random = np.random.default_rng(0)
    times = np.arange(1000) * 0.01 + random.choice([0.0, -0.03], 1000, p=[0.99, 0.01])
    values = random.standard_normal(1000)
    one, all_at_once = Rings(("a",), capacity), Rings(("a",), capacity)
    for first in range(0, 1000, 70):
        part = slice(first, first + 70)
        one.deliver([Sample("a", *row) for row in zip(times[part].tolist(), values[part].tolist(), strict=True)])
        all_at_once.deliver_columns({"a": (times[part], values[part])})
        assert one.last_times() == all_at_once.last_times()
        if first % 4 == 0:
            read = [rings.around("a", times[first] - 1.0, times[first], times[first]) for rings in (one, all_at_once)]
            assert all(np.array_equal(*pair) for pair in zip(*read, strict=True))
    assert one.counters() == all_at_once.counters()
    everything = [rings.around("a", -1.0, 20.0, 0.0) for rings in (one, all_at_once)]
    assert all(np.array_equal(*pair) for pair in zip(*everything, strict=True))
