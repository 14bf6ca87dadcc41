"""Bounds of a TOML file before and after it is parsed: depth of its keys, length and characters of its texts.

The parser of the standard library takes time and memory by the square of the depth of a dotted key, so that few bytes
are much work; see the test for figures. No text of a configuration needs a control character, and one that has them
could become several lines of a file that is made from it: a unit of systemd, a journal, a table.
"""

import re
from collections.abc import Iterator
from typing import Any

from otolith_drivers.outside_text import CONTROL, code_of

MAX_DEPTH = 16  # parts of a key, and tables in each other; engineering choice, 3 times the deepest machine file
MAX_TEXT = 4096  # characters of a text: the longest path of Linux; the longest equation of the library has 300
MAX_KEY = 255  # characters of a key: the longest file name of Linux
STRING = re.compile(
    r'"""(?:[^\\]|\\.)*?(?:"""|\\?\Z)|\'\'\'.*?(?:\'\'\'|\Z)|#[^\n]*+'
    r'|"(?:[^"\\\n]|\\[^\n])*+(?:"|\\?$)|\'[^\'\n]*+(?:\'|$)',
    re.DOTALL | re.MULTILINE,
)
"""A text or a comment; also one that does not end, so that no second search begins within it."""
KEY = re.compile(r"[\w\-. \t]*+")

Path = tuple[int | str, ...]  # Keys and list indices that lead to a value


def depth_fault(text: str) -> str | None:
    """Return what is wrong with the depth of the keys in the text of a TOML file, None if nothing is."""
    for number, line in enumerate(STRING.sub(_bare, text).split("\n"), start=1):
        if line.count(".") >= MAX_DEPTH and any(run.count(".") >= MAX_DEPTH for run in KEY.findall(line)):
            return f"{number}: a key of more than {MAX_DEPTH} parts: write at most {MAX_DEPTH}"
    return None


def _bare(found: re.Match[str]) -> str:
    """Return what stands for a string or a comment: a name with the line breaks that it spans."""
    return "_" + "\n" * found[0].count("\n")


def text_faults(data: Any, at: Path = ()) -> Iterator[tuple[Path, str]]:
    """Yield location and message of each key and text that is too deep, too long, or has a control character."""
    if len(at) > 2 * MAX_DEPTH:  # a list of tables has two parts, its key and its index
        yield at, f"tables and lists in each other: write at most {2 * MAX_DEPTH}"
    elif isinstance(data, str):
        yield from ((at, message) for message in _faults("the text", data, MAX_TEXT))
    elif isinstance(data, dict):
        for key, value in data.items():
            yield from (((*at, key), message) for message in _faults("the key", key, MAX_KEY))
            yield from text_faults(value, (*at, key))
    elif isinstance(data, list):
        for index, item in enumerate(data):
            yield from text_faults(item, (*at, index))


def _faults(what: str, text: str, limit: int) -> Iterator[str]:
    if len(text) > limit:
        yield f"{what} has {len(text)} characters: write at most {limit}"
    if control := CONTROL.search(text):
        place = f"the control character {code_of(control[0])} at character {control.start() + 1}"
        yield f"{what} has {place}: write it without, in one line of visible characters"
