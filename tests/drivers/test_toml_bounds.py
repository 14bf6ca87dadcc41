"""Bounds of configuration files: control characters, depth and length, in every kind of file, at little cost."""

import time
import unicodedata
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith_drivers.config_files import MAX_FAULTS, SourceFile, StrictModel, parse, validate
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import CONTROL, visible
from otolith_drivers.toml_bounds import MAX_DEPTH, MAX_KEY, MAX_TEXT
from tests.hostile import hostile_text

SECONDS = 5.0  # of processor time; the inputs took 60 s and more, and take some 0.1 s
FILE = Path("machine.toml")


def as_toml(text: str) -> str:
    return '"' + "".join(f"\\U{ord(character):08x}" for character in text) + '"'


def fault_of(text: str) -> str:
    with pytest.raises(ConfigurationError) as caught:
        parse(SourceFile(FILE, text))
    return str(caught.value)


def test_controls_are_those_of_unicode() -> None:
    bidirectional = {*map(chr, range(0x202A, 0x202F)), *map(chr, range(0x2066, 0x206A)), "\u200e", "\u200f", "\u061c"}
    ends_of_lines = {character for code in range(0x110000) if len((character := chr(code)).join("ab").splitlines()) > 1}
    assert all(CONTROL.match(character) for character in bidirectional | ends_of_lines)
    assert all(CONTROL.match(chr(code)) for code in range(0x300) if unicodedata.category(chr(code)) == "Cc")
    assert not CONTROL.search("Größe Ωµ·²°θ±− 電動機 مضخة мотор \u00a0\u202f")


@given(st.text(st.characters(exclude_categories=()), max_size=60))
def test_visible_text_is_one_line_without_controls(text: str) -> None:
    assert not CONTROL.search(visible(text))
    visible(text).encode()
    assert CONTROL.search(text) or visible(text) == text


@given(hostile_text)
@settings(max_examples=200, deadline=None)
def test_a_text_or_key_with_a_control_is_refused_wherever_it_is(text: str) -> None:
    if any("\ud800" <= character <= "\udfff" for character in text):
        return  # no TOML file has them
    text = text[: MAX_TEXT + 1]
    for written in (f"a = {as_toml(text)}", f"a.b = [1, {{ c = {as_toml(text)} }}]", f"[a]\n{as_toml(text)} = 1"):
        if CONTROL.search(text) or len(text) > MAX_TEXT or (written.endswith("= 1") and len(text) > MAX_KEY):
            for line in fault_of(written).splitlines():
                assert line.startswith("machine.toml:")
                assert not CONTROL.search(line)
                assert len(line) < 500
        else:
            parse(SourceFile(FILE, written))


def test_the_error_has_line_key_and_character() -> None:
    message = fault_of('[machine]\nname = "press"\n[driver]\nhost = "a\\u0085b"\n')
    assert all(needle in message for needle in ("machine.toml:4:", "driver.host", "U+0085", "character 2"))


HEAVY = {
    "dotted keys": "\n".join(f"{'a.' * 500}b{number} = 1" for number in range(60)),
    "one dotted key": ".".join("a" * 35_000) + " = 1",
    "quoted parts": '"a" . ' * 12_000 + "b = 1",
    "headers": "\n".join(f"[{'a.' * 400}b{number}]" for number in range(80)),
    "lists": "a = " + "[" * 100_000 + "]" * 100_000,
    "tables": "a = " + "{ a = " * 50_000,
    "tables in lists": "a = " + "[ { a = " * 30 + "1" + " } ]" * 30,
    "spaces before nothing": "[" + " " * 500_000 + "\n" + " " * 500_000 + "x",
    "quotes": "a = " + '"\\' * 200_000,
    "open strings": '"""' + "a.b." * 200_000,
}
"""Some kilobytes each, which cost the parser minutes or gigabytes, or the search for a line does."""


@pytest.mark.parametrize("kind", HEAVY)
def test_a_small_file_is_little_work(kind: str) -> None:
    begin = time.process_time()
    assert fault_of(HEAVY[kind]).startswith("machine.toml:")
    assert time.process_time() - begin < SECONDS


def test_a_dotted_text_is_not_a_deep_key() -> None:
    name = ".".join("a" * 100)
    data = parse(SourceFile(FILE, f'a = \'ns=2;s={name}\' # {name}\nb = "{name}"\nc = """{name}"""'))
    assert data == {"a": f"ns=2;s={name}", "b": name, "c": name}
    parts = ".".join("a" * MAX_DEPTH)
    assert parse(SourceFile(FILE, f"{parts} = 1"))
    assert str(MAX_DEPTH) in fault_of(f"\n\n{parts}.a = 1")
    assert "machine.toml:3:" in fault_of(f"\n\n{parts}.a = 1")


class _Empty(StrictModel):
    pass


def test_many_faults_are_counted_not_listed() -> None:
    file = SourceFile(FILE, "".join(f"key{number} = 1\n" for number in range(20_000)))
    begin = time.process_time()
    with pytest.raises(ConfigurationError) as caught:
        validate(parse(file), _Empty, file)
    lines = str(caught.value).splitlines()
    assert time.process_time() - begin < SECONDS
    assert len(lines) == MAX_FAULTS + 1
    assert str(20_000 - MAX_FAULTS) in lines[-1]
