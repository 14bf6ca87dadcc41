"""Any text of a file, a device, a server, a message or a certificate leaves a writer only escaped, or is refused.

Each writer has a row: what writes a text, and what must hold of what it wrote.
"""

import tomllib
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings

from otolith.cli.commissioning.probe import _opcua_line
from otolith.storage.evidence import public_text
from otolith_drivers.opcua.connection import Variable
from otolith_drivers.outside_text import CONTROL
from otolith_drivers.toml_lines import toml_comment, toml_key, toml_value
from tests.hostile import HOSTILE, hostile_text


class Writer(NamedTuple):
    """A place where text leaves the program."""

    write: Callable[[str], str]
    check: Callable[[str, str], object]  # of the text and of what was written of it


def whole(text: str) -> str:
    """What is left of a text in a file in UTF-8, which has no halves of a pair."""
    return "".join("\ufffd" if "\ud800" <= character <= "\udfff" else character for character in text)


def is_one_line(written: str) -> bool:
    written.encode()
    return not CONTROL.search(written)


def is_toml_of(expected: Any) -> Callable[[str, str], None]:
    def check(text: str, written: str) -> None:
        assert all(is_one_line(line) for line in written.split("\n"))
        assert tomllib.loads(written) == expected(whole(text))

    return check


def opcua_line(text: str) -> str:
    variable = Variable(node=f"ns=2;s={text}", path=f"Motor/{text}", value=text, type=text, unit=text, status=text)
    return "[signals]\n" + _opcua_line(variable)


def only_the_node(text: str, written: str) -> None:
    assert all(is_one_line(line) for line in written.split("\n"))
    (signal,) = tomllib.loads(written)["signals"].values()
    assert signal == {"node": f"ns=2;s={whole(text)}"} | ({} if text else {"unit": "?"})
    assert len(written.split("\n")) == 2


TOML = {
    "key": Writer(lambda text: f"{toml_key(text)} = 1", is_toml_of(lambda text: {text: 1})),
    "value": Writer(
        lambda text: f"a = {toml_value([text, {text: text}, True, 1.5])}",
        is_toml_of(lambda text: {"a": [text, {text: text}, True, 1.5]}),
    ),
    "comment": Writer(lambda text: f"a = 1  {toml_comment(text)}", is_toml_of(lambda _: {"a": 1})),
    "line of a variable": Writer(opcua_line, only_the_node),
    "machine file of a bundle": Writer(
        lambda text: public_text({"limits": {text: text}, "rule": [{"a": text}]}),
        is_toml_of(lambda text: {"limits": {text: text}, "rule": [{"a": text}]}),
    ),
}
WRITERS = {f"TOML: {name}": writer for name, writer in TOML.items()}


@pytest.mark.parametrize("name", WRITERS)
@given(text=hostile_text)
@settings(max_examples=60, deadline=None)
def test_any_text_is_escaped(name: str, text: str) -> None:
    WRITERS[name].check(text, WRITERS[name].write(text))


@pytest.mark.parametrize("name", WRITERS)
def test_each_attack_is_escaped(name: str) -> None:
    for text in HOSTILE:
        WRITERS[name].check(text, WRITERS[name].write(text))
