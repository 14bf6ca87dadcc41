"""What many cases come to."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import RenderableType
from rich.table import Table

from benchmarks.discovery.judge import Judged
from otolith.twin.component_families import FAMILY_NAMES

FIRST_AT_LEAST, NAMED_AT_LEAST, COVERED = 0.90, 0.98, (0.93, 0.97)
OTHERS = ("two or more", "sensor", "parameter", "nothing")  # that a family may be taken for
SHORT = {"negative exponential": "neg. exp.", "exponential": "exp.", "logarithmic": "log."}


@dataclass(frozen=True, slots=True)
class Share:
    """So many of so many."""

    name: str
    hits: int
    of: int
    low: float = 0.0
    """What is asked for at least."""
    high: float = 1.0

    @property
    def value(self) -> float:
        """From 0 to 1; not a number of none."""
        return self.hits / self.of if self.of else math.nan

    @property
    def met(self) -> bool:
        """Whether the target is."""
        return not self.of or self.low <= self.value <= self.high


def shares(rows: Sequence[Judged]) -> list[Share]:
    """All shares; those without a target have one that is always met."""
    decided = [row for row in rows if row.decided]
    tried = [row for row in rows if row.tried]
    return [
        Share("first among decided", sum(row.first for row in decided), len(decided), FIRST_AT_LEAST),
        Share("named among all", sum(row.named for row in rows), len(rows), NAMED_AT_LEAST),
        Share("amplitude within its 95 % interval", sum(row.covered for row in tried), len(tried), *COVERED),
        Share("first among all", sum(row.first for row in rows), len(rows)),
        Share("decided", len(decided), len(rows)),
        Share("truth itself polished", len(tried), len(rows)),
        Share("detected by the search", sum(row.detected for row in rows), len(rows)),
        Share("noticed by the glance", sum(row.noticed for row in rows), len(rows)),
        Share("healthy windows noticed by the glance", sum(row.false_gain > 0.0 for row in rows), len(rows)),
    ]


def pages(rows: Sequence[Judged], *, verbose: bool) -> Iterator[RenderableType]:
    """What a person reads."""
    if verbose:
        yield _lines(rows)
    yield _confusion(rows)
    yield _by_family(rows)
    yield _shares(rows)


def document(rows: Sequence[Judged], seed: int) -> dict[str, Any]:
    """For ``--json``."""
    return {
        "seed": seed,
        "shares": [asdict(entry) | {"value": entry.value, "met": entry.met} for entry in shares(rows)],
        "cases": [asdict(row) | {"off": row.off, "covered": row.covered} for row in rows],
    }


def _confusion(rows: Sequence[Judged]) -> Table:
    table = Table(title="true family down, family of the best explanation across", title_justify="left")
    table.add_column("")
    for name in (*FAMILY_NAMES, *OTHERS):
        table.add_column(SHORT.get(name, name), justify="right")
    counts = Counter((row.family, row.best_family) for row in rows)
    for family in FAMILY_NAMES:
        cells = [counts[family, name] for name in (*FAMILY_NAMES, *OTHERS)]
        table.add_row(family, *(str(cell) if cell else "·" for cell in cells))
    return table


def _by_family(rows: Sequence[Judged]) -> Table:
    table = Table(title="by true family", title_justify="left")
    for name in ("", "cases", "decided", "first of decided", "named", "polished", "covered", "detected", "noticed"):
        table.add_column(name, justify="right" if name else "left")
    for family in FAMILY_NAMES:
        own = [row for row in rows if row.family == family]
        decided, tried = [row for row in own if row.decided], [row for row in own if row.tried]
        table.add_row(
            family,
            str(len(own)),
            str(len(decided)),
            _percent(sum(row.first for row in decided), len(decided)),
            _percent(sum(row.named for row in own), len(own)),
            _percent(len(tried), len(own)),
            _percent(sum(row.covered for row in tried), len(tried)),
            _percent(sum(row.detected for row in own), len(own)),
            _percent(sum(row.noticed for row in own), len(own)),
        )
    return table


def _shares(rows: Sequence[Judged]) -> Table:
    table = Table(title="shares", title_justify="left")
    for name in ("", "share", "of", "asked", ""):
        table.add_column(name, justify="right" if name else "left")
    for entry in shares(rows):
        asked = "" if (entry.low, entry.high) == (0.0, 1.0) else f"{100 * entry.low:.0f} to {100 * entry.high:.0f} %"
        met = ("met" if entry.met else "[red]missed") if asked else ""
        table.add_row(entry.name, _percent(entry.hits, entry.of), str(entry.of), asked, met)
    return table


def _lines(rows: Sequence[Judged]) -> Table:
    table = Table(title="cases: how far explanations are behind the best, in -2 log evidence", title_justify="left")
    for name in ("", "operation", "truth", "× limit", "amplitude", "inner", "found", "off/sd", "behind", "", "ranking"):
        table.add_column(name)
    for row in rows:
        marks = ("first" if row.first else "", "decided" if row.decided else "", "" if row.named else "[red]not named")
        table.add_row(
            str(row.number),
            row.kind,
            row.truth,
            f"{row.times:.1f}",
            f"{row.amplitude:.4g}",
            f"{row.inner:.4g}",
            f"{row.found_amplitude:.4g}",
            f"{row.off:.1f}",
            f"{row.behind:.1f}",
            " ".join(filter(None, marks)),
            ", ".join(f"{name} {behind:.0f}" for name, behind in row.ranking),
        )
    return table


def _percent(hits: int, of: int) -> str:
    return f"{100.0 * hits / of:.1f} %" if of else "-"
