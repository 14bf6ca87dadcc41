"""The candidate library of a twin: which component families may enter at which of its sites, driven by which source."""

from dataclasses import dataclass
from functools import lru_cache

from otolith.estimation.problem import key_of
from otolith.twin.augmentation import ComponentSource, sites, sources
from otolith.twin.component_families import COMPONENT_FAMILIES, ComponentFamily, SourceKind
from otolith.twin.definition import Definition

SENSOR_FAMILIES = frozenset({"constant", "linear"})  # the errors of a sensor: an offset and a gain


@dataclass(frozen=True, slots=True)
class CandidateForm:
    """A component without amplitude, inner parameter and phase."""

    site: int
    """Index of the site."""
    model: ComponentFamily
    source: int
    """Index of the source."""
    bounds: tuple[float, float] = (0.0, 0.0)
    """Of the inner parameter."""


@lru_cache(maxsize=64)
def candidate_table(base: Definition) -> tuple[tuple[str, CandidateForm], ...]:
    """Return the key and the form of every component that ``base``, a twin without slots, could have.

    The bounds of inner parameters depend on the window, and so does which forms it can distinguish.
    """
    machine_sites = len(base.sites)
    return tuple(
        (key_of(site.name, model.name, source.name), CandidateForm(index, model, number))
        for index, site in enumerate(sites(base))
        for model in COMPONENT_FAMILIES
        for number, source in enumerate(sources(base))
        if source.kind in model.inputs and (index < machine_sites or _is_sensor_error(model, source, site.into))
    )


def _is_sensor_error(model: ComponentFamily, source: ComponentSource, signal: str) -> bool:
    """Whether the form is an offset, or a gain error, of the sensor of ``signal``."""
    if model.name not in SENSOR_FAMILIES:
        return False
    return source.kind is SourceKind.NOTHING or source.name == signal
