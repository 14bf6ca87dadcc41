"""What the command lines of the benchmarks share: options, child processes, progress and tables."""

import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import wraps
from multiprocessing import get_context
from typing import Any, TypeVar

import click
from rich.console import Console, RenderableType

Result = TypeVar("Result")
PROCESSES = 2
FILE_WIDTH = 250  # columns, if the output is no terminal


@dataclass(frozen=True, slots=True)
class Options:
    """The options of every benchmark."""

    seed: int
    processes: int
    as_json: bool


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options of every benchmark, which the command gets as its first argument."""

    @click.option("--seed", default=1, show_default=True)
    @click.option("--processes", default=PROCESSES, show_default=True, type=click.IntRange(1, PROCESSES))
    @click.option("--json", "as_json", is_flag=True, help="Print a JSON document.")
    @wraps(command)
    def with_one_object(*, seed: int, processes: int, as_json: bool, **others: Any) -> None:
        command(Options(seed, processes, as_json), **others)

    return with_one_object


def in_processes(jobs: Sequence[Callable[[], Result]], processes: int) -> list[Result]:
    """Return the results of the jobs, in their order; progress goes to the standard error. One process is this one."""
    if processes == 1:
        results = []
        for job in jobs:
            results.append(job())
            show_progress(len(results), len(jobs), "parts")
        return results
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        pending = [pool.submit(job) for job in jobs]
        for count, _ in enumerate(as_completed(pending), 1):
            show_progress(count, len(jobs), "parts")
    return [future.result() for future in pending]


def show_progress(count: int, total: int, what: str) -> None:
    """Print to the standard error how many are done: one line on a terminal, else a line for each tenth."""
    text = f"{count} of {total} {what}"
    if sys.stderr.isatty():
        print(f"\r{text}", end="\n" if count == total else "", file=sys.stderr, flush=True)
    elif 10 * count // total > 10 * (count - 1) // total:
        print(text, file=sys.stderr, flush=True)


def print_pages(*pages: RenderableType) -> None:
    """Print tables and lines."""
    console = Console() if sys.stdout.isatty() else Console(width=FILE_WIDTH)
    for page in pages:
        console.print(page, markup=not isinstance(page, str), highlight=False)
