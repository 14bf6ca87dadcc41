r"""JSON in one line: the grammar by which text enters JSON Lines, messages and the input of a command.

JSON allows C1 controls, DEL, separators of lines and marks of direction in a string as they are; a terminal, or a
reader of lines, does not. They are written like ``\u2028``. A number that is not finite, which JSON lacks, is null.
"""

import json
import math
import re
from collections.abc import Mapping
from typing import Any, NoReturn

from otolith_drivers.outside_text import CONTROL, SURROGATE

WHITESPACE = str.maketrans("\n\r\t", "   ")


def json_text(document: Any, indent: int | None = None) -> str:
    """Return a document as JSON, in one line unless there is an ``indent``."""
    text = json.dumps(_finite(document), ensure_ascii=False, indent=indent)
    return "\n".join(escaped(line) for line in text.split("\n"))  # within strings it has no line break


def escaped(text: str) -> str:
    """Return a line of JSON with the controls in its strings escaped, and without halves of characters."""
    return CONTROL.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    units = found[0].encode("utf-16-be", "replace" if SURROGATE.match(found[0]) else "strict").hex()
    return "".join(f"\\u{units[at : at + 4]}" for at in range(0, len(units), 4))


def checked_line(text: str) -> str:
    """Return the JSON object ``text``, which anybody may have written, as one line.

    Raises:
        ValueError: it is no JSON object, is nested too deeply, or has a number that is not finite or is too long.
    """
    try:
        document = json.loads(text, parse_constant=_refuse)
    except RecursionError as error:
        raise ValueError("its objects and lists are nested too deeply") from error
    if not isinstance(document, dict):
        raise ValueError(f"no object but a {type(document).__name__}")  # noqa: TRY004 - a fault of the text
    return escaped(text.translate(WHITESPACE))  # JSON has these in its strings only as escapes


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is no number of JSON")


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return value
