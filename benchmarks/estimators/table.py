"""The table of the comparison, and the conclusions."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from benchmarks.estimators import otolith_itself, paper
from benchmarks.estimators.data import FREE
from benchmarks.estimators.measure import Row

PLAIN_AT_LEAST, COMPILED_AT_LEAST = 1000.0, 100.0  # times Otolith's time


@dataclass(frozen=True, slots=True)
class Verdict:
    """One conclusion, and whether it meets its target."""

    sentence: str
    holds: bool


def lines(rows: Sequence[Row]) -> list[str]:
    """The table: errors in per cent of the truth as median/99th percentile, coverage of the intervals, time."""
    ours = _by_name(rows)[otolith_itself.PUBLISHED]
    head = "".join(f"{f'{name} % error':>15}" for name in FREE)
    table = [f"{'':31}{'windows':>8}{head}{'95 % holds':>17}{'ms':>10}{'p99':>10}{'x ours':>9}"]
    for row in rows:
        errors = "".join(f"{_pair(row, name):>15}" for name in FREE)
        covered = "/".join(f"{100.0 * row.covered[name]:.0f}" for name in FREE) if row.covered else "-"
        times = f"{1e3 * row.seconds:>10.1f}{1e3 * row.seconds_p99:>10.1f}{row.seconds / ours.seconds:>9.1f}"
        table.append(f"{row.name:31}{row.windows or '-':>8}{errors}{covered:>17}{times}  {row.note}".rstrip())
    return table


def verdicts(rows: Sequence[Row]) -> list[Verdict]:
    """Comparison with the values that Otolith publishes."""
    named = _by_name(rows)
    ours = named[otolith_itself.PUBLISHED]
    plain = named[paper.PYTHON].seconds / ours.seconds
    compiled = min(named[paper.ADAPTIVE].seconds, named[paper.FIXED].seconds) / ours.seconds
    own = (otolith_itself.PUBLISHED, otolith_itself.ALONE, otolith_itself.COLD)
    methods = [row for row in rows if row.name not in own]
    better = [row.name for row in methods if row.size < ours.size and row.seconds < ours.seconds]
    return [
        Verdict(
            f"the paper's method in pure Python takes {plain:.0f} times our time ({PLAIN_AT_LEAST:.0f} asked)",
            plain >= PLAIN_AT_LEAST,
        ),
        Verdict(
            f"the paper's method compiled takes {compiled:.0f} times our time ({COMPILED_AT_LEAST:.0f} asked)",
            compiled >= COMPILED_AT_LEAST,
        ),
        Verdict(f"methods with both less error and less time: {', '.join(better) or 'none'}", not better),
        Verdict(f"with less error, and more time: {_compared(methods, ours, by_error=True)}", holds=True),
        Verdict(f"with less time, and more error: {_compared(methods, ours, by_error=False)}", holds=True),
    ]


def _compared(methods: Sequence[Row], ours: Row, *, by_error: bool) -> str:
    """The methods that are better in only one of error and time, with both ratios."""
    texts = []
    for row in methods:
        error, time = row.size / ours.size, row.seconds / ours.seconds
        if (error < 1.0 <= time) if by_error else (time < 1.0 <= error):
            texts.append(f"{row.name} ({error:.2f} x the error, {time:.2g} x the time)")
    return ", ".join(texts) or "none"


def _by_name(rows: Sequence[Row]) -> Mapping[str, Row]:
    return {row.name: row for row in rows}


def _pair(row: Row, name: str) -> str:
    if name not in row.error or math.isnan(row.error[name]):
        return "-"
    return f"{row.error[name]:.2g}/{row.error_p99[name]:.2g}"
