"""Playback cuts the same windows from recorded rows as the daemon from live samples."""

from itertools import pairwise

import numpy as np
import pytest

from otolith.acquisition.playback import Playback, PlaybackCounts
from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.window import Array, Window
from otolith_drivers.replay.readers import Rows
from tests.acquisition.test_windower import CYCLIC, LIMITS, PERIOD, RECORDS, cut_all


def rows(times: Array, values: Array) -> Rows:
    count = np.arange(len(times))
    return Rows(times, {"a": values, "b": -values}, count + 2, np.zeros(len(times), dtype=np.int64))


def played(playback: Playback, *parts: Rows) -> list[Window]:
    return [window for part in parts for window in playback.windows(part)] + list(playback.rest())


def test_playback_cuts_the_windows_of_the_daemon() -> None:
    random = np.random.default_rng(3)
    times = 0.1 + np.arange(1000.0) * PERIOD + random.uniform(0.0, 0.002, 1000)
    values = np.arange(1000.0)
    live = cut_all(Rings(("a", "b"), 400), list(zip(times.tolist(), values.tolist(), strict=True)), until=10.3)
    replayed = played(Playback(CYCLIC, RECORDS, PERIOD, LIMITS), rows(times, values))
    assert len(live) == len(replayed) == 20
    for one, other in zip(live, replayed, strict=True):
        assert np.array_equal(one.values, other.values)
        assert (one.index, one.quality.verdict) == (other.index, other.quality.verdict)


def test_window_length_may_change_between_windows() -> None:
    times = np.arange(1000.0) * PERIOD
    playback = Playback(CYCLIC, RECORDS, PERIOD, LIMITS)
    lengths = iter([100, 20, 400, *[50] * 9])
    windows = []
    for window in playback.windows(rows(times, np.arange(1000.0))):
        windows.append(window)
        playback.windower.records = next(lengths)
    windows += playback.rest()
    assert [window.records for window in windows] == [50, 100, 20, 400, *[50] * 8]
    assert np.array_equal(np.concatenate([window.column("a") for window in windows]), np.arange(970.0))


def test_windows_do_not_depend_on_chunks() -> None:
    random = np.random.default_rng(7)
    times = np.arange(2000.0) * PERIOD
    times[1200:] += 3.0
    times[1500:] += 200.0
    times[random.integers(0, 2000, 20)] -= 0.1
    values = np.where(random.random(2000) < 0.02, np.nan, np.arange(2000.0))
    whole = Playback(CYCLIC, RECORDS, PERIOD, LIMITS)
    pieces = Playback(CYCLIC, RECORDS, PERIOD, LIMITS)
    log = rows(times, values)
    at_once = played(whole, log)
    cuts = [0, *sorted(random.integers(1, 2000, 60).tolist()), 2000]
    parts = [log.part(slice(first, last)) for first, last in pairwise(cuts)]
    in_parts = played(pieces, *(part for part in parts if len(part.times)))
    assert len(at_once) == len(in_parts) == 40
    for one, other in zip(at_once, in_parts, strict=True):
        assert (one.start, one.quality) == (other.start, other.quality)
        assert np.array_equal(one.values, other.values)
    assert whole.counts == pieces.counts
    assert whole.counts.gaps == 2
    assert whole.counts.longest_gap == pytest.approx(200.0, abs=0.2)


@pytest.mark.parametrize("blank", ["", "b"])
def test_windows_do_not_depend_on_where_a_playback_is_continued(blank: str) -> None:
    """Twenty samples come in the time of a record, so rings for one each would lose most of a window.

    Without a sample of one signal, the first window begins at the moment of a check.
    """
    times = 5.0 + np.arange(6000.0) * PERIOD / 20.37
    log = rows(times, np.sin(times))
    log.columns.update({blank: np.full(len(times), np.nan)} if blank else {})
    plans = (SignalPlan("a"), SignalPlan("b"))

    def continued(*cuts: int) -> tuple[list[Window], PlaybackCounts]:
        windows, playback = list[Window](), Playback(plans, RECORDS, PERIOD, LIMITS)
        for first, last in pairwise([0, *cuts, len(times)]):
            part = log.part(slice(first, last))
            windows += playback.windows(part) if last < len(times) else played(playback, part)
            before, playback = playback, Playback(plans, RECORDS, PERIOD, LIMITS)
            playback.restore(before.state)
        return windows, playback.counts

    at_once, counts = continued()
    assert len(at_once) == 5
    assert counts.lost == 0
    for cuts in ((1,), (6, 2500), tuple(range(990, 1070)), (5999,)):
        again, others = continued(*cuts)
        assert counts == others
        for one, other in zip(at_once, again, strict=True):
            assert (one.start, one.index, one.quality) == (other.start, other.index, other.quality)
            assert np.array_equal(one.values, other.values)
