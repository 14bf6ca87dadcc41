"""Which register is which signal, and what a step of it is worth, from what the display of a drive shows meanwhile.

Registers have neither names nor units. Drives scale them by powers of ten, so that a number off the display, times one
of these, is what the register holds. Some hold another usual unit than the display shows, as rad/s where that has rpm:
these are tried for a value that no register holds in its own unit, or not as closely: 0.1 rad/s is nearly 1 rpm.
"""

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from otolith.acquisition.window import Array
from otolith.cli.commissioning.draft.answers import Answers
from otolith.cli.commissioning.draft.offers import Offer
from otolith.cli.terminal import echo
from otolith.twin.definition import Definition
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import factor

# Engineering choices: docs/reference/thresholds-cli.md.
POWERS = range(-5, 4)  # of ten, by which a drive scales a register
CLOSE = 0.05  # of the displayed value: how far a register may be from it
AS_CLOSE = 0.01  # of the displayed value: registers that differ by less are both named
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
    distances, pairs = _assigned([shown[name][0] for name in names], offers)
    found = {names[at] for at, place in pairs if distances[at, place] <= CLOSE}
    taken = {place for at, place in pairs if names[at] in found}
    rest = [offer for at, offer in enumerate(offers) if at not in taken]
    shown |= {name: _in_usual_unit(shown[name], rest) for name in names if name not in found}
    close = {names[at]: offers[place] for at, place in pairs if names[at] in found}
    shown |= {name: _in_usual_unit(shown[name], [offer]) for name, offer in close.items()}
    signals, units, scales = dict(answers.signals), dict(answers.units), dict(answers.scales)
    distances, pairs = _assigned([shown[name][0] for name in names], offers)
    found = {names[at] for at, place in pairs if distances[at, place] <= CLOSE}
    if lost := [f"{name}={answers.displays[name]}" for name in names if name not in found]:
        raise ConfigurationError(f"--display {', '.join(lost)}: {_not_found(offers)}")
    for at, place in pairs:
        name, offer = names[at], offers[int(place)]
        value, unit = shown[name]
        power = _power(value, offer)
        signals[name], units[offer.name] = offer.name, units.get(offer.name, unit)
        scales.setdefault(offer.name, f"{10.0**power:g}")
        echo(f"{name}: {value:g} {unit} is {float(np.median(offer.values)):.5g}·10^{power} in register {offer.name}")
        equal = distances[at] <= distances[at, place] + AS_CLOSE
        if others := [row.name for row, is_equal in zip(offers, equal, strict=True) if is_equal and row is not offer]:
            remedy = f"another speed or load decides, or --signal {name}=REGISTER"
            echo(f"! {', '.join(others)} would fit {name} as well: {remedy}")
    return replace(answers, twin=twin.name, signals=signals, units=units, scales=scales)


def _assigned(values: Sequence[float], offers: Sequence[Offer]) -> tuple[Array, list[tuple[int, int]]]:
    """Return the distance of each value from each register, and which register is best for which value."""
    distances = np.array([[_distance(value, offer) for offer in offers] for value in values])
    distances = distances.reshape(len(values), len(offers))
    return distances, list(zip(*map(np.ndarray.tolist, linear_sum_assignment(distances)), strict=True))


def _in_usual_unit(shown: tuple[float, str], offers: Sequence[Offer]) -> tuple[float, str]:
    """Return a displayed value in the usual unit in which a register holds it; else as it is."""

    def distance(number: float) -> float:
        return min((_distance(number, offer) for offer in offers), default=UNLIKELY)

    value, unit = shown
    converted = [shown]
    for other in (other for units in USUAL for other in units if _is_one_of(unit, units)):
        scale, offset = factor(unit, other)
        converted.append((scale * value + offset, other))
    closest = min(converted, key=lambda each: distance(each[0]))
    return closest if distance(closest[0]) <= min(CLOSE, distance(value) - AS_CLOSE) else shown


def _is_one_of(unit: str, units: Sequence[str]) -> bool:
    """Whether a unit is one of the ``units``, however it is written."""
    for other in units:
        with contextlib.suppress(ValueError):
            if factor(unit, other) == (1.0, 0.0):
                return True
    return False


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
