"""Which register is which signal, and what a step of it is worth, from what the display of a drive shows meanwhile.

Registers have neither names nor units. Drives scale them by powers of ten, so that a number off the display, times one
of these, is what the register holds. Some hold another usual unit than the display shows, as rad/s where that has rpm.
0.1 rad/s is nearly 1 rpm, and a display is read earlier than a register. So a value that is close as displayed is taken
so, unless it is exact in another unit only; where both are close, both are named.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from otolith.cli.commissioning.draft.answers import Answers
from otolith.cli.commissioning.draft.offers import Offer
from otolith.cli.terminal import echo
from otolith.twin.definition import Definition
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import are_equal, factor

# Engineering choices: docs/reference/thresholds-cli.md.
POWERS = range(-5, 4)  # of ten, by which a drive scales a register
CLOSE = 0.05  # of the displayed value: how far a register may be from it
AS_CLOSE = 0.01  # of the displayed value: less is exact; registers and units that differ by less are both named
USUAL = (  # units of one quantity between which displays and registers differ by no power of ten
    ("rpm", "rad/s", "turn/s"),
    ("degree", "rad", "turn"),
    ("kW", "hp"),
    ("bar", "psi"),
    ("m/s", "km/h", "m/min"),
    ("m^3/h", "l/min", "l/s"),
    ("N*m", "lbf*ft"),
    ("N", "lbf"),
)
UNLIKELY = 1e6  # distance of what cannot be the same


def with_displays(answers: Answers, offers: Sequence[Offer], twins: Sequence[Definition]) -> Answers:
    """Return the answers with twin, signals, units and scales that follow from displayed values; told ones stay.

    Raises:
        ConfigurationError: a value is none, or no register can have it.
    """
    if not answers.displays:
        return answers
    twin = _twin_of(answers, twins)
    shown = {name: _quantity(twin, name, text) for name, text in answers.displays.items()}
    names = [name for name in shown if name not in answers.signals]
    readings = [[_readings(shown[name], offer, answers.units.get(offer.name)) for offer in offers] for name in names]
    pairs = _assigned(readings)
    found = {names[at] for at, place in pairs if _chosen(readings[at][place]).distance <= CLOSE}
    if lost := [f"{name}={answers.displays[name]}" for name in names if name not in found]:
        raise ConfigurationError(f"--display {', '.join(lost)}: {_not_found(offers)}")
    signals, units, scales = dict(answers.signals), dict(answers.units), dict(answers.scales)
    for at, place in pairs:
        name, offer, reading = names[at], offers[place], _chosen(readings[at][place])
        power = _power(reading.value, offer)
        signals[name] = offer.name
        units.setdefault(offer.name, reading.unit)
        scales.setdefault(offer.name, f"{10.0**power:g}")
        held = f"{float(np.median(offer.values)):.5g}·10^{power} in register {offer.name}"
        echo(f"{name}: {reading.value:g} {reading.unit} is {held}")
        distances = [_distance(reading.value, row) for row in offers]
        equal = [row.name for row, far in zip(offers, distances, strict=True) if far <= reading.distance + AS_CLOSE]
        if others := [other for other in equal if other != offer.name]:
            remedy = f"another speed or load decides, or --signal {name}=REGISTER"
            echo(f"! {', '.join(others)} would fit {name} as well: {remedy}")
        for other in _rivals(readings[at][place]):
            own = f"--unit {offer.name}={other.unit} --scale {offer.name}={10.0 ** _power(other.value, offer):g}"
            remedy = f"read the display again while the machine runs steadily, or {own}"
            echo(f"! {other.unit} would fit {name} in register {offer.name} as well: {remedy}")
    return replace(answers, twin=twin.name, signals=signals, units=units, scales=scales)


class _Reading(NamedTuple):
    """A displayed value in a unit in which a register may hold it."""

    value: float
    unit: str
    distance: float  # From what the register holds, in shares of it


def _readings(shown: tuple[float, str], offer: Offer, told: str | None) -> list[_Reading]:
    """Return a displayed value in the unit that was ``told`` of a register; else as it is, then in usual units."""
    value, unit = shown
    units = [unit, *_other_units(unit)] if told is None else [told]
    converted = list[_Reading]()
    for other in units:
        with contextlib.suppress(ValueError):
            scale, offset = (1.0, 0.0) if other == unit else factor(unit, other)
            number = scale * value + offset
            converted.append(_Reading(number, other, _distance(number, offer)))
    return converted or [_Reading(value, unit, UNLIKELY)]


def _chosen(readings: Sequence[_Reading]) -> _Reading:
    """Return the first reading if it is close and no other one is exact alone; else the closest."""
    first, closest = readings[0], min(readings, key=lambda each: each.distance)
    is_exact_alone = closest.distance <= min(AS_CLOSE, first.distance - AS_CLOSE)
    return first if first.distance <= CLOSE and not is_exact_alone else closest


def _rivals(readings: Sequence[_Reading]) -> list[_Reading]:
    """Return the readings that may be right in place of the chosen one."""
    chosen = _chosen(readings)
    limits = [CLOSE, *[min(CLOSE, chosen.distance + AS_CLOSE) for _ in readings[1:]]]
    return [each for each, limit in zip(readings, limits, strict=True) if each != chosen and each.distance <= limit]


def _assigned(readings: Sequence[Sequence[Sequence[_Reading]]]) -> list[tuple[int, int]]:
    """Return which register is best for which value."""
    costs = np.array([[_cost(each) for each in registers] for registers in readings])
    costs = costs.reshape(len(readings), len(readings[0]) if readings else 0)
    return list(zip(*map(np.ndarray.tolist, linear_sum_assignment(costs)), strict=True))


def _cost(readings: Sequence[_Reading]) -> float:
    """Return the distance; one that is close as displayed is better than in another unit, and all others are alike."""
    distance = _chosen(readings).distance
    if distance > CLOSE:
        return UNLIKELY
    return distance if readings[0].distance <= CLOSE else distance + CLOSE


def _other_units(unit: str) -> list[str]:
    """Return the other units that are usual for a quantity in ``unit``."""
    for units in USUAL:
        with contextlib.suppress(ValueError):
            same = [other for other in units if are_equal(unit, other, other)]
            if same:
                return [other for other in units if other not in same]
    return []


def _not_found(offers: Sequence[Offer]) -> str:
    """Return why no register can have a displayed value, and what to do."""
    held = ", ".join(f"{row.name}: {float(np.median(row.values)):.5g}" for row in offers if len(row.values)) or "none"
    fault = f"no register of its own holds it times a power of ten (those that change: {held})"
    return f"{fault}: let the machine run steadily and read the display again, or choose others by --registers"


def _twin_of(answers: Answers, twins: Sequence[Definition]) -> Definition:
    """Return the twin that was told, or the one that lacks the fewest inputs of those with all outputs displayed."""
    names = answers.displays.keys() | answers.signals.keys()
    if answers.twin is not None:
        fitting = [twin for twin in twins if twin.name == answers.twin]
    else:
        fitting = [twin for twin in twins if {row.name for row in twin.outputs} <= names <= set(twin.signals)]
    if not fitting:
        known = ", ".join(f"{twin.name}: {', '.join(twin.signals)}" for twin in twins)
        raise ConfigurationError(
            f"--display {', '.join(sorted(names))}: no twin has these outputs; signals are {known}"
        )
    return min(fitting, key=lambda twin: (len(twin.signals), len(twin.parameters)))


def _quantity(twin: Definition, name: str, text: str) -> tuple[float, str]:
    """Return number and unit of a displayed value; raise ConfigurationError if it is none of that signal."""
    if name not in twin.signals:
        raise ConfigurationError(f"--display {name}={text}: twin {twin.name}: {nearest(name, list(twin.signals))}")
    number, _, unit = text.strip().partition(" ")
    try:
        value = float(number.replace(",", "."))
        factor(unit, twin.unit_of(name))
    except ValueError as error:
        remedy = f'write it as --display "{name}=12.5 {twin.unit_of(name)}"'
        raise ConfigurationError(f"--display {name}={text}: {error}: {remedy}") from error
    if not math.isfinite(value) or value == 0.0:
        raise ConfigurationError(f"--display {name}={text}: a value of zero shows no scale: let the machine run")
    return value, unit


def _power(value: float, offer: Offer) -> int:
    return min(POWERS, key=lambda power: _distance_at(value, offer, power))


def _distance(value: float, offer: Offer) -> float:
    """Return how far a displayed value is from what a register holds, in shares of it, at the best power of ten."""
    return min((_distance_at(value, offer, power) for power in POWERS), default=UNLIKELY)


def _distance_at(value: float, offer: Offer, power: int) -> float:
    if not len(offer.values):
        return UNLIKELY
    held = 10.0**power * float(np.median(offer.values))
    return min(abs(held / value - 1.0), UNLIKELY)
