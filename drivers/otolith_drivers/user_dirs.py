"""Folders that belong to this user: systemd's folders in a service, the XDG folders otherwise."""

import contextlib
import os
import tempfile
from pathlib import Path

from otolith_drivers.errors import ServiceError

EXECUTED = "its content is executed"
SERVICES = Path("/run/otolith")  # The folder of systemd's RuntimeDirectory=otolith/%i: one folder for each service


def state_directory() -> Path:
    """Return the folder for recordings and estimates, which may be missing; raise ServiceError without a home."""
    return _user_directory("STATE_DIRECTORY", "XDG_STATE_HOME", ".local/state")


def runtime_directory() -> Path:
    """Return the folder for sockets, which no other user can replace.

    Raises:
        ServiceError: the folder cannot be created, belongs to another user, or is writable by others.
    """
    own = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    is_own = own.is_absolute() and own.is_dir() and own.stat().st_uid == os.geteuid()  # not so after su or sudo
    folder = _user_directory("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR" if is_own else "XDG_STATE_HOME", ".local/state")
    return _guarded(writable(folder), "readers trust its sockets")


def runtime_folders() -> list[Path]:
    """Return the folders where daemons of this user and services have their sockets; some may be missing."""
    bases = (os.environ.get("XDG_RUNTIME_DIR"), os.environ.get("XDG_STATE_HOME"), f"{Path.home()}/.local/state")
    own = [Path(base) / "otolith" for base in bases if base and Path(base).is_absolute()]
    folders = list(own)
    for parent in (*own, SERVICES):
        with contextlib.suppress(OSError):  # missing, closed to this user, or removed meanwhile
            folders += parent.iterdir()
    return folders


def cache_directory(name: str) -> Path:
    """Return the folder for data that can be recreated: compiled kernels, parsed units.

    Raises:
        ServiceError: the folder cannot be created, belongs to another user, or is writable by others.
    """
    return _guarded(writable(_cache(name)), EXECUTED)


def spare_cache_directory(name: str) -> tuple[Path, Path | None]:
    """Return a folder for the same data where the cache cannot be written, and the cache itself if it can be read.

    Raises:
        ServiceError: the cache, or the other folder, belongs to another user or is writable by others.
    """
    cache = _cache(name)
    readable = _guarded(cache, EXECUTED) if cache.is_dir() else None
    try:
        folder = runtime_directory() / name
    except ServiceError:
        folder = _guarded(writable(Path(tempfile.gettempdir()) / f"otolith-{os.geteuid()}"), EXECUTED) / name
    return _guarded(writable(folder), EXECUTED), readable


def _cache(name: str) -> Path:
    return _user_directory("CACHE_DIRECTORY", "XDG_CACHE_HOME", ".cache") / name


def _guarded(folder: Path, reason: str) -> Path:
    status = folder.stat()
    if status.st_uid != os.geteuid() or status.st_mode & 0o022:
        raise ServiceError(f"{folder}: must belong to this user and be writable by no other: {reason}")
    return folder


def writable(folder: Path) -> Path:
    """Return ``folder``, created for this user alone if it is missing; raise ServiceError if it is not writable."""
    try:
        for missing in reversed([path for path in (folder, *folder.parents) if not path.exists()]):
            missing.mkdir(exist_ok=True, mode=0o700)
    except OSError as error:
        raise ServiceError(f"{folder}: cannot be created: {error.strerror}{way_out(folder)}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        fault = "not writable for this user" if folder.is_dir() else "a file, not a folder: move it away"
        raise ServiceError(f"{folder}: {fault}{way_out(folder)}")
    return folder


def way_out(path: Path) -> str:
    """Return what makes ``path`` usable for this user if it is a link or another user's, as after a copy by root."""
    try:
        owner = path.lstat().st_uid
        if path.is_symlink():
            return ", as it is a link: move it away"
    except OSError:  # it is missing, or in a folder that this user must not search
        return ""
    command = f"chown --recursive {os.geteuid()}:{os.getegid()} {path.parent}"
    return "" if owner == os.geteuid() else f", as it belongs to user {owner}: run '{command}' as root"


def check_writable(folder: Path) -> None:
    """Raise ServiceError if :func:`writable` would not accept ``folder``, without creating it."""
    parent = folder
    while not parent.exists() and parent != parent.parent:
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise ServiceError(f"{folder}: cannot be written by this user: {parent} is not a writable folder")


def _user_directory(systemd: str, xdg: str, fallback: str) -> Path:
    if service_folders := os.environ.get(systemd):
        return Path(service_folders.split(":")[0])
    base = Path(os.environ.get(xdg, ""))
    if not base.is_absolute():  # the XDG specification says to ignore relative paths
        home = Path(os.environ.get("HOME", ""))
        if not home.is_absolute():
            raise ServiceError(f"no home directory: set {xdg} or HOME to an absolute path")
        base = home / fallback
    return base / "otolith"
