"""The machine files of a hall: read and checked, each for itself."""

import logging
import re
import tomllib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from otolith.health.schema import LANGUAGES, Language
from otolith.machine import LoadedMachine, load_machine
from otolith.machine_file import MachineTable
from otolith.service_file import SERVICE_FILE
from otolith.storage.state_store import is_served
from otolith_drivers.config_files import check_name, is_of_another_kind
from otolith_drivers.errors import OtolithError

log = logging.getLogger(__name__)

Names = tuple[str, str]
"""Site and name of a machine."""


@dataclass(frozen=True, slots=True)
class Refused:
    """A machine that is not served, and why."""

    path: Path
    names: Names  # As far as they can be read; else those that the file stands for
    reason: str
    language: Language = "en"
    is_served: bool = False  # Whether a machine with these names is, by this daemon or by another one


@dataclass(frozen=True, slots=True)
class MachineFiles:
    """The machines of a hall by their files."""

    machines: Mapping[Names, LoadedMachine] = field(default_factory=dict)
    refused: tuple[Refused, ...] = ()


def usable(path: Path) -> LoadedMachine:
    """Return the machine of a file; raise ConfigurationError if something in it is wrong."""
    machine = load_machine(path)
    machine.try_fmu()
    return machine


def files_in(paths: Sequence[Path]) -> list[Path]:
    """Return the machine files that are meant, each once, those of a directory by name."""
    files = [_machine_files(path) if path.is_dir() else [path] for path in paths]
    return list(dict.fromkeys(file.absolute() for each in files for file in each))


def _machine_files(folder: Path) -> list[Path]:
    """Return the machine files of a folder, where twins, scenarios and the file of the service may lie as well."""
    files = (path for path in folder.glob("*.toml") if path.name != SERVICE_FILE)
    return sorted(path for path in files if not is_of_another_kind(path, "machine"))


def read_files(paths: Sequence[Path], served: Collection[Path] = ()) -> MachineFiles:
    """Return the machines of files and directories; what is wrong with one is logged, and leaves it out.

    Of several files for one machine the first counts, or that which is ``served``.
    """
    machines, refused = dict[Names, LoadedMachine](), list[Refused]()
    for path in sorted(files_in(paths), key=lambda path: path not in served):
        try:
            machine = usable(path)
        except (OtolithError, OSError) as error:
            refused.append(_refused(path, one_line(error)))
            continue
        except Exception as error:  # no file of a hall ends it
            log.exception("%s: not served", path)
            refused.append(_refused(path, f"{path}: {type(error).__name__}: {error}"))
            continue
        names = machine.file.machine.site, machine.file.machine.name
        if names in machines:
            reason = f"{path}: {machines[names].path} has machine {names[1]} at {names[0]}"
            refused.append(Refused(path, names, reason, machine.file.machine.language, is_served=True))
            continue
        machines[names] = machine
    for each in refused:
        log.error("%s.%s: not served: %s", *each.names, each.reason)
    return MachineFiles(machines, tuple(refused))


def one_line(error: Exception) -> str:
    """Return the text of an error without line breaks."""
    return "; ".join(str(error).split("\n"))


def _refused(path: Path, reason: str) -> Refused:
    """Return a file that cannot be used, with the names in it, or without them that of the file."""
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8", errors="replace")).get("machine", {})
    except (OSError, ValueError, RecursionError):
        table = {}
    table = table if isinstance(table, dict) else {}
    site, name, language = (table.get(key) for key in ("site", "name", "language"))
    own = re.sub(r"[^A-Za-z0-9_-]", "-", path.stem).lstrip("-_")[:64] or "machine"
    names = _name(site, str(MachineTable.model_fields["site"].default)), _name(name, own)
    own_language: Language = next((known for known in LANGUAGES if known == language), "en")
    return Refused(path, names, reason, own_language, is_served(*names))


def _name(written: object, default: str) -> str:
    try:
        return check_name(written) if isinstance(written, str) else default
    except ValueError:
        return default
