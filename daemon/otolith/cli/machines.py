"""Which machine a command means, in all commands alike: its file, its name, or site and name with a point between.

A service may also be given by its own name, that of its machine file in ``/etc/otolith``.
"""

import math
import os
import time
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from otolith.cli import common
from otolith.cli.terminal import echo
from otolith_drivers.errors import ConfigurationError, OtolithError, nearest, some_names

if TYPE_CHECKING:
    from otolith.storage.history import HistoryReader

Found = TypeVar("Found")
SITE = "site"  # of a machine whose file names none


@dataclass(frozen=True, slots=True)
class MachineIdentity:
    """Site and name of a machine."""

    site: str
    name: str

    @property
    def key(self) -> str:
        """Both, with a point between."""
        return f"{self.site}.{self.name}"

    def is_named(self, text: str) -> bool:
        """Whether ``text`` is its name, with or without its site."""
        return text in {self.name, self.key}


def is_file(text: str) -> bool:
    """Whether a user means a file and not a name."""
    return "/" in text or text.endswith(".toml") or Path(text).is_file()


def identity_of(path: Path) -> MachineIdentity | None:
    """Return the identity in a machine file; None if it has none that can be read."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))["machine"]
        return MachineIdentity(str(table.get("site", SITE)), str(table["name"]))
    except (OSError, ValueError, LookupError, AttributeError):
        return None


def services() -> dict[Path, MachineIdentity]:
    """Return the machine files of the services that this user may read."""
    folders = (common.INSTALLED, common.INSTALLED / common.HALL)
    readable = [folder for folder in folders if os.access(folder, os.R_OK | os.X_OK)]
    files = [path for folder in readable for path in sorted(folder.glob("*.toml"))]
    return {path: identity for path in files if (identity := identity_of(path)) is not None}


def service_file(text: str) -> Path | None:
    """Return the machine file of the service with this name, or of a machine with this name.

    Raises:
        ConfigurationError: it is the name of several machines.
    """
    files = services()
    own = [path for path in files if path.stem == text]
    return _single(text, {path: files[path] for path in own or files if own or files[path].is_named(text)})


def key_of(text: str) -> str:
    """Return site and name with a point between of what a user gives; a name that is only a name stays so.

    Raises:
        ConfigurationError: ``text`` is a file without the name of a machine, or the name of several machines.
    """
    path = Path(text) if is_file(text) else service_file(text)
    if path is None:
        return text
    identity = identity_of(path)
    if identity is None:
        from otolith.machine import load_machine

        load_machine(path, with_driver=False)  # says what is wrong
        raise ConfigurationError(f"{path}: [machine] has no name")
    return identity.key


def file_of(text: str) -> Path:
    """Return the machine file that an argument means: a path, or the name of a machine whose file is known here.

    Raises:
        ConfigurationError: no machine of this name is known, or several are.
    """
    if is_file(text):
        return Path(text)
    if (path := service_file(text)) is not None:
        return path
    files = {path: reader for reader in own_histories() if MachineIdentity(reader.site, reader.machine).is_named(text)
             for path in _described_file(reader)}  # fmt: skip
    path = _single(text, {path: MachineIdentity(reader.site, reader.machine) for path, reader in files.items()})
    if path is None:
        raise ConfigurationError(none_text(text, "machine file"))
    return path


def reader_of(text: str) -> "HistoryReader":
    """Return the history in a file, of a machine file, or of a machine by its name or that of its service.

    If there is none of that name, it is that of the last demo, which is said on standard error.

    Raises:
        ConfigurationError: the file is wrong, or there is no history, or several, of that name.
    """
    from otolith.storage.history import HistoryReader, history_path

    if text.endswith(".sqlite"):
        return HistoryReader.of_file(Path(text))
    if is_file(text):
        from otolith.machine import load_machine

        common.use_state_of_service(Path(text))
        names = load_machine(Path(text), with_driver=False).file.machine
        return HistoryReader(history_path(names.site, names.name))
    if (reader := _own_reader(text)) is not None:
        return reader
    service = service_file(text)
    if common.use_state_of_service(service or text):
        is_in_hall = service is not None and common.service_of(service) == common.HALL
        return reader_of(services()[service].key if service is not None and is_in_hall else text)
    if not (demos := _demos_of(text)):
        raise ConfigurationError(none_text(text, "history"))
    echo(f"no machine is named {text!r}: this is the demo in {demos[-1].path.parents[1]}", err=True)
    return demos[-1]


def _own_reader(text: str) -> "HistoryReader | None":
    """Return the history in the state directory of a machine or service of this name; raise as :func:`reader_of`."""
    is_instance = Path(os.environ.get("STATE_DIRECTORY", "")).name == text  # which systemd names so
    known = {reader: MachineIdentity(reader.site, reader.machine) for reader in own_histories()}
    return _single(text, {reader: name for reader, name in known.items() if is_instance or name.is_named(text)})


def none_text(text: str, what: str) -> str:
    """Return that there is no ``what`` of a machine of this name, and which machines are known here."""
    known = sorted(set(_known_names()))
    if any(text in {name, name.partition(".")[2]} for name in known):
        return (
            f"where the {what} of {text!r} is, is not known here, as its history is of a demo or a log: give the file"
        )
    similar = nearest(text, known if "." in text else [name.partition(".")[2] for name in known])
    hint = f"{similar} " if known and not similar.startswith("known") else ""
    listed = f"known here: {some_names(known)}" if known else "none is known here"
    return f"no {what} of a machine {text!r}: {hint}{listed}; or give its machine file"


def _known_names() -> Iterator[str]:
    yield from (identity.key for identity in services().values())
    yield from (f"{reader.site}.{reader.machine}" for reader in (*own_histories(), *_demos()))


def own_histories() -> "list[HistoryReader]":
    """Return the histories in the state directory."""
    from otolith.storage.history import SUFFIX, HistoryReader, history_directory

    return [HistoryReader(path) for path in sorted(history_directory().glob(f"*{SUFFIX}"))]


def _demos() -> "list[HistoryReader]":
    """Return the histories that demos left, in the order of time."""
    from otolith.storage.history import SUFFIX, HistoryReader
    from otolith_drivers.user_dirs import state_directory

    paths = (state_directory() / common.DEMOS).glob(f"*/history/*{SUFFIX}")
    return [HistoryReader(path) for path in sorted(paths)]


def _demos_of(text: str) -> "list[HistoryReader]":
    return [reader for reader in _demos() if MachineIdentity(reader.site, reader.machine).is_named(text)]


def zone_of_machine(text: str) -> str | None:
    """Return the zone in which people read the times of a machine, given by its file or name.

    None for that of this computer: nothing is known of the machine, or it has no zone. Of a service its machine file
    says it: its history is closed to most of those who may see its recordings.
    """
    try:
        if not text:
            return None
        reader = None if is_file(text) else _own_reader(text)
        file = Path(text) if is_file(text) else service_file(text) if reader is None else None
        if file is not None:
            return _zone_of_file(file)
        readers = _demos_of(text) if reader is None else [reader]
        return readers[-1].language_and_zone()[1] if readers else None
    except (OtolithError, OSError, ValueError):
        return None


def _zone_of_file(path: Path) -> str | None:
    table = tomllib.loads(path.read_text(encoding="utf-8")).get("machine", {})
    zone = table.get("timezone") if isinstance(table, dict) else None
    return zone if isinstance(zone, str) else None


def _described_file(reader: "HistoryReader") -> Iterator[Path]:
    """Yield the machine file that a daemon was started with, if it is still that of its machine."""
    try:
        path = Path(str(reader.description().get("file", "")))
    except ConfigurationError:
        return
    identity = identity_of(path) if path.is_file() else None
    if identity == MachineIdentity(reader.site, reader.machine):
        yield path


def _single(text: str, found: dict[Found, MachineIdentity]) -> Found | None:
    if len(found) > 1:
        keys = sorted(identity.key for identity in found.values())
        remedy = "give one of these names" if len(set(keys)) == len(keys) else "give the machine file"
        raise ConfigurationError(f"several machines are named {text!r}: {some_names(keys)}: {remedy}")
    return next(iter(found), None)


def last_reports(text: str = "*") -> Iterable[str]:
    """Yield when the last report of each machine of this user was, in words; ``text`` is a name, or ``*`` for all.

    Without any, that is the last demo.
    """
    from otolith.health.text import duration_text
    from otolith.health.times import clock_in

    for reader in own_histories() or _demos()[-1:]:
        identity = MachineIdentity(reader.site, reader.machine)
        if text in {"*", "*.*"} or identity.is_named(text):
            try:
                last, labels, (_, zone) = reader.last(), reader.labels(), reader.language_and_zone()
            except ConfigurationError:
                continue
            if math.isfinite(last):
                end, name = labels.unix(last), identity.key
                when, ago = clock_in(zone)(end), duration_text(time.time() - end)
                yield f"last report of {name}: {when}, {ago} ago; 'otolith report {name}' shows it"
