"""``python -m benchmarks.sampling``: coverage of 95 % intervals, and errors over the Cramér-Rao bound.

Every recording has another motor, starts cold and has ten windows. A scenario meets its target if the intervals of
single windows hold the truth in 93 to 97 % of the windows, for each of R_a, D and J, if at least 95 % of the windows
are estimated whose bound allows the interval that is asked for, and if the errors are at most 1.1 times the bound.

By chance, a share of 500 windows varies by 1 % (standard deviation). The efficient estimate of the same samples, which
uses the truth, has the same noise and varies with it. Therefore its deviation from 95 % is subtracted from the
coverage, and the errors are divided by its errors.
"""

import json
import sys
from collections.abc import Mapping
from functools import partial

import click
import numpy as np
from rich.table import Table

from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.sampling.cases import CASES
from benchmarks.sampling.measure import FREE, Summary, run
from otolith.acquisition.window import Array

COVERAGE = (0.93, 0.97)
MIN_ESTIMATED = 0.95
MAX_ERROR_RATIO = 1.1


@click.command(help=__doc__)
@click.argument("names", nargs=-1)
@click.option("--windows", default=500, show_default=True, help="Windows of each scenario.")
@with_options
def main(options: Options, names: tuple[str, ...], windows: int) -> None:
    """Measure the scenarios whose names contain one of NAMES, or all; exit code 1 if one misses its target."""
    selected = [case for case in CASES if not names or any(name in case for name in names)]
    if not selected:
        raise click.BadParameter(f"no scenario's name contains it; there are {', '.join(CASES)}", param_hint="NAMES")
    jobs = [partial(run, CASES[case], windows=windows, seed=options.seed) for case in selected]
    summaries = dict(zip(selected, in_processes(jobs, options.processes), strict=True))
    if options.as_json:
        click.echo(json.dumps({case: document(own) for case, own in summaries.items()}, indent=2))
    else:
        _show(summaries)
    sys.exit(0 if all(meets_target(own) for case, own in summaries.items()) else 1)


def meets_target(summary: Summary) -> bool:
    """Whether coverage, share of estimated windows and errors of a scenario are within their limits."""
    low, high = COVERAGE
    covers = bool(((summary.coverage >= low) & (summary.coverage <= high)).all())
    estimated = summary.allowed == 0 or summary.estimated >= MIN_ESTIMATED
    return covers and estimated and bool((summary.error_ratio <= MAX_ERROR_RATIO).all())


def document(summary: Summary) -> dict[str, object]:
    """Return the figures of a scenario as a document; None for what no window gives."""

    def by_name(values: Array) -> dict[str, float | None]:
        pairs = zip(FREE, values.tolist(), strict=True)
        return {name: value if np.isfinite(value) else None for name, value in pairs}

    coverages = ("raw_coverage", "efficient_coverage", "coverage", "published_coverage")
    keys = (*coverages, "spread", "efficient_spread", "error_ratio", "bias", "bound")
    return {
        "windows": summary.windows,
        "learned": summary.learned,
        "allowed": summary.allowed,
        "estimated": summary.estimated if summary.allowed else None,
        **{key: by_name(getattr(summary, key)) for key in keys},
        "reasons": dict(summary.reasons),
        "met": meets_target(summary),
    }


def _show(summaries: Mapping[str, Summary]) -> None:
    """Print a row for each scenario, then why windows were not used."""
    columns = (
        "learned",
        "allowed",
        "estimated",
        "coverage raw",
        "efficient",
        "published",
        "error/bound",
        "efficient",
        "bias/bound",
        "bound",
    )
    table = Table("scenario", *columns, "met", title=f"{', '.join(FREE)} in each column")
    for case, summary in summaries.items():
        table.add_row(
            case,
            f"{summary.learned} of {summary.windows}",
            f"{summary.allowed / summary.windows:.0%}",
            f"{summary.estimated:.1%}",
            _percent(summary.raw_coverage),
            _percent(summary.efficient_coverage),
            _percent(summary.published_coverage),
            " ".join(f"{value:.2f}" for value in summary.spread),
            " ".join(f"{value:.2f}" for value in summary.efficient_spread),
            " ".join(f"{value:+.2f}" for value in summary.bias),
            " ".join(f"{value:.2%}" for value in summary.bound),
            "yes" if meets_target(summary) else "no",
        )
    reasons = [
        f"{case}: {count} of {summary.windows} windows: {reason}"
        for case, summary in summaries.items()
        for reason, count in summary.reasons
    ]
    print_pages(table, *reasons)


def _percent(shares: Array) -> str:
    return " ".join(f"{100.0 * share:.1f}" for share in shares)


if __name__ == "__main__":
    main()
