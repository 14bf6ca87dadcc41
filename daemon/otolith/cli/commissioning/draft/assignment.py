"""Which signal of a source is which input or output of a twin, and which twin fits: by units, names and values."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from otolith.cli.commissioning.draft.offers import Offer
from otolith.cli.commissioning.draft.words import QUALIFIERS, QUANTITIES, meanings
from otolith.twin.definition import Definition, Input, Output, Role
from otolith_drivers.units import factor

# Points of a pair of an offer and a signal. Engineering choices: docs/reference/thresholds-cli.md.
SAME_UNIT = 2.0  # the unit is one of the quantity; another unit excludes the pair
SAME_NAME = 4.0
SAME_QUANTITY = 2.0  # both names have a word for it
OTHER_QUANTITY = -4.0
SAME_QUALIFIER = 1.5  # both say armature, load, motor
OTHER_QUALIFIER = -1.5  # the offer says one that the signal does not
SET_POINT = -3.0  # where a measurement is wanted
WITHIN_RANGE, BEYOND_RANGE = 0.5, -1.0  # the values fit the range of the input, or the bounds of the state
STILL = -1.0  # a value that never changes
LEAST = 2.0  # points from which a pair is proposed
UNMEASURED = 1.0  # points that a twin loses by each input without a sensor
MACHINE = 2.0  # points of a twin whose kind of machine the source names
KINDS = {"fan", "pump", "piston"}  # Words for the kind of a machine
BEYOND = 3.0  # times a bound: a value beyond is of another signal or unit


@dataclass(frozen=True, slots=True)
class Pair:
    """An offer for a signal of a twin."""

    offer: Offer
    points: float
    why: str


@dataclass(frozen=True, slots=True)
class TwinProposal:
    """A twin with the signals that a source offers for it."""

    twin: Definition
    pairs: Mapping[str, Pair]  # By signal
    points: float
    missing: tuple[str, ...] = ()  # Outputs without an offer, and inputs that the data cannot do without
    unmeasured: tuple[str, ...] = ()  # Inputs without an offer
    others: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # Offers with the same points, by signal

    @property
    def fits(self) -> bool:
        """Whether the source has all that the twin needs."""
        return not self.missing


def rank(
    twins: Sequence[Definition],
    offers: Sequence[Offer],
    hint: str = "",
    given: Mapping[str, Offer] | None = None,
    unmeasured: Collection[str] = (),
) -> list[TwinProposal]:
    """Return a proposal for each twin, the best first; ``hint`` is a text that may name the kind of machine.

    Of those that lack a signal, the one that lacks fewest comes first; what is there in percent it has if told of what.
    """

    def lost(row: TwinProposal) -> int:
        found = percentages(row, offers)
        driven = {item.name for item in row.twin.inputs if item.has_range and found.keys() & set(row.unmeasured)}
        return len(set(row.missing) - found.keys() - driven)

    def other_kind(row: TwinProposal) -> bool:
        return bool(meanings(hint) & KINDS) and not meanings(hint) & KINDS & meanings(row.twin.title)

    proposals = [propose(twin, offers, given, unmeasured, hint) for twin in twins]
    best = sorted(proposals, key=lambda row: (-row.points, _estimated(row.twin)))
    return sorted(best, key=lambda row: (not row.fits, not row.fits and (lost(row), other_kind(row))))


def percentages(proposal: TwinProposal, offers: Sequence[Offer]) -> dict[str, Offer]:
    """Return the offers that are in percent of a rated value, by the missing signal that each may be by its name."""
    twin, found = proposal.twin, dict[str, Offer]()
    signals: list[Input | Output] = [*twin.inputs, *twin.outputs]
    for offer in offers:
        left = [row for row in signals if row.name in proposal.missing and row.name not in found]
        points = {row.name: _of_words(twin, row, replace(offer, unit=None)) for row in left if offer.unit == "%"}
        words = {row.name: len(meanings(offer.name) & meanings(f"{row.name} {row.meaning}")) for row in left}
        best = max(points, key=lambda name: (points[name], words[name]), default="")
        if best and points[best] > 0.0:
            found[best] = offer
    return found


def propose(
    twin: Definition,
    offers: Sequence[Offer],
    given: Mapping[str, Offer] | None = None,
    unmeasured: Collection[str] = (),
    hint: str = "",
) -> TwinProposal:
    """Return the offers that fit the signals of ``twin`` best, each used once; the ``given`` ones stand."""
    given = given or {}
    free = [offer for offer in offers if offer not in given.values()]
    signals: list[Input | Output] = [*twin.inputs, *twin.outputs]
    wanted = [row for row in signals if row.name not in given and row.name not in unmeasured]
    points = np.array([[score(twin, row, offer)[0] for offer in free] for row in wanted]).reshape(
        len(wanted), len(free)
    )
    pairs = {name: Pair(offer, SAME_NAME, "as told") for name, offer in given.items()}
    others: dict[str, tuple[str, ...]] = {}
    if points.size:
        usable = np.where(points >= LEAST, points, 0.0)
        for at, place in zip(*linear_sum_assignment(usable, maximize=True), strict=True):
            if usable[at, place]:
                name = wanted[at].name
                pairs[name] = Pair(free[place], *score(twin, wanted[at], free[place]))
                equal = np.flatnonzero(points[at] >= points[at, place] - 1e-9)
                others[name] = tuple(free[number].name for number in equal if number != place)
    inputs = [row for row in twin.inputs if row.name not in pairs]
    driven = any(row.name in pairs for row in twin.inputs)
    missing = [row.name for row in twin.outputs if row.name not in pairs]
    missing += [row.name for row in inputs if not (row.has_range and driven)]
    named = meanings(hint) | {meaning for offer in offers for meaning in meanings(offer.name)}
    kind = MACHINE if named & meanings(twin.title) & KINDS else 0.0
    total = sum(pair.points for pair in pairs.values()) - UNMEASURED * len(inputs) + kind
    return TwinProposal(twin, pairs, total, tuple(missing), tuple(row.name for row in inputs), others)


def score(twin: Definition, signal: Input | Output, offer: Offer) -> tuple[float, str]:
    """Return the points of an offer for a signal, and why; minus infinity if it cannot be that."""
    points, why = 0.0, []
    conversion = (1.0, 0.0)
    if offer.unit is not None:
        try:
            conversion = factor(offer.unit, signal.unit)
        except ValueError:
            return -math.inf, "another unit"
        points, why = SAME_UNIT, ["unit"]
    if offer.name.casefold() == signal.name.casefold():
        points += SAME_NAME
        why.append("name")
    elif of_words := _of_words(twin, signal, offer):
        points += of_words
        why += ["name"] if of_words > 0.0 else []
    if len(offer.values):
        points += _of_values(twin, signal, offer, conversion)
    return points, " and ".join(why)


def _of_words(twin: Definition, signal: Input | Output, offer: Offer) -> float:
    """Return the points of the words in the name of an offer; a word for the whole machine is no other qualifier."""
    theirs, ours = meanings(offer.name), meanings(f"{signal.name} {signal.meaning}")
    quantities, qualifiers = set(QUANTITIES.values()), set(QUALIFIERS.values())
    points = 0.0
    if theirs & quantities:
        same = theirs & ours & quantities
        points += SAME_QUANTITY if same else OTHER_QUANTITY if offer.unit is None else 0.0
    points += SAME_QUALIFIER * len(theirs & ours & qualifiers)
    foreign = (theirs & qualifiers) - ours - meanings(twin.title)
    points += OTHER_QUALIFIER * len(foreign - {"setpoint", "supply"})
    is_command = isinstance(signal, Input) and signal.hold == "zoh"
    return points + SET_POINT * ("supply" in foreign) + SET_POINT * ("setpoint" in foreign and not is_command)


def _of_values(twin: Definition, signal: Input | Output, offer: Offer, conversion: tuple[float, float]) -> float:
    """Return the points of the values of an offer."""
    ends = [conversion[0] * float(end) + conversion[1] for end in (offer.values.min(), offer.values.max())]
    low, high = _bounds(twin, signal)
    largest, reach = max(map(abs, ends)), max(abs(low), abs(high))
    points = 0.0 if offer.moves else STILL
    if largest > BEYOND * reach:
        return points + BEYOND_RANGE
    is_input = isinstance(signal, Input) and signal.has_range
    return points + (WITHIN_RANGE if is_input and offer.moves and low <= min(ends) and max(ends) <= high else 0.0)


def _bounds(twin: Definition, signal: Input | Output) -> tuple[float, float]:
    if isinstance(signal, Input):
        return (signal.low, signal.high) if signal.has_range else (-math.inf, math.inf)
    state = next((row for row in twin.states if row.name == signal.name), None)
    return (state.low, state.high) if state is not None else (-math.inf, math.inf)


def _estimated(twin: Definition) -> int:
    return sum(parameter.role is Role.ESTIMATED for parameter in twin.parameters)
