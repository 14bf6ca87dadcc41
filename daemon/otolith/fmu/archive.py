"""An FMU on disk: an archive from outside, checked before anything of it is used, and unpacked into the cache.

Only its description is read until a process has to evaluate it. Its binaries and resources are then unpacked into a
folder of this user alone, by the digest of the archive: a file that was changed meanwhile is refused.
"""

import contextlib
import errno
import fcntl
import hashlib
import io
import os
import platform
import re
import shutil
import stat
import tempfile
import time
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from otolith.fmu.reference import FmuReference
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.outside_text import visible
from otolith_drivers.user_dirs import cache_directory

# Limits keep memory and disk from hostile archives; docs/reference/thresholds-twin.md.
MAX_ARCHIVE_BYTES = 256 << 20
MAX_UNPACKED_BYTES = 1 << 30
MAX_MEMBERS = 20_000
MAX_DESCRIPTION_BYTES = 32 << 20
MAX_RATIO, RATIO_BYTES = 200.0, 16 << 20  # of unpacked to packed bytes, for members above that size
KEPT = 8  # unpacked archives, the latest; and those in use
LEFT = 86400.0  # s: age from which on a folder that was not finished is removed
NEW = "new-"  # begins the names of folders that are not whole
DESCRIPTION = "modelDescription.xml"
USED = ("binaries/", "resources/")
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,199}")
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # of the standard; zipfile limits what these unpack at a time
CHUNK = 1 << 16  # bytes
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OverflowError)
READ_ERRORS = (OSError, NotImplementedError, RuntimeError, ValueError, *DAMAGED)
BY_NAMES = (errno.ENAMETOOLONG, errno.ENOTDIR, errno.EISDIR, errno.EEXIST)  # a member is too long, or below another


class FmuArchive(NamedTuple):
    """A checked archive."""

    path: Path
    digest: str
    names: frozenset[str]
    description: bytes


def read_archive(path: Path) -> FmuArchive:
    """Return a checked archive; raise ValueError with the reason for which it is refused."""
    return _checked(path, _content(path))


def _checked(path: Path, content: bytes) -> FmuArchive:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            _check_members(members)
            names = frozenset(member.filename for member in members)
            if DESCRIPTION not in names:
                raise ValueError(f"has no {DESCRIPTION}, so it is no FMU")
            size = archive.getinfo(DESCRIPTION).file_size
            if size > MAX_DESCRIPTION_BYTES:
                raise ValueError(
                    f"{DESCRIPTION} has {size >> 20} MB: at most {MAX_DESCRIPTION_BYTES >> 20} MB are read"
                )
            description = b"".join(_chunks(archive, archive.getinfo(DESCRIPTION)))
    except READ_ERRORS as error:
        raise ValueError(_reason(error)) from error
    return FmuArchive(path, hashlib.sha256(content).hexdigest(), names, description)


def _content(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ValueError("no such file" if not path.exists() else "is no file")
        if (size := path.stat().st_size) > MAX_ARCHIVE_BYTES:
            raise ValueError(f"has {size >> 20} MB: an FMU may have {MAX_ARCHIVE_BYTES >> 20} MB")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror}") from error


