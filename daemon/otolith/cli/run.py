"""Run the daemon: for one machine as it is, for several as a hall of which no machine ends the service."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from otolith_drivers.errors import ConfigurationError

if TYPE_CHECKING:
    from otolith.machine import LoadedMachine

log = logging.getLogger(__name__)


def serve(paths: Sequence[Path], listen: tuple[str, ...] | None, recording: Path | None, workers: int | None) -> int:
    """Serve the machines of files and directories until a signal, and return its number.

    Raises:
        ConfigurationError: the file of a machine that is alone is wrong, or no file of several can be used.
    """
    from otolith.runtime.hall.about import name_machines_in_log
    from otolith.runtime.hall.daemon import Daemon, hall_of
    from otolith.runtime.service import Service

    is_alone = len(paths) == 1 and not paths[0].is_dir()
    if recording is not None and not is_alone:
        raise ConfigurationError("--recording is one file, for one machine: set [recording] folder in each file")
    try:
        if is_alone:
            machines = [_usable(paths[0])]
        else:
            name_machines_in_log()
            machines = _loaded(paths)
    except ConfigurationError as error:
        error.exit_code = os.EX_CONFIG  # so that systemd distinguishes it from a bus that may come up later
        raise
    if is_alone:
        return Daemon([Service(machines[0], listen, recording)]).run()
    return hall_of(machines, listen, workers).run()


def files_in(paths: Sequence[Path]) -> list[Path]:
    """Return the machine files that are meant, each once, those of a directory by name."""
    files = [sorted(path.glob("*.toml")) if path.is_dir() else [path] for path in paths]
    return list(dict.fromkeys(file.absolute() for each in files for file in each))


def _usable(path: Path) -> "LoadedMachine":
    """Return the machine of a file; raise ConfigurationError if something in it is wrong."""
    from otolith.machine import load_machine

    machine = load_machine(path)
    machine.try_fmu()
    return machine


def _loaded(paths: Sequence[Path]) -> list["LoadedMachine"]:
    """Return the machines of files and directories; what is wrong with one is logged, and leaves it out."""
    machines, files = dict[tuple[str, str], "LoadedMachine"](), files_in(paths)
    for path in files:
        try:
            machine = _usable(path)
        except ConfigurationError as error:
            log.error("not served: %s", "; ".join(str(error).split("\n")))  # noqa: TRY400 - no traceback
            continue
        except Exception:  # no file of a hall ends it
            log.exception("%s: not served", path)
            continue
        names = machine.file.machine.site, machine.file.machine.name
        if names in machines:
            log.error("%s: not served: %s has machine %s at %s", path, machines[names].path, names[1], names[0])
            continue
        machines[names] = machine
    if not machines:
        why = "the lines above say why" if files else f"{', '.join(map(str, paths))}: there is no machine file (*.toml)"
        raise ConfigurationError(f"no machine can be served: {why}")
    return list(machines.values())
