"""Files that the user named: read whole, and never more than a file of their kind may have."""

from pathlib import Path

from otolith_drivers.errors import ConfigurationError


def content(path: Path, limit: int, key: tuple[str, ...] = ()) -> bytes:
    """The bytes of ``path``, ``limit`` of them at most; ``key`` is where in the machine file it is named.

    Raises:
        ConfigurationError: no such file, no file at all, a larger one, or one that may not be read.
    """
    try:
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"{path}: is a directory or a device, not a file", key)
        if path.stat().st_size > limit:
            raise ConfigurationError(f"{path}: larger than {limit} bytes, so it is not read", key)
        return path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}", key) from error
