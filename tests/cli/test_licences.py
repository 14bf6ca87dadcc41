"""``otolith licences``: every package that Otolith needs, with a licence and its text."""

import re
from importlib.metadata import requires

from click.testing import CliRunner

from otolith.cli.main import cli


def listed(*options: str) -> str:
    result = CliRunner().invoke(cli, ["licences", *options], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_every_package_has_a_licence() -> None:
    rows = dict(re.findall(r"^(\S+) \S+ {2,}(.+)$", listed(), re.MULTILINE))
    needed = {re.split(r"[<>=\[; ]", text)[0].lower() for text in requires("otolith") or () if "extra ==" not in text}
    assert needed <= {name.replace("_", "-") for name in rows}
    assert "LGPL" in rows["python-can"] or "Lesser" in rows["python-can"]
    assert not [name for name in needed if "not stated" in rows[name]]


def test_their_texts_are_printed() -> None:
    texts = listed("--texts")
    assert "Copyright (c) 2005-" in texts  # NumPy
    assert "GNU LESSER GENERAL PUBLIC LICENSE" in texts
