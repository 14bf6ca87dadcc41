"""``python -m benchmarks.sampling``: coverage of 95 % intervals, and errors over the Cramér-Rao bound.

Every recording has another motor, starts cold and has ten windows. A scenario meets its target if the intervals of
single windows hold the truth in 93 to 97 % of the windows, for each of R_a, D and J, if at least 95 % of the windows
are estimated whose bound allows the interval that is asked for, and if the errors are at most 1.1 times the bound.
"""

import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.sampling.cases import CASES
from benchmarks.sampling.measure import FREE, Summary, run
from otolith.acquisition.window import Array

PROCESSES = 2
FILE_WIDTH = 200  # columns, if the output is no terminal
COVERAGE = (0.93, 0.97)
MIN_ESTIMATED = 0.95
MAX_SPREAD = 1.1


@click.command(help=__doc__)
@click.argument("names", nargs=-1)
@click.option("--windows", default=500, show_default=True, help="Windows of each scenario.")
@click.option("--seed", default=1, show_default=True)
@click.option("--processes", default=PROCESSES, show_default=True, type=click.IntRange(1, PROCESSES))
@click.option("--json", "as_json", is_flag=True)
def main(names: tuple[str, ...], windows: int, seed: int, processes: int, *, as_json: bool) -> None:
    """Measure the scenarios whose names contain one of NAMES, or all; exit code 1 if one misses its target."""
    selected = [case for case in CASES if not names or any(name in case for name in names)]
    if not selected:
        raise click.BadParameter(f"no scenario's name contains it; there are {', '.join(CASES)}", param_hint="NAMES")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the processes share the cores
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        summaries = list(pool.map(partial(run, windows=windows, seed=seed), map(CASES.__getitem__, selected)))
    if as_json:
        click.echo(json.dumps({case: document(own) for case, own in zip(selected, summaries, strict=True)}, indent=2))
    else:
        _show(selected, summaries)
    sys.exit(0 if all(map(meets_target, summaries)) else 1)


def meets_target(summary: Summary) -> bool:
    """Whether coverage, share of estimated windows and errors of a scenario are within their limits."""
    low, high = COVERAGE
    covers = bool(((summary.raw_coverage >= low) & (summary.raw_coverage <= high)).all())
    estimated = summary.allowed == 0 or summary.estimated >= MIN_ESTIMATED
    return covers and estimated and bool((summary.spread <= MAX_SPREAD).all())


def document(summary: Summary) -> dict[str, object]:
    """Return the figures of a scenario as a document; None for what no window gives."""

    def by_name(values: Array) -> dict[str, float | None]:
        pairs = zip(FREE, values.tolist(), strict=True)
        return {name: value if np.isfinite(value) else None for name, value in pairs}

    keys = ("raw_coverage", "published_coverage", "spread", "bias", "bound")
    return {
        "windows": summary.windows,
        "learned": summary.learned,
        "allowed": summary.allowed,
        "estimated": summary.estimated if summary.allowed else None,
        **{key: by_name(getattr(summary, key)) for key in keys},
        "reasons": dict(summary.reasons),
        "met": meets_target(summary),
    }


def _show(cases: Sequence[str], summaries: Sequence[Summary]) -> None:
    """Print a row for each scenario, then why windows were not used."""
    columns = ("learned", "allowed", "estimated", "coverage raw", "published", "error/bound", "bias/bound", "bound")
    table = Table("scenario", *columns, "met", title=f"{', '.join(FREE)} in each column")
    for case, summary in zip(cases, summaries, strict=True):
        table.add_row(
            case,
            f"{summary.learned} of {summary.windows}",
            f"{summary.allowed / summary.windows:.0%}",
            f"{summary.estimated:.1%}",
            _percent(summary.raw_coverage),
            _percent(summary.published_coverage),
            " ".join(f"{value:.2f}" for value in summary.spread),
            " ".join(f"{value:+.2f}" for value in summary.bias),
            " ".join(f"{value:.2%}" for value in summary.bound),
            "yes" if meets_target(summary) else "no",
        )
    console = Console() if sys.stdout.isatty() else Console(width=FILE_WIDTH)
    console.print(table)
    for case, summary in zip(cases, summaries, strict=True):
        for reason, count in summary.reasons:
            console.print(f"{case}: {count} of {summary.windows} windows: {reason}", markup=False, highlight=False)


def _percent(shares: Array) -> str:
    return " ".join(f"{100.0 * share:.1f}" for share in shares)


if __name__ == "__main__":
    main()
