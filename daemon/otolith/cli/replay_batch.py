"""``otolith replay --output``: recordings of many machines or months, by several processes, into a folder."""

import contextlib
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from otolith.cli.common import progress_line
from otolith.cli.replay import with_decisions
from otolith.cli.terminal import echo
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.batch.batch import (
    MachineReplay,
    Workers,
    key_of_machine,
    machine_replay,
    raise_failures,
    run_batch,
)
from otolith.runtime.batch.outputs import OutputFormat, opened_output
from otolith.runtime.hall.files import files_in
from otolith.runtime.segment import first_state
from otolith.storage.recording_files import recording_file
from otolith_drivers.base import Sampling
from otolith_drivers.errors import ConfigurationError, counted, some_names
from otolith_drivers.replay.sample_names import FOLDER, SAMPLES, viewing_file

if TYPE_CHECKING:
    from otolith.runtime.batch.cluster import ClusterAccess

log = logging.getLogger(__name__)


def replay_batch(
    paths: Sequence[Path],
    data: Sequence[Path],
    output: Path,
    kind: OutputFormat,
    state: Path | None,
    jobs: int | None,
    cluster: "ClusterAccess | None",
    stopped: Callable[[], bool],
) -> None:
    """Replay the recordings in ``data`` of the machines in ``paths``, and leave reports in the folder ``output``.

    With ``cluster`` its workers compute, else ``jobs`` processes of this computer: one per processor without a number.

    Raises:
        OtolithError: a file cannot be used or written, or a machine could not be replayed to its end.
    """
    machines = _loaded(paths)
    files = files_of_machines(list(machines.values()), data)
    with opened_output(output):
        replays = []
        for key, machine in machines.items():
            begin = with_decisions(machine, first_state(machine, Sampling.TRUE).adaptation, state)
            replays.append(machine_replay(machine, begin, files[key], output, kind))
        is_continued = [item for item in replays if item.output.checkpoint is not None]
        if is_continued:
            echo(f"{output}: {counted(len(is_continued), 'machine')} continued from checkpoints", err=True)
        with _workers(jobs, cluster, replays) as workers, progress_line("replaying") as show:
            if workers is not None:
                run_batch(replays, workers, stopped, lambda items: show(_progress(items)))
        for item in replays:
            reports, warnings = counted(item.output.reports, "report"), counted(item.output.warnings, "warning")
            told = f", {warnings}: {item.output.warnings_path}" if item.output.warnings else ""
            unfinished = "" if item.output.is_done else ", not to the end"
            echo(f"{item.key}: {reports}{unfinished}: {item.output.path}{told}", err=True)
        raise_failures(replays)


@contextlib.contextmanager
def _workers(
    jobs: int | None, cluster: "ClusterAccess | None", replays: Sequence[MachineReplay]
) -> Iterator[Workers | None]:
    """Yield what computes; None if nothing is to be computed."""
    left = sum(not item.is_over for item in replays)
    if not left:
        yield None
    elif cluster is not None:
        from otolith.runtime.batch.cluster import cluster_workers

        with cluster_workers(cluster) as remote:
            yield remote
    else:
        from otolith.runtime.batch.local import LocalWorkers

        local = LocalWorkers(min(jobs or len(os.sched_getaffinity(0)), left))
        try:
            yield local
        finally:
            local.close()


def _progress(replays: Sequence[MachineReplay]) -> str:
    done, files = sum(item.is_over for item in replays), sum(len(item.files) for item in replays)
    read, reports = sum(item.read for item in replays), sum(item.output.reports for item in replays)
    return f"{done} of {counted(len(replays), 'machine')}, {read} of {counted(files, 'file')}, {reports} reports"


def _loaded(paths: Sequence[Path]) -> dict[str, LoadedMachine]:
    """Return the machines of files and directories by site and name; raise ConfigurationError if one is wrong."""
    machines = dict[str, LoadedMachine]()
    for path in files_in(paths):
        machine = load_machine(path, with_driver=False)
        machine.try_fmu()
        key = key_of_machine(machine)
        if key in machines:
            raise ConfigurationError(f"{path}: {machines[key].path} is of the same machine, {key}")
        machines[key] = machine
    if not machines:
        raise ConfigurationError(f"{some_names(list(map(str, paths)))}: there is no machine file (*.toml)")
    return machines


def files_of_machines(machines: Sequence[LoadedMachine], data: Sequence[Path]) -> dict[str, list[Path]]:
    """Return the recordings of each machine by its site and name, those of a folder in the order of their names.

    A machine that is alone has all files. Of several, each has the files in a folder of its name, the files that have
    its name before the first point, and its own recordings. Files in a folder that no machine has are logged.

    Raises:
        ConfigurationError: a machine has no file, or a file no machine.
    """
    found: dict[str, list[Path]] = {key_of_machine(machine): [] for machine in machines}
    names, left = _names(machines), list[str]()
    for path in data:
        listed = _listed(path)
        for file in listed:
            owner = next(iter(found)) if len(found) == 1 else _owner(file, path, names)
            if owner is not None:
                found[owner].append(file)
            elif file == path:
                raise ConfigurationError(f"{path}: of which machine it is, its name does not say: {_rule(names)}")
            else:
                left.append(str(file))
    if left:
        log.warning(
            "%s of none of these machines, not replayed: %s: %s",
            counted(len(left), "file"),
            some_names(left),
            _rule(names),
        )
    if lacking := [key for key, files in found.items() if not files]:
        where = some_names(list(map(str, data)))
        raise ConfigurationError(f"{where}: no file of {some_names(lacking)}: {_rule(names)}")
    return found


def _rule(names: dict[str, str]) -> str:
    example = next(iter(names))
    return f"a machine has the files in a folder {example!r}, and those that begin with '{example}.'"


def _names(machines: Sequence[LoadedMachine]) -> dict[str, str]:
    """Return site and name of each machine by both, and by the name if no other one has it."""
    names = [machine.file.machine.name for machine in machines]
    short = {
        name: key_of_machine(machine) for name, machine in zip(names, machines, strict=True) if names.count(name) == 1
    }
    return short | {key: key for key in map(key_of_machine, machines)}


def _listed(path: Path) -> list[Path]:
    """Return the files in a folder and in the folders in it, in the order of their names; or the file itself."""
    if not path.is_dir():
        return [path]
    inside = [item for item in sorted(path.iterdir()) if not item.name.startswith(".")]
    deeper = [file for item in inside if item.is_dir() for file in sorted(item.iterdir()) if file.is_file()]
    files = [item for item in inside if item.is_file()] + [file for file in deeper if not file.name.startswith(".")]
    return [file for file in files if not _is_of_another(file)]


def _is_of_another(file: Path) -> bool:
    """Whether a file has the samples of a recording that is listed as well, or a part of them."""
    return file.parent.name.endswith(FOLDER) or (file.name.endswith(SAMPLES) and viewing_file(file).exists())


def _owner(file: Path, under: Path, names: dict[str, str]) -> str | None:
    """Return the machine of a file that was found ``under`` a folder; None if its name does not say it."""
    if file.parent != under and (owner := names.get(file.parent.name)) is not None:
        return owner
    if (recording := recording_file(viewing_file(file))) is not None and recording.key in names:
        return names[recording.key]
    parts = file.name.split(".")
    return names.get(".".join(parts[:2])) or names.get(parts[0])
