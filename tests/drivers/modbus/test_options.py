"""Registers to numbers, for all types, orders and contents."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.base import Signal
from otolith_drivers.modbus.options import (
    ORDERS,
    ModbusOptions,
    ModbusSource,
    Order,
    TypeName,
    bit_reader,
    reader,
    register_signal,
    registers_of,
)
from tests.drivers.registers import KINDS, item, registers


@given(st.sampled_from(KINDS), st.sampled_from(ORDERS), st.data())
def test_reader_inverts_the_encoding(kind: TypeName, order: Order, data: st.DataObject) -> None:
    width = 16 * registers_of(kind)
    if kind.startswith("float"):
        number: float = data.draw(st.floats(width=32 if width == 32 else 64, allow_nan=False))
    else:
        low = 0 if kind.startswith("u") else -(2 ** (width - 1))
        number = data.draw(st.integers(low, low + 2**width - 1))
    assert reader(kind, order)(registers(number, kind, order)) == number


@given(st.sampled_from(KINDS), st.sampled_from(ORDERS), st.lists(st.integers(0, 65535), min_size=4, max_size=4))
def test_any_registers_are_a_finite_value_or_nan(kind: TypeName, order: Order, words: list[int]) -> None:
    value = item(type=kind, order=order, scale=1e300).value(words[: registers_of(kind)])
    assert math.isfinite(value) or math.isnan(value)


@given(st.integers(0, 65535), st.integers(0, 15), st.integers(0, 15))
def test_bit_field_of_an_integer(word: int, one: int, other: int) -> None:
    low, high = sorted((one, other))
    value = item(type="uint16", bits=f"{low}..{high}").value([word])
    assert value == int(f"{word:016b}"[15 - high : 16 - low], 2)


@pytest.mark.parametrize(("written", "kind"), [("4..2", "uint16"), ("16", "int16"), ("x", "int16"), ("1", "float32")])
def test_invalid_bit_field_is_refused(written: str, kind: TypeName) -> None:
    with pytest.raises(ValueError, match="bits"):
        bit_reader(written, kind)


def test_scale_offset_and_unit_are_applied_in_order() -> None:
    assert item(type="int16", scale=0.1, offset=-5.0, unit="mV").value([200]) == pytest.approx(0.015)


def test_value_out_of_range_is_nan() -> None:
    assert math.isnan(item(type="int16", unit="V", range=(-10.0, 10.0)).value([11]))


def test_first_address_shifts_registers() -> None:
    source = ModbusSource.model_validate({"register": 1, "type": "int16", "unit": "V"})
    assert register_signal(Signal("s", "V", source), ModbusOptions(host="localhost", first_address=1)).address == 0
