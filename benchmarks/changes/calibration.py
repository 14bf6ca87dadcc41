"""Random changes of random machines: stated probabilities beside the shares that are right.

A change is a component of a family at a site of the twin, a gain or an offset of a sensor, a step of a parameter, or
nothing. A component moves the most affected output by 1 to 30 times its noise; sensors and parameters change by 1 to
30 %. The sensors have 0.3 to 4 times the noise of the machine file. Each hypothesis of the last report that has some
counts with its probability; an adopted component counts with its probability at adoption. A hypothesis is right if it
names type and place of the change. Components that equal a step of parameters are not drawn.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.changes.classes import VERDICTS, text_of
from benchmarks.changes.machines import DC_MOTOR, PUMP, REVERSING_MOTOR, SERVO_AXIS, TWO_MASS, problem_of, twin_of
from benchmarks.changes.observe import Case, Observed, Stated, observe
from benchmarks.changes.plants import HEALTHY, Change, Plant, Term, generator, simulate
from otolith.acquisition.window import Array
from otolith.discovery.alternatives import WindowDecision

PLANTS = (DC_MOTOR, REVERSING_MOTOR, PUMP, SERVO_AXIS, TWO_MASS)
KINDS = {"nothing": 0.1, "component": 0.4, "gain": 0.15, "offset": 0.15, "parameter": 0.2}
FAMILIES = ("constant", "linear", "power", "exponential", "periodic", "Coulomb")
EFFECT = (1.0, 30.0)  # of the noise of the most affected output, root mean square
SHARE = (0.01, 0.3)  # of a parameter, or of the root mean square of a signal
NOISE = (0.3, 4.0)  # over the noise of the machine file
FREQUENCY = (5.0, 40.0)  # rad/s
TRANSITION = 0.02  # of a signal's root mean square: within which dry friction changes its sign
PROBE_WINDOWS = 2  # in which the effect of a component is measured
ATTEMPTS = 100
SMALL = 1e-6  # amplitude of a component whose effect is measured
BEFORE, AFTER = 8, 8  # windows
BINS = (0.0, 0.2, 0.5, 0.8, 0.95, 1.0)
SURE, RIGHT_AT_LEAST = 0.95, 0.90  # probability from which such a share of the hypotheses must be right
PARAMETERS = frozenset({
    *(("dc_motor", "shaft", "linear", "omega"), ("dc_motor", "winding", "linear", "i")),
    *(("dc_motor", "shaft", "linear", "i"), ("dc_motor", "winding", "linear", "omega")),
    *(("pump", "shaft", "constant", ""), ("pump", "head", "constant", ""), ("pump", "shaft", "power", "omega")),
    *(("pump", "pipe", "constant", ""), ("servo_axis", "friction", "constant", "")),
    *(("servo_axis", "carriage", "constant", ""), ("servo_axis", "carriage", "linear", "v")),
    *(("servo_axis", "carriage", "Coulomb", "v"), ("two_mass", "load_side", "linear", "omega_l")),
    *(("two_mass", "shaft", "constant", ""), ("two_mass", "motor_side", "linear", "omega_m")),
})  # fmt: skip
"""Components that equal a step of parameters: twin, site, family and source."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A case and what its reports should state."""

    kind: str
    place: str
    """Site, sensor or parameter."""
    case: Case

    def is_right(self, stated: Stated) -> bool:
        """Whether a hypothesis names type and place of the change."""
        if self.kind == "parameter":
            return stated.reason == "PARAMETER" and self.place in stated.text.split(", ")
        if self.kind == "component":
            return stated.reason == "COMPONENT" and re.match(rf"{self.place}(:|/)", stated.text) is not None
        if self.kind in ("gain", "offset"):
            return stated.reason == "SENSOR" and stated.text.startswith(f"{self.place} reads")
        return stated.reason == "NOTHING"


@dataclass(frozen=True, slots=True)
class Result:
    """What the reports of a case stated in the end."""

    name: str
    kind: str
    decision: str
    """The first verdict, or the last decision."""
    stated: tuple[tuple[float, bool], ...]
    """Probability of each hypothesis, and whether it is right."""
    right: bool
    """Whether the most probable hypothesis is; without any, whether nothing has happened."""
    text: str


def run_case(number: int, seed: int) -> Result:
    """Draw a case, and return what its reports stated."""
    drawn = draw(number, seed)
    (windows,) = observe(drawn.case, [number], seed)
    after = windows[drawn.case.healthy :]
    verdict = next((window for window in after if window.decision in VERDICTS), None)
    window = _deciding(after)
    stated = window.components if window.decision is WindowDecision.DISCOVERED else window.stated
    best = max(stated, key=lambda item: item.probability, default=None)
    return Result(
        name=drawn.case.name,
        kind=drawn.kind,
        decision=(verdict or after[-1]).decision.name,
        stated=tuple((item.probability, drawn.is_right(item)) for item in stated),
        right=drawn.kind == "nothing" if best is None else drawn.is_right(best),
        text=text_of(window),
    )


def _deciding(after: Sequence[Observed]) -> Observed:
    """Return the window of the first discovery, or the last with hypotheses before a step, or the last one."""
    last = after[-1]
    for window in after:
        if window.decision is WindowDecision.DISCOVERED:
            return window
        if window.decision is WindowDecision.STEPPED:
            return last
        if window.stated:
            last = window
    return last


