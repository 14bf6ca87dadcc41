"""Raw numbers in frames: read as cantools reads them from the same layout."""

import math
import struct
from typing import Literal

import pytest
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.canbus.options import bytes_needed, raw_reader


@st.composite
def layouts(draw: st.DrawFn) -> CanSignal:
    is_float = draw(st.booleans())
    length = draw(st.sampled_from([16, 32, 64]) if is_float else st.integers(1, 64))
    orders: tuple[Literal["little_endian", "big_endian"], ...] = ("little_endian", "big_endian")
    order = draw(st.sampled_from(orders))
    first = draw(st.integers(0, 512 - length))
    start = first if order == "little_endian" else 8 * (first // 8) + 7 - first % 8
    return CanSignal(
        "S",
        start,
        length,
        byte_order=order,
        is_signed=draw(st.booleans()),
        conversion=BaseConversion.factory(is_float=is_float),
    )


@given(layouts(), st.binary(min_size=64, max_size=64))
def test_raw_numbers_are_those_of_cantools(signal: CanSignal, data: bytes) -> None:
    expected = Message(1, "M", 64, [signal], is_fd=True).decode_simple(data, decode_choices=False)["S"]
    assert isinstance(expected, int | float)
    got = raw_reader(signal)(bytearray(data))
    assert got == expected or (math.isnan(got) and math.isnan(expected))


@given(layouts(), st.binary(min_size=64, max_size=64))
def test_bytes_beyond_those_needed_have_no_effect(signal: CanSignal, data: bytes) -> None:
    needed = bytes_needed(signal)
    got, whole = raw_reader(signal)(data[:needed]), raw_reader(signal)(data)
    assert got == whole or (math.isnan(got) and math.isnan(whole))


@pytest.mark.parametrize(("start", "length", "is_float"), [(0, 0, False), (-1, 8, False), (0, 24, True)])
def test_layouts_that_are_no_number_are_refused(start: int, length: int, is_float: bool) -> None:
    with pytest.raises(ValueError, match="bits"):
        raw_reader(CanSignal("S", start, length, conversion=BaseConversion.factory(is_float=is_float)))


def test_a_double_that_is_not_byte_aligned() -> None:
    signal = CanSignal("S", 3, 64, conversion=BaseConversion.factory(is_float=True))
    data = (int.from_bytes(struct.pack("<d", -2.5), "little") << 3).to_bytes(9, "little")
    assert raw_reader(signal)(data) == -2.5
