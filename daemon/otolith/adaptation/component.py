"""An unknown component, as it was found."""

from dataclasses import dataclass

from otolith.twin.metamodels import MetaModel, metamodel


@dataclass(frozen=True, slots=True)
class Component:
    """A component: where it enters, which family, of what, and its numbers when it was found."""

    site: str
    family: str
    source: str
    """Empty for nothing, ``t``, ``angle(omega)`` or the name of a signal or state."""
    amplitude: float
    """In the unit of the site."""
    inner: float = 0.0
    phase: float = 0.0
    """rad, at the first record of the window it was found in."""
    low: float = 0.0
    """Of the inner number."""
    high: float = 0.0
    origin: float = 0.0
    """Unix seconds at which a time that does not repeat itself counts zero."""

    @property
    def key(self) -> str:
        """What tells it from others of the machine."""
        return key_of(self.site, self.family, self.source)

    @property
    def model(self) -> MetaModel:
        """Its family."""
        return metamodel(self.family)

    @property
    def repeats(self) -> bool:
        """Whether it has a phase."""
        return len(self.model.phases) > 1


def key_of(site: str, family: str, source: str) -> str:
    """``site/family/source``, without the source if there is none."""
    return f"{site}/{family}/{source}".rstrip("/")
