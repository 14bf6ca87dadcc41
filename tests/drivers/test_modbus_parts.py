"""The pure parts of the Modbus driver: numbers, requests, pace, order of bytes."""

import math
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.base import Signal
from otolith_drivers.modbus_freshness import MOST_IN_A_ROW, Freshness
from otolith_drivers.modbus_line import Refused
from otolith_drivers.modbus_options import Item, Options, Source, item_of
from otolith_drivers.modbus_pace import EASY, ROUNDS, Pace
from otolith_drivers.modbus_plan import plan, split
from otolith_drivers.modbus_plausible import judge
from otolith_drivers.modbus_requests import LONGEST_REST, Requests
from otolith_drivers.modbus_types import LETTERS, ORDERS, Order, TypeName, bits, orders_of, reader, registers_of
from otolith_drivers.modbus_watch import OrderWatch

KINDS: list[TypeName] = list(LETTERS)


def registers(number: float, kind: TypeName, order: Order) -> list[int]:
    """The inverse of what is tested, written byte by byte."""
    data = list(struct.pack(f">{LETTERS[kind]}", number if kind.startswith("float") else int(number)))
    words = [data[at : at + 2] for at in range(0, len(data), 2)]
    if order in ("BADC", "DCBA"):
        words = [word[::-1] for word in words]
    if order in ("CDAB", "DCBA"):
        words = words[::-1]
    return [high << 8 | low for high, low in words]


def item(name: str = "s", **keys: object) -> Item:
    source = Source.model_validate({"register": 0, "type": "float32", "unit": "V", **keys})
    return item_of(Signal(name, "V", source), Options(host="localhost"))


@given(st.sampled_from(KINDS), st.sampled_from(ORDERS), st.data())
def test_numbers_come_back_from_their_registers(kind: TypeName, order: Order, data: st.DataObject) -> None:
    width = 16 * registers_of(kind)
    if kind.startswith("float"):
        number: float = data.draw(st.floats(width=32 if width == 32 else 64, allow_nan=False))
    else:
        low = 0 if kind.startswith("u") else -(2 ** (width - 1))
        number = data.draw(st.integers(low, low + 2**width - 1))
    assert reader(kind, order)(registers(number, kind, order)) == number


@given(st.sampled_from(KINDS), st.sampled_from(ORDERS), st.lists(st.integers(0, 65535), min_size=4, max_size=4))
def test_any_registers_are_a_finite_value_or_none(kind: TypeName, order: Order, words: list[int]) -> None:
    value = item(type=kind, order=order, scale=1e300).value(words[: registers_of(kind)])
    assert math.isfinite(value) or math.isnan(value)


@given(st.integers(0, 65535), st.integers(0, 15), st.integers(0, 15))
def test_bits_are_cut_out_of_an_integer(word: int, one: int, other: int) -> None:
    low, high = sorted((one, other))
    found = item(type="uint16", bits=f"{low}..{high}").value([word])
    assert found == int(f"{word:016b}"[15 - high : 16 - low], 2)


@pytest.mark.parametrize(("written", "kind"), [("4..2", "uint16"), ("16", "int16"), ("x", "int16"), ("1", "float32")])
def test_bits_that_are_not_there_are_refused(written: str, kind: TypeName) -> None:
    with pytest.raises(ValueError, match="bits"):
        bits(written, kind)


def test_scale_offset_and_unit_are_applied_in_this_order() -> None:
    assert item(type="int16", scale=0.1, offset=-5.0, unit="mV").value([200]) == pytest.approx(0.015)


def test_a_value_out_of_range_is_no_reading() -> None:
    assert math.isnan(item(type="int16", unit="V", range=(-10.0, 10.0)).value([11]))


places = st.lists(
    st.tuples(st.integers(1, 2), st.sampled_from(["holding", "input"]), st.integers(0, 300), st.sampled_from(KINDS)),
    min_size=1,
    max_size=30,
)


