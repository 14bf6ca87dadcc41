"""Requests, their backoff, and the grid of rounds."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.base import Signal
from otolith_drivers.modbus.client import ExceptionReplyError
from otolith_drivers.modbus.options import ModbusOptions, ModbusSource, RegisterSignal, TypeName, register_signal
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
from tests.messages import assert_says

register_places = st.lists(
    st.tuples(st.integers(1, 2), st.sampled_from(["holding", "input"]), st.integers(0, 300), st.sampled_from(KINDS)),
    min_size=1,
    max_size=30,
)


def signals_at(places: Sequence[tuple[int, str, int, TypeName]]) -> list[RegisterSignal]:
    return [
        item(f"s{index}", device=device, table=table, register=address, type=kind)
        for index, (device, table, address, kind) in enumerate(places)
    ]


@given(register_places, st.integers(0, 20), st.integers(4, 125))
def test_plan_reads_all_signals_within_the_limits(
    places: list[tuple[int, str, int, TypeName]], gap: int, most: int
) -> None:
    requests = plan(signals_at(places), gap, most)
    names = [signal.name for request in requests for signal in request.signals]
    assert sorted(names) == sorted(f"s{index}" for index in range(len(places)))
    for request in requests:
        assert request.count <= most
        wanted = {at for signal in request.signals for at in range(signal.address, signal.end)}
        assert {request.address, request.address + request.count - 1} <= wanted
        unwanted = 0
        for at in range(request.address, request.address + request.count):
            unwanted = 0 if at in wanted else unwanted + 1
            assert unwanted <= gap
        assert all((signal.device, signal.table) == (request.device, request.table) for signal in request.signals)


@given(register_places)
def test_split_ends_with_single_signals(places: list[tuple[int, str, int, TypeName]]) -> None:
    whole = plan(signals_at(places), 20, 125)
    pieces = list(whole)
    for _ in range(100):
        pieces = [part for request in pieces for part in split(request)]
    assert sorted(signal.name for piece in pieces for signal in piece.signals) == sorted(
        signal.name for request in whole for signal in request.signals
    )
    for piece in pieces:  # signals that stay together overlap
        for before, after in zip(piece.signals, piece.signals[1:], strict=False):
            assert after.address < max(signal.end for signal in piece.signals if signal.address <= before.address)


def test_period_is_kept_or_lengthened_to_what_fits() -> None:
    schedule, now = PollSchedule(0.01), 100.0
    schedule.start(now)
    for _ in range(3 * DECISION_ROUNDS):
        now = max(now, schedule.due)
        assert schedule.begin(now) == 0
        now += 0.004
        assert not schedule.end(0.004, repeated=False)
    assert schedule.achieved == pytest.approx(0.01)
    missed = 0
    for _ in range(5 * DECISION_ROUNDS):
        now = max(now, schedule.due)
        missed += schedule.begin(now)
        now += 0.021
        schedule.end(0.021, repeated=False)
    assert schedule.period == 0.025
    assert schedule.achieved == pytest.approx(0.025)
    assert missed > 0
    assert "100 Hz asked, 40.0 achieved" in schedule.describe()
    assert schedule.describe_period().startswith("read every 25 ms from now on, instead of every 10 ms: a round of req")
    for _ in range(FAST_DECISIONS * DECISION_ROUNDS + 2 * DECISION_ROUNDS):
        now = max(now, schedule.due)
        schedule.begin(now)
        now += 0.004
        schedule.end(0.004, repeated=False)
    assert schedule.period == 0.01
    assert_says(schedule.describe_period(), "10 ms", "as asked")


def test_busy_computer_does_not_change_the_period() -> None:
    schedule, now = PollSchedule(0.01), 0.0
    schedule.start(now)
    for index in range(10 * DECISION_ROUNDS):
        now = max(now, schedule.due)
        schedule.begin(now)
        duration = 0.03 if index % 20 == 0 else 0.004
        now += duration
        assert not schedule.end(duration, repeated=False)


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=50))
def test_each_round_is_begun_or_counted_as_skipped(pauses: list[float]) -> None:
    schedule, now = PollSchedule(0.01), 0.0
    schedule.start(now)
    begun = missed = 0
    for pause in pauses:
        if now >= schedule.due:
            missed += schedule.begin(now)
            begun += 1
        now += pause
        missed += schedule.pass_over(now)
    assert begun + missed == math.floor(now / 0.01 + 1e-6) + 1 or schedule.due - now <= 0.01 + 1e-6
    assert abs(begun + missed - (schedule.due / 0.01)) < 1e-6 * (1 + begun + missed)


def test_aliasing_shifts_the_grid() -> None:
    schedule, now = PollSchedule(0.01), 0.0
    schedule.start(now)
    phases = set()
    for index in range(500):
        now = schedule.due
        schedule.begin(now)
        phases.add(round(now / 0.01, 3) % 1.0)
        schedule.end(0.001, repeated=index < 200 and index % 4 == 0)
    assert phases == {0.0, 0.25, 0.5}


def test_lasting_aliasing_shifts_ever_more_seldom() -> None:
    """It is a coarse register, and each shift disturbs the grid."""
    schedule, now, steps = PollSchedule(0.1), 0.0, 0
    schedule.start(now)
    for index in range(20_000):
        before, now = now, schedule.due
        steps += now - before > 0.11
        schedule.begin(now)
        schedule.end(0.001, repeated=index % 5 == 0)
    assert steps <= 15


def test_backoff_of_a_dead_device_is_bounded() -> None:
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


@pytest.mark.parametrize("code", [5, 6])
def test_busy_device_is_reported_and_never_paused(code: int) -> None:
    requests = RequestSet(plan([item("a")], 0, 125))
    only = requests.requests[0]
    for _ in range(3):
        assert requests.warnings(1.0) == []
        requests.refused(only, ExceptionReplyError(code), 1.0)
        assert requests.due(1.0) == [only]
    assert "no values for 2 s: exception" in requests.warnings(3.0)[0]
    assert "repeated in each round" in requests.warnings(3.0)[0]
    requests.answered(only)
    assert requests.warnings(3.0) == []


@pytest.mark.parametrize(
    ("table", "register", "hint"),
    [("holding", 40103, True), ("holding", 40000, True), ("holding", 39999, False), ("input", 30021, True)],
)
def test_a_register_with_the_digit_of_its_table_is_explained(table: str, register: int, hint: bool) -> None:
    requests = RequestSet(plan([item("a", table=table, register=register)], 0, 125))
    requests.refused(requests.requests[0], ExceptionReplyError(2), 1.0)
    (line,) = requests.warnings(1.0)
    digit = "3" if table == "input" else "4"
    remedy = f"where a manual says {digit}0103, write first_address = 1 and register = 103"
    assert (remedy in line) == hint


def test_registers_are_named_as_the_machine_file_counts_them() -> None:
    source = ModbusSource.model_validate({"register": 103, "type": "float32", "unit": "V"})
    signal = register_signal(Signal("a", "V", source), ModbusOptions(host="localhost", first_address=1))
    (request,) = plan([signal], 0, 125)
    assert request.address == 102
    assert_says(request.describe(), "device 1", "holding", "103 to 104")


def test_least_time_counts_serial_characters() -> None:
    line = ModbusOptions(serial="/dev/ttyUSB0", baudrate=9600)
    assert line.least_time(10) == pytest.approx((8 + 5 + 20 + 7) * 11 / 9600)
    without_parity = ModbusOptions(serial="/dev/ttyUSB0", baudrate=9600, parity="N")
    assert without_parity.least_time(10) == pytest.approx((8 + 5 + 20 + 7) * 10 / 9600)
    assert Path(line.serial or "").name in line.title()
