"""``python -m benchmarks.paper``: the paper's scenarios, and our figures beside the paper's."""

import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from benchmarks.paper import process_pool
from benchmarks.paper.discovery import Discovery, Search
from benchmarks.paper.output import document, pages
from benchmarks.paper.scenarios import HIDING, NAMES, UNKNOWN_NAMES, UNKNOWNS, row_of
from benchmarks.paper.study import Job, Kind, Study, verdict
from otolith_drivers.user_dirs import state_directory, writable

QUICK = 300.0  # s
WIDTH = 120  # columns of tables that go into a file


def new_folder() -> Path:
    """For the plots of this run."""
    stamp = datetime.now().astimezone().strftime("%Y%m%dT%H%M%S")
    return state_directory() / "paper" / f"{stamp}-{os.getpid()}"


def compare(names: Sequence[str], folder: Path | None, *, noise: bool, quick: bool, as_json: bool) -> int:
    """Study the scenarios ``names``, or all, and draw into ``folder``; 0 if every target is met, 1 if not.

    Raises:
        OtolithError: a file or folder that cannot be used.
    """
    if folder is not None:
        writable(folder)  # before all the work
    with _bars() as hear:
        found = process_pool.perform(jobs_of(names, noise=noise, quick=quick), hear)
    studies = [entry for entry in found if isinstance(entry, Study)]
    discoveries = [entry for entry in found if isinstance(entry, Discovery)]
    written: list[Path] = []
    if folder is not None:
        from benchmarks.paper.plots import draw  # noqa: PLC0415 - slow to load, and nobody else needs it

        written = draw(studies, discoveries, folder)
    if as_json:
        click.echo(document(found, written))
    else:
        console = Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH)
        for page in pages(found):
            console.print(page)
        if written:
            console.print(f"{len(written)} plots are in {folder}", soft_wrap=True)
    met = all(verdict(entry.job.row, entry.score) for entry in studies if entry.job.kind is Kind.IDEAL)
    return 0 if met and all(entry.met for entry in discoveries) else 1


def jobs_of(names: Sequence[str], *, noise: bool, quick: bool) -> list[process_pool.Work]:
    """In the order of the rows, each once; a search for a noise once for each machine."""
    rows = [row_of(name) for name in NAMES if name in names or not names]
    seconds = {row.name: min(row.seconds, QUICK) if quick else row.seconds for row in rows}
    unknown = [row for row in UNKNOWNS if row.name in names or not names]
    jobs: list[process_pool.Work] = [Job(row, Kind.IDEAL, seconds[row.name]) for row in rows]
    for kind in (Kind.IDEAL, Kind.NOISY) if noise else (Kind.IDEAL,):
        jobs += [Search(row, kind, min(row.seconds, QUICK) if quick else row.seconds) for row in unknown]
    if noise:
        jobs += [Job(row, Kind.NOISY, seconds[row.name]) for row in rows]
        first = {row.machine: row for row in reversed(rows) if row.machine in HIDING}
        jobs += [Job(row, Kind.LIMIT, seconds[row.name]) for row in first.values()]
    return jobs


@contextmanager
def _bars() -> Iterator[Callable[[process_pool.Progress], None]]:
    """A bar for each job that has begun, on standard error, if somebody sees it."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[process_pool.Work, TaskID] = {}

        def hear(told: process_pool.Progress) -> None:
            if told.job not in tasks:
                tasks[told.job] = bars.add_task("", total=told.job.steps)
            bars.update(tasks[told.job], completed=told.steps, description=told.doing)

        yield hear


@click.command()
@click.option(
    "--scenario",
    multiple=True,
    type=click.Choice((*NAMES, *UNKNOWN_NAMES)),
    help="Only this one; may be given more than once.",
)
@click.option("--quick", is_flag=True, help="Only the first 300 s of each.")
@click.option("--noise", is_flag=True, help="Again with noisy sensors; and how much noise hides the lift's damping.")
@click.option(
    "--plots",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Draw into this folder instead of a new one in the state directory.",
)
@click.option("--no-plots", is_flag=True, help="Draw nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of tables.")
def paper(
    scenario: tuple[str, ...], quick: bool, noise: bool, plots: Path | None, no_plots: bool, as_json: bool
) -> int:
    """Run the paper's scenarios through the daemon's estimation; compare what is found with the truth and the paper.

    Each machine is simulated; drifting parameters are estimated in windows of 0.1, 1, 2, 4 and 10 s, unknown components
    discovered in windows of 2 s. That takes minutes.

    \b
    Examples:
      python -m benchmarks.paper
      python -m benchmarks.paper --quick --scenario armature-resistance
      python -m benchmarks.paper --noise --plots figures
      python -m benchmarks.paper --json --no-plots | jq '.scenarios[].published'
    """
    if plots is not None and no_plots:
        raise click.UsageError("--plots and --no-plots exclude each other")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # so that bars and processes are put away
    folder = None if no_plots else plots or new_folder()
    return compare(scenario, folder, noise=noise, quick=quick, as_json=as_json)


if __name__ == "__main__":
    sys.exit(paper(standalone_mode=False))
