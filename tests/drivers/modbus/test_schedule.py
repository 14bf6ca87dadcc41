"""Which registers are read together, and when."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.modbus.options import ModbusOptions, RegisterSignal
from otolith_drivers.modbus.protocol import ExceptionReplyError, TypeName
from otolith_drivers.modbus.schedule import (
    DECISION_ROUNDS,
    FAST_DECISIONS,
    MAX_PAUSE,
    PollSchedule,
    RequestSet,
    plan,
    split,
)
from tests.drivers.registers import KINDS, item

places = st.lists(
    st.tuples(st.integers(1, 2), st.sampled_from(["holding", "input"]), st.integers(0, 300), st.sampled_from(KINDS)),
    min_size=1,
    max_size=30,
)


def items_at(found: Sequence[tuple[int, str, int, TypeName]]) -> list[RegisterSignal]:
    return [
        item(f"s{index}", device=device, table=table, register=address, type=kind)
        for index, (device, table, address, kind) in enumerate(found)
    ]


@given(places, st.integers(0, 20), st.integers(4, 125))
def test_a_plan_reads_everything_within_the_limits(
    found: list[tuple[int, str, int, TypeName]], gap: int, most: int
) -> None:
    requests = plan(items_at(found), gap, most)
    names = [signal.name for request in requests for signal in request.signals]
    assert sorted(names) == sorted(f"s{index}" for index in range(len(found)))
    for request in requests:
        assert request.count <= most
        wanted = {at for signal in request.signals for at in range(signal.address, signal.end)}
        assert {request.address, request.address + request.count - 1} <= wanted
        unwanted = 0
        for at in range(request.address, request.address + request.count):
            unwanted = 0 if at in wanted else unwanted + 1
            assert unwanted <= gap
        assert all((signal.device, signal.table) == (request.device, request.table) for signal in request.signals)


@given(places)
def test_splitting_ends_with_single_registers_and_loses_none(found: list[tuple[int, str, int, TypeName]]) -> None:
    whole = plan(items_at(found), 20, 125)
    pieces = list(whole)
    for _ in range(100):
        pieces = [part for request in pieces for part in split(request)]
    assert sorted(signal.name for piece in pieces for signal in piece.signals) == sorted(
        signal.name for request in whole for signal in request.signals
    )
    for piece in pieces:  # what is left together overlaps
        for before, after in zip(piece.signals, piece.signals[1:], strict=False):
            assert after.address < max(signal.end for signal in piece.signals if signal.address <= before.address)


def test_a_pace_that_fits_is_kept_and_one_that_does_not_is_lengthened_evenly() -> None:
    pace, now = PollSchedule(0.01), 100.0
    pace.start(now)
    for _ in range(3 * DECISION_ROUNDS):
        now = max(now, pace.due)
        assert pace.begin(now) == 0
        now += 0.004
        assert not pace.end(0.004, repeated=False)
    assert pace.achieved == pytest.approx(0.01)
    missed = 0
    for _ in range(5 * DECISION_ROUNDS):
        now = max(now, pace.due)
        missed += pace.begin(now)
        now += 0.021
        pace.end(0.021, repeated=False)
    assert pace.period == 0.025
    assert pace.achieved == pytest.approx(0.025)
    assert missed > 0
    assert "100 Hz asked, 40.0 achieved" in pace.describe()
    for _ in range(FAST_DECISIONS * DECISION_ROUNDS + 2 * DECISION_ROUNDS):
        now = max(now, pace.due)
        pace.begin(now)
        now += 0.004
        pace.end(0.004, repeated=False)
    assert pace.period == 0.01


def test_a_computer_that_was_busy_for_a_moment_does_not_change_the_grid() -> None:
    pace, now = PollSchedule(0.01), 0.0
    pace.start(now)
    for index in range(10 * DECISION_ROUNDS):
        now = max(now, pace.due)
        pace.begin(now)
        duration = 0.03 if index % 20 == 0 else 0.004
        now += duration
        assert not pace.end(duration, repeated=False)


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=50))
def test_every_slot_is_begun_or_told_as_left_out(pauses: list[float]) -> None:
    pace, now = PollSchedule(0.01), 0.0
    pace.start(now)
    begun = missed = 0
    for pause in pauses:
        if now >= pace.due:
            missed += pace.begin(now)
            begun += 1
        now += pause
        missed += pace.pass_over(now)
    assert begun + missed == math.floor(now / 0.01 + 1e-6) + 1 or pace.due - now <= 0.01 + 1e-6
    assert abs(begun + missed - (pace.due / 0.01)) < 1e-6 * (1 + begun + missed)


def test_reading_moves_away_from_the_moment_at_which_the_device_renews_its_registers() -> None:
    pace, now = PollSchedule(0.01), 0.0
    pace.start(now)
    phases = set()
    for index in range(500):
        now = pace.due
        pace.begin(now)
        phases.add(round(now / 0.01, 3) % 1.0)
        pace.end(0.001, repeated=index < 200 and index % 4 == 0)
    assert phases == {0.0, 0.25, 0.5}


def test_a_beat_that_stays_wherever_one_reads_is_not_run_away_from_for_ever() -> None:
    """It is a coarse register, and every step is a disturbance of the grid."""
    pace, now, steps = PollSchedule(0.1), 0.0, 0
    pace.start(now)
    for index in range(20_000):
        before, now = now, pace.due
        steps += now - before > 0.11
        pace.begin(now)
        pace.end(0.001, repeated=index % 5 == 0)
    assert steps <= 15


def test_the_pause_before_a_dead_device_is_asked_again_is_bounded() -> None:
    requests = RequestSet(plan([item("a", device=1), item("b", device=2)], 0, 125))
    dead, now, asked = requests.requests[1], 0.0, []
    for _ in range(2000):
        now += 0.1
        for request in requests.due(now):
            if request == dead:
                requests.unanswered(request, "no answer", now)
                asked.append(now)
            else:
                requests.answered(request)
    pauses = np.diff(asked)
    assert pauses.max() <= MAX_PAUSE + 0.2
    assert len(asked) >= 200.0 / (MAX_PAUSE + 0.2)
    assert len(asked) <= 40


def test_a_busy_device_is_asked_again_at_once_and_left_alone_only_after_a_while() -> None:
    requests = RequestSet(plan([item("a")], 0, 125))
    only = requests.requests[0]
    for _ in range(2):
        requests.refused(only, ExceptionReplyError(6), 1.0)
        assert requests.due(1.0) == [only]
    requests.refused(only, ExceptionReplyError(6), 1.0)
    assert requests.due(1.0) == []
    assert "server device busy" in requests.warnings(1.0)[0]


def test_the_lines_least_time_is_that_of_its_characters() -> None:
    line = ModbusOptions(serial="/dev/ttyUSB0", baudrate=9600)
    assert line.least_time(10) == pytest.approx((8 + 5 + 20 + 7) * 11 / 9600)
    without_parity = ModbusOptions(serial="/dev/ttyUSB0", baudrate=9600, parity="N")
    assert without_parity.least_time(10) == pytest.approx((8 + 5 + 20 + 7) * 10 / 9600)
    assert Path(line.serial or "").name in line.title()
