"""What the files of a service change on SIGHUP: read in another thread, so that the main thread waits for no disk."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.hall.files import Refused, files_in, one_line, read_files
from otolith.runtime.service import Revision, Service
from otolith_drivers.errors import OtolithError


@dataclass(frozen=True, slots=True)
class Changes:
    """What is to be done with the machines that are served, and with others."""

    revised: list[tuple[Service, Revision]] = field(default_factory=list)  # They go on, and take this over
    kept: list[tuple[Service, str]] = field(default_factory=list)  # They go on as before, for this reason
    ended: list[Service] = field(default_factory=list)
    new: list[LoadedMachine] = field(default_factory=list)  # Also in the place of one that ends
    refused: tuple[Refused, ...] = ()


def changes_of_one(service: Service) -> Changes:
    """Return what the file of a machine that is alone changes."""
    try:
        return Changes(revised=[(service, service.revision(load_machine(service.path)))])
    except (OtolithError, OSError) as error:
        return Changes(kept=[(service, one_line(error))])


def changes_of_hall(served: Sequence[Service], paths: Sequence[Path]) -> Changes:
    """Return what the files of a hall change. A machine goes on as before if its file cannot be used now.

    So do all machines of a directory without files: it is another one, or its disk is not there.
    """
    by_path = {service.path: service for service in served}
    by_names = {service.names: service for service in served}
    unusable = (path for path in paths if not path.is_file() and not (path.is_dir() and files_in([path])))
    empty = [path.absolute() for path in unusable]
    files = read_files([path for path in paths if path.absolute() not in empty], by_path)
    changes = Changes(refused=tuple(each for each in files.refused if each.path not in by_path))
    changes.kept.extend((by_path[each.path], each.reason) for each in files.refused if each.path in by_path)
    kept = [service for service, _ in changes.kept]
    gone = {names: service for names, service in by_names.items() if service not in kept}
    for names, machine in files.machines.items():
        if (service := by_names.get(names)) is None:
            changes.new.append(machine)
            continue
        if gone.pop(names, None) is None:  # one file of it is kept, though another one names it
            continue
        try:
            revision = service.revision(machine)
        except (OtolithError, OSError) as error:
            changes.kept.append((service, one_line(error)))
            continue
        if revision.change.needs_restart or machine.path != service.path:
            changes.ended.append(service)
            changes.new.append(machine)
        else:
            changes.revised.append((service, revision))
    for service in gone.values():
        if without := next((path for path in empty if path in (service.path, service.path.parent)), None):
            changes.kept.append((service, f"{without}: there is no machine file"))
        else:
            changes.ended.append(service)
    return changes
