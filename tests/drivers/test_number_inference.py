"""Number inference: certain where bytes move, likely where they hardly do, none where they are still."""

import re
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from otolith_drivers.modbus.options import ORDERS, LineOptions, Order, TypeName, is_float, orders_of
from otolith_drivers.modbus.probe import Block, Number, Place, Words, modbus_signal_lines, numbers_of
from otolith_drivers.number_inference import FRAMES, REGISTERS, Layout, LayoutVerdict, Part, parts
from tests.drivers.registers import registers

READINGS = 250
KINDS: list[TypeName] = ["int16", "uint16", "int32", "float32", "float64"]
FULL = {"int16": 2e4, "uint16": 6e4, "int32": 1.5e6}
Floats = NDArray[np.float64]


def moving(random: np.random.Generator) -> dict[str, Floats]:
    """Typical signals of machines."""
    time, noise = 0.012 * np.arange(READINGS), random.standard_normal(READINGS)
    return {
        "voltage with noise": 24.0 + 0.01 * noise,
        "noise around zero": 2e-4 * noise,
        "noisy ramp": np.linspace(0.0, 1.0, READINGS) + 1e-3 * noise,
        "speed that changes its sign": 30.0 * np.sin(2.0 * time),
        "display with two decimals": 20.0 + np.round(0.3 * time, 2),
        "set-point in halves": 24.0 + 0.5 * np.floor(time),
        "speed with noise": 1500.0 + 3.0 * noise,
        "one step in the last decimal": 23.456 + 0.001 * (time > 1.5),
    }


SIGNALS = moving(np.random.default_rng(1))


def words(numbers: Floats, kind: TypeName, order: Order) -> Words:
    if not is_float(kind):
        numbers = np.round(numbers / np.abs(numbers).max() * FULL[kind])
        numbers = np.abs(numbers) if kind == "uint16" else numbers
    return np.array([registers(number, kind, order) for number in numbers.tolist()], dtype=np.uint16)


def still(*values: int) -> Words:
    return np.tile(np.array(values, dtype=np.uint16), (READINGS, 1))


def inferred(*columns: Words) -> list[Number]:
    together = np.hstack(columns)
    return numbers_of({Block(0, together.shape[1]): together})


def same(layout: Layout | None, kind: TypeName, order: Order) -> bool:
    """Whether type and order agree; signed and unsigned count as one, as half of their numbers are the same."""
    return layout is not None and layout.kind.lstrip("u") == kind.lstrip("u") and layout.order == order


@pytest.mark.parametrize("name", SIGNALS)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("order", ORDERS)
def test_number_among_still_registers(name: str, kind: TypeName, order: Order) -> None:
    if order not in orders_of(kind) or (name, kind) == ("noise around zero", "uint16"):
        pytest.skip("a single register has no word order, and this noise has no unsigned form")
    column = words(SIGNALS[name], kind, order)
    numbers = [number for number in inferred(still(0x1234, 0), column, still(0, 7)) if number.part.layout]
    for number in numbers:
        layout = number.part.layout
        if number.part.verdict is LayoutVerdict.CERTAIN:
            # The high half of an integer may be still: then only its low half can be recognised.
            half = kind == "int32" and layout is not None and layout.kind in ("int16", "uint16")
            assert half or (number.address == 2 and same(layout, kind, order))
    if is_float(kind) and name not in ("set-point in halves", "one step in the last decimal"):
        assert [number.part.verdict for number in numbers] == [LayoutVerdict.CERTAIN]
        assert numbers[0].part.latest == pytest.approx(SIGNALS[name][-1], rel=1e-6)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("seed", range(5))
def test_adjacent_numbers_of_all_types(order: Order, seed: int) -> None:
    """All move and have one order, so each is recognised in its place."""
    random = np.random.default_rng(seed)
    kinds: list[TypeName] = ["float32", "int16", "int32", "float64", "float32", "float32", "int16", "int16"]
    signals = list(moving(random).values())
    wanted, columns, address = [], [still(0x0237)], 1
    for kind in kinds:
        # An integer that stays near its mean has a still high half, which is another test.
        number = signals[int(random.choice([2, 3] if kind == "int32" else [0, 2, 3, 6]))]
        kept = order if kind != "int16" else "ABCD"
        columns.append(words(number + 0.01 * random.standard_normal(READINGS), kind, kept))
        wanted.append((address, kind, kept))
        address += columns[-1].shape[1]
    recognised = {
        (number.address, layout.kind.lstrip("u"), layout.order)
        for number in inferred(*columns)
        if (layout := number.part.layout) is not None
    }
    assert recognised == set(wanted)


@pytest.mark.parametrize("seed", range(3))
def test_still_registers_have_no_type(seed: int) -> None:
    random = np.random.default_rng(seed)
    column = still(*random.integers(0, 1 << 16, 40).tolist(), *registers(23.5, "float32", "ABCD"))
    assert {number.part.verdict for number in inferred(column)} == {LayoutVerdict.STILL}


def test_noise_in_all_bits_is_erratic() -> None:
    random = np.random.default_rng(2)
    column = random.integers(0, 1 << 16, (READINGS, 3)).astype(np.uint16)
    assert {number.part.verdict for number in inferred(column)} == {LayoutVerdict.ERRATIC}


def frames(*columns: Floats | NDArray[np.int_], layout: str) -> NDArray[np.uint8]:
    record = np.zeros(READINGS, dtype=np.dtype([(f"f{at}", part) for at, part in enumerate(layout.split())]))
    for at, column in enumerate(columns):
        record[f"f{at}"] = column
    return record.view(np.uint8).reshape(READINGS, -1)


def in_frames(data: NDArray[np.uint8]) -> list[Part]:
    return [part for part in parts(data, FRAMES, 1) if part.layout is not None]