def items_at(found: Sequence[tuple[int, str, int, TypeName]]) -> list[Item]:
    return [
        item(f"s{index}", device=device, table=table, register=address, type=kind)
        for index, (device, table, address, kind) in enumerate(found)
    ]


@given(places, st.integers(0, 20), st.integers(4, 125))
def test_a_plan_reads_everything_within_the_limits(
    found: list[tuple[int, str, int, TypeName]], gap: int, most: int
) -> None:
    requests = plan(items_at(found), gap, most)
    names = [entry.name for request in requests for entry in request.items]
    assert sorted(names) == sorted(f"s{index}" for index in range(len(found)))
    for request in requests:
        assert request.count <= most
        wanted = {at for entry in request.items for at in range(entry.address, entry.end)}
        assert {request.address, request.address + request.count - 1} <= wanted
        unwanted = 0
        for at in range(request.address, request.address + request.count):
            unwanted = 0 if at in wanted else unwanted + 1
            assert unwanted <= gap
        assert all((entry.device, entry.table) == (request.device, request.table) for entry in request.items)


@given(places)
def test_splitting_ends_with_single_registers_and_loses_none(found: list[tuple[int, str, int, TypeName]]) -> None:
    whole = plan(items_at(found), 20, 125)
    pieces = list(whole)
    for _ in range(100):
        pieces = [part for request in pieces for part in split(request)]
    assert sorted(entry.name for piece in pieces for entry in piece.items) == sorted(
        entry.name for request in whole for entry in request.items
    )
    for piece in pieces:  # what is left together overlaps
        for before, after in zip(piece.items, piece.items[1:], strict=False):
            assert after.address < max(entry.end for entry in piece.items if entry.address <= before.address)


def test_a_pace_that_fits_is_kept_and_one_that_does_not_is_lengthened_evenly() -> None:
    pace, now = Pace(0.01), 100.0
    pace.start(now)
    for _ in range(3 * ROUNDS):
        now = max(now, pace.due)
        assert pace.begin(now) == 0
        now += 0.004
        assert not pace.end(0.004, repeated=False)
    assert pace.achieved == pytest.approx(0.01)
    missed = 0
    for _ in range(5 * ROUNDS):
        now = max(now, pace.due)
        missed += pace.begin(now)
        now += 0.021
        pace.end(0.021, repeated=False)
    assert pace.period == 0.025
    assert pace.achieved == pytest.approx(0.025)
    assert missed > 0
    assert "100 Hz asked, 40.0 achieved" in pace.describe()
    for _ in range(EASY * ROUNDS + 2 * ROUNDS):
        now = max(now, pace.due)
        pace.begin(now)
        now += 0.004
        pace.end(0.004, repeated=False)
    assert pace.period == 0.01


def test_a_computer_that_was_busy_for_a_moment_does_not_change_the_grid() -> None:
    pace, now = Pace(0.01), 0.0
    pace.start(now)
    for index in range(10 * ROUNDS):
        now = max(now, pace.due)
        pace.begin(now)
        duration = 0.03 if index % 20 == 0 else 0.004
        now += duration
        assert not pace.end(duration, repeated=False)


@given(st.lists(st.floats(0.0, 3.0), min_size=1, max_size=50))
def test_every_slot_is_begun_or_told_as_left_out(pauses: list[float]) -> None:
    pace, now = Pace(0.01), 0.0
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
    pace, now = Pace(0.01), 0.0
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
    pace, now, steps = Pace(0.1), 0.0, 0
    pace.start(now)
    for index in range(20_000):
        before, now = now, pace.due
        steps += now - before > 0.11
        pace.begin(now)
        pace.end(0.001, repeated=index % 5 == 0)
    assert steps <= 15


def drawn(numbers: Sequence[float], kind: TypeName, order: Order) -> list[list[int]]:
    return [registers(number, kind, order) for number in numbers]


