"""``python -m benchmarks.discovery``: random components for the search, and PySINDy on the same signals."""

import importlib.util
import json
import sys
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context

import click
from rich.console import Console, RenderableType

from benchmarks.discovery import comparison, report
from benchmarks.discovery.comparison import cells, run_cell
from benchmarks.discovery.judge import run_case

PROCESSES = 2
FILE_WIDTH = 250  # columns, if the output is no terminal


@click.group(help=__doc__)
def main() -> None:
    """Both benchmarks."""


@main.command("cases")
@click.option("--count", default=300, show_default=True, help="How many random components.")
@click.option("--seed", default=1, show_default=True)
@click.option("--processes", default=PROCESSES, show_default=True, type=click.IntRange(1, PROCESSES))
@click.option("--verbose", is_flag=True, help="A line for every case.")
@click.option("--json", "as_json", is_flag=True)
def cases_command(count: int, seed: int, processes: int, *, verbose: bool, as_json: bool) -> None:
    """How often the search identifies the true component; exit code 1 if a target is missed."""
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(partial(run_case, seed=seed), range(count), chunksize=4))
    if as_json:
        click.echo(json.dumps(report.document(rows, seed), indent=2))
    else:
        _show(report.pages(rows, verbose=verbose))
    sys.exit(0 if all(share.met for share in report.shares(rows)) else 1)


@main.command("compare")
@click.option("--repeats", default=3, show_default=True, help="Windows of each case and noise.")
@click.option("--seed", default=1, show_default=True)
@click.option("--processes", default=PROCESSES, show_default=True, type=click.IntRange(1, PROCESSES))
@click.option("--json", "as_json", is_flag=True)
def compare_command(repeats: int, seed: int, processes: int, *, as_json: bool) -> None:
    """The search and PySINDy in twelve typical cases with noise."""
    with_sindy = importlib.util.find_spec("pysindy") is not None
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        rows = list(pool.map(partial(run_cell, with_sindy=with_sindy), cells(repeats, seed)))
    if as_json:
        click.echo(json.dumps(comparison.document(rows), indent=2))
        return
    _show(comparison.pages(rows))
    if not with_sindy:
        click.echo("not compared: PySINDy, as it is not installed")


def _show(pages: Iterable[RenderableType]) -> None:
    console = Console()
    if not console.is_terminal:
        console = Console(width=FILE_WIDTH)
    for page in pages:
        console.print(page)


if __name__ == "__main__":
    main()
