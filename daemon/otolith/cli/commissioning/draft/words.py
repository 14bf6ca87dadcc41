"""Words in the names of signals, in English and German, and what they mean."""

import re

UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
PART = re.compile(r"[^\W\d_]+")
HUMP = re.compile(r"(?<=[a-zäöüß])(?=[A-ZÄÖÜ])")
LEVELS = re.compile(r"[/.]")  # Between the names of a path
MIN_INSIDE = 4  # letters of a word that is looked for inside others, as in Ankerspannung


def _rows(text: str) -> dict[str, str]:
    pairs = (row.split(" = ") for row in text.strip().splitlines())
    return {spelling: meaning.strip() for meaning, spellings in pairs for spelling in spellings.split()}


QUANTITIES = _rows("""
    voltage = voltage volt volts spannung tension
    current = current strom courant amps
    speed = speed velocity drehzahl geschwindigkeit omega rpm vitesse
    torque = torque moment drehmoment couple
    position = position lage weg hub pos angle winkel
    force = force kraft
    pressure = pressure druck
    flow = flow durchfluss volumenstrom
    frequency = frequency frequenz freq
    area = area querschnitt flaeche section
    opening = opening oeffnung
    temperature = temperature temperatur temp
    power = power leistung
""")
"""Which quantity a word names."""

QUALIFIERS = _rows("""
    armature = armature anker
    load = load last
    motor = motor
    direct = direct flux feldbildend magnetising magnetizing magnetisierungs d
    quadrature = quadrature drehmomentbildend momentbildend q
    piston = piston kolben
    valve = valve ventil
    throttle = throttle drossel
    converter = output ausgang ausgangs
    fan = fan luefter ventilator geblaese
    pump = pump pumpe pumpen
    setpoint = setpoint soll set ref reference command cmd target desired demand vorgabe fuehrung
    supply = link bus zwischenkreis supply battery batterie versorgung netz mains
""")
"""Which one of several signals of that quantity it is."""

SYMBOLS = _rows("""
    voltage = u v
    current = i
    speed = n w
    torque = m
    pressure = p
    force = f
    position = x s
""")
"""Letters that stand alone or begin a symbol, as in ``U_A``."""

WORDS = QUANTITIES | QUALIFIERS
INSIDE = sorted((word for word in WORDS if len(word) >= MIN_INSIDE), key=len, reverse=True)


USUAL_UNITS = {"drehzahl": "1/min", "umdrehung": "1/min", "upm": "1/min", "rpm": "1/min"}
"""By a word in the name of a signal without a unit: the unit in which drives give it."""


def usual_unit(name: str) -> str | None:
    """Return the unit in which drives give a signal of that name; None if it is not known by its name."""
    return next((unit for word, unit in USUAL_UNITS.items() if word in name.casefold()), None)


def meanings(name: str) -> frozenset[str]:
    """Return what the words in ``name`` mean; a symbol counts where no word names a quantity.

    Of a path, as ``hall/drive/u_dc`` or ``metrics.u_dc``, the symbol is that of its last name.
    """
    found = {meaning for part in _parts(name) for meaning in _of_part(part)}
    last = _parts(LEVELS.split(name.rstrip("/. "))[-1])
    if not found & set(QUANTITIES.values()) and last and last[0] in SYMBOLS:
        found.add(SYMBOLS[last[0]])
    return frozenset(found)


def _parts(name: str) -> list[str]:
    return [part.casefold().translate(UMLAUTS) for part in PART.findall(HUMP.sub(" ", name))]


def _of_part(part: str) -> set[str]:
    """Return what the words in a part mean; of words inside others the longest counts."""
    if part in WORDS:
        return {WORDS[part]}
    found = set()
    for word in INSIDE:
        if word in part:
            found.add(WORDS[word])
            part = part.replace(word, " ")
    return found
