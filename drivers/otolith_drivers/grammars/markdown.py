"""Text in a file of Markdown: the grammar by which it stays text."""

import re

from otolith_drivers.outside_text import visible

MARKS = re.compile(r"[\\`*<>#|\[\]!&]|(?<![^\W_])_|_(?![^\W_])")  # within a word, '_' is no mark


def markdown_text(text: str) -> str:
    """Return text that is not Markdown, as ``N*m`` would be, in Markdown: one line, also in a table."""
    return MARKS.sub(r"\\\g<0>", visible(text))
