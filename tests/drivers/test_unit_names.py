"""Units as databases of drives and vehicles write them: converted, or refused with a request to write them out."""

import math
import re
from pathlib import Path

import pytest

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.units import equation_text, factor, unit, unit_text
from tests.drivers.can_frames import dbc, decoder, frame
from tests.messages import raises_saying

TURN, DEGREE = 2 * math.pi, math.pi / 180
SPELLINGS: dict[tuple[str, float, float], str] = {
    ("V", 1, 0): "V|[V]|(V)|V(dc)|V_DC|Volts DC|v|Volt|Volts|volt|volts|VOLT|VOLTS|Vdc|VDC|V DC|Vrms|V_rms|Vac",
    ("V", 1e-3, 0): "mV|mv|mVolt|mVolts|millivolts",
    ("V", 1e3, 0): "kV|KV",
    ("A", 1, 0): "A|A_dc|A_peak|Amps DC|Amp|Amps|amps|AMPS|amp|Ampere|Amperes|ampere|Amp.|Arms|A rms|"
    "A_rms|ARMS|Apk|A peak|Adc|A DC|Amps RMS|A(rms)|[A]",
    ("A", 1e-3, 0): "mA|mAmp|mAmps|milliamps",
    ("ohm", 1, 0): "ohm|Ohm|Ohms|OHM|Ω|\u2126",
    ("ohm", 1e-3, 0): "mOhm|mohm|mΩ|milliohm",
    ("ohm", 1e3, 0): "kOhm|KOhm|kΩ|kOhms",
    ("rad", DEGREE, 0): "°|º|deg|Deg|DEG|deg.|Degree|Degrees|degrees|DEGREES|Grad|Winkelgrad",
    ("rad", 1, 0): "rad|Rad|RAD|rads|Radian|Radians",
    ("rad", TURN, 0): "rev|Rev|turn|Turns|revolutions|Umdrehungen|Umdr",
    ("rad/s", DEGREE, 0): "°/s|deg/s|Deg/s|deg/sec|Deg/Sec|degrees/s|Degree/Second|Grad/s|Grad/Sek|º/s|D/S|dps",
    ("rad/s", 1, 0): "rad/s|rad.s-1|rad·s⁻¹|rad s-1|Rad/s|rad/sec|Radians/Second",
    ("rad/s", TURN / 60, 0): "rpm|RPM|Rpm|r.p.m.|1/min|min-1|min⁻¹|rot/min|min^-1|/min|U/min|U/Min|Umdr/min|"
    "Umdrehungen/min|"
    "Umdr./min|[rpm]|RPMs|UPM|Upm|rotations/min|rev/min|Rev/Min|revs/min|Revolutions/Minute|r/min|tr/min|1/Min",
    ("rad/s", TURN, 0): "rps|rev/s|Rev/s|U/s|Umdr/s|r/s",
    ("rad/s^2", 1, 0): "rad/s2|rad/s²|rad/s^2|rad/s/s|rad/sec2|rad/s**2",
    ("rad/s^2", DEGREE, 0): "deg/s2|°/s2|°/s²|deg/s^2|Deg/s2|Grad/s2|deg/sec^2",
    ("degC", 1, 0): "°C|ºC|° C|℃|degC|DegC|deg C|Deg C|DEG C|deg.C|Degrees C|degrees C|Degree C|Celsius|celsius|"
    "Cel|Â°C|\ufffdC|"
    "Degrees Celsius|deg Celsius|Grad C|Grad Celsius|GradC|C|deg_C|°Celsius|°c|˚C|oC|[°C]|Celcius",
    ("degC", 5 / 9, -160 / 9): "°F|degF|deg F|Deg F|Degrees F|Fahrenheit|F",
    ("K", 1, 0): "K|Kelvin|kelvin|degK|deg K|°K",
    ("N*m", 1, 0): "Nm|[Nm]|N⋅m|N∙m|N•m|N-M|N_m|Nm rms|NM|N.m|N-m|N*m|N m|N·m|Newton meter|Newton-meters|newtonmeter",
    ("N*m", 1e3, 0): "kNm|KNm|kN*m",
    ("N*m", 1e-3, 0): "mNm|mN.m|mN-m|Nmm|N.mm|mN·m",
    ("N*m", 1e-2, 0): "Ncm|cNm|cN*m",
    ("N*m", 10, 0): "daNm",
    ("N*m", 1.3558179, 0): "lb-ft|ft-lb|lbf-ft|ft.lbf|lbf*ft|ft lbf|FT-LB|ft-lbs|ftlbs|ft.lb|lb.ft|lbf.ft|lbft",
    ("N*m", 0.11298483, 0): "in-lb|lbf-in|lb-in|lbf*in|in-lbs|lbs-in|in.lb",
    ("N*m", 7.0615518e-3, 0): "oz-in|ozf-in|oz.in|ozf*in",
    ("N*m", 0.0980665, 0): "kgf-cm|kgf.cm|kgf*cm",
    ("N*m/A", 1, 0): "Nm/A|N.m/A|Nm/Arms|Nm/Amp",
    ("N*m/s", 1, 0): "Nm/s|Nm/sec",
    ("m/s^2", 1, 0): "m/s2|m/s²|m/s^2|m/ss|m/s/s|m/sec2|m/sec^2|M/S2",
    ("m/s^2", 9.80665, 0): "g|G|g_n",
    ("m/s", 1 / 3.6, 0): "km/h|Km/h|KM/H|kmh|Kmh|KMH|kph|KPH|kmph|km/hr|km/Std",
    ("m/s", 1, 0): "m/s|m/sec|M/s",
    ("N", 1, 0): "N|Newton|Newtons|newtons",
    ("N", 1e3, 0): "kN|KN|kn",
    ("W", 1, 0): "W|Watt|Watts|WATT|watts",
    ("W", 735.49875, 0): "PS",
    ("W", 745.69987, 0): "hp|HP|Hp",
    ("V*s/rad", 1, 0): "V.s/rad|Vs/rad|V/(rad/s)",
    ("V*s/rad", 9.5492966e-3, 0): "V/krpm|V/kRPM|mV/rpm",
    ("H", 1e-3, 0): "mH|mHenry",
    ("Pa", 133.322368, 0): "Torr|torr",
    ("W", 1e3, 0): "kW|KW|Kw|kw|kiloWatt",
    ("W*h", 1e3, 0): "kWh|KWh|KWH|kwh",
    ("J", 1, 0): "J|Joule|Joules",
    ("Hz", 1, 0): "Hz|hz|HZ|Hertz",
    ("Hz", 1e3, 0): "kHz|KHz|khz|KHZ",
    ("s", 1, 0): "s|S|sec|Sec|SEC|secs|Seconds|second|sec.|Sekunden|Sek",
    ("s", 1e-3, 0): "ms|msec|mSec|Msec|milliseconds",
    ("s", 60, 0): "min|Min|MIN|minutes|Minuten|min.",
    ("s", 3600, 0): "h|hr|hrs|Hours|hour|Std|Stunden",
    ("Pa", 1e5, 0): "bar|Bar|BAR",
    ("Pa", 1e2, 0): "mbar|mBar|hPa|hpa",
    ("Pa", 1e3, 0): "kPa|KPa|kpa|KPA",
    ("Pa", 1e6, 0): "MPa|Mpa",
    ("Pa", 6894.757, 0): "psi|PSI|Psi",
    ("kg", 1, 0): "kg|Kg|KG",
    ("m", 1, 0): "m|M|meter|Meters|metres",
    ("A*h", 1, 0): "Ah|AH",
    ("m", 1e-3, 0): "mm",
    ("m", 1e3, 0): "km|Km|KM",
    ("m^3/s", 1 / 60e3, 0): "l/min|L/min|l/Min|lpm|LPM|liters/minute",
    ("m^3/s", 1 / 3600, 0): "m3/h|m³/h|m^3/h|m3/hr",
    ("kg*m^2", 1, 0): "kgm2|kg.m2|kg.m^2|kg-m^2|kg*m2|kg m2|kg m^2|kgm^2|kgm²",
    ("kg*m^2", 1e-4, 0): "kgcm2|kg.cm2|kg*cm2|kg cm^2",
    ("1", 0.01, 0): "%|Percent|percent|PERCENT|pct|Pct|Prozent",
    ("1", 1, 0): "|-|--|1|none|None|n/a|N/A|unitless|Unitless|counts",
}  # fmt: skip