def draw(number: int, seed: int) -> Drawn:
    """Return the case of that number.

    Raises:
        RuntimeError: no drawn component changes the outputs by a finite amount.
    """
    random = np.random.default_rng([seed, number])
    plant = PLANTS[number % len(PLANTS)]
    kind = str(random.choice(list(KINDS), p=list(KINDS.values())))
    noise = _log_uniform(random, NOISE)
    for _ in range(ATTEMPTS):
        place, detail, change = _change(plant, kind, random)
        if change is not None:
            name = f"{number}: {plant.name}, {kind} {place} {detail}, noise {noise:.1f}"
            return Drawn(kind, place, Case(name, plant, change, healthy=BEFORE, changed=AFTER, noise=noise))
    raise RuntimeError(f"no component of {plant.name} in {ATTEMPTS} attempts")


def _change(plant: Plant, kind: str, random: np.random.Generator) -> tuple[str, str, Change | None]:
    """Return place, description and change."""
    twin = twin_of(plant)
    if kind == "nothing":
        return "", "", HEALTHY
    if kind == "component":
        return _component(plant, random)
    share = _log_uniform(random, SHARE) * float(random.choice([-1.0, 1.0]))
    if kind == "parameter":
        place = str(random.choice([free.name for free in problem_of(plant).free]))
        change = Change(parameters={place: (1.0 + share) * plant.parameters[place]})
    else:
        place = str(random.choice(twin.signals))
        gain = Change(gains={place: 1.0 + share})
        change = gain if kind == "gain" else Change(offsets={place: share * _size(probe(plant.name)[place])})
    return place, f"{share:+.1%}", change


def _component(plant: Plant, random: np.random.Generator) -> tuple[str, str, Change | None]:
    """Return site, description and change; no change if the machine diverges or a parameter is the same."""
    twin, healthy = twin_of(plant), probe(plant.name)
    site = str(random.choice([site.name for site in twin.sites]))
    family = str(random.choice(FAMILIES))
    source = {"constant": "", "periodic": "t"}.get(family)
    if source is None:
        source = str(random.choice(sorted({*plant.initial, *(signal.name for signal in twin.inputs)} & set(healthy))))
    size = _size(healthy[source]) if source in healthy else 1.0
    inner = {
        "power": 2.0,
        "exponential": 1.0 / size,
        "periodic": float(random.uniform(*FREQUENCY)),
        "Coulomb": TRANSITION * size,
    }.get(family, 0.0)
    effect = _log_uniform(random, EFFECT)
    sign = float(random.choice([-1.0, 1.0]))
    if (twin.name, site, family, source) in PARAMETERS:
        return site, "", None
    per_unit = _effect(plant, Change(terms={site: Term(family, source, SMALL, inner)})) / SMALL
    if not 0.0 < per_unit < np.inf:
        return site, "", None
    term = Term(family, source, sign * effect / per_unit, inner)
    change = Change(terms={site: term})
    moved = _effect(plant, change)
    finite = np.isfinite(moved) and moved < 3.0 * effect  # a machine that a large term drives far off is another one
    return site, f"{family} of {source or 'nothing'}, {moved:.0f} times the noise", change if finite else None


def _effect(plant: Plant, change: Change) -> float:
    """Return by how much a change moves the most affected output, root mean square over its noise."""
    healthy = probe(plant.name)
    with np.errstate(all="ignore"):
        changed = _probed(plant, change)
        return max(_size(changed[item.name] - healthy[item.name]) / item.noise for item in twin_of(plant).outputs)


@cache
def probe(name: str) -> dict[str, Array]:
    """Return the signals of the healthy machine of that name."""
    return _probed(next(plant for plant in PLANTS if plant.name == name), HEALTHY)


def _probed(plant: Plant, change: Change) -> dict[str, Array]:
    rows = simulate(plant, [generator(0, plant.name, 0)], PROBE_WINDOWS * plant.records, change, change, 0)
    return {name: values[0] for name, values in rows.items()}


def _size(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _log_uniform(random: np.random.Generator, ends: tuple[float, float]) -> float:
    return float(np.exp(random.uniform(*np.log(ends))))


def table(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return count, mean probability and share that is right of the hypotheses in each bin of probability."""
    stated = [pair for result in results for pair in result.stated]
    rows = []
    for low, high in pairwise(BINS):
        own = [pair for pair in stated if low <= pair[0] < high or high == pair[0] == BINS[-1]]
        if own:
            probability, right = (float(np.mean(column)) for column in zip(*own, strict=True))
            rows.append({"low": low, "high": high, "count": len(own), "probability": probability, "right": right})
    return rows


def decisions(results: Sequence[Result]) -> list[dict[str, Any]]:
    """Return how often the most probable hypothesis is right, by kind of change and decision."""
    keys = sorted({(result.kind, result.decision) for result in results})
    groups = {key: [own.right for own in results if (own.kind, own.decision) == key] for key in keys}
    return [
        {"kind": kind, "decision": decision, "count": len(own), "right": sum(own) / len(own)}
        for (kind, decision), own in groups.items()
    ]


def met(results: Sequence[Result]) -> bool:
    """Whether hypotheses stated as sure are right as often as they should."""
    sure = [right for result in results for probability, right in result.stated if probability >= SURE]
    return not sure or sum(sure) / len(sure) >= RIGHT_AT_LEAST
