"""``otolith paper``: the jobs, their progress, and what is said of what they found."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from otolith.paper import crew
from otolith.paper.discovering import Discovery, Search
from otolith.paper.document import document
from otolith.paper.rows import HIDING, NAMES, row_of
from otolith.paper.score import verdict
from otolith.paper.studies import Job, Kind, Study
from otolith.paper.tables import pages
from otolith.paper.unknowns import UNKNOWNS
from otolith.paths import state_directory, writable

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
        found = crew.perform(jobs_of(names, noise=noise, quick=quick), hear)
    studies = [entry for entry in found if isinstance(entry, Study)]
    discoveries = [entry for entry in found if isinstance(entry, Discovery)]
    written: list[Path] = []
    if folder is not None:
        from otolith.paper.plots import draw  # noqa: PLC0415 - slow to load, and nobody else needs it

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


def jobs_of(names: Sequence[str], *, noise: bool, quick: bool) -> list[crew.Work]:
    """In the order of the rows, each once; a search for a noise once for each machine."""
    rows = [row_of(name) for name in NAMES if name in names or not names]
    seconds = {row.name: min(row.seconds, QUICK) if quick else row.seconds for row in rows}
    unknown = [row for row in UNKNOWNS if row.name in names or not names]
    jobs: list[crew.Work] = [Job(row, Kind.IDEAL, seconds[row.name]) for row in rows]
    for kind in (Kind.IDEAL, Kind.NOISY) if noise else (Kind.IDEAL,):
        jobs += [Search(row, kind, min(row.seconds, QUICK) if quick else row.seconds) for row in unknown]
    if noise:
        jobs += [Job(row, Kind.NOISY, seconds[row.name]) for row in rows]
        first = {row.machine: row for row in reversed(rows) if row.machine in HIDING}
        jobs += [Job(row, Kind.LIMIT, seconds[row.name]) for row in first.values()]
    return jobs


@contextmanager
def _bars() -> Iterator[Callable[[crew.Progress], None]]:
    """A bar for each job that has begun, on standard error, if somebody sees it."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[crew.Work, TaskID] = {}

        def hear(told: crew.Progress) -> None:
            if told.job not in tasks:
                tasks[told.job] = bars.add_task("", total=told.job.steps)
            bars.update(tasks[told.job], completed=told.steps, description=told.doing)

        yield hear
