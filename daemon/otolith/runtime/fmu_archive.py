"""An FMU as one archive: generated and common sources, and the binary that the C compiler of this computer makes."""

import io
import platform
import shutil
import subprocess
import tempfile
import zipfile
from importlib.resources import files
from pathlib import Path

from otolith.exchange.fmu import FmuFiles
from otolith.exchange.model_description import Version
from otolith_drivers.errors import ConfigurationError

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-shared", "-fPIC", "-fvisibility=hidden", "-Wl,--build-id=none")
TIMEOUT = 120.0  # s of the compiler; docs/reference/thresholds-runtime.md has its origin
DATE = (1980, 1, 1, 0, 0, 0)  # of all files: the same twin is the same archive, byte for byte


def fmu_archive(parts: FmuFiles) -> bytes:
    """Return the archive.

    Raises:
        ConfigurationError: there is no C compiler, or it cannot compile the sources.
    """
    common = files("otolith.exchange") / "fmi"
    contents = {name: text.encode() for name, text in parts.texts.items()}
    contents |= {f"sources/{name}": (common / name).read_bytes() for name in parts.same}
    sources = {Path(name).name: text for name, text in contents.items() if name.startswith("sources/")}
    binary = f"binaries/{_platform(parts.version)}/{parts.identifier}.so"
    contents[binary] = _compiled(sources, parts.version.source)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            entry = zipfile.ZipInfo(name, DATE)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o100644 << 16
            archive.writestr(entry, content)
    return target.getvalue()


def _platform(version: Version) -> str:
    """Return what the standard calls this computer."""
    machine = platform.machine()
    return "linux64" if version is Version.TWO and machine == "x86_64" else f"{machine}-linux"


def _compiled(sources: dict[str, bytes], main: str) -> bytes:
    """Return the shared library of the source ``main``; raises as :func:`fmu_archive`."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        remedy = "install one, like gcc and libc6-dev of Debian"
        raise ConfigurationError(f"an FMU needs a C compiler, and neither cc nor gcc is on the PATH: {remedy}")
    with tempfile.TemporaryDirectory(prefix="otolith-fmu-") as name:
        folder = Path(name)
        for file, content in sources.items():
            (folder / file).write_bytes(content)
        command = [compiler, *FLAGS, main, "-o", "model.so", "-lm"]
        try:
            done = subprocess.run(  # noqa: S603 - the command is ours
                command, cwd=folder, capture_output=True, timeout=TIMEOUT, check=False
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise ConfigurationError(f"{compiler} failed: {error}: see whether it compiles other sources") from error
        if done.returncode:
            lines = done.stderr.decode(errors="replace").splitlines()
            reason = next((line for line in lines if "error" in line), lines[0] if lines else "it says nothing")
            raise ConfigurationError(f"{compiler} failed: {reason}: are the headers of C there (libc6-dev)?")
        return (folder / "model.so").read_bytes()
