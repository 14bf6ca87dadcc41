"""Who finds what under how much noise."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from benchmarks.discovery import ours, sindy
from benchmarks.discovery.typical import TYPICAL, Answer, record

NOISES = (0.0, 0.01, 0.02, 0.05, 0.10)  # of each signal's standard deviation
Cell = tuple[int, float, int]  # which typical case, noise, seed


@dataclass(frozen=True, slots=True)
class Found:
    """What everybody found in one window."""

    case: int
    noise: float
    answers: dict[str, Answer]


def cells(repeats: int, seed: int) -> list[Cell]:
    """All windows."""
    return [(case, noise, seed + turn) for case in range(len(TYPICAL)) for noise in NOISES for turn in range(repeats)]


def ask(cell: Cell, *, with_sindy: bool) -> Found:
    """Everybody."""
    number, noise, seed = cell
    case = TYPICAL[number]
    seen = record(case, noise, seed)
    answers = ours.answers(case, seen, seed)
    if with_sindy:
        answers |= sindy.answers(case, seen, seed)
    return Found(number, noise, answers)


def chosen(rows: Sequence[Found]) -> list[str]:
    """Whose answers are shown: of every variant of PySINDy the setting that does best over all windows."""
    names = list(rows[0].answers)

    def merit(name: str) -> tuple[int, int, int]:
        own = [row.answers[name] for row in rows]
        return (
            sum(entry.right and not entry.spurious for entry in own),
            sum(entry.right for entry in own),
            -sum(entry.spurious for entry in own),
        )

    variants = {name.partition(" ")[0] for name in names if name != "Otolith"}
    best = [max((n for n in names if n.partition(" ")[0] == variant), key=merit) for variant in sorted(variants)]
    return ["Otolith", *best]


def pages(rows: Sequence[Found]) -> Iterator[RenderableType]:
    """What a person reads."""
    names = chosen(rows)
    table = Table(title="right of all windows, median error of the effect, spurious terms per window")
    table.add_column("case")
    table.add_column("by")
    for noise in NOISES:
        table.add_column(f"{100 * noise:g} % noise", justify="right")
    for number, case in enumerate(TYPICAL):
        for name in names:
            own = [[r.answers[name] for r in rows if (r.case, r.noise) == (number, noise)] for noise in NOISES]
            cells_of = [_cell(entries) for entries in own]
            table.add_row(case.name if name == names[0] else "", name, *cells_of, end_section=name == names[-1])
    yield table
    whole = Table(title="right of all windows; without any spurious term; spurious terms per window")
    whole.add_column("by")
    for noise in NOISES:
        whole.add_column(f"{100 * noise:g} % noise", justify="right")
    for name in names:
        whole.add_row(name, *(_whole([r.answers[name] for r in rows if r.noise == noise]) for noise in NOISES))
    for variant in sorted({name.partition(" ")[0] for name in names[1:]}):
        best = (_whole([_best(row, variant) for row in rows if row.noise == noise]) for noise in NOISES)
        whole.add_row(f"{variant}, the best setting for each window", *best)
    yield whole


def _best(row: Found, variant: str) -> Answer:
    """Of all settings the one that somebody who knew the truth would choose for this window."""
    own = [answer for name, answer in row.answers.items() if name.partition(" ")[0] == variant]
    return max(own, key=lambda entry: (entry.right and not entry.spurious, entry.right, -entry.spurious))


def document(rows: Sequence[Found]) -> list[dict[str, Any]]:
    """For ``--json``: all settings."""
    names = chosen(rows)
    return [
        {"case": TYPICAL[row.case].name, "noise": row.noise, "by": name, "shown": name in names} | asdict(answer)
        for row in rows
        for name, answer in row.answers.items()
    ]


def _cell(entries: Sequence[Answer]) -> str:
    errors = [entry.error for entry in entries if not math.isnan(entry.error)]
    spurious = sum(entry.spurious for entry in entries) / len(entries)
    error = f"{100.0 * float(np.median(errors)):.2g} %" if errors else ""
    return f"{sum(entry.right for entry in entries)}/{len(entries)} {error:>7} +{spurious:.1f}"


def _whole(entries: Sequence[Answer]) -> str:
    right = sum(entry.right for entry in entries) / len(entries)
    exact = sum(entry.right and not entry.spurious for entry in entries) / len(entries)
    spurious = sum(entry.spurious for entry in entries) / len(entries)
    return f"{100 * right:.0f} %  {100 * exact:.0f} %  +{spurious:.1f}"
