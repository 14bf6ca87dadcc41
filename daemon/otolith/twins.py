"""Where twins come from: the library that travels with Otolith, and a specialist's own files."""

from pathlib import Path

from otolith.errors import ConfigurationError, nearest
from otolith.twin.definition import Definition
from otolith.twin.language import read_twin
from otolith_drivers.toml_files import read

LIBRARY = Path(__file__).parent / "twin" / "library"


def names() -> list[str]:
    """The twins of the library."""
    return sorted(path.stem for path in LIBRARY.glob("*.toml"))


def find_twin(name: str) -> Definition:
    """The twin called ``name`` in the library.

    Raises:
        ConfigurationError: there is none of that name.
    """
    if name not in names():
        raise ConfigurationError(f"unknown twin {name!r}: {nearest(name, names())}")
    return load_twin(LIBRARY / f"{name}.toml")


def load_twin(path: Path) -> Definition:
    """The twin in a file.

    Raises:
        ConfigurationError: unreadable or wrong, one line per fault.
    """
    return read_twin(read(path))
