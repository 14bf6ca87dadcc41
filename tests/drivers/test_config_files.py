"""TOML files as closed models: each fault names file, line, key and remedy."""

from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BeforeValidator, Field

from otolith_drivers.config_files import SourceFile, StrictModel, parse, read, validate
from otolith_drivers.errors import ConfigurationError, nearest
from tests.messages import assert_refuses, assert_says


class Inner(StrictModel):
    speed: float = 1.0
    torque: float = 0.0


class Push(StrictModel):
    kind: Literal["push"]
    force: float = 0.0


class Turn(StrictModel):
    kind: Literal["turn"]
    torque: float = 0.0


class Outer(StrictModel):
    name: str
    inner: Inner = Inner()
    entries: tuple[Inner, ...] = ()
    quantity: float | str = 0.0
    choice: Literal[0, 1] | None = None
    switch: bool = True
    either: int | bool | None = None
    folder: Path | None = None
    moves: tuple[Annotated[Push | Turn, Field(discriminator="kind")], ...] = ()
    named: dict[str, Annotated[Inner, BeforeValidator(lambda value: value)]] | None = None


def load(path: Path) -> Outer:
    file = read(path)
    return validate(parse(file), Outer, file)


FAULTS = [
    ("name = 'x'\n\n[inner]\nsped = 2.0\n", "4: inner.sped: unknown key 'sped': did you mean 'speed'?"),
    ("nam = 'x'\n", "1: nam: unknown key 'nam': did you mean 'name'?"),
    ("name = 'x'\n[[entries]]\nspeed = 1.0\n[[entries]]\nspeed = 'fast'\n", "5: entries[1].speed: 'fast': the value"),
    ("name = 'x'\n[named.a]\ntorqe = 1.0\n", "3: named.a.torqe: unknown key 'torqe': did you mean 'torque'?"),
    ("name = 'x'\ninner = { speed = inf }\n", "2: inner.speed: inf: the value should be a finite number"),
    ("name = 'x'\ninner = { speed = true }\n", "2: inner.speed: true is a boolean: write a number"),
    ("name = 'x'\nchoice = true\n", "2: choice: true is a boolean: write a number"),
    ("name = 'x'\nswitch = 0\n", "2: switch: 0 is a number: write true or false"),
    ('name = "\\u0000"\n', "1: name: the text has the control character U+0000"),
    ("name = 'x'\nfolder = 1\n", "2: folder: 1: must be a text, in quotes"),
    ("name = 'x'\nquantity = [1]\n", "2: quantity: [1]: the value should be a valid number"),
    (f"name = 'x'\nquantity = {[1] * 999}\n", "1,...: the value should be a valid number"),
    ("name = 'x'\nname = 'y'\n", "not valid TOML: "),
    (
        "name = 'x'\n[[moves]]\nkind = 'push'\ntorque = 1.0\n",
        "4: moves[0].torque: unknown key 'torque': known: force, kind",
    ),
    ("[inner]\nspeed = 1.0\n", ": name: missing: this key must be set"),
]


@pytest.mark.parametrize(("text", "sentence"), FAULTS)
def test_fault_names_file_line_key_and_remedy(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "file.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load(path)
    assert str(caught.value).startswith(str(path))
    assert sentence in str(caught.value)


@pytest.mark.parametrize(
    ("text", "faults"),
    [
        ("nam = 'x'\n[inner]\nsped = 1\n", 3),  # the misspelt name is also a missing one
        ("name = 'x'\nquantity = { low = 1 }\n", 1),  # neither a number nor a text
    ],
)
def test_each_fault_is_a_line(tmp_path: Path, text: str, faults: int) -> None:
    path = tmp_path / "file.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load(path)
    assert len(str(caught.value).splitlines()) == faults


def test_a_byte_order_mark_is_no_fault(tmp_path: Path) -> None:
    """Editors of Windows write one in front of UTF-8."""
    path = tmp_path / "file.toml"
    path.write_bytes(b"\xef\xbb\xbfname = 'x'\r\n")
    load(path)


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a" * (2 << 20)])
def test_binary_or_huge_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=str(path)):
        load(path)


def test_missing_file_or_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        load(tmp_path / "none.toml")
    with pytest.raises(ConfigurationError, match="directory"):
        load(tmp_path)


@given(st.text(max_size=300))
def test_any_text_is_parsed_or_refused(text: str) -> None:
    file = SourceFile(Path("any.toml"), text)
    try:
        validate(parse(file), Outer, file)
    except ConfigurationError as error:
        assert_refuses(error, "any.toml")


@pytest.mark.parametrize(
    ("word", "hint"),
    [("cna", "did you mean 'can'?"), ("CAN", "did you mean 'can'?"), ("xyz", "known: can, modbus")],
)
def test_nearest_name_ignores_case(word: str, hint: str) -> None:
    assert nearest(word, ["modbus", "can"]) == hint


@pytest.mark.parametrize(
    ("word", "names", "near"),
    [
        ("120", [str(number) for number in range(400)], {"118", "119", "120", "121", "122"}),
        ("Umdrehungen", [f"Kanal{number:03}" for number in range(400)] + ["Drehzahl"], {"Drehzahl"}),
    ],
)
def test_of_many_names_the_nearest_few_are_shown(word: str, names: list[str], near: set[str]) -> None:
    hint = nearest(word, [name for name in names if name != word])
    assert_says(hint, *near - {word})
    assert sum(name in hint for name in names if len(name) > 2) <= 6
