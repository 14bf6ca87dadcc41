"""Shares and tables of many cases."""

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import RenderableType
from rich.table import Table

from benchmarks.discovery.judge import CaseResult
from otolith.twin.components import FAMILY_NAMES

FIRST_AT_LEAST, NAMED_AT_LEAST, COVERED = 0.90, 0.98, (0.93, 0.97)
OTHERS = ("two or more", "sensor", "parameter", "nothing")  # results that are no single component
SHORT = {"negative exponential": "neg. exp.", "exponential": "exp.", "logarithmic": "log."}


@dataclass(frozen=True, slots=True)
class Share:
    """A share of the cases, and its target."""

    name: str
    hits: int
    of: int
    low: float = 0.0
    """Target, with ``high``."""
    high: float = 1.0

    @property
    def value(self) -> float:
        """From 0 to 1; not a number without cases."""
        return self.hits / self.of if self.of else math.nan

    @property
    def met(self) -> bool:
        """Whether the target is met."""
        return not self.of or self.low <= self.value <= self.high


def shares(rows: Sequence[CaseResult]) -> list[Share]:
    """All shares; one without a target is always met."""
    decided = [row for row in rows if row.decided]
    tried = [row for row in rows if row.tried]
    return [
        Share("first among decided", sum(row.first for row in decided), len(decided), FIRST_AT_LEAST),
        Share("named among all", sum(row.named for row in rows), len(rows), NAMED_AT_LEAST),
        Share("amplitude within its 95 % interval", sum(row.covered for row in tried), len(tried), *COVERED),
        Share("first among all", sum(row.first for row in rows), len(rows)),
        Share("decided", len(decided), len(rows)),
        Share("true hypothesis fitted", len(tried), len(rows)),
        Share("detected by the search", sum(row.detected for row in rows), len(rows)),
        Share("noticed by screening", sum(row.noticed for row in rows), len(rows)),
        Share("healthy windows noticed by screening", sum(row.false_gain > 0.0 for row in rows), len(rows)),
    ]


def pages(rows: Sequence[CaseResult], *, verbose: bool) -> Iterator[RenderableType]:
    """All tables."""
    if verbose:
        yield _lines(rows)
    yield _confusion(rows)
    yield _by_family(rows)
    yield _shares(rows)


def document(rows: Sequence[CaseResult], seed: int) -> dict[str, Any]:
    """For ``--json``."""
    return {
        "seed": seed,
        "shares": [asdict(share) | {"value": share.value, "met": share.met} for share in shares(rows)],
        "cases": [asdict(row) | {"normalised_error": row.normalised_error, "covered": row.covered} for row in rows],
    }


def _confusion(rows: Sequence[CaseResult]) -> Table:
    table = Table(title="true family down, family of the best hypothesis across", title_justify="left")
    table.add_column("")
    for name in (*FAMILY_NAMES, *OTHERS):
        table.add_column(SHORT.get(name, name), justify="right")
    counts = Counter((row.family, row.best_family) for row in rows)
    for family in FAMILY_NAMES:
        cells = [counts[family, name] for name in (*FAMILY_NAMES, *OTHERS)]
        table.add_row(family, *(str(cell) if cell else "·" for cell in cells))
    return table


def _by_family(rows: Sequence[CaseResult]) -> Table:
    table = Table(title="by true family", title_justify="left")
    for name in ("", "cases", "decided", "first of decided", "named", "fitted", "covered", "detected", "noticed"):
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


def _shares(rows: Sequence[CaseResult]) -> Table:
    table = Table(title="shares", title_justify="left")
    for name in ("", "share", "of", "target, %", ""):
        table.add_column(name, justify="right" if name else "left")
    for share in shares(rows):
        target = "" if (share.low, share.high) == (0.0, 1.0) else f"{100 * share.low:.0f} to {100 * share.high:.0f} %"
        met = ("met" if share.met else "[red]missed") if target else ""
        table.add_row(share.name, _percent(share.hits, share.of), str(share.of), target, met)
    return table


def _lines(rows: Sequence[CaseResult]) -> Table:
    table = Table(title="cases: distance of hypotheses from the best, in -2 log evidence", title_justify="left")
    for name in (
        "",
        "operation",
        "truth",
        "× limit",
        "amplitude",
        "inner",
        "estimate",
        "error/sd",
        "behind",
        "",
        "ranking",
    ):
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
            f"{row.estimated_amplitude:.4g}",
            f"{row.normalised_error:.1f}",
            f"{row.behind:.1f}",
            " ".join(filter(None, marks)),
            ", ".join(f"{name} {behind:.0f}" for name, behind in row.ranking),
        )
    return table


def _percent(hits: int, of: int) -> str:
    return f"{100.0 * hits / of:.1f} %" if of else "-"
