"""All that a component could be: families, sites and sources that a window can tell anything of."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.adaptation.component import key_of
from otolith.twin.definition import Definition
from otolith.twin.kernel import Numbers
from otolith.twin.metamodels import METAMODELS, Kind, MetaModel, code_of
from otolith.twin.slots import Source, sites, sources

SENSOR_FAMILIES = frozenset({"constant", "linear"})  # an offset and a gain


@dataclass(frozen=True, slots=True)
class Structure:
    """A component without its numbers."""

    site: int
    """Number of the site."""
    model: MetaModel
    source: int
    """Number of the source."""
    bounds: tuple[float, float] = (0.0, 0.0)
    """Of the inner number."""


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Curves of components of unit amplitude; those of one guess follow each other."""

    families: Array
    """(curves,)."""
    sources: Numbers
    """(curves,)."""
    sites: Numbers
    """(curves,)."""
    inner: Array
    """(curves,)."""
    phases: Array
    """(curves,)."""


def structures(twin: Definition, x: Array, taken: frozenset[str] = frozenset()) -> list[Structure]:
    """All that can be told from each other where the sources are ``x`` (sources, records); ``twin`` is the author's.

    Those whose keys are ``taken`` are left out.
    """
    known = [
        (model, number, source, _bounds(model, x[number]))
        for model in METAMODELS
        for number, source in enumerate(sources(twin))
        if source.kind in model.inputs and model.valid(x[number])
    ]
    own = len(twin.sites)
    return [
        Structure(index, model, number, bounds)
        for index, site in enumerate(sites(twin))
        for model, number, source, bounds in known
        if (index < own or _lies_so(model, source, site.into))
        and key_of(site.name, model.name, source.name) not in taken
    ]


def _bounds(model: MetaModel, x: Array) -> tuple[float, float]:
    if model.given is not None:
        return model.given(x), model.given(x)
    return (0.0, 0.0) if model.inner is None else model.inner.bounds(x)


def _lies_so(model: MetaModel, source: Source, signal: str) -> bool:
    """A sensor has an offset, or a gain that is off."""
    if model.name not in SENSOR_FAMILIES:
        return False
    return source.kind is Kind.NOTHING or source.name == signal


def grid(structure: Structure, x: Array, fineness: float) -> Array:
    """(points,) of the inner number from which a search begins; ``x`` (sources, records)."""
    inner = structure.model.inner
    low, high = structure.bounds
    if inner is None:
        return np.array([low])
    if inner.points:
        points = max(round(inner.points / fineness**2), 2)
        return np.exp(np.linspace(np.log(low), np.log(high), points))
    width = fineness * 2.0 * np.pi / max(float(np.ptp(x[structure.source])), 1e-9)  # a line of the spectrum
    return np.arange(low, high, width)


def shapes(guesses: Iterator[tuple[Structure, float]]) -> Shapes:
    """One curve for each guess, or two where the phase is free."""
    rows = [
        (code_of(entry.model.name), entry.source, entry.site, inner, phase)
        for entry, inner in guesses
        for phase in entry.model.phases
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    families, numbers, places, inner, phases = columns
    return Shapes(families, numbers.astype(np.int64), places.astype(np.int64), inner, phases)
