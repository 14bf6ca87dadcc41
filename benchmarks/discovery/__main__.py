"""``python -m benchmarks.discovery``: random components for the search, and PySINDy on the same signals."""

import importlib.util
import json
import sys
from functools import partial

import click

from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.discovery import comparison, report
from benchmarks.discovery.comparison import cells, run_cell
from benchmarks.discovery.judge import run_case


@click.group(help=__doc__)
def main() -> None:
    """Both benchmarks."""


@main.command("cases")
@click.option("--count", default=300, show_default=True, help="How many random components.")
@click.option("--verbose", is_flag=True, help="A line for every case.")
@with_options
def cases_command(options: Options, count: int, *, verbose: bool) -> None:
    """How often the search identifies the true component; exit code 1 if a target is missed."""
    rows = in_processes([partial(run_case, number, seed=options.seed) for number in range(count)], options.processes)
    if options.as_json:
        click.echo(json.dumps(report.document(rows, options.seed), indent=2))
    else:
        print_pages(*report.pages(rows, verbose=verbose))
    sys.exit(0 if all(share.met for share in report.shares(rows)) else 1)


@main.command("compare")
@click.option("--repeats", default=3, show_default=True, help="Windows of each case and noise.")
@with_options
def compare_command(options: Options, repeats: int) -> None:
    """The search and PySINDy in twelve typical cases with noise."""
    with_sindy = importlib.util.find_spec("pysindy") is not None
    jobs = [partial(run_cell, cell, with_sindy=with_sindy) for cell in cells(repeats, options.seed)]
    rows = in_processes(jobs, options.processes)
    if options.as_json:
        click.echo(json.dumps(comparison.document(rows), indent=2))
        return
    print_pages(*comparison.pages(rows))
    if not with_sindy:
        click.echo("not compared: PySINDy, as it is not installed")


if __name__ == "__main__":
    main()