def _chunks(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Iterator[bytes]:
    """Return the content of a member, by small parts and of the size that the archive declares.

    Reading a member at once would unpack all of its stream before its size is compared.
    """
    count = 0
    with archive.open(member) as stream:
        while chunk := stream.read(CHUNK):
            if (count := count + len(chunk)) > member.file_size:
                break
            yield chunk
    if count != member.file_size:
        name = repr(visible(member.filename, 80))
        raise zipfile.BadZipFile(f"its member {name} has another size than it declares, {member.file_size} bytes")


def _reason(error: Exception) -> str:
    text = visible(str(error), 200) or type(error).__name__
    if isinstance(error, DAMAGED):
        return f"is no archive, or a damaged one: {text}: export it again"
    return text


def _check_members(members: list[zipfile.ZipInfo]) -> None:
    """Raise ValueError if an archive would write outside of its folder, or more than a disk should take."""
    if len(members) > MAX_MEMBERS:
        raise ValueError(f"has {len(members)} members: at most {MAX_MEMBERS} are unpacked")
    seen = set[str]()
    for member in members:
        name, shown = member.filename, repr(visible(member.filename, 80))
        parts = PurePosixPath(name).parts
        if not name or name.startswith("/") or ".." in parts or re.search(r"[\\:\x00-\x1f]", member.orig_filename):
            raise ValueError(f"its member {shown} leads out of its folder")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise ValueError(f"its member {shown} is a link")
        if name in seen:
            raise ValueError(f"its member {shown} is in it twice")
        if member.flag_bits & 1:
            raise ValueError(f"its member {shown} is encrypted")
        if member.compress_type not in PACKINGS:
            packing = f"by method {member.compress_type} of zip"
            raise ValueError(f"its member {shown} is packed {packing}, an FMU by deflate only: export it with that")
        if member.file_size > max(RATIO_BYTES, MAX_RATIO * member.compress_size):
            packed = f"{member.compress_size} bytes packed"
            raise ValueError(f"its member {shown} has {member.file_size >> 20} MB, {packed}: a bomb")
        seen.add(name)
    if (total := sum(member.file_size for member in members)) > MAX_UNPACKED_BYTES:
        raise ValueError(f"has {total >> 20} MB unpacked: at most {MAX_UNPACKED_BYTES >> 20} MB are unpacked")


def check_binary(archive: FmuArchive, version: str, identifier: str) -> None:
    """Raise ValueError if the archive has no binary of that name for this computer."""
    if not IDENTIFIER.fullmatch(identifier):
        raise ValueError(f"its modelIdentifier {visible(identifier, 80)!r} is no name in C")
    wanted = f"binaries/{platform_name(version)}/{identifier}.so"
    if wanted not in archive.names:
        parts = (PurePosixPath(name).parts for name in archive.names)
        others = sorted({part[1] for part in parts if len(part) > 2 and part[0] == "binaries"})
        has = f"it has {', '.join(visible(name, 40) for name in others[:8])}" if others else "it has none"
        raise ValueError(f"has no binary for this computer, {wanted}: {has}: export it for Linux, or compile it there")


def platform_name(version: str) -> str:
    """Return what the standard calls this computer."""
    machine = platform.machine()
    return "linux64" if version == "2" and machine == "x86_64" else f"{machine}-linux"


def unpacked(reference: FmuReference) -> Path:
    """Return the folder with binaries and resources of an FMU.

    Raises:
        ConfigurationError: the archive was changed since its description was read, or cannot be unpacked.
    """
    store = store_of(reference)
    folder = store / reference.digest
    if not folder.is_dir():
        path = Path(reference.path)
        try:
            archive = _checked(path, content := _content(path))
        except ValueError as error:
            raise ConfigurationError(f"{reference.path}: {error}") from error
        if archive.digest != reference.digest:
            raise ConfigurationError(f"{reference.path}: was changed since it was checked: start again")
        try:
            _unpack(content, folder)
        except OSError as error:
            if error.errno not in BY_NAMES:
                raise ConfigurationError(no_room(reference, store, error)) from error
            fault = f"cannot be unpacked by the names of its members: {error.strerror}: export it with others"
            raise ConfigurationError(f"{reference.path}: {fault}") from error
        except READ_ERRORS as error:
            raise ConfigurationError(f"{reference.path}: {_reason(error)}") from error
        _remove_old(store, folder)
    with contextlib.suppress(OSError):  # as on a disk that became read-only: it is used as it is
        os.utime(folder)
    return folder


def store_of(reference: FmuReference) -> Path:
    """Return the folder of this user for unpacked FMUs; raise ConfigurationError if there can be none."""
    try:
        return cache_directory("fmus")
    except ServiceError as error:
        raise ConfigurationError(f"{reference.path}: has no cache in which it could be tried: {error}") from error


def no_room(reference: FmuReference, store: Path, error: OSError) -> str:
    """Return what to say where the folder of unpacked FMUs cannot be written."""
    return f"{reference.path}: {store} cannot be written: {error.strerror or error}: make room there"


def _unpack(content: bytes, folder: Path) -> None:
    """Make a folder of what is used of an archive, at once."""
    temporary = Path(tempfile.mkdtemp(prefix=NEW, dir=folder.parent))
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as opened:
            for member in opened.infolist():
                if member.filename.startswith(USED) and not member.is_dir():
                    target = temporary / member.filename
                    target.parent.mkdir(parents=True, exist_ok=True)
                    with target.open("wb") as file:
                        file.writelines(_chunks(opened, member))
        try:
            temporary.rename(folder)
        except OSError:
            if not folder.is_dir():  # another process has unpacked it
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def held(folder: Path) -> int:
    """Return a descriptor by which no process removes a folder until it is closed."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    fcntl.flock(handle, fcntl.LOCK_SH)
    return handle


def _remove_old(store: Path, keep: Path) -> None:
    """Remove what was used long ago and is in no use, and what processes that were killed have left."""
    dated = list[tuple[float, Path]]()
    for path in store.iterdir():
        with contextlib.suppress(OSError):  # another process has removed it
            if path.is_dir():
                dated.append((path.stat().st_mtime, path))
    whole = [path for _, path in sorted(dated) if not path.name.startswith(NEW)]
    begun = [path for mtime, path in dated if path.name.startswith(NEW) and time.time() - mtime > LEFT]
    for folder in (*whole[:-KEPT], *begun):
        if folder != keep:
            _remove(folder)


def _remove(folder: Path) -> None:
    with contextlib.suppress(OSError):  # it is in use, or another process has removed it
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            gone = folder.with_name(f"{NEW}{folder.name.removeprefix(NEW)}")
            folder.rename(gone)  # nobody finds a part of it
            shutil.rmtree(gone, ignore_errors=True)
        finally:
            os.close(handle)