@pytest.mark.parametrize(("mark", "order"), [("<", "little"), (">", "big")])
def test_fields_of_a_can_frame(mark: str, order: str) -> None:
    speed, current = 1000.0 * SIGNALS["speed that changes its sign"] / 30.0, 2000.0 + 300.0 * SIGNALS["noisy ramp"]
    count = np.arange(READINGS) % 256
    data = frames(speed.round(), current.round(), np.zeros(READINGS), count, layout=f"{mark}i2 {mark}i2 {mark}i2 u1")
    one, other, counter = in_frames(data)
    assert [(part.start, part.layout and part.layout.name) for part in (one, other)] == [
        (0, f"int16 {order}"),
        (2, f"int16 {order}"),
    ]
    assert (one.verdict, counter.start, counter.verdict) == (LayoutVerdict.CERTAIN, 6, LayoutVerdict.COUNTER)


def test_can_fields_of_three_and_four_bytes() -> None:
    position = (1e6 * SIGNALS["speed that changes its sign"]).round().astype(np.int64)
    data = np.hstack([frames(position, layout="<i4"), frames((position // 10) << 8, layout="<i4")[:, 1:]])
    fields = in_frames(data)
    assert [(part.start, part.layout and part.layout.name) for part in fields] == [
        (0, "int32 little"),
        (4, "int24 little"),
    ]


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12).flatmap(lambda width: arrays(np.uint16, st.tuples(st.integers(0, 12), st.just(width)))))
def test_any_registers_are_covered_once(readings: Words) -> None:
    numbers = numbers_of({Block(100, readings.shape[1]): readings})
    places = [at for number in numbers for at in range(number.address, number.address + number.count)]
    assert places == (list(range(100, 100 + readings.shape[1])) if len(readings) else [])


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12).flatmap(lambda width: arrays(np.uint8, st.tuples(st.integers(1, 12), st.just(width)))))
def test_any_bytes_are_covered_once(data: NDArray[np.uint8]) -> None:
    places = [at for part in parts(data, FRAMES, 1) for at in range(part.start, part.start + part.width)]
    assert places == list(range(data.shape[1]))
    assert all(layout.width <= 8 for layout in REGISTERS)


def test_a_probability_is_not_too_high() -> None:
    """Of the candidates in frames with one moving number, at least as many are right as their probabilities say."""
    random = np.random.default_rng(1)
    right, probabilities = [], []
    for _ in range(400):
        layout = FRAMES[random.integers(len(FRAMES))]
        count, at = int(random.choice([8, 12, 20, 40])), int(random.integers(0, 9 - layout.width))
        wave = np.sin(random.uniform(0.01, 0.3) * np.arange(count) + random.uniform(0.0, 6.0))
        wave += 10.0 ** random.uniform(-3.0, -1.0) * random.standard_normal(count)
        if layout.is_float:
            rows = [struct.pack(">f", value) for value in 10.0 ** random.uniform(-1.0, 3.0) * wave]
        else:
            size = 2.0 ** random.uniform(3.0, 8 * layout.width - 2)
            middle = 0.0 if layout.signed else 2.0 * size
            rows = [round(middle + size * value).to_bytes(layout.width, "big", signed=layout.signed) for value in wave]
        data = np.repeat(random.integers(0, 256, (1, 8)), count, axis=0).astype(np.uint8)
        data[:, [at + position for position in layout.positions]] = np.frombuffer(b"".join(rows), np.uint8).reshape(
            count, -1
        )
        number = layout.numbers(data[:, at : at + layout.width])
        for part in parts(data, FRAMES, 1):
            if part.layout is not None and part.verdict in (LayoutVerdict.CERTAIN, LayoutVerdict.LIKELY):
                overlaps = part.start < at + layout.width and part.end > at
                right.append(overlaps and np.ptp(part.numbers - number) == 0.0)
                probabilities.append(part.probability)
    assert len(right) > 300
    assert np.mean(right) > np.mean(probabilities)
    assert np.mean(np.array(right)[np.array(probabilities) >= 0.95]) > 0.93


def lines_of(words: Words) -> list[str]:
    place = Place(LineOptions(host="plc"), 1, "holding", 0)
    return [
        line for line in modbus_signal_lines(place, numbers_of({Block(0, words.shape[1]): words})) if "NAME" in line
    ]


def test_a_quiet_high_word_offers_the_reading_of_32_bits() -> None:
    """While the high word is still, the low one changes as a number of 16 bits does."""
    random, time = np.random.default_rng(4), np.arange(READINGS)
    number = np.round(70_000 + 300 * np.sin(0.05 * time) + random.standard_normal(READINGS)).astype(np.int64)
    words = np.stack([number >> 16, number & 0xFFFF, 0 * number + 7], axis=1).astype(np.uint16)
    (line,) = lines_of(words)
    assert re.search(r"# \? \d+ now.*; or u?int32 of register 0 \((69|70)\d\d\d\)", line)
    assert re.search(r"; or u?int32 CDAB of register 1 \(46\d\d\d\d\)", line), (
        "the register behind may be the high word"
    )


def test_only_what_is_uncertain_is_marked_in_the_lines() -> None:
    random, time = np.random.default_rng(4), np.arange(READINGS)
    number = np.round(900 * np.sin(0.05 * time) + 2 * random.standard_normal(READINGS)).astype(np.int16)
    words = np.stack([number.view(np.uint16), (number // 3 + 100).view(np.uint16)], axis=1)
    assert [line.partition("#")[2].startswith(" ?") for line in lines_of(words)] == [False, False]
    (line,) = lines_of(words[:5, :1])
    assert line.partition("#")[2].startswith(" ? ")
