"""What goes to a terminal, a pipe or the journal: each text from outside is part of one line, and controls nothing.

All commands print through this module, and tables with colours through ``console.py``. Colours are styles there, never
escape sequences in a text.
"""

import copy
import csv
import logging
import sys
import traceback
from collections.abc import Iterable
from types import TracebackType
from typing import Any

import click

from otolith_drivers.grammars.json_lines import json_text
from otolith_drivers.outside_text import visible

LOG_TEXT = 4000  # characters of a message of the log: journald cuts lines of 48 kB, and a character may take ten
MAX_CELL = 32_000  # characters of a cell of CSV: spreadsheets take 32,767
FORMULA = ("=", "+", "-", "@", "＝", "＋", "－", "＠")
"""Beginnings of a cell that a spreadsheet computes. Source: OWASP, CSV Injection."""


def echo(*lines: object, err: bool = False) -> None:
    """Print each of ``lines`` as one line, to standard output or to standard error."""
    for line in lines:
        click.echo(visible(str(line)), err=err)


def echo_json(document: Any, indent: int | None = None) -> None:
    """Print a document as JSON, in one line unless there is an ``indent``."""
    click.echo(json_text(document, indent))


def echo_csv(rows: Iterable[Iterable[object]]) -> None:
    """Print rows of a table as CSV; a text that a spreadsheet would compute begins with an apostrophe."""
    csv.writer(sys.stdout, lineterminator="\n").writerows([_cell(value) for value in row] for row in rows)


def _cell(value: object) -> object:
    if not isinstance(value, str):
        return value
    text = visible(value)[:MAX_CELL]
    return f"'{text}" if value.startswith(FORMULA) else text


class LogFormatter(logging.Formatter):
    """Formats a record as one line, and a traceback as lines of its own."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record."""
        own = copy.copy(record)
        own.msg, own.args = visible(record.getMessage(), LOG_TEXT), ()
        return "\n".join(map(visible, super().format(own).split("\n")))


class JournalFormatter(LogFormatter):
    """The same with the priority before each line that journald reads."""

    PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))

    def format(self, record: logging.LogRecord) -> str:
        """Return the lines of a record."""
        priority = next(number for level, number in self.PRIORITIES if record.levelno >= level)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).split("\n"))


def echo_traceback(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an exception that nothing has caught; its text may be of another package, and have text from outside."""
    echo(*"".join(traceback.format_exception(kind, error, trace)).rstrip("\n").split("\n"), err=True)
