"""Lines of a TOML file: the grammar by which names, values and remarks enter them."""

import re
from typing import Any

from otolith_drivers.outside_text import CONTROL, SURROGATE, visible

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
SHOWN = 400  # characters of a comment; engineering choice, three times the longest one of 'otolith probe'


def toml_key(name: str) -> str:
    """Return ``name`` as a key, quoted where it must be."""
    return name if BARE_KEY.fullmatch(name) else _text(name)


def toml_value(value: Any) -> str:
    """Return a text, number, list or table as a value in one line; another object as its text."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{toml_key(key)} = {toml_value(item)}' for key, item in value.items())} }}"
    return _text(str(value))


def toml_comment(text: str) -> str:
    """Return ``text`` as one comment, shortened."""
    return f"# {visible(text, SHOWN)}"


def _text(text: str) -> str:
    whole = SURROGATE.sub("\ufffd", text).replace("\\", "\\\\").replace('"', '\\"')  # no TOML file has half a character
    return '"' + CONTROL.sub(lambda found: f"\\U{ord(found[0]):08x}", whole) + '"'
