"""FMUs that stand for those of other tools: our own export, changed as a test needs it, and machine files of them."""

import re
import shutil
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from tempfile import mkdtemp

from otolith.exchange.exported import exported_twin
from otolith.exchange.fmu import FmuFiles, Stepping, fmu_files
from otolith.exchange.model_description import Version
from otolith.machine import find_twin
from otolith.runtime.fmu_archive import fmu_archive
from otolith.simulation.simulate import substeps_of
from otolith.twin.definition import Definition, Role
from tests.simulation.motors import PERIOD, library_state

DESCRIPTION, MODEL = "modelDescription.xml", "sources/model.h"
Changes = Mapping[str, Callable[[str], str]]  # Of files of an FMU, by their paths


def exported(name: str, version: Version = Version.TWO, changes: Changes | None = None) -> bytes:
    """Return the archive of a twin of the library, with changed texts before its sources are compiled."""
    state = library_state(name)
    parts = fmu_files(exported_twin(state), ("a note",), version, Stepping(PERIOD, substeps_of(state)), name)
    return fmu_archive(changed(parts, changes or {}))


def changed(parts: FmuFiles, changes: Changes) -> FmuFiles:
    """Return the files with changed texts; a change of no text is an error of the test."""
    common = files("otolith.exchange") / "fmi"
    texts, same = dict(parts.texts), parts.same
    for path, change in changes.items():
        name = path.removeprefix("sources/")
        before = (common / name).read_text(encoding="utf-8") if name in same else texts[path]
        same = tuple(other for other in same if other != name)
        texts[path] = change(before)
        assert texts[path] != before
    return replace(parts, texts=texts, same=same)


@cache
def plain(name: str = "dc_motor", version: Version = Version.TWO) -> bytes:
    """Return the archive of a twin of the library as it is exported."""
    return exported(name, version)


def rewritten(path: Path, change: Callable[[str, bytes], bytes | None]) -> Path:
    """Return ``path`` with each member as ``change`` returns it; None leaves it out."""
    source = Path(mkdtemp(dir=path.parent)) / "source.fmu"
    shutil.copy(path, source)
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            if (content := change(name, old.read(name))) is not None:
                new.writestr(name, content)
    return path


def described(path: Path, old: str, new: str) -> Path:
    """Return ``path`` with another text in its description."""

    def change(name: str, content: bytes) -> bytes:
        if name != DESCRIPTION:
            return content
        assert old.encode() in content
        return content.replace(old.encode(), new.encode())

    return rewritten(path, change)


def description_of(path: Path) -> str:
    """Return the description of an FMU."""
    with zipfile.ZipFile(path) as opened:
        return opened.read(DESCRIPTION).decode()


def only_co_simulation(path: Path) -> Path:
    """Return ``path`` without model exchange."""
    (exchange,) = re.findall(r"  <ModelExchange[^>]*/>\n|  <ModelExchange.*?</ModelExchange>\n", description_of(path),
                             re.DOTALL)  # fmt: skip
    return described(path, exchange, "")


def without_derivatives(path: Path) -> Path:
    """Return ``path`` for co-simulation alone, without the list of its derivatives: only steps show them."""
    only_co_simulation(path)
    text = description_of(path)
    lists = r"    <Derivatives>.*?</Derivatives>\n|    <ContinuousStateDerivative [^>]*/>\n"
    changed_text = re.sub(lists, "", text, flags=re.DOTALL)
    assert changed_text != text
    return described(path, text, changed_text)


def with_line(file: Path, old: str, new: str) -> Path:
    """Return a file in which a text was replaced once."""
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    return file


def machine_text(twin: Definition, fmu: str, more: str = "", *, is_native: bool = False) -> str:
    """Return a machine file with the bounds, the noise and the estimated parameters of a twin of the library."""
    shown = {row.name for row in twin.outputs}
    states = {row.name: f"state.{row.name}" for row in twin.states}
    names = {row.name: row.name for row in twin.outputs} | states
    bounds = {row.name: f', bounds = ["{row.low!r} {row.unit}", "{row.high!r} {row.unit}"]' for row in twin.states}
    bounds |= {row.name: f', bounds = ["{row.low!r} {row.unit}", "{row.high!r} {row.unit}"]' for row in twin.inputs}
    names |= {row.name: row.name for row in twin.inputs}
    lines = ["[machine]", 'name = "imported"', "[twin]", f'name = "{twin.name}"' if is_native else f'fmu = "{fmu}"']
    if not is_native:
        lines.append("[twin.variables]")
        hidden = {own: ", measured = false" for own in states if own not in shown}
        lines += [
            f'{own} = {{ variable = "{name}"{bounds.get(own, "")}{hidden.get(own, "")} }}'
            for own, name in names.items()
        ]
    lines.append("[parameters]")
    for row in twin.parameters:
        estimate = str(row.role is Role.ESTIMATED).lower()
        ends = f'low = "{row.low!r} {row.unit}", high = "{row.high!r} {row.unit}"'
        lines.append(f'{row.name} = {{ value = "{row.nominal!r} {row.unit}", estimate = {estimate}, {ends} }}')
    lines += ["[noise]", *(f'{row.name} = "{row.noise!r} {row.unit}"' for row in twin.outputs)]
    return "\n".join([*lines, more, ""])


def write_machine(folder: Path, fmu: bytes, name: str = "dc_motor", more: str = "") -> Path:
    """Write an FMU and a machine file for it into a folder; return the path of the machine file."""
    (folder / "motor.fmu").write_bytes(fmu)
    path = folder / "machine.toml"
    path.write_text(machine_text(find_twin(name), "motor.fmu", more), encoding="utf-8")
    return path
