r"""Text from outside: which characters control a line, a terminal or the direction of writing, and how they are shown.

Text of files, devices, servers, messages and certificates may hold anything. A line break in it becomes a line of the
file that it is written to; an escape sequence becomes a command to the terminal that shows it; a mark of the direction
of writing shows other letters than those that are there. Each writer escapes text by its own grammar; ``visible`` is
that of lines for people, which write a control as ``\n``, ``\x1b`` or ``\u202e``.
"""

import re

CONTROL = re.compile(
    "[\x00-\x1f\x7f-\x9f"  # C0, DEL and C1: line breaks, tabs, escape sequences
    "\u2028\u2029"  # separators of lines and paragraphs
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # direction of writing
    "\u00ad\u180e\u200b-\u200d\u2060-\u2065\u206a-\u206f\ufeff\ufff9-\ufffb\U000e0000-\U000e007f"  # without a width
    "\ud800-\udfff]"  # halves of a pair, which no encoding of a file has
)
"""A character that is not shown as itself. Source: the categories Cc, Cf, Cs, Zl and Zp of Unicode."""

SURROGATE = re.compile("[\ud800-\udfff]")
"""Half a character, as JSON and the names of files may have: no encoding writes it."""


def visible(text: str, limit: int | None = None) -> str:
    """Return ``text`` as one line with its controls escaped; of more than ``limit`` characters only the first."""
    shortened = text if limit is None or len(text) <= limit else f"{text[:limit]}..."
    return CONTROL.sub(lambda found: found[0].encode("unicode_escape", "surrogatepass").decode("ascii"), shortened)


def code_of(control: str) -> str:
    """Return the name of a control character as Unicode writes it, like ``U+000A``."""
    return f"U+{ord(control):04X}"
