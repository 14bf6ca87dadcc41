"""Folders that belong to this user: systemd's folders in a service, the XDG folders otherwise."""

import os
from pathlib import Path

from otolith_drivers.errors import ServiceError


def state_directory() -> Path:
    """Return the folder for recordings and estimated parameters.

    Raises:
        ServiceError: the folder cannot be created or is not writable.
    """
    return _user_directory("STATE_DIRECTORY", "XDG_STATE_HOME", ".local/state")


def cache_directory(name: str) -> Path:
    """Return the folder for data that can be recreated: compiled kernels, parsed units.

    Raises:
        ServiceError: the folder cannot be created, belongs to another user, or is writable by others.
    """
    folder = writable(_user_directory("CACHE_DIRECTORY", "XDG_CACHE_HOME", ".cache") / name)
    status = folder.stat()
    if status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise ServiceError(f"{folder}: must belong to this user and be writable by no other: its content is executed")
    return folder


def writable(folder: Path) -> Path:
    """Return ``folder``, created if it is missing.

    Raises:
        ServiceError: the folder cannot be created or is not writable.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise ServiceError(f"{folder}: cannot be created: {error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ServiceError(f"{folder}: not writable for this user")
    return folder


def check_writable(folder: Path) -> None:
    """Check that :func:`writable` would accept ``folder``, without creating it.

    Raises:
        ServiceError: the folder, or the nearest parent that exists, is not writable.
    """
    parent = folder
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise ServiceError(f"{folder}: cannot be written by this user: {parent} is not a writable folder")


def _user_directory(systemd: str, xdg: str, fallback: str) -> Path:
    if service_folders := os.environ.get(systemd):
        return writable(Path(service_folders.split(":")[0]))
    base = Path(os.environ.get(xdg, ""))
    if not base.is_absolute():  # the XDG specification says to ignore relative paths
        home = Path(os.environ.get("HOME", ""))
        if not home.is_absolute():
            raise ServiceError(f"no home directory: set {xdg} or HOME to an absolute path")
        base = home / fallback
    return writable(base / "otolith")
