"""Folders of this user alone: systemd's in a service, the user's own (XDG) otherwise."""

import os
from pathlib import Path

from otolith_drivers.errors import ServiceError


def state_directory() -> Path:
    """Recordings and what is learned."""
    return _private("STATE_DIRECTORY", "XDG_STATE_HOME", ".local/state")


def cache_directory(name: str) -> Path:
    """A folder for what can be made again: compiled kernels, parsed units. What is loaded from there may run.

    Raises:
        ServiceError: it cannot be made, belongs to somebody else or can be written by others.
    """
    folder = writable(_private("CACHE_DIRECTORY", "XDG_CACHE_HOME", ".cache") / name)
    found = folder.stat()
    if found.st_uid != os.geteuid() or found.st_mode & 0o022:
        raise ServiceError(f"{folder}: must belong to this user and be writable by nobody else, as what is in it runs")
    return folder


def writable(folder: Path) -> Path:
    """``folder``, made if it is missing.

    Raises:
        ServiceError: it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ServiceError(f"{folder}: cannot be made: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ServiceError(f"{folder}: not writable for this user")
    return folder


def complain_unless_writable(folder: Path) -> None:
    """Refuse a folder that :func:`writable` would, without making it.

    Raises:
        ServiceError: it cannot be written to, or could not be made.
    """
    nearest = folder
    while not nearest.exists() and nearest != nearest.parent:
        nearest = nearest.parent
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise ServiceError(f"{folder}: cannot be written by this user, as {nearest} is no folder that can be")


def _private(systemd: str, xdg: str, fallback: str) -> Path:
    if given := os.environ.get(systemd):
        return writable(Path(given.split(":")[0]))
    base = Path(os.environ.get(xdg, ""))
    if not base.is_absolute():  # as the XDG specification asks
        home = Path(os.environ.get("HOME", ""))
        if not home.is_absolute():
            raise ServiceError(f"no home directory: set {xdg} or HOME to an absolute path")
        base = home / fallback
    return writable(base / "otolith")
