"""Units as databases write them, and the names by which pint reads them. Tables only.

pint distinguishes capitals and splits off prefixes: it reads "Grad" as a gigaradian and "amps" as attometres per
second. So a unit is looked up here first: as a whole without its spaces, then factor by factor.
"""

import re


def _by_spelling(table: dict[str, str]) -> dict[str, str]:
    return {spelling: name for name, spellings in table.items() for spelling in spellings.split()}


EXACT = _by_spelling(
    {
        "(N*m)": "Nm NM N.m N-m",
        "(kN*m)": "kNm KNm",
        "(mN*m)": "mNm",
        "(N*cm)": "Ncm",
        "(N*m*s)": "Nms",
        "(N*m/A)": "N.m/A N-m/A",
        "rpm": "/min",
        "degree": "° º",
        "degC": "°C ºC ℃",
        "degF": "°F ºF ℉",
        "kelvin": "°K",
        "V": "v",
        "(m/s)": "M/s M/S",
        "(degree/s)": "D/S",
        "(m/s^2)": "M/s2 M/S2",
        "milliohm": "mOhm",
        "megaohm": "MOhm",
        "MPa": "Mpa",
        "kN": "KN",
        "kV": "KV",
        "kJ": "KJ",
        "dimensionless": "1 - --",
    }
)
"""pint's names by spellings whose capitals matter."""

FOLDED = _by_spelling({
    "V": "volt volts vrms v_rms vpk v_pk vpeak vdc vac",
    "mV": "mvolt mvolts millivolts",
    "A": "amp amps ampere amperes arms a_rms apk a_pk apeak adc aac",
    "mA": "mamp mamps milliamp milliamps",
    "ohm": "ohm ohms",
    "kiloohm": "kohm",
    "W": "watt watts",
    "kW": "kw kilowatt kilowatts",
    "kWh": "kwh",
    "Ah": "ah",
    "J": "joule joules",
    "N": "newton newtons",
    "(N*m)": "newtonmeter newtonmeters newton-meter newton-meters newtonmetre newtonmetres",
    "Hz": "hz hertz",
    "kHz": "khz",
    "s": "sec secs second seconds sekunde sekunden sek",
    "ms": "msec msecs milliseconds",
    "min": "min mins minute minutes minuten",
    "h": "hr hrs hour hours std stunden",
    "degree": "deg degree degrees grad winkelgrad",
    "rad": "rad rads radian radians",
    "turn": "rev revs revolution revolutions turn turns umdr umdrehung umdrehungen",
    "rpm": "rpm r.p.m u/min 1/min r/min tr/min rev/min revs/min revolutions/minute umdr/min umdr./min umdrehungen/min "
           "min^-1 min**-1 min-1",
    "(turn/s)": "rps u/s r/s",
    "degC": "°celsius celsius degc deg.c deg_c degreec degreesc degcelsius degreecelsius degreescelsius grad_c gradc "
            "gradcelsius",
    "degF": "°fahrenheit fahrenheit degf deg.f deg_f degreef degreesf degfahrenheit degreesfahrenheit",
    "kelvin": "kelvin degk",
    "(km/h)": "km/h km/hr km/std kmh kmph kph",
    "(m/s^2)": "m/ss",
    "(kg*m^2)": "kgm2 kgm^2 kgm²",
    "(kg*cm^2)": "kgcm2 kgcm^2 kgcm²",
    "(g*cm^2)": "gcm2 gcm^2 gcm²",
    "kg": "kg",
    "m": "metre metres meter meters",
    "km": "km",
    "bar": "bar",
    "mbar": "mbar",
    "hPa": "hpa",
    "kPa": "kpa",
    "psi": "psi",
    "(L/min)": "lpm",
    "percent": "pct percent prozent",
    "dimensionless": "none n/a unitless counts",
})  # fmt: skip
"""pint's names by spellings in any capitals, written here in small letters."""

UNCLEAR = {
    "grad": ("degree", "gon"),
    "gradian": ("degree", "gon"),
}
"""Units with several meanings of one dimension, by their exact spelling."""

OTHER_MEANINGS = {
    "C": "degC",
    "F": "degF",
    "g": "standard_gravity",
    "G": "standard_gravity",
    "kn": "kN",
    "S": "s",
    "M": "m",
}
"""What a symbol means for a signal that has not the dimension of its standard meaning."""

POWER = re.compile(r"(s|sec|mm|cm|m|min|h)([23])", re.IGNORECASE)
"""A unit with an exponent behind it, without a sign between them."""

ODD_PREFIX = re.compile(
    r"\b(?:quecto|ronto|yocto|zepto|atto|femto|peta|exa|zetta|yotta|ronna|quetta"
    r"|(?:mega|giga)(?=(?:volt|ampere|second|radian|meter|turn|degree)\b))\w+"
)
"""A prefix that machines do not have with its unit, so that another unit or a file in capitals is meant."""