@pytest.mark.parametrize(
    ("written", "target", "scale", "offset"),
    [(text, *meaning) for meaning, texts in SPELLINGS.items() for text in texts.split("|")],
)
def test_spelling_of_a_database_is_understood(written: str, target: str, scale: float, offset: float) -> None:
    assert list(factor(written, target)) == [pytest.approx(scale, rel=1e-6), pytest.approx(offset, abs=1e-9)]


@pytest.mark.parametrize(
    ("written", "target"),
    [
        ("grad", "rad"),  # the degree in German, the gon elsewhere
        ("grad/s", "rad/s"),
        ("Gon?", "rad"),
        ("MV", "V"),  # of a file in capitals, or a million volts
        ("MA", "A"),
        ("Ms", "s"),
        ("MRAD", "rad"),
        ("Mrad", "rad"),
        ("PF", "F"),
        ("counts", "rad"),  # an encoder's
        ("", "rad"),
        ("%", "rad"),
        ("deg", "degC"),  # Celsius or Fahrenheit
        ("°", "kelvin"),
        ("ERPM", "rad/s"),  # times the pole pairs
        ("1/s", "rad/s"),
        ("Hz", "rad/s"),
        ("barg", "Pa"),  # above the pressure of the air
        ("mpa", "Pa"),
        ("U", "rad"),
        ("bits", "rad"),
        ("rad", "1"),
        ("dB", "1"),  # logarithmic: no factor converts it
        ("ton", "kg"),  # metric, short or long
        ("psig", "Pa"),
    ],
)  # fmt: skip
def test_ambiguous_unit_is_refused(written: str, target: str) -> None:
    with pytest.raises(ValueError, match=r"unit|measure|write"):
        factor(written, target)