RANDOM = np.random.default_rng(5)
SIGNALS = {
    "voltage with noise": 24.0 + 0.01 * RANDOM.standard_normal(20),
    "noise around zero": 2e-4 * RANDOM.standard_normal(20),
    "ramp": np.linspace(0.0, 1.0, 20),
    "valve area": 1e-5 + 1e-8 * RANDOM.standard_normal(20),
    "speed that changes its sign": 30.0 * np.sin(np.arange(20) / 3.0),
}


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("kind", ["float32", "float64", "int32"])
@pytest.mark.parametrize("order", ORDERS)
def test_swapped_words_are_told_and_right_ones_are_not(name: str, kind: TypeName, order: Order) -> None:
    whole = 1.0 if kind.startswith("float") else 2e4 / np.abs(SIGNALS[name]).max()
    numbers = SIGNALS[name] * whole
    history = drawn(numbers.tolist(), kind, order)
    assert judge(history, kind, order).plausible
    swapped: dict[Order, Order] = {"ABCD": "CDAB", "CDAB": "ABCD", "BADC": "DCBA", "DCBA": "BADC"}
    judgement = judge(history, kind, swapped[order])
    assert not judgement.plausible
    assert judgement.better is not None


COUNT = np.arange(20)
FLOATS = {
    "rest, then motion": np.where(COUNT < 10, 1e-9 * RANDOM.standard_normal(20), 1500.0 + RANDOM.standard_normal(20)),
    "square wave with noise": np.where(COUNT % 8 < 4, 1e-7, 1500.0) * (1.0 + 1e-3 * RANDOM.standard_normal(20)),
    "set-point that jumps often": np.where(COUNT % 3 < 1, 1e-8, 1500.0),
    "filter of a machine that stops": 1500.0 * 10.0 ** -(COUNT / 2.0),
    "no reading now and then": np.where(COUNT % 4 == 0, np.nan, 1500.0),
}
INTEGERS = {
    "encoder that wraps": (2**31 - 300 + 100 * COUNT + 2**31) % 2**32 - 2**31,
    "encoder of 20 bits that wraps": (2**20 - 300 + 100 * COUNT) % 2**20,
    "set-point in sixteen bits and sixteen behind the point": np.where(COUNT % 8 < 4, 1500 << 16, 0),
    "set-point from end to end": np.where(COUNT % 8 < 4, 2**30, -(2**30)),
    "steps of 256 about zero": 256 * np.array([0, 1, -1, 2, 3, -2, -3, 1, 0, 4] * 2),
    "noise about zero": np.rint(3.0 * RANDOM.standard_normal(20)).astype(int),
}


@pytest.mark.parametrize("order", ORDERS)
def test_what_machines_do_is_not_taken_for_swapped_words(order: Order) -> None:
    kinds: list[tuple[TypeName, dict[str, np.ndarray]]]
    kinds = [("float32", FLOATS), ("float64", FLOATS), ("int32", INTEGERS), ("int64", INTEGERS)]
    withheld = [
        (name, kind)
        for kind, signals in kinds
        for name, numbers in signals.items()
        if not judge(drawn(numbers.tolist(), kind, order), kind, order).plausible
    ]
    assert not withheld


def test_the_end_of_a_filter_is_as_good_as_zero_but_a_swap_on_the_way_is_told() -> None:
    watched = item(type="float32")
    watch = OrderWatch([watched])

    def read(numbers: Sequence[float], order: Order) -> frozenset[str]:
        for words in drawn(numbers, "float32", order):
            watch.take(watched, words)
            watch.end_round()
        return watch.withheld

    assert not read(np.linspace(23.0, 25.0, 40).tolist(), "ABCD")
    assert not read(np.maximum(24.0 * np.exp(-COUNT.repeat(20) / 3.0), 7e-44).tolist(), "ABCD")
    assert not read([7e-44] * 300, "ABCD")
    assert not read(np.linspace(23.0, 25.0, 40).tolist(), "ABCD")
    assert read([24.0] * 300, "CDAB") == {"s"}
    assert not read([24.0] * 40, "ABCD")


@pytest.mark.parametrize("kind", KINDS)
def test_a_machine_at_rest_is_plausible(kind: TypeName) -> None:
    assert all(judge([[0] * registers_of(kind)] * 20, kind, order).plausible for order in orders_of(kind))


