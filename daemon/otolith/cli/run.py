"""Run the daemon: for one machine as it is, for several as a hall of which no machine ends the service."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from otolith_drivers.errors import ConfigurationError

if TYPE_CHECKING:
    from otolith.runtime.hall.files import MachineFiles


def serve(paths: Sequence[Path], listen: tuple[str, ...] | None, recording: Path | None, workers: int | None) -> int:
    """Serve the machines of files and directories until a signal, and return its number.

    Raises:
        ConfigurationError: the file of a machine that is alone is wrong, or no file of several can be used.
    """
    from otolith.runtime.hall.about import name_machines_in_log
    from otolith.runtime.hall.daemon import Daemon, hall_of
    from otolith.runtime.hall.files import usable
    from otolith.runtime.service import Service

    is_alone = len(paths) == 1 and not paths[0].is_dir()
    if recording is not None and not is_alone:
        raise ConfigurationError("--recording is one file, for one machine: set [recording] folder in each file")
    if not is_alone:
        name_machines_in_log()
    try:
        if is_alone:
            machine = usable(paths[0])
        else:
            files = _checked(paths)
    except ConfigurationError as error:
        error.exit_code = os.EX_CONFIG  # so that systemd distinguishes it from a bus that may come up later
        raise
    if is_alone:
        return Daemon([Service(machine, listen, recording)]).run()
    return hall_of(paths, files, listen, workers).run()


def _checked(paths: Sequence[Path]) -> "MachineFiles":
    """Return the machines of files and directories; raise ConfigurationError if no file can be used."""
    from otolith.runtime.hall.files import files_in, read_files

    files = read_files(paths)
    if not files.machines:
        none = f"{', '.join(map(str, paths))}: there is no machine file (*.toml)"
        raise ConfigurationError(f"no machine can be served: {'the lines above say why' if files_in(paths) else none}")
    return files
