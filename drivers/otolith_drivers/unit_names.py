"""Units as databases write them, and the names by which pint reads them. Tables only.

pint distinguishes capitals and splits off prefixes: it reads "Grad" as a gigaradian and "amps" as attometres per
second. So a unit is looked up here first: as a whole without its spaces, then factor by factor.
"""

import re


def _by_spelling(rows: str) -> dict[str, str]:
    """Return pint's names by spelling; a row is a name and its spellings."""
    pairs = (row.split(" = ") for row in re.split(r";|\n", rows) if row.strip())
    return {spelling: name.strip() for name, spellings in pairs for spelling in spellings.split()}


EXACT = _by_spelling("""
    (N*m) = Nm NM N.m N-m; (kN*m) = kNm KNm; (mN*m) = mNm; (N*cm) = Ncm; (N*m*s) = Nms; (N*m/A) = N.m/A N-m/A
    degree = ° º; degC = °C ºC ℃; degF = °F ºF ℉; kelvin = °K; (degree/s) = D/S; rpm = /min
    V = v; kV = KV; milliohm = mOhm; megaohm = MOhm; kN = KN; kJ = KJ; MPa = Mpa
    (m/s) = M/s M/S; (m/s^2) = M/s2 M/S2; dimensionless = 1 - --
""")
"""pint's names by spellings whose capitals matter."""

FOLDED = _by_spelling("""
    V = volt volts vrms v_rms vpk v_pk vpeak vdc vac; mV = mvolt mvolts millivolts
    A = amp amps ampere amperes arms a_rms apk a_pk apeak adc aac; mA = mamp mamps milliamp milliamps; Ah = ah
    ohm = ohm ohms; kiloohm = kohm; W = watt watts; kW = kw kilowatt kilowatts; kWh = kwh; J = joule joules
    N = newton newtons; (N*m) = newtonmeter newtonmeters newton-meter newton-meters newtonmetre newtonmetres
    Hz = hz hertz; kHz = khz; s = sec secs second seconds sekunde sekunden sek; ms = msec msecs milliseconds
    min = min mins minute minutes minuten; h = hr hrs hour hours std stunden
    degree = deg degree degrees grad winkelgrad; rad = rad rads radian radians
    turn = rev revs revolution revolutions turn turns umdr umdrehung umdrehungen; (turn/s) = rps u/s r/s
    rpm = rpm r.p.m u/min 1/min r/min tr/min rev/min revs/min revolutions/minute umdr/min umdr./min umdrehungen/min
    rpm = min^-1 min**-1 min-1
    degC = °celsius celsius degc deg.c deg_c degreec degreesc degcelsius degreecelsius degreescelsius
    degC = grad_c gradc gradcelsius; kelvin = kelvin degk
    degF = °fahrenheit fahrenheit degf deg.f deg_f degreef degreesf degfahrenheit degreesfahrenheit
    (km/h) = km/h km/hr km/std kmh kmph kph; (m/s^2) = m/ss; m = metre metres meter meters; km = km
    (kg*m^2) = kgm2 kgm^2 kgm²; (kg*cm^2) = kgcm2 kgcm^2 kgcm²; (g*cm^2) = gcm2 gcm^2 gcm²; kg = kg
    bar = bar; mbar = mbar; hPa = hpa; kPa = kpa; psi = psi; (L/min) = lpm
    percent = pct percent prozent; dimensionless = none n/a unitless counts
""")
"""pint's names by spellings in any capitals, written here in small letters."""

UNCLEAR = {"grad": ("degree", "gon"), "gradian": ("degree", "gon")}
"""Units with several meanings of one dimension, by their exact spelling."""

OTHER_MEANINGS = _by_spelling("degC = C; degF = F; standard_gravity = g G; kN = kn; s = S; m = M")
"""What a symbol means for a signal that has not the dimension of its standard meaning."""

POWER = re.compile(r"(s|sec|mm|cm|m|min|h)([23])", re.IGNORECASE)
"""A unit with an exponent behind it, without a sign between them."""

ODD_PREFIX = re.compile(
    r"\b(?:quecto|ronto|yocto|zepto|atto|femto|peta|exa|zetta|yotta|ronna|quetta"
    r"|(?:mega|giga)(?=(?:volt|ampere|second|radian|meter|turn|degree)\b))\w+"
)
"""A prefix that machines do not have with its unit, so that another unit or a file in capitals is meant."""