@pytest.mark.parametrize(
    ("written", "per_turn"), [("gon", 400), ("gon/s", 400), ("arcmin", 21600), ("arcsec", 1296000)]
)
def test_every_unit_of_an_angle_is_one(written: str, per_turn: int) -> None:
    target = "rad/s" if written.endswith("/s") else "rad"
    assert factor(written, target)[0] == pytest.approx(2 * math.pi / per_turn)


def test_ambiguous_unit_names_its_meanings() -> None:
    with raises_saying(ValueError, "'grad'", "'degree'", "'gon'"):
        unit("grad")
    with pytest.raises(ValueError, match=r"'MV' would be megavolt: write"):
        unit("MV")
    for written, target, turns in (("counts", "rad", "turn"), ("1/s", "rad/s", "rpm"), ("1/s2", "rad/s2", "turn/s^2")):
        with pytest.raises(
            ValueError, match=f"whether turns or radians are meant: write '{target}' or '{re.escape(turns)}'"
        ):
            factor(written, target)
    with raises_saying(ValueError, "'rpm'", "turns or radians", "'Hz'"):
        factor("rpm", "Hz")


@pytest.mark.parametrize("written", ["C", "F", "g", "kn", "S"])
def test_a_symbol_keeps_its_standard_meaning(written: str) -> None:
    """Only a signal of another dimension takes the other meaning."""
    standard = {"C": "coulomb", "F": "farad", "g": "gram", "kn": "knot", "S": "siemens"}[written]
    assert factor(written, standard) == (1.0, 0.0)


