"""A command in the process of its test, and the machine file that it has written."""

import tomllib
from pathlib import Path
from typing import Any

from click.testing import CliRunner, Result

from otolith.cli.main import cli


def otolith(*arguments: object, answers: str = "") -> Result:
    """Run a command with ``answers`` as its standard input; what it raises is raised here."""
    texts = list(map(str, arguments))
    return CliRunner().invoke(cli, texts, input=answers, standalone_mode=False, catch_exceptions=False)


def tables(path: Path) -> dict[str, Any]:
    """The tables of a machine file."""
    return tomllib.loads(path.read_text(encoding="utf-8"))
