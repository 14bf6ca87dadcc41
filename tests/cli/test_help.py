"""Help of every command: at most 80 columns, with an example; docs/reference/commands.md has every option."""

import codecs
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from otolith.__main__ import written_plainly
from otolith.cli.main import cli

REFERENCE = Path(__file__).parents[2] / "docs" / "reference" / "commands.md"
WIDTH = 80  # columns of a terminal


def command_paths(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    if isinstance(command, click.Group):
        for name, child in command.commands.items():
            yield from command_paths(child, (*path, name))


def command_at(path: tuple[str, ...]) -> click.Command:
    command: click.Command = cli
    for name in path:
        assert isinstance(command, click.Group)
        command = command.commands[name]
    return command


PATHS = list(command_paths(cli))


@pytest.mark.parametrize("path", PATHS, ids=" ".join)
def test_help_fits_80_columns_and_has_an_example(path: tuple[str, ...]) -> None:
    text = CliRunner().invoke(cli, [*path, "--help"], env={"COLUMNS": "200"}).output
    assert max(map(len, text.splitlines())) <= WIDTH
    assert re.search(rf"(Examples?|Start here):\n\s+{' '.join(('otolith', *path))}\b", text)


def test_a_list_of_commands_cuts_no_sentence() -> None:
    groups = [path for path in PATHS if isinstance(command_at(path), click.Group)]
    texts = [CliRunner().invoke(cli, [*path, "--help"], env={"COLUMNS": str(WIDTH)}).output for path in groups]
    assert not [line for text in texts for line in text.splitlines()[1:] if line.endswith("...")]


@pytest.mark.parametrize("path", PATHS, ids=" ".join)
def test_the_reference_has_every_command_and_option(path: tuple[str, ...]) -> None:
    text = REFERENCE.read_text(encoding="utf-8")
    command = command_at(path)
    if not isinstance(command, click.Group):
        section = text.partition(f"## `{' '.join(('otolith', *path))}")[2].partition("\n## ")[0]
        assert section
        options = [option for option in command.params if isinstance(option, click.Option)]
        assert {name for option in options for name in option.opts} <= set(re.findall(r"`(-{1,2}[\w-]+)", section))


def test_the_reference_has_every_exit_code() -> None:
    assert set(re.findall(r"^\| (\d+)", REFERENCE.read_text(encoding="utf-8"), re.MULTILINE)) == {
        "0",
        "1",
        "2",
        "78",
        "130",
    }


def test_a_full_disk_gives_one_line_with_place_and_remedy() -> None:
    command = [sys.executable, "-m", "otolith", "--help"]
    with Path("/dev/full").open("w") as full:
        result = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert result.returncode == 2
    (line,) = result.stderr.splitlines()
    assert "standard output: No space left on device: free space on its disk" in line


@pytest.mark.parametrize("arguments", [["--help"], ["twin", "show", "dc_motor"]])
def test_a_reader_that_closes_the_output_is_no_error(arguments: list[str]) -> None:
    """Click writes the help, rich the tables."""
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as closed:
        command = [sys.executable, "-m", "otolith", *arguments]
        result = subprocess.run(command, stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")


def test_the_page_of_a_twin_calls_a_parameter_known_or_estimated() -> None:
    """As the messages of ``otolith check`` do, and the documentation of a twin."""
    page = CliRunner().invoke(cli, ["twin", "show", "dc_motor"]).output
    assert re.search(r"R_a .* estimated ", page)
    assert re.search(r"K_e .* known ", page)
    assert "instrumented" not in page


def test_a_terminal_without_greek_letters_gets_question_marks() -> None:
    command = [sys.executable, "-m", "otolith", "twin", "show", "dc_motor"]
    latin = {**os.environ, "PYTHONIOENCODING": "latin-1"}
    result = subprocess.run(command, env=latin, capture_output=True, encoding="latin-1", check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert "K?" in result.stdout


def test_a_terminal_without_a_symbol_gets_its_plain_form() -> None:
    codecs.register_error("otolith", written_plainly)
    shown = "R_a 5.98 Ω ± 0.01, 2e-3 N·m·s/rad, 4 m/s², 60 °C, sin(1·θ), ▁▄█, 中"
    plain = "R_a 5.98 ohm +- 0.01, 2e-3 N*m*s/rad, 4 m/s^2, 60 degC, sin(1*angle), _.^, ?"
    assert shown.encode("ascii", "otolith").decode() == plain
    assert "5.98 ohm ± 0.01, 2e-3 N·m·s/rad, 4 m/s²" in shown.encode("latin-1", "otolith").decode("latin-1")
