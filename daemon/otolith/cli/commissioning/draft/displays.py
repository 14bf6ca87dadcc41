"""Which register is which signal, and what a step of it is worth, from what the display of a drive shows meanwhile.

Registers have neither names nor units. Drives scale them by powers of ten, so that a number off the display, times one
of these, is what the register holds. Some hold another usual unit than the display shows, as rad/s where that has rpm.
0.1 rad/s is nearly 1 rpm, and a display is read earlier than a register. So a value that is close as displayed is taken
so, unless it is exact in another unit only; where both are close, both are named.

The values of a display are those of one moment. While the machine moves, they are looked for together in each moment of
what was read, and the moment with the closest ones says which registers they are.
"""

import contextlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from functools import cache
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
CLOSE_IN_MOTION = 0.02  # the same, where a register moves by more than CLOSE: many would pass a wrong value
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
MOMENTS = 100  # at most, into which the readings are divided
NUMBER = re.compile(r"\s*([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d+)?)")  # The unit may follow without a blank


def displayed(answers: Answers, twins: Sequence[Definition]) -> tuple[Definition, dict[str, tuple[float, str]]]:
    """Return the twin whose signals are displayed, and numbers and units of the displayed values, by signal.

    Raises:
        ConfigurationError: no twin has these signals, or a value is none.
    """
    twin = _twin_of(answers, twins)
    return twin, {name: _quantity(twin, name, text) for name, text in answers.displays.items()}


def with_displays(
    answers: Answers, offers: Sequence[Offer], twins: Sequence[Definition], still: Mapping[str, float] | None = None
) -> Answers:
    """Return the answers with twin, signals, units and scales that follow from displayed values; told ones stay.

    ``still`` is what registers hold that never changed, by name: they are not chosen, but named where they fit.

    Raises:
        ConfigurationError: a value is none, or no register can have it.
    """
    if not answers.displays:
        return answers
    twin, shown = displayed(answers, twins)
    names = [name for name in shown if name not in answers.signals]
    values, moments = [shown[name] for name in names], _moments(offers)
    moves = [_moves(track) for track in zip(*moments, strict=True)]
    fits = [_Fit(moment, values, offers, answers.units, moves) for moment in moments]
    best = min(fits, key=lambda fit: fit.cost)
    if lost := [f"{names[at]}={answers.displays[names[at]]}" for at in range(len(names)) if at not in best.found]:
        absent = [values[at] for at in range(len(names)) if at not in best.found]
        raise ConfigurationError(f"--display {', '.join(lost)}: {_not_found(absent, offers, still or {})}")
    signals, units, scales = dict(answers.signals), dict(answers.units), dict(answers.scales)
    as_good = [fit for fit in fits if fit.cost <= best.cost + AS_CLOSE]
    for at, place in best.found.items():
        name, offer, reading = names[at], offers[place], best.chosen(at, place)
        power, held = _power(reading.value, best.held[place]), best.held[place]
        signals[name] = offer.name
        units.setdefault(offer.name, reading.unit)
        scales.setdefault(offer.name, f"{10.0**power:g}")
        echo(f"{name}: {reading.value:g} {reading.unit} is {held:.5g}·10^{power} in register {offer.name}")
        equal = {row for fit in as_good for row in fit.equal(at, reading.value)}
        if others := [row.name for number, row in enumerate(offers) if number in equal and number != place]:
            remedy = f"another speed or load decides, or --signal {name}=REGISTER"
            echo(f"! {', '.join(others)} would fit {name} as well: {remedy}")
        for other, number in best.rivals(at, place):
            own = f"--unit {offer.name}={other} --scale {offer.name}={10.0**number:g}"
            remedy = f"read the display again while the machine runs steadily, or {own}"
            echo(f"! {other} would fit {name} in register {offer.name} as well: {remedy}")
    return replace(answers, twin=twin.name, signals=signals, units=units, scales=scales)


def _moments(offers: Sequence[Offer]) -> list[list[float]]:
    """Return what all registers hold at each of at most MOMENTS times, NaN of one without a number.

    All are read in turn, so that equal shares of their values are of the same time. A median is without noise.
    """
    longest = max((len(offer.values) for offer in offers), default=0)
    count = max(1, min(MOMENTS, longest))
    tracks = [
        [float(np.median(part)) if len(part) else math.nan for part in np.array_split(offer.values, count)]
        for offer in offers
    ]
    return [[track[at] for track in tracks] for at in range(count)]


