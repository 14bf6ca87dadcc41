"""The file of a service: what belongs to the computer, and not to one of the machines on it.

``service.toml`` beside machine files holds for all of them. A table that a machine file has itself stands in place of
that table, for its machine alone. Paths are relative to the file. ``docs/reference/service-file.md`` explains each key.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from pydantic import Field

from otolith.machine_file import EvidenceTable, HistoryTable, MachineFile, RecordingTable, ZenohTable
from otolith.outlet_tables import OutletsTable
from otolith_drivers.config_files import StrictModel, expect, parse, read, validate

SERVICE_FILE = "service.toml"


class ServiceTable(StrictModel):
    """The processes of a service."""

    workers: Annotated[int | None, Field(ge=1, le=1024)] = None
    """Those that compute for several machines, at most; by default one for each processor."""


class ServiceFile(StrictModel):
    """The whole file."""

    service: ServiceTable = ServiceTable()
    zenoh: ZenohTable = ZenohTable()
    recording: RecordingTable = RecordingTable()
    history: HistoryTable = HistoryTable()
    evidence: EvidenceTable = EvidenceTable()
    outlets: OutletsTable = OutletsTable()


TABLES = tuple(name for name in ServiceFile.model_fields if name in MachineFile.model_fields)
"""Those that a machine file may have as well."""


def service_file_in(folder: Path) -> ServiceFile | None:
    """Return the file of the service for the machine files in ``folder``; None if there is none.

    Raises:
        ConfigurationError: something in it is wrong; one line per fault.
    """
    path = folder / SERVICE_FILE
    if not os.path.lexists(path):  # a link to a disk that is not there must not be taken for no file
        return None
    source = read(path)
    data = parse(source)
    expect(source, data, "service")
    return validate(data, ServiceFile, source)


def with_service_file(file: MachineFile, path: Path) -> tuple[MachineFile, tuple[str, ...]]:
    """Return the machine file at ``path`` with the tables of the service that it lacks, and their names.

    Raises:
        ConfigurationError: something in the file of the service is wrong; one line per fault.
    """
    service = service_file_in(path.parent)
    if service is None:
        return file, ()
    names = tuple(name for name in TABLES if name not in file.model_fields_set)
    return file.model_copy(update={name: getattr(service, name) for name in names}), names


def workers_of(folders: Sequence[Path]) -> int | None:
    """Return the most ``workers`` that the files of the service in ``folders`` state; None if none does.

    Raises:
        ConfigurationError: something in one of them is wrong; one line per fault.
    """
    files = [service_file_in(folder) for folder in folders]
    return max((file.service.workers for file in files if file and file.service.workers), default=None)
