"""Files as closed models: a fault names file, line and key, and the nearest key that exists."""

from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BeforeValidator

from otolith_drivers.config_files import SourceFile, StrictModel, load, parse, validate
from otolith_drivers.errors import ConfigurationError, nearest


class Inner(StrictModel):
    speed: float = 1.0
    torque: float = 0.0


class Outer(StrictModel):
    name: str
    inner: Inner = Inner()
    entries: tuple[Inner, ...] = ()
    named: dict[str, Annotated[Inner, BeforeValidator(lambda value: value)]] | None = None


FAULTS = [
    ("name = 'x'\n\n[inner]\nsped = 2.0\n", "4: inner.sped: unknown key 'sped': did you mean 'speed'?"),
    ("nam = 'x'\n", "1: nam: unknown key 'nam': did you mean 'name'?"),
    ("name = 'x'\n[[entries]]\nspeed = 1.0\n[[entries]]\nspeed = 'fast'\n", "5: entries[1].speed: 'fast': the value"),
    ("name = 'x'\n[named.a]\ntorqe = 1.0\n", "3: named.a.torqe: unknown key 'torqe': did you mean 'torque'?"),
    ("name = 'x'\ninner = { speed = inf }\n", "2: inner.speed: inf: the value should be a finite number"),
    ("name = 'x'\nname = 'y'\n", "not valid TOML: "),
    ("[inner]\nspeed = 1.0\n", ": name: missing: this key must be set"),
]


@pytest.mark.parametrize(("text", "sentence"), FAULTS)
def test_a_fault_says_where_and_what(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "file.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load(path, Outer)
    assert str(caught.value).startswith(str(path))
    assert sentence in str(caught.value)


def test_two_faults_are_two_lines(tmp_path: Path) -> None:
    path = tmp_path / "file.toml"
    path.write_text("nam = 'x'\n[inner]\nsped = 1\n", encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load(path, Outer)
    assert len(str(caught.value).splitlines()) == 3  # the misspelt name is also a missing one


@pytest.mark.parametrize("content", [b"\xff\xfe", b"a" * (2 << 20)])
def test_what_is_no_text_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=str(path)):
        load(path, Outer)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="No such file"):
        load(tmp_path / "none.toml", Outer)
    with pytest.raises(ConfigurationError, match="directory"):
        load(tmp_path, Outer)


@given(st.text(max_size=300))
def test_any_text_is_read_or_refused(text: str) -> None:
    page = SourceFile(Path("any.toml"), text)
    try:
        validate(parse(page), Outer, page)
    except ConfigurationError as error:
        assert str(error).startswith("any.toml")  # noqa: PT017 - either outcome is right, another error is not


@pytest.mark.parametrize(
    ("word", "hint"),
    [("cna", "did you mean 'can'?"), ("CAN", "did you mean 'can'?"), ("xyz", "known: can, modbus")],
)
def test_the_nearest_name_is_found_whatever_its_case(word: str, hint: str) -> None:
    assert nearest(word, ["modbus", "can"]) == hint
