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
from benchmarks.paper.scenarios import LIMITING_SIGNAL, NAMES, UNKNOWN_NAMES, UNKNOWNS, row_of
from benchmarks.paper.study import Job, Kind, Study, verdict
from otolith_drivers.user_dirs import state_directory, writable

QUICK = 300.0  # s of each scenario with --quick
WIDTH = 120  # columns, if the output is no terminal


def new_folder() -> Path:
    """Folder for the plots of this run."""
    stamp = datetime.now().astimezone().strftime("%Y%m%dT%H%M%S")
    return state_directory() / "paper" / f"{stamp}-{os.getpid()}"


def compare(names: Sequence[str], folder: Path | None, *, noise: bool, quick: bool, as_json: bool) -> int:
    """Exit code: 0 if every target of the scenarios ``names``, or of all, is met, 1 if not; plots go into ``folder``.

    Raises:
        OtolithError: a file or folder cannot be used.
    """
    if folder is not None:
        writable(folder)  # fail before the long computation
    with _bars() as on_progress:
        results = process_pool.run_jobs(jobs_of(names, noise=noise, quick=quick), on_progress)
    studies = [result for result in results if isinstance(result, Study)]
    discoveries = [result for result in results if isinstance(result, Discovery)]
    written: list[Path] = []
    if folder is not None:
        from benchmarks.paper.plots import draw  # noqa: PLC0415 - slow to load, and only needed for plots

        written = draw(studies, discoveries, folder)
    if as_json:
        click.echo(document(results, written))
    else:
        console = Console(highlight=False, width=None if sys.stdout.isatty() else WIDTH)
        for page in pages(results):
            console.print(page)
        if written:
            console.print(f"{len(written)} plots are in {folder}", soft_wrap=True)
    met = all(verdict(study.job.row, study.score) for study in studies if study.job.kind is Kind.IDEAL)
    return 0 if met and all(discovery.met for discovery in discoveries) else 1


def jobs_of(names: Sequence[str], *, noise: bool, quick: bool) -> list[process_pool.AnyJob]:
    """The jobs in the order of the rows, each once; one search for the limiting noise per machine."""
    rows = [row_of(name) for name in NAMES if name in names or not names]
    seconds = {row.name: min(row.seconds, QUICK) if quick else row.seconds for row in rows}
    unknown = [row for row in UNKNOWNS if row.name in names or not names]
    jobs: list[process_pool.AnyJob] = [Job(row, Kind.IDEAL, seconds[row.name]) for row in rows]
    for kind in (Kind.IDEAL, Kind.NOISY) if noise else (Kind.IDEAL,):
        jobs += [Search(row, kind, min(row.seconds, QUICK) if quick else row.seconds) for row in unknown]
    if noise:
        jobs += [Job(row, Kind.NOISY, seconds[row.name]) for row in rows]
        first = {row.machine: row for row in reversed(rows) if row.machine in LIMITING_SIGNAL}
        jobs += [Job(row, Kind.LIMIT, seconds[row.name]) for row in first.values()]
    return jobs


@contextmanager
def _bars() -> Iterator[Callable[[process_pool.Progress], None]]:
    """A progress bar for each job that has begun, on standard error if that is a terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[process_pool.AnyJob, TaskID] = {}

        def on_progress(progress: process_pool.Progress) -> None:
            if progress.job not in tasks:
                tasks[progress.job] = bars.add_task("", total=progress.job.steps)
            bars.update(tasks[progress.job], completed=progress.steps, description=progress.activity)

        yield on_progress


@click.command()
@click.option(
    "--scenario",
    multiple=True,
    type=click.Choice((*NAMES, *UNKNOWN_NAMES)),
    help="Only this one; may be given more than once.",
)
@click.option("--quick", is_flag=True, help="Only the first 300 s of each.")
@click.option(
    "--noise", is_flag=True, help="Also with noisy sensors, and the noise at which the lift's damping is lost."
)
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
    """Run the paper's scenarios through the daemon's core; compare the estimates with the truth and with the paper.

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
    signal.signal(signal.SIGINT, signal.default_int_handler)  # so that bars and child processes are cleaned up
    folder = None if no_plots else plots or new_folder()
    return compare(scenario, folder, noise=noise, quick=quick, as_json=as_json)


if __name__ == "__main__":
    sys.exit(paper(standalone_mode=False))
