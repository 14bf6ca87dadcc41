"""How a value is written: rounded as its interval, with the prefix of its unit."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith_drivers.units import quantity_text, scale_of

EXPONENTS = {"p": -12, "n": -9, "µ": -6, "m": -3, "": 0, "k": 3, "M": 6, "G": 9}


@pytest.mark.parametrize(
    ("value", "half", "unit", "text"),
    [
        (0.0046806, 0.000041, "N*m", "4.681 ± 0.041 mN·m"),
        (0.0014296, 1.5e-6, "N*m*s/rad", "1.4296 ± 0.0015 mN·m·s/rad"),
        (5.98561, 0.0075, "ohm", "5.9856 ± 0.0075 Ω"),
        (6.5, 0.02, "ohm", "6.500 ± 0.020 Ω"),
        (12345.0, 678.0, "N", "12.35 ± 0.68 kN"),
        (300.0, 123.0, "ohm", "300 ± 120 Ω"),
        (0.00012, 1.2e-4, "V*s/rad", "120 ± 120 µV·s/rad"),
        (-0.003, 3.9, "N*m", "0.0 ± 3.9 N·m"),
        (0.0, 2e-5, "N", "0 ± 20 µN"),
        (0.0, 0.0, "N", "0 ± 0 N"),
        (5.0, 2e-12, "ohm", "5 ± 2e-12 Ω"),
        (0.0099, 0.00996, "A", "10 ± 10 mA"),
        (0.5, 0.1, "1", "0.50 ± 0.10"),
        (0.00014296, 1.5e-7, "kg*m^2", "142.96e-6 ± 0.15e-6 kg·m²"),
        (1500.0, 2.0, "rad/s", "1500.0 ± 2.0 rad/s"),
        (2e-8, 3e-9, "m^3/s", "20.0e-9 ± 3.0e-9 m³/s"),
        (0.0021, 0.0003, "s", "2.10 ± 0.30 ms"),
        (7200.0, 60.0, "s", "7200 ± 60 s"),
        (0.02, 0.001, "mm", "0.0200 ± 0.0010 mm"),
        (3.0, None, "N", "3 N"),
        (0.000075, None, "N*m", "75 µN·m"),
        (math.inf, 1.0, "N", "inf ± 1 N"),
    ],
)
def test_value_and_interval_are_rounded_together(value: float, half: float | None, unit: str, text: str) -> None:
    assert quantity_text(value, unit, half) == text


@given(
    st.floats(1e-9, 1e9), st.floats(1e-4, 1.0), st.sampled_from(["N*m", "ohm", "kg*m^2", "1", "rad/s", "V*s/rad", "s"])
)
def test_what_is_written_is_the_value_to_two_digits_of_its_interval(value: float, share: float, unit: str) -> None:
    half = share * value
    match = re.fullmatch(r"(\S+) ± (\S+?)(?: ([pnµmkMG]?)(?=N|Ω|V|s|$)\S*| \S+)?", quantity_text(value, unit, half))
    assert match
    factor = 10.0 ** EXPONENTS[match[3] or ""]
    assert float(match[2]) * factor == pytest.approx(half, rel=0.051)
    assert abs(float(match[1]) * factor - value) <= 0.051 * half


def test_numbers_beside_a_value_have_its_scale() -> None:
    scale = scale_of(0.00143, "N*m*s/rad")
    assert (scale.number(0.002145, 4), scale.number(0.0), scale.unit) == ("2.145", "0", "mN·m·s/rad")
    assert scale_of(1.4e-4, "kg*m^2").number(2.1e-4) == "210e-6"