def test_ambiguous_unit_of_a_database_asks_for_unit(tmp_path: Path) -> None:
    """And the unit of the machine file replaces that of the database."""
    text = dbc('BO_ 385 Motor: 8 Drive\n SG_ Angle : 0|16@1- (0.5,0) [0|0] "grad" Monitor')
    with raises_saying(ConfigurationError, "Motor.Angle", "'grad'", "'unit'"):
        decoder(tmp_path, {"phi": ("rad", {"signal": "Angle"})}, text)
    with pytest.raises(ConfigurationError, match=r"'1/s' leaves open .*; set 'unit' beside it"):
        decoder(tmp_path, {"omega": ("rad/s", {"signal": "Angle"})}, text.replace("grad", "1/s"))
    read = decoder(tmp_path, {"phi": ("rad", {"signal": "Angle", "unit": "degree"})}, text)
    (sample,) = read.decode(frame(385, bytes([180, 0, 0, 0, 0, 0, 0, 0])), 0.0)
    assert sample.value == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        *(("ohm", "Ω"), ("mohm", "mΩ"), ("kOhm", "kΩ"), ("uohm", "µΩ"), ("uA", "µA"), ("um", "µm"), ("us", "µs")),
        *(("N*m*s/rad", "N·m·s/rad"), ("kg*m^2", "kg·m²"), ("N*m**2/A", "N·m²/A"), ("m^3/s", "m³/s")),
        *(("1/s^0.5", "1/s^0.5"), ("m^2.5", "m^2.5"), ("(rad/s)/s^0.5", "(rad/s)/s^0.5"), ("rad/s^2", "rad/s²")),
        *(("degC", "°C"), ("delta_degC", "°C"), ("degF", "°F"), ("deg/s", "°/s"), ("degree", "°"), ("rpm", "rpm")),
        *(("1", ""), ("", ""), ("rad/rad", ""), ("m/mm", "m/mm"), ("kelvin", "kelvin"), ("bus", "bus")),
        *(("L/min", "L/min"), ("Ω", "Ω"), ("N·m", "N·m")),
    ],
)
def test_a_unit_is_shown_by_its_usual_symbols_and_read_back(written: str, shown: str) -> None:
    assert unit_text(written) == shown
    if shown and written != "bus":  # no unit, but the end of a word is no ohm and its begin no prefix
        assert unit(shown).dimensionality == unit(written).dimensionality


@pytest.mark.parametrize(
    ("written", "shown"),
    [
        ("0.0053·sin(1·angle(omega) - 3.06) N*m", "0.0053·sin(1·θ - 3.06) N·m"),
        ("0.2·sin(3·angle(omega_load) + 1.00) N*m", "0.2·sin(3·θ_load + 1.00) N·m"),
        ("2·sign(angle(n)) ohm", "2·sign(θ_n) Ω"),
        ("0.5·omega^0.3 N*m", "0.5·omega^0.3 N·m"),
        ("0.1·exp(-(ohm/0.2)^2)", "0.1·exp(-(ohm/0.2)²)"),
        ("0.3·deg", "0.3·deg"),
    ],
)
def test_an_equation_is_shown_with_symbols_and_keeps_its_names(written: str, shown: str) -> None:
    assert equation_text(written) == shown


@pytest.mark.parametrize(
    ("written", "target"),
    [
        ("(m)/(N*m)", "1/N"),
        ("(rad/s)/(N*m*s)", "rad/(N*m*s^2)"),
        ("(N*m)/(A)", "N*m/A"),
        ("((N*m))/(kg)", "m^2/s^2"),
        ("(kg)*(m^2)", "kg*m^2"),
    ],
)
def test_parentheses_hold_a_product_together(written: str, target: str) -> None:
    assert list(factor(written, target)) == [pytest.approx(1.0), pytest.approx(0.0)]
