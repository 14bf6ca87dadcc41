"""Swapped words and old images are detected; signals of machines are not withheld."""

from collections.abc import Sequence

import numpy as np
import pytest

from otolith_drivers.modbus.options import ORDERS, Order, TypeName, orders_of, registers_of
from otolith_drivers.modbus.plausibility import (
    MAX_STALE_RUN,
    OrderMonitor,
    StalenessMonitor,
    judge_order,
    renewal_period,
)
from otolith_drivers.modbus.schedule import plan
from tests.drivers.registers import KINDS, item, registers
from tests.messages import assert_says


def encoded(numbers: Sequence[float], kind: TypeName, order: Order) -> list[list[int]]:
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
def test_swapped_words_are_detected(name: str, kind: TypeName, order: Order) -> None:
    whole = 1.0 if kind.startswith("float") else 2e4 / np.abs(SIGNALS[name]).max()
    numbers = SIGNALS[name] * whole
    history = encoded(numbers.tolist(), kind, order)
    assert judge_order(history, kind, order).plausible
    swapped: dict[Order, Order] = {"ABCD": "CDAB", "CDAB": "ABCD", "BADC": "DCBA", "DCBA": "BADC"}
    judgement = judge_order(history, kind, swapped[order])
    assert not judgement.plausible
    assert judgement.better is not None


@pytest.mark.parametrize("words", [[0x7FC0, 0], [0x7F80, 0], [0xFFFF, 0xFFFF]])
def test_a_device_without_a_reading_is_told_no_other_order(words: list[int]) -> None:
    """Constant not-a-number has a plausible number in some wrong order, as 0x7FC00000 has -3.98 in BADC."""
    judgement = judge_order([words] * 20, "float32", "ABCD")
    assert not judgement.plausible
    assert judgement.better is None
    assert "none of the readings is a number" in judgement.reason


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
def test_signals_of_machines_are_plausible(order: Order) -> None:
    kinds: list[tuple[TypeName, dict[str, np.ndarray]]]
    kinds = [("float32", FLOATS), ("float64", FLOATS), ("int32", INTEGERS), ("int64", INTEGERS)]
    withheld = [
        (name, kind)
        for kind, signals in kinds
        for name, numbers in signals.items()
        if not judge_order(encoded(numbers.tolist(), kind, order), kind, order).plausible
    ]
    assert not withheld


def test_decayed_filter_is_plausible_unless_swapped() -> None:
    watched = item(type="float32")
    monitor = OrderMonitor([watched])

    def read(numbers: Sequence[float], order: Order) -> frozenset[str]:
        for words in encoded(numbers, "float32", order):
            monitor.take(watched, words)
            monitor.end_round()
        return monitor.withheld

    assert not read(np.linspace(23.0, 25.0, 40).tolist(), "ABCD")
    assert not read(np.maximum(24.0 * np.exp(-COUNT.repeat(20) / 3.0), 7e-44).tolist(), "ABCD")
    assert not read([7e-44] * 300, "ABCD")
    assert not read(np.linspace(23.0, 25.0, 40).tolist(), "ABCD")
    assert read([24.0] * 300, "CDAB") == {"s"}
    assert not read([24.0] * 40, "ABCD")


@pytest.mark.parametrize("kind", KINDS)
def test_machine_at_rest_is_plausible(kind: TypeName) -> None:
    assert all(judge_order([[0] * registers_of(kind)] * 20, kind, order).plausible for order in orders_of(kind))


def test_repeated_image_among_new_ones_is_stale() -> None:
    monitor, request = StalenessMonitor(), plan([item("a")], 0, 125)[0]
    for index in range(500):
        assert monitor.take(request, [100 * index, 0]) == (False, False)
    assert monitor.take(request, [49900, 0]) == (True, False)  # aliasing of two clocks
    assert monitor.take(request, [49900, 0]) == (True, True)
    assert monitor.take(request, [50000, 0]) == (False, False)


STEPS = {
    "noise of a few steps": np.rint(4.0 * RANDOM.standard_normal(3000)).astype(int) % 65536,
    "nearly a step in each reading": (0.93 * np.arange(3000)).astype(int) % 65536,
}


@pytest.mark.parametrize("name", STEPS)
def test_repeated_coarse_registers_are_not_stale(name: str) -> None:
    monitor, request = StalenessMonitor(), plan([item("a", type="uint16")], 0, 125)[0]
    assert not any(monitor.take(request, [int(word)])[1] for word in STEPS[name])


def test_machine_that_stops_is_soon_accepted() -> None:
    monitor, request = StalenessMonitor(), plan([item("a", type="uint16")], 0, 125)[0]
    for word in RANDOM.permutation(1000):
        monitor.take(request, [int(word)])
    assert sum(monitor.take(request, [0])[1] for _ in range(1000)) <= MAX_STALE_RUN


def test_frequent_repeats_are_accepted_with_a_warning() -> None:
    """A machine at rest is no fault; nor is a coarse register."""
    monitor, request = StalenessMonitor(), plan([item("a")], 0, 125)[0]
    stale = [monitor.take(request, [index // 5, 0])[1] for index in range(1000)]
    assert not any(stale)
    assert_says(monitor.warnings([request], 0.01)[0], "80% of the readings", 'sample_period = "50 ms"')


@pytest.mark.parametrize("period", [0.010, 0.016, 0.1])
def test_the_period_of_renewals_is_found_between_coarser_readings_and_rests(period: float) -> None:
    times = np.cumsum(0.01 + 1e-3 * np.random.default_rng(1).random(500))
    moving = times % 2.0 < 1.0
    counts = np.floor(np.where(moving, times, np.floor(times) + 1.0) / period)
    renewed = times[1:][np.diff(counts) > 0.0]
    assert renewal_period(np.diff(renewed).tolist()) == pytest.approx(period, rel=0.1)
    assert renewal_period(np.diff(renewed[:4]).tolist()) is None


def test_registers_without_repeats_have_no_warning() -> None:
    monitor, request = StalenessMonitor(), plan([item("a")], 0, 125)[0]
    for index in range(300):
        monitor.take(request, [index, 0])
        assert not monitor.warnings([request], 0.01)
