"""The files of an FMU that are written for one twin; those of ``fmi/`` are the same in each."""

import hashlib
import re
import uuid
from collections.abc import Sequence
from dataclasses import dataclass

from otolith import __version__
from otolith.exchange.c_model import model_header
from otolith.exchange.exported import ExportedTwin
from otolith.exchange.fmi_variables import FmuVariables
from otolith.exchange.model_description import Description, Version

MAX_IDENTIFIER = 60  # characters of the name of the binary: file systems take 255
SHARED = "both_versions.h", "instance.h"
SAME_FILES = {
    Version.TWO: ("fmi2.c", *SHARED, "fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    Version.THREE: ("fmi3.c", *SHARED, "fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}
"""Sources that are the same in each FMU of a version. The headers are those of the FMI standard, with its licence."""


@dataclass(frozen=True, slots=True)
class Stepping:
    """How the kernel integrates."""

    period: float  # Between two samples, s
    substeps: int  # Of the integrator in it


@dataclass(frozen=True, slots=True)
class FmuFiles:
    """What an FMU has, but for the binary."""

    version: Version
    identifier: str  # Name of the binary
    texts: dict[str, str]  # By their paths in the FMU
    same: tuple[str, ...]  # Names of files of fmi/, which belong to ``sources``


def fmu_files(twin: ExportedTwin, notes: Sequence[str], version: Version, kernel: Stepping, machine: str) -> FmuFiles:
    """Return the files for a ``machine``; ``notes`` say of which machine and of which time it is, a line each.

    In co-simulation the integrator has the steps of the ``kernel``.
    """
    variables, longest_step = FmuVariables.of(twin), kernel.period / kernel.substeps
    noted = [*notes, f"Source of the equations: {twin.source}"]
    blank = model_header(variables, "", longest_step, noted)
    token = f"{{{uuid.UUID(hashlib.sha256(f'{version}{blank}'.encode()).hexdigest()[:32])}}}"
    identifier = f"otolith_{re.sub(r'[^A-Za-z0-9_]', '_', machine)}"[:MAX_IDENTIFIER]
    description = Description(
        title=f"{twin.title}, as Otolith has adapted it",
        notes=tuple(noted),
        identifier=identifier,
        token=token,
        tool=f"Otolith {__version__}",
        period=kernel.period,
        longest_step=longest_step,
        variables=variables,
    )
    texts = {
        "modelDescription.xml": description.model(version),
        "sources/model.h": model_header(variables, token, longest_step, noted),
    }
    if version is Version.THREE:
        texts["sources/buildDescription.xml"] = description.build()
    return FmuFiles(version, identifier, texts, SAME_FILES[version])