def _moves(track: Sequence[float]) -> bool:
    """Whether a register differs by more than a displayed value may at one moment."""
    return bool(np.nanmax(np.abs(track)) - np.nanmin(np.abs(track)) > CLOSE * np.nanmedian(np.abs(track)))


class _Reading(NamedTuple):
    """A displayed value in a unit in which a register may hold it."""

    value: float
    unit: str
    distance: float  # From what the register holds, in shares of it


class _Fit:
    """Which register is best for which displayed value, by what the registers ``held`` at one moment."""

    def __init__(
        self,
        held: Sequence[float],
        shown: Sequence[tuple[float, str]],
        offers: Sequence[Offer],
        told: Mapping[str, str],
        moves: Sequence[bool],
    ) -> None:
        self.held = held
        registers = list(zip(held, offers, strict=True))
        self._readings = [
            [_readings(value, number, told.get(offer.name)) for number, offer in registers] for value in shown
        ]
        costs = np.array([[_cost(readings) for readings in row] for row in self._readings])
        costs = costs.reshape(len(shown), len(offers))
        pairs = list(zip(*map(np.ndarray.tolist, linear_sum_assignment(costs)), strict=True))
        close = [(at, place) for at, place in pairs if costs[at, place] < UNLIKELY]
        limit = CLOSE_IN_MOTION if any(moves[place] for _, place in close) else CLOSE
        self.found = {at: place for at, place in close if self.chosen(at, place).distance <= limit}
        """Register by displayed value."""
        self.cost = sum(costs[pair] for pair in self.found.items()) + UNLIKELY * (len(shown) - len(self.found))

    def chosen(self, at: int, place: int) -> _Reading:
        """Return the reading of a register that is right for a displayed value."""
        return _chosen(self._readings[at][place])

    def equal(self, at: int, value: float) -> list[int]:
        """Return the registers that hold a value about as well as the best one for it."""
        closest = self.chosen(at, self.found[at]).distance
        return [place for place, held in enumerate(self.held) if _distance(value, held) <= closest + AS_CLOSE]

    def rivals(self, at: int, place: int) -> list[tuple[str, int]]:
        """Return the units, and powers of ten, that may be right in place of the chosen ones."""
        readings = self._readings[at][place]
        chosen = _chosen(readings)
        limits = [CLOSE, *[min(CLOSE, chosen.distance + AS_CLOSE) for _ in readings[1:]]]
        others = [each for each, limit in zip(readings, limits, strict=True) if each.distance <= limit]
        return [(each.unit, _power(each.value, self.held[place])) for each in others if each != chosen]


def _readings(shown: tuple[float, str], held: float, told: str | None) -> list[_Reading]:
    """Return a displayed value in the unit that was ``told`` of a register; else as it is, then in usual units."""
    value, unit = shown
    units = [unit, *_other_units(unit)] if told is None else [told]
    converted = list[_Reading]()
    for other in units:
        with contextlib.suppress(ValueError):
            scale, offset = (1.0, 0.0) if other == unit else factor(unit, other)
            number = scale * value + offset
            converted.append(_Reading(number, other, _distance(number, held)))
    return converted or [_Reading(value, unit, UNLIKELY)]


def _chosen(readings: Sequence[_Reading]) -> _Reading:
    """Return the first reading if it is close and no other one is exact alone; else the closest."""
    first, closest = readings[0], min(readings, key=lambda each: each.distance)
    is_exact_alone = closest.distance <= min(AS_CLOSE, first.distance - AS_CLOSE)
    return first if first.distance <= CLOSE and not is_exact_alone else closest


def _cost(readings: Sequence[_Reading]) -> float:
    """Return the distance; one that is close as displayed is better than in another unit, and all others are alike."""
    distance = _chosen(readings).distance
    if distance > CLOSE:
        return UNLIKELY
    return distance if readings[0].distance <= CLOSE else distance + CLOSE


@cache
def _other_units(unit: str) -> tuple[str, ...]:
    """Return the other units that are usual for a quantity in ``unit``."""
    for units in USUAL:
        with contextlib.suppress(ValueError):
            same = [other for other in units if are_equal(unit, other, other)]
            if same:
                return tuple(other for other in units if other not in same)
    return ()


