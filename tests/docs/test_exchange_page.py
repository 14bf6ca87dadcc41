"""The commands of docs/exchange.md do what the page says, and what it shows is what they write."""

import re
import shlex
import subprocess
import zipfile
from pathlib import Path

import click
import pytest

from otolith.machine import find_twin
from tests.cli.commands import otolith
from tests.simulation.recorded_motor import save_learned, write_files

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "exchange.md").read_text(encoding="utf-8")


def shown(language: str, begin: str = "") -> list[str]:
    """The lines of the one block of the page that begins so, without the blank ones."""
    (block,) = re.findall(rf"^```{language}\n({re.escape(begin)}.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    return [line for line in block.splitlines() if line.strip()]


def test_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_learned(write_files(tmp_path))
    monkeypatch.chdir(tmp_path)
    commands = re.findall(r"^    otolith (twin export .*)$", PAGE, re.MULTILINE)
    assert len(commands) == 4
    for command in commands:
        assert otolith(*shlex.split(command)).exit_code == 0
    assert set(shown("modelica")) <= set(Path("motor.mo").read_text(encoding="utf-8").splitlines())
    for name, version in (("motor.fmu", "2"), ("motor-3.fmu", "3")):
        with zipfile.ZipFile(name) as archive:
            archive.extractall(tmp_path / version)
        assert set(shown("c")) <= set(Path(version, "sources", "model.h").read_text(encoding="utf-8").splitlines())
    (command,) = shown("sh")
    assert subprocess.run(shlex.split(command), cwd=tmp_path / "2", check=False).returncode == 0
    assert (tmp_path / "2" / "motor.so").stat().st_size > 0


def test_the_twin_of_the_page_is_that_of_the_library() -> None:
    library = ROOT / "daemon" / "otolith" / "twin" / "library" / f"{find_twin('dc_motor').name}.toml"
    assert set(shown("toml", "[states]")) <= set(library.read_text(encoding="utf-8").splitlines())


def test_one_form_is_named(tmp_path: Path) -> None:
    machine = write_files(tmp_path)
    for options in ([], ["--python", "--fmu", tmp_path / "a.fmu"], ["--fmu", tmp_path / "a.fmu", "--output", "b"]):
        with pytest.raises(click.UsageError, match="--fmu"):
            otolith("twin", "export", machine, *options)
