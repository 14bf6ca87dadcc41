"""Cells of a text table as numbers, a column at a time."""

import contextlib
import csv
import math
import re
from collections.abc import Collection, Sequence
from operator import methodcaller

import numpy as np

from otolith_drivers.logs.rows import Array

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?")
BLANK = re.compile(r"^[ \t]*(?:[+-]?nan|n/?a|null|none)?[ \t]*$", re.IGNORECASE | re.MULTILINE)


def split_line(line: str, separator: str) -> list[str]:
    """The cells of one line; a quote that is never closed reaches to its end."""
    return next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])


def split_lines(lines: Sequence[str], separator: str, *, quoted: bool) -> list[list[str]]:
    """The cells of each line; ``quoted`` says that there are quotes, which must not reach into the next line."""
    if quoted:
        return [split_line(line, separator) for line in lines]
    return list(map(methodcaller("split", separator), lines))


def is_blank(cell: str) -> bool:
    """Whether a cell says that there is no reading: empty, NaN, NA, null."""
    return BLANK.fullmatch(cell) is not None


def decimal_sign(texts: Collection[str]) -> str:
    """The one that most of ``texts`` use, empty if none uses any."""
    points, commas = (sum(text.count(sign) for text in texts) for sign in ".,")
    return "" if points == commas == 0 else "," if commas > points else "."


def numbers(text: str, decimal: str) -> Array:
    """One number per line of ``text``: not a number where the cell is blank, infinite where it is no number.

    A decimal sign other than ``decimal`` makes no number, as it may stand between thousands.
    """
    if decimal == ",":
        text = text.replace(".", "?").replace(",", ".")
    if "_" not in text:  # which Python takes for a part of a number
        with contextlib.suppress(ValueError):
            return np.array(text.split("\n"), dtype=np.float64)
        with contextlib.suppress(ValueError):
            return np.array(BLANK.sub("nan", text).split("\n"), dtype=np.float64)
    return np.array([_number(cell.strip()) for cell in text.split("\n")])


def _number(cell: str) -> float:
    if is_blank(cell):
        return math.nan
    return float(cell) if NUMBER.fullmatch(cell) else math.inf