def _not_found(absent: Sequence[tuple[float, str]], offers: Sequence[Offer], still: Mapping[str, float]) -> str:
    """Return why no register can have the ``absent`` values, and what to do."""
    fitting = [name for name, held in still.items() if any(_distance(value, held) <= CLOSE for value, _ in absent)]
    if fitting:
        which = f"register {', '.join(fitting)}, which never changed, so that it may as well be a set-point or a limit"
        remedy = "let the machine change its speed in a cycle, take a photo of the display, and read for a whole cycle"
        return f"it fits only {which}: {remedy} by --seconds 30"
    ends = [(row.name, float(row.values.min()), float(row.values.max())) for row in offers if len(row.values)]
    held = ", ".join(f"{name}: {low:.5g} to {high:.5g}" for name, low, high in ends) or "none"
    fault = f"no register of its own holds it times a power of ten together with the other values ({held})"
    remedy = "show values of one moment, read off a steady machine or off a photo of the display; while it moves, read"
    return f"{fault}: {remedy} its registers for a whole cycle by --seconds 30; or choose other --registers"


def _twin_of(answers: Answers, twins: Sequence[Definition]) -> Definition:
    """Return the twin that was told, or the one that lacks the fewest inputs of those with all outputs displayed."""
    names = answers.displays.keys() | answers.signals.keys()
    if answers.twin is not None:
        fitting = [twin for twin in twins if twin.name == answers.twin]
    else:
        fitting = [twin for twin in twins if {row.name for row in twin.outputs} <= names <= set(twin.signals)]
    if not fitting:
        raise ConfigurationError(f"--display {', '.join(sorted(answers.displays))}: {_without_twin(names, twins)}")
    return min(fitting, key=lambda twin: (len(twin.signals), len(twin.parameters)))


def _without_twin(names: Collection[str], twins: Sequence[Definition]) -> str:
    """Return why no twin has all of its outputs, and no other signals, in ``names``; and what to do."""
    known = dict.fromkeys(name for twin in twins for name in twin.signals)
    if unknown := [name for name in names if name not in known]:
        return f"no twin has a signal {unknown[0]!r}: {nearest(unknown[0], list(known))}"

    def missing(twin: Definition) -> list[str]:
        return [row.name for row in twin.outputs if row.name not in names]

    closest = min(twins, key=lambda twin: (len(set(names) - set(twin.signals)), len(missing(twin))))
    if lacks := missing(closest):
        remedy = f"give --display or --signal also of {', '.join(lacks)}"
        return f"no twin has these outputs alone; the nearest, {closest.name}, needs more: {remedy}, or another --twin"
    foreign = ", ".join(sorted(set(names) - set(closest.signals)))
    return f"no twin has all of these signals; the nearest, {closest.name}, has no {foreign}: leave it out"


def _quantity(twin: Definition, name: str, text: str) -> tuple[float, str]:
    """Return number and unit of a displayed value; raise ConfigurationError if it is none of that signal."""
    if name not in twin.signals:
        raise ConfigurationError(f"--display {name}={text}: twin {twin.name}: {nearest(name, list(twin.signals))}")
    remedy = f'write it as --display "{name}=12.5 {twin.unit_of(name)}"'
    if (shown := NUMBER.match(text)) is None:
        raise ConfigurationError(f"--display {name}={text}: it has no number: {remedy}")
    value, unit = float(shown[1].replace(",", ".")), text[shown.end() :].strip()
    if not unit and twin.unit_of(name) != "1":
        raise ConfigurationError(f"--display {name}={text}: its unit is missing: {remedy}")
    try:
        factor(unit, twin.unit_of(name))
    except ValueError as error:
        raise ConfigurationError(f"--display {name}={text}: {error}: {remedy}") from error
    if not math.isfinite(value) or value == 0.0:
        raise ConfigurationError(f"--display {name}={text}: a value of zero shows no scale: let the machine run")
    return value, unit


def _power(value: float, held: float) -> int:
    return min(POWERS, key=lambda power: _distance_at(value, held, power))


def _distance(value: float, held: float) -> float:
    """Return how far a displayed value is from what a register holds, in shares of it, at the best power of ten."""
    return min((_distance_at(value, held, power) for power in POWERS), default=UNLIKELY)


def _distance_at(value: float, held: float, power: int) -> float:
    return min(abs(10.0**power * held / value - 1.0), UNLIKELY) if math.isfinite(held) else UNLIKELY
