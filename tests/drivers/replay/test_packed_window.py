"""Packed windows: bit for bit the same after reading, and anything else is refused."""

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.replay.recording import HEADER, MAX_RECORDS, unpacked
from tests.drivers.replay.packed_windows import packed
from tests.messages import assert_refuses

WORDS = st.integers(-(2**63), 2**63 - 1)
WINDOWS = st.integers(0, 30).flatmap(
    lambda count: st.lists(st.lists(WORDS, min_size=count, max_size=count), min_size=1, max_size=5)
)


@given(WINDOWS, st.booleans())
def test_times_and_values_are_the_same_bit_for_bit(words: list[list[int]], good: bool) -> None:
    """Values are any 64 bits: not-a-number with any payload, infinity, minus zero, subnormal."""
    numbers = np.array(words, dtype=np.int64).reshape(len(words), -1)
    packet = packed(numbers[0], list(numbers[1:].view(np.float64)), good=good)
    verdict, times, values = unpacked(packet, len(words) - 1)
    assert verdict is good
    assert np.array_equal(times, numbers[0])
    assert np.array_equal(values.view(np.int64), numbers[1:])


def test_signals_with_few_values_take_a_fraction() -> None:
    steps = np.random.default_rng(1).integers(0, 16, (4, 200)) * 0.25
    packet = packed(np.arange(200) * 10_000_000, list(steps), good=True)
    assert len(packet) < 0.2 * steps.nbytes


@pytest.mark.parametrize("signals", [1, 3])
def test_another_number_of_signals_is_refused(signals: int) -> None:
    with pytest.raises(ValueError, match="bytes instead of"):
        unpacked(packed(np.arange(5), [np.ones(5)] * 2, good=True), signals)


@given(st.integers(0, 40), st.integers(0, 255))
def test_a_changed_byte_is_noticed_or_harmless(place: int, value: int) -> None:
    packet = bytearray(packed(np.arange(5), [np.ones(5)], good=True))
    packet[place % len(packet)] = value
    try:
        _, times, values = unpacked(bytes(packet), 1)
    except ValueError as error:
        assert_refuses(error, "")
        return
    assert np.array_equal(times, np.arange(5))
    assert np.array_equal(values, np.ones((1, 5)))


def test_neither_a_short_nor_an_expanding_packet_is_read() -> None:
    packet = packed(np.arange(5), [np.ones(5)], good=True)
    for end in range(len(packet)):
        with pytest.raises(ValueError, match=r".+"):
            unpacked(packet[:end], 1)
    with pytest.raises(ValueError, match="instead of"):
        unpacked(HEADER.pack(5, True) + zlib.compress(bytes(1 << 26)), 1)
    with pytest.raises(ValueError, match="records"):
        unpacked(HEADER.pack(MAX_RECORDS + 1, True), 1)
