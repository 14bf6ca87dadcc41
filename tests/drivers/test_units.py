"""Quantities with units: parsed and converted, or refused with a message."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.units import Quantity, factor, unit
from tests.messages import assert_refuses, raises_saying


@pytest.mark.parametrize(
    ("written", "target", "value"),
    [
        ("6.5 ohm", "ohm", 6.5),
        ("6500 mohm", "ohm", 6.5),
        ("11.7 g*cm^2", "kg*m^2", 1.17e-6),
        ("11.7 g·cm^2", "kg*m^2", 1.17e-6),
        ("2 s", "s", 2.0),
        ("60 rpm", "rad/s", 2 * math.pi),
        ("5 Nm", "N*m", 5.0),
        ("20 degC", "kelvin", 293.15),
        ("5 %", "1", 0.05),
        ("60 min^-1", "rad/s", 2 * math.pi),
        ("60 1 / min", "rad/s", 2 * math.pi),
        ("2 N*m*s", "N*m*s/rad", 2.0),
        ("0.5 (rad/s)/s^0.5", "rad/s^1.5", 0.5),
        ("-1e-3 V", "mV", -1.0),
        (0.25, "1", 0.25),
    ],
)
def test_quantity_in_usual_notations(written: object, target: str, value: float) -> None:
    assert Quantity(target)(written) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("written", "target", "sentence"),
    [
        ("6.5 V", "ohm", "unit 'V' does not measure what 'ohm' does"),
        (6.5, "ohm", "6.5 has no unit"),
        ("6.5", "ohm", "'6.5' has no unit"),
        ("six ohm", "ohm", "'six ohm' is not a number with a unit"),
        ("10 Hz", "rad/s", "turns or radians"),
        ("1 s", "s/s", "does not measure"),
        ("1 1/s", "rad/s", "turns or radians"),
        ("1 rad/s", "1/s", "turns or radians"),
        ("6.5 ohm*9**9**9", "ohm", "is not a unit"),
        ("1 s^9^9^9", "s", "is not a unit"),
        ("0,673 H", "H", "the decimal sign is a point"),
        ("0.673" + 3000 * "<" + "x\ny", "H", "is not a number with a unit"),
        ("0.673<" + 3000 * " " + "x\ny", "H", "is not a number with a unit"),
        (True, "1", "not a quantity"),
        ("1e999 s", "s", "not finite"),
        ("9**9**9**9 s", "s", "is not a unit"),
        ("1 s**99999999", "s", "is not a unit"),
        ("1 __import__('os')", "s", "is not a unit"),
    ],
)
def test_invalid_quantity_names_the_fault(written: object, target: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        Quantity(target)(written)
    assert sentence in str(caught.value)


def test_bounds_are_named_with_their_unit() -> None:
    with raises_saying(ValueError, "'1 ms'", "0.1", "600 s"):
        Quantity("s", 0.1, 600.0)("1 ms")


def test_nm_is_newton_metre() -> None:
    assert unit("Nm").dimensionality == unit("N*m").dimensionality


@given(st.floats(-1e12, 1e12), st.sampled_from([("ohm", "kohm"), ("rpm", "rad/s"), ("degC", "kelvin"), ("Nm", "mN*m")]))
def test_conversion_is_invertible(value: float, units: tuple[str, str]) -> None:
    there, back = factor(units[0], units[1]), factor(units[1], units[0])
    assert back[0] * (there[0] * value + there[1]) + back[1] == pytest.approx(value, rel=1e-9, abs=1e-9)


@given(st.text(max_size=80))
def test_any_text_is_a_quantity_or_refused(text: str) -> None:
    try:
        value = Quantity("ohm")(text)
    except ValueError as error:
        assert_refuses(error, "")
    else:
        assert math.isfinite(value)
