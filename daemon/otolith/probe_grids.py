"""Tables that fit a terminal: what has too many columns becomes several tables, one under the other."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from typing import Literal

from rich.console import Console
from rich.table import Table
from rich.text import Text

PLAIN_WIDTH = 200  # columns where nobody looks at a terminal
GAP = 2  # columns between columns
LEFT = ("what", "remark")  # columns of words
WORDS = 24  # columns into which words are broken where there is no more room
STYLES = {"*": "bold green", "?": "yellow", "!": "bold red"}


@dataclass(slots=True)
class Row:
    """A row: what stands in every table, and what goes where there is room."""

    fixed: tuple[str, ...]
    cells: dict[str, str] = field(default_factory=dict)
    """By the name of the column, of which each word is a line."""
    marks: dict[str, str] = field(default_factory=dict)
    """By the name of the column: ``*``, ``?`` or ``!`` before what deserves it."""


def console() -> Console:
    """Standard output: as wide as the terminal, or as a file may be."""
    found = Console(highlight=False)
    return found if found.is_terminal else Console(highlight=False, width=PLAIN_WIDTH)


def grids(heads: Sequence[str], rows: Sequence[Row], width: int) -> Iterator[Table]:
    """Tables of all rows, none wider than ``width`` as far as that is possible.

    Columns whose names begin alike stay in one table if one can hold them.
    """
    if not rows:
        return
    names = [name for name in dict.fromkeys(name for row in rows for name in row.cells) if _filled(rows, name)]
    fixed = sum(GAP + max(len(head), *(len(row.fixed[at]) for row in rows)) for at, head in enumerate(heads))
    families = groupby(names, key=lambda name: name.split()[0])
    together: list[str] = []
    room = width - fixed
    for family in (list(members) for _, members in families):
        whole = sum(_width(rows, name) for name in family)
        for name in family:
            needed = whole if name == family[0] and whole <= width - fixed else _width(rows, name)
            if together and needed > room:
                yield _grid(heads, rows, together)
                together, room = [], width - fixed
            together.append(name)
            room -= _width(rows, name)
    yield _grid(heads, rows, together)


def _filled(rows: Sequence[Row], name: str) -> bool:
    return any(row.cells.get(name) for row in rows)


def _width(rows: Sequence[Row], name: str) -> int:
    longest = max(len(row.cells.get(name, "")) + len(row.marks.get(name, "")) for row in rows)
    longest = min(longest, WORDS) if name in LEFT else longest
    return GAP + max([longest, *map(len, name.split())])


def _grid(heads: Sequence[str], rows: Sequence[Row], names: Sequence[str]) -> Table:
    table = Table(box=None, padding=(0, GAP, 0, 0), header_style="bold")
    for head in heads:
        table.add_column(head, no_wrap=True, vertical="bottom")
    for name in names:
        justify: Literal["left", "right"] = "left" if name in LEFT else "right"
        table.add_column(name.replace(" ", "\n"), justify=justify, no_wrap=name not in LEFT, vertical="bottom")
    for row in rows:
        table.add_row(*row.fixed, *(_cell(row, name) for name in names))
    return table


def _cell(row: Row, name: str) -> Text:
    mark = row.marks.get(name, "")
    text = row.cells.get(name, "")
    words = f"{mark} {text}" if mark and name in LEFT else f"{mark}{text}"
    return Text(words, style=STYLES.get(mark, "dim" if text == "·" else ""))