def test_the_pause_before_a_dead_device_is_asked_again_is_bounded() -> None:
    requests = Requests(plan([item("a", device=1), item("b", device=2)], 0, 125))
    dead, now, asked = requests.requests[1], 0.0, []
    for _ in range(2000):
        now += 0.1
        for request in requests.due(now):
            if request == dead:
                requests.silent(request, "no answer", now)
                asked.append(now)
            else:
                requests.answered(request)
    pauses = np.diff(asked)
    assert pauses.max() <= LONGEST_REST + 0.2
    assert len(asked) >= 200.0 / (LONGEST_REST + 0.2)
    assert len(asked) <= 40


def test_a_busy_device_is_asked_again_at_once_and_left_alone_only_after_a_while() -> None:
    requests = Requests(plan([item("a")], 0, 125))
    only = requests.requests[0]
    for _ in range(2):
        requests.refused(only, Refused(6), 1.0)
        assert requests.due(1.0) == [only]
    requests.refused(only, Refused(6), 1.0)
    assert requests.due(1.0) == []
    assert "server device busy" in requests.complaints(1.0)[0]


def test_files_may_count_registers_from_one() -> None:
    source = Source.model_validate({"register": 1, "type": "int16", "unit": "V"})
    assert item_of(Signal("s", "V", source), Options(host="localhost", first_address=1)).address == 0


def test_the_lines_least_time_is_that_of_its_characters() -> None:
    line = Options(serial="/dev/ttyUSB0", baudrate=9600)
    assert line.least_time(10) == pytest.approx((8 + 5 + 20 + 7) * 11 / 9600)
    without_parity = Options(serial="/dev/ttyUSB0", baudrate=9600, parity="N")
    assert without_parity.least_time(10) == pytest.approx((8 + 5 + 20 + 7) * 10 / 9600)
    assert Path(line.serial or "").name in line.title()


def test_an_old_image_among_new_ones_is_none() -> None:
    freshness, request = Freshness(), plan([item("a")], 0, 125)[0]
    for index in range(500):
        assert freshness.take(request, [100 * index, 0]) == (False, False)
    assert freshness.take(request, [49900, 0]) == (True, False)  # the beat of two clocks
    assert freshness.take(request, [49900, 0]) == (True, True)
    assert freshness.take(request, [50000, 0]) == (False, False)


STEPS = {
    "noise of a few steps": np.rint(4.0 * RANDOM.standard_normal(3000)).astype(int) % 65536,
    "nearly a step in each reading": (0.93 * np.arange(3000)).astype(int) % 65536,
}


@pytest.mark.parametrize("name", STEPS)
def test_coarse_registers_repeat_by_chance(name: str) -> None:
    freshness, request = Freshness(), plan([item("a", type="uint16")], 0, 125)[0]
    assert not any(freshness.take(request, [int(word)])[1] for word in STEPS[name])


def test_a_machine_that_stops_is_soon_believed() -> None:
    freshness, request = Freshness(), plan([item("a", type="uint16")], 0, 125)[0]
    for word in RANDOM.permutation(1000):
        freshness.take(request, [int(word)])
    assert sum(freshness.take(request, [0])[1] for _ in range(1000)) <= MOST_IN_A_ROW


def test_registers_that_often_say_the_same_are_believed_and_told() -> None:
    """A machine that stands still is no fault; nor is a coarse register."""
    freshness, request = Freshness(), plan([item("a")], 0, 125)[0]
    stale = [freshness.take(request, [index // 5, 0])[1] for index in range(1000)]
    assert not any(stale)
    assert "80% of the readings" in freshness.complaints([request], 0.01)[0]


def test_registers_that_never_say_the_same_are_not_complained_of() -> None:
    freshness, request = Freshness(), plan([item("a")], 0, 125)[0]
    for index in range(300):
        freshness.take(request, [index, 0])
        assert not freshness.complaints([request], 0.01)
