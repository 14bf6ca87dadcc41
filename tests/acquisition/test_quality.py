"""Quality: a window is refused only for what makes it useless, or beyond a limit of the machine file."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.acquisition.quality import CALENDAR, QualityLimits, time_text
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Array, GridSpan, Quality, Verdict
from otolith.acquisition.windower import Windower
from otolith.machine_file import WindowTable
from otolith_drivers.base import Sampling
from tests.acquisition.series import cut_next, ramp
from tests.messages import assert_each_says

PERIOD, RECORDS = 0.01, 200
LENGTH = RECORDS * PERIOD
GRID = ramp(3 * RECORDS) * PERIOD
NO_LIMITS = QualityLimits(missing=1.0, gap=600.0, jitter=10.0, surplus=1.0, irregularity=100.0)
Samples = tuple[SignalPlan, Array]


def quality_of(
    *signals: Samples, limits: QualityLimits | None = None, begin: float = 0.0, length: float = LENGTH
) -> Quality:
    """Return the quality of the second window, which begins ``length`` (s), that of a window, after ``begin``."""
    rings = Rings([plan.name for plan, _ in signals], 4000)
    windower = Windower([plan for plan, _ in signals], round(length / PERIOD), PERIOD, limits)
    rings.deliver_columns({plan.name: (times + begin, np.sin(times)) for plan, times in signals})
    assert windower.begin(rings, begin + 3.0 * length, 3.0 * length)
    cut_next(windower, rings)
    return cut_next(windower, rings).quality


def output(times: Array, sampling: Sampling = Sampling.TRUE) -> Samples:
    return SignalPlan("y", sampling=sampling), times


def command(times: Array) -> Samples:
    return SignalPlan("u", "zoh"), times


def without(times: Array, start: float, end: float) -> Array:
    return times[(times < start) | (times >= end)]


def test_the_defaults_are_those_of_a_machine_file() -> None:
    table, limits = WindowTable(), QualityLimits()
    assert (limits.missing, limits.jitter) == (table.missing_limit, table.jitter_limit)
    assert (limits.surplus, limits.irregularity) == (table.surplus_limit, table.irregularity_limit)
    assert limits.same_time == table.same_time_limit
    assert min(limits.gap, 600.0) == table.gap_limit  # a window is at most as long


def test_a_command_whose_first_sample_comes_after_the_window_is_unknown_in_it() -> None:
    """No bound is known of what it was before."""
    rings, late = Rings(["y", "u"], 4000), GRID[GRID >= LENGTH]
    windower = Windower([SignalPlan("y"), SignalPlan("u", "zoh")], RECORDS, PERIOD)
    rings.deliver_columns({"y": (GRID, np.sin(GRID))})
    assert windower.begin(rings, LENGTH, LENGTH)
    rings.deliver_columns({"u": (late, np.sin(late))})
    first, second = (cut_next(windower, rings).quality for _ in range(2))
    assert first.verdict is Verdict.BAD
    assert first.reasons[0].startswith("no samples of u from t = 0 s for 2 s: is the source on")
    assert second.verdict is Verdict.GOOD


@pytest.mark.parametrize("together", [2, 10])
def test_same_time_limit_is_the_only_bound_of_samples_at_one_time(together: int) -> None:
    """A reading that is recorded twice is no other one."""
    times, share = np.floor(GRID / (PERIOD * together) + 1e-6) * PERIOD * together, 1.0 - 1.0 / together
    values = {"other readings": np.sin(GRID), "one reading": np.sin(times)}
    for name, readings in values.items():
        for limit, is_good in ((share - 0.01, name == "one reading"), (share + 0.01, True)):
            rings = Rings(["y"], 4000)
            windower = Windower([SignalPlan("y")], RECORDS, PERIOD, replace(NO_LIMITS, same_time=limit))
            rings.deliver_columns({"y": (times, readings)})
            assert windower.begin(rings, 3.0 * LENGTH, 3.0 * LENGTH)
            quality = cut_next(windower, rings).quality
            assert (quality.verdict is Verdict.GOOD) == is_good
            if not is_good:
                assert quality.reasons[0].startswith(
                    f"{share:.0%} of the samples of y share a time but differ: log finer"
                )


@pytest.mark.parametrize("kept", [1, 2, 10, 100])
def test_missing_outputs_alone_refuse_no_window(kept: int) -> None:
    inside = LENGTH + np.linspace(0.3, 1.7, kept)
    times = np.concatenate([GRID[:RECORDS], inside, GRID[2 * RECORDS :]])
    quality = quality_of(output(times), command(GRID))
    assert quality.verdict is Verdict.GOOD
    assert quality.missing == pytest.approx(1.0 - kept / RECORDS)


def test_a_window_without_any_output_is_refused() -> None:
    quality = quality_of(output(without(GRID, 2.0, 4.0)), command(GRID), begin=1000.0)
    assert quality.verdict is Verdict.BAD
    assert_each_says(quality.reasons, ("y", "1002.00 s", "2 s", "source", "[signals]"))


@pytest.mark.parametrize("sampling", Sampling)
@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_missing_limit_is_the_only_bound_of_missing_records(sampling: Sampling, share: float) -> None:
    lost = round(share * RECORDS)
    kept = np.sort(np.random.default_rng(1).permutation(np.arange(1, RECORDS - 1))[lost:])
    times = np.concatenate([GRID[:RECORDS], GRID[RECORDS : RECORDS + 1], LENGTH + kept * PERIOD, GRID[2 * RECORDS :]])
    missing = 1.0 - (len(kept) + 1) / RECORDS
    for slack, verdict in ((0.001, Verdict.GOOD), (-0.001, Verdict.BAD)):
        quality = quality_of(output(times, sampling), limits=replace(NO_LIMITS, missing=missing + slack))
        assert quality.missing == pytest.approx(missing)
        assert quality.verdict is verdict
        if verdict is Verdict.BAD:
            assert quality.reasons[0].startswith(f"{missing:.0%} of y is missing, more than missing_limit (")


@pytest.mark.parametrize("sampling", Sampling)
@pytest.mark.parametrize(("start", "gap"), [(2.5, 0.05), (2.5, 0.4), (2.2, 1.7)])
def test_gap_limit_is_the_only_bound_of_a_gap(sampling: Sampling, start: float, gap: float) -> None:
    times = without(GRID, start - PERIOD / 2, start + gap - PERIOD / 2)
    for slack, verdict in ((0.001, Verdict.GOOD), (-0.001, Verdict.BAD)):
        quality = quality_of(output(times, sampling), limits=replace(NO_LIMITS, gap=gap + slack), begin=50.0)
        assert quality.longest_gap == pytest.approx(gap)
        assert quality.verdict is verdict
        if verdict is Verdict.BAD:
            expected = f"y has no sample for {gap:.4g} s from t = {50.0 + start:.4g} s, longer than gap_limit"
            assert quality.reasons[0].startswith(expected)


@pytest.mark.parametrize(("period", "jitter"), [(0.01, 0.004), (0.5, 0.04), (0.5, 0.099)])
def test_jitter_limit_is_the_only_bound_of_jitter(period: float, jitter: float) -> None:
    """Root mean square lateness: bursts, so that no sample comes later than its window waits.

    Windows have samples enough to show a period. 0.04 s are a multiple of that of the grid: true times are on it then.
    """
    length = max(LENGTH, 20.0 * period)
    times = ramp(round(3.0 * length / period)) * period
    late = np.zeros(len(times))
    late[1::2] = jitter
    arrivals = times + late
    with_a_loss = np.delete(arrivals, len(times) // 2)
    limits, strict = replace(NO_LIMITS, jitter=0.1), replace(NO_LIMITS, jitter=0.3 * jitter)
    assert quality_of(output(with_a_loss, Sampling.CYCLIC), limits=limits, length=length).verdict is Verdict.GOOD
    refused = quality_of(output(with_a_loss, Sampling.CYCLIC), limits=strict, length=length)
    assert refused.verdict is Verdict.BAD
    assert "y arrives with" in refused.reasons[0]
    assert "more than jitter_limit" in refused.reasons[0]
    assert quality_of(output(arrivals, Sampling.CYCLIC), limits=strict, length=length).verdict is Verdict.GOOD
    no_jitter = replace(limits, jitter=0.0)
    assert quality_of(output(with_a_loss, Sampling.TRUE), limits=no_jitter, length=length).verdict is Verdict.GOOD


@pytest.mark.parametrize("surplus", [3, 15])
def test_surplus_limit_is_the_only_bound_of_surplus_samples(surplus: int) -> None:
    extra = GRID[RECORDS + 20 : RECORDS + 20 + surplus * 10 : 10] + 1e-4
    times = np.sort(np.concatenate([GRID, extra]))
    assert quality_of(output(times, Sampling.CYCLIC), limits=NO_LIMITS).verdict is Verdict.GOOD
    allowed = replace(NO_LIMITS, surplus=(surplus + 0.1) / RECORDS)
    assert quality_of(output(times, Sampling.CYCLIC), limits=allowed).verdict is Verdict.GOOD
    quality = quality_of(output(times, Sampling.CYCLIC), limits=replace(NO_LIMITS, surplus=(surplus - 0.1) / RECORDS))
    assert quality.verdict is Verdict.BAD
    assert "do two nodes send it? If not, raise surplus_limit" in quality.reasons[0]


def test_irregularity_limit_is_the_only_bound_of_irregular_intervals() -> None:
    times = np.sort(np.concatenate([GRID[::5], GRID[::5] + 0.012]))
    assert quality_of(output(times, Sampling.CYCLIC), limits=NO_LIMITS).verdict is Verdict.GOOD
    quality = quality_of(output(times, Sampling.CYCLIC))
    assert quality.verdict is Verdict.BAD
    assert "do two nodes send it? If not, raise irregularity_limit" in quality.reasons[0]


@given(
    st.lists(st.floats(0.0, 6.0), min_size=1, max_size=300).map(sorted),
    st.sampled_from(Sampling),
    st.sampled_from([None, "foh"]),
)
def test_without_limits_only_useless_windows_are_refused(
    times: list[float], sampling: Sampling, hold: str | None
) -> None:
    ordered = np.unique(np.array([0.0, *times]))
    other = SignalPlan("x", hold, sampling)
    quality = quality_of(output(ordered, sampling), (other, GRID), limits=NO_LIMITS)
    useless = hold is not None and not ((ordered >= 1.9) & (ordered <= 4.1)).any()
    if quality.verdict is Verdict.BAD:
        assert quality.reasons[0].startswith("no samples of y")
    else:
        assert not useless


def test_a_command_that_is_recorded_on_change_has_no_gaps() -> None:
    limits = QualityLimits(missing=0.05, gap=0.05)
    for command_times in (np.array([0.0]), np.array([0.0, 2.6, 2.9])):
        quality = quality_of(output(GRID), command(command_times), limits=limits)
        assert quality.verdict is Verdict.GOOD
        assert quality.missing == 0.0


def test_a_measured_input_without_samples_is_refused() -> None:
    quality = quality_of(output(GRID), (SignalPlan("v", "foh"), without(GRID, 1.9, 4.1)))
    assert quality.verdict is Verdict.BAD
    assert quality.reasons[0].startswith("no samples of v from t = 2 s for 2 s")


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "t = 0 s"),
        (12.3456, "t = 12.35 s"),
        (1234.5678, "t = 1234.57 s"),
        (CALENDAR[0] - 1.0, "t = 99999999.00 s"),
    ],
)
def test_a_time_of_the_data_is_shown_in_seconds(seconds: float, text: str) -> None:
    assert time_text(seconds) == text


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_any_time_has_a_text(seconds: float) -> None:
    assert time_text(seconds)


def test_a_column_of_milliseconds_since_1970_is_no_date() -> None:
    assert [time_text(seconds) for seconds in (1.7e12, -2.5, -0.0)] == ["t = 1.7e+12 s", "t = -2.5 s", "t = 0 s"]


def test_unix_time_is_shown_as_a_date() -> None:
    assert time_text(1_700_000_000.25) == "2023-11-14 22:13:20.25 UTC"
    quality = quality_of(output(without(GRID, 2.0, 4.0)), command(GRID), begin=1_700_000_000.0)
    assert "no samples of y from 2023-11-14 22:13:22.00 UTC for 2 s" in quality.reasons[0]


def test_the_span_of_a_grid_ends_after_its_last_record() -> None:
    span = GridSpan(1.0, RECORDS, PERIOD)
    assert [span.length, span.end] == pytest.approx([2.0, 3.0])
