"""A twin with slots for components: the page that every twin is searched and completed on.

Which component sits in a slot, where it enters and what it depends on are settings, chosen when the twin runs; so one
compiled kernel serves every component, and nothing has to be compiled when one is found.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

from otolith.twin.component_families import Kind
from otolith.twin.definition import Definition, Input, Parameter, Role, Site, StateVariable
from otolith.twin.dimensions import dimension_of

SLOTS = 3
ELAPSED = "_elapsed"  # s since the first record; what begins with "_" no author of a twin can write
WIDE = 1e30
SPEEDS = {"rad/s": "rad", "m/s": "m"}


@dataclass(frozen=True, slots=True)
class Source:
    """What a component may depend on."""

    name: str
    unit: str
    kind: Kind
    symbol: str
    """In the slotted twin; empty for nothing."""


def reading(name: str) -> str:
    """The site at which the sensor of a signal may lie."""
    return f"sensor of {name}"


@lru_cache(maxsize=64)
def sites(definition: Definition) -> tuple[Site, ...]:
    """The author's, then one for what each sensor adds to the truth."""
    sensors = (
        Site(reading(name), definition.unit_of(name), f"error of the sensor of {name}", name, "additive")
        for name in (*(entry.name for entry in definition.outputs), *(entry.name for entry in definition.inputs))
    )
    return (*definition.sites, *sensors)


@lru_cache(maxsize=64)
def sources(definition: Definition) -> tuple[Source, ...]:
    """Time, angles, inputs, states, and outputs that are no states; ``definition`` is the author's."""
    states = [entry.name for entry in definition.states]
    return (
        Source("", "1", Kind.NOTHING, ""),
        Source("t", "s", Kind.TIME, ELAPSED),
        *(Source(f"angle({name})", unit, Kind.PLACE, _angle(name)) for name, unit in _speeds(definition)),
        *(Source(entry.name, entry.unit, Kind.SIGNAL, entry.name) for entry in definition.inputs),
        *(Source(entry.name, entry.unit, _kind(entry.unit), entry.name) for entry in definition.states),
        *(Source(e.name, e.unit, _kind(e.unit), e.name) for e in definition.outputs if e.name not in states),
    )


def _kind(unit: str) -> Kind:
    return Kind.PLACE if unit in ("rad", "m") else Kind.SIGNAL


def _angle(speed: str) -> str:
    return f"_angle_{speed}"


def _speeds(definition: Definition) -> list[tuple[str, str]]:
    """States that are speeds, and the unit of their integrals; not those whose integral is a state already."""
    integrated = {text.strip() for left, text in definition.equations if left.startswith("der(")}
    found = []
    for entry in definition.states:
        for speed, unit in SPEEDS.items():
            turns = speed == "m/s" or "rad" in entry.unit or "rpm" in entry.unit
            if turns and dimension_of(entry.unit) == dimension_of(speed) and entry.name not in integrated:
                found.append((entry.name, unit))
                break
    return found


def enters(index: int) -> str:
    """The input through which something may be added at a site, by the site's number."""
    return f"_enter_{index}"


def entrances(definition: Definition) -> tuple[str, ...]:
    """The inputs through which something may be added, in the order of the sites; ``definition`` is the author's."""
    return tuple(enters(index) for index in range(len(sites(definition))))


def numbers(slot: int) -> tuple[str, str, str]:
    """Amplitude, inner number and phase of a slot."""
    return f"_amplitude_{slot}", f"_inner_{slot}", f"_phase_{slot}"


def family(slot: int) -> str:
    """The setting that says which meta-model sits in a slot."""
    return f"_family_{slot}"


def shift(slot: int) -> str:
    """The setting that is added to a slot's input."""
    return f"_shift_{slot}"


def weight(slot: int, source: int) -> str:
    """The setting that is one for the source that a slot depends on, by the source's number."""
    return f"_weight_{slot}_{source}"


def place(slot: int, site: int) -> str:
    """The setting that is one for the site where a slot enters, by the site's number."""
    return f"_place_{slot}_{site}"


@lru_cache(maxsize=64)
def with_slots(definition: Definition) -> Definition:
    """The same machine with empty slots, the angles of its speeds as states, and an input for each site."""
    speeds = _speeds(definition)
    settings, found = [], []
    for slot in range(SLOTS):
        found += [Parameter(name, "1", 0.0, -WIDE, WIDE, "") for name in numbers(slot)]
        names = [family(slot), shift(slot)]
        names += [weight(slot, index) for index in range(1, len(sources(definition)))]
        names += [place(slot, index) for index in range(len(sites(definition)))]
        settings += [Parameter(name, "1", 0.0, -WIDE, WIDE, "", Role.SETTING) for name in names]
    entering = (Input(enters(index), site.unit, "", "foh") for index, site in enumerate(sites(definition)))
    return replace(
        definition,
        states=(*definition.states, *(StateVariable(_angle(name), unit, "", 0.0, 0.0, 0.0) for name, unit in speeds)),
        inputs=(*definition.inputs, Input(ELAPSED, "s", "", "foh"), *entering),
        parameters=(*definition.parameters, *found, *settings),
        equations=(*definition.equations, *((f"der({_angle(name)})", name) for name, _ in speeds)),
        plain=definition,
    )
