"""Run the daemon: for one machine as it is, for several as a hall of which no machine ends the service."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from otolith_drivers.errors import ConfigurationError, some_names

if TYPE_CHECKING:
    from otolith.runtime.hall.files import MachineFiles

log = logging.getLogger(__name__)


def serve(paths: Sequence[Path], listen: tuple[str, ...] | None, recording: Path | None, workers: int | None) -> int:
    """Serve the machines of files and directories until a signal, and return its number.

    Raises:
        ConfigurationError: the file of a machine that is alone, or of the service, is wrong, or no file of several can
            be used.
    """
    from otolith.runtime.hall.about import name_machines_in_log
    from otolith.runtime.hall.daemon import Daemon, hall_of
    from otolith.runtime.hall.files import usable
    from otolith.runtime.service import Service
    from otolith.service_file import workers_of

    is_alone = len(paths) == 1 and not paths[0].is_dir()
    if recording is not None and not is_alone:
        raise ConfigurationError("--recording is one file, for one machine: set [recording] folder in each file")
    if not is_alone:
        name_machines_in_log()
    try:
        if is_alone:
            machine = usable(paths[0])
        else:
            stated = workers_of([path for path in paths if path.is_dir()])
            files = _checked(paths)
    except ConfigurationError as error:
        error.exit_code = os.EX_CONFIG  # so that systemd distinguishes it from a bus that may come up later
        raise
    if is_alone:
        return Daemon([Service(machine, listen, recording)]).run()
    return hall_of(paths, files, listen, stated if workers is None else workers).run()


def _checked(paths: Sequence[Path]) -> "MachineFiles":
    """Return the machines of files and directories; raise ConfigurationError if no file can be used."""
    from otolith.runtime.hall.files import files_in, read_files

    files = read_files(paths)
    if not files.machines:
        none = f"{', '.join(map(str, paths))}: there is no machine file (*.toml)"
        raise ConfigurationError(f"no machine can be served: {'the lines above say why' if files_in(paths) else none}")
    _tell_where_tables_belong(files)
    return files


def _tell_where_tables_belong(files: "MachineFiles") -> None:
    """Log which machine files have tables of the service: each stands in place of that of ``service.toml``."""
    from otolith.service_file import SERVICE_FILE, TABLES

    for table in TABLES:
        own = [
            machine.path.name
            for machine in files.machines.values()
            if table in machine.file.model_fields_set and table not in machine.of_service
        ]
        if own:
            text = "[%s] in a machine file holds for its machine alone, in %s beside them for all: %s"
            log.info(text, table, SERVICE_FILE, some_names(own))
