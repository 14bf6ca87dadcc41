"""The table of twins."""

from otolith.errors import ConfigurationError, nearest
from otolith.twin.dc_motor import DC_MOTOR
from otolith.twin.model import Twin

TWINS: dict[str, Twin] = {twin.name: twin for twin in (DC_MOTOR,)}


def find_twin(name: str) -> Twin:
    """The twin called ``name``.

    Raises:
        ConfigurationError: there is none of that name.
    """
    if name not in TWINS:
        raise ConfigurationError(f"unknown twin {name!r}: {nearest(name, list(TWINS))}")
    return TWINS[name]
