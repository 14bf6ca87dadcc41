"""Changes of simulated machines, and what the reports state of them."""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import click
from rich.console import Console, RenderableType
from rich.table import Table

from benchmarks.changes import calibration, classes, healthy, steps
from benchmarks.changes.observe import in_processes, observe_all

PROCESSES = 2
FILE_WIDTH = 200  # columns, if the output is no terminal
Command = Callable[..., None]


def _options(command: Command) -> Command:
    """Add the options of all commands."""
    for option in (
        click.option("--json", "as_json", is_flag=True, help="Print a JSON document."),
        click.option("--processes", default=PROCESSES, show_default=True, type=click.IntRange(1, PROCESSES)),
        click.option("--seed", default=1, show_default=True),
        click.option("--runs", default=20, show_default=True, type=click.IntRange(1), help="Runs of each case."),
    ):
        command = option(command)
    return command


def _windows(command: Command) -> Command:
    """Add the options for the number of windows."""
    for option in (
        click.option("--changed", default=12, show_default=True, help="Windows after the change."),
        click.option("--healthy", default=12, show_default=True, help="Windows before the change."),
    ):
        command = option(command)
    return command


@click.group(help=__doc__, context_settings={"max_content_width": 80})
def main() -> None:
    """All commands."""


@main.command("classes")
@click.argument("names", nargs=-1)
@_windows
@_options
def classes_command(
    names: tuple[str, ...], healthy: int, changed: int, runs: int, seed: int, processes: int, *, as_json: bool
) -> None:
    """Changes that the data cannot distinguish, or can.

    Only pairs and changes whose names contain one of NAMES; all by default. The exit code is 1 if a target is missed.
    """
    trials = _selected(classes.trials(healthy, changed), names, lambda trial: f"{trial.pair}: {trial.truth}")
    results = observe_all([trial.case for trial in trials], runs, seed, processes)
    summaries = [classes.summarise(trial, own) for trial, own in zip(trials, results, strict=True)]
    documents = list(map(classes.document, summaries))
    table = Table("pair", "truth", "expected", "right", "verdicts", "first", "equal", "coverage", "met")
    for own in documents:
        verdicts = ", ".join(f"{count} {name}" for name, count in own["verdicts"].items() if name)
        covered = ", ".join(f"{name} {share:.0%}" for name, share in own["coverage"].items())
        equal = "" if own["equal"] is None else f"{own['equal']:.0%}"
        first = "" if own["first"] is None else str(own["first"])
        row = (own["pair"], own["truth"], own["expected"], f"{own['right']:.1%}", verdicts, first, equal, covered)
        table.add_row(*row, "yes" if own["met"] else "no")
    _finish(documents, table, as_json=as_json)


@main.command("steps")
@click.argument("names", nargs=-1)
@_windows
@_options
def steps_command(
    names: tuple[str, ...], healthy: int, changed: int, runs: int, seed: int, processes: int, *, as_json: bool
) -> None:
    """Steps of 20 % of each parameter of the library's twins.

    Only steps whose names contain one of NAMES; all by default. The exit code is 1 if a target is missed.
    """
    selected = _selected(steps.steps(healthy, changed), names, lambda step: step.case.name)
    results = observe_all([step.case for step in selected], runs, seed, processes)
    documents = [steps.summarise(step, own) for step, own in zip(selected, results, strict=True)]
    table = Table("case", "held", "published", "half-width", "sensor", "others", "statuses", "met")
    for own in documents:
        others = ", ".join(f"{name} {share:.0%}" for name, share in own["others"].items())
        statuses = ", ".join(f"{count} {name}" for name, count in own["statuses"].items())
        width = "" if own["half_width"] is None else f"{own['half_width']:.2%}"
        row = (
            own["case"],
            f"{own['held']:.1%}",
            f"{own['published']:.0%}",
            width,
            f"{own['sensor']:.1%}",
            others,
            statuses,
        )
        table.add_row(*row, "yes" if own["met"] else "no")
    _finish(documents, table, as_json=as_json)


@main.command("healthy")
@click.argument("names", nargs=-1)
@click.option("--windows", default=25, show_default=True, help="Windows of each run.")
@_options
def healthy_command(
    names: tuple[str, ...], windows: int, runs: int, seed: int, processes: int, *, as_json: bool
) -> None:
    """Healthy machines with ripple, quantisation, jitter or wear.

    Only cases whose names contain one of NAMES; all by default. The exit code is 1 if a component is adopted or a
    verdict stated.
    """
    cases = _selected(healthy.cases(windows, names), names, lambda case: case.name)
    results = observe_all(cases, runs, seed, processes)
    documents = [healthy.summarise(case, own) for case, own in zip(cases, results, strict=True)]
    table = Table("case", "windows", "adopted", "verdicts", "per 1000", "open", "cost", "held", "met")
    for own in documents:
        held = ", ".join(f"{name} {share:.0%}" for name, share in own["held"].items())
        rate = f"{1e3 * (own['adopted'] + own['verdicts']) / own['windows']:.1f}"
        row = (own["case"], *(str(own[key]) for key in ("windows", "adopted", "verdicts")), rate, str(own["open"]))
        table.add_row(*row, f"{own['cost']:.2f}", held, "yes" if own["met"] else "no")
    _finish(documents, table, as_json=as_json)


@main.command("calibration")
@click.option("--list", "listed", is_flag=True, help="Print a line for each case.")
@_options
def calibration_command(runs: int, seed: int, processes: int, *, listed: bool, as_json: bool) -> None:
    """Stated probabilities beside the shares that are right.

    Each run is a random case. The exit code is 1 if hypotheses of 95 % and more are right in less than 90 %.
    """
    results = in_processes([partial(calibration.run_case, number, seed) for number in range(runs)], processes)
    bins, decisions = calibration.table(results), calibration.decisions(results)
    if as_json:
        cases = [asdict(result) for result in results]
        click.echo(json.dumps({"bins": bins, "decisions": decisions, "cases": cases}, indent=2))
    else:
        stated = Table("stated", "hypotheses", "mean", "right")
        for row in bins:
            ends = f"{row['low']:.0%} to {row['high']:.0%}"
            stated.add_row(ends, str(row["count"]), f"{row['probability']:.1%}", f"{row['right']:.1%}")
        kinds = Table("change", "decision", "cases", "most probable is right")
        for row in decisions:
            kinds.add_row(row["kind"], row["decision"], str(row["count"]), f"{row['right']:.0%}")
        lines = [f"{'right' if result.right else 'wrong'}: {result.name}: {result.text}" for result in results]
        _print(stated, kinds, *(lines if listed else ()))
    sys.exit(0 if calibration.met(results) else 1)


def _selected(items: list[Any], names: Sequence[str], name_of: Callable[[Any], str]) -> list[Any]:
    chosen = [item for item in items if not names or any(name in name_of(item) for name in names)]
    if not chosen:
        raise click.BadParameter("no case's name contains one of them", param_hint="NAMES")
    return chosen


def _finish(documents: list[dict[str, Any]], table: Table, *, as_json: bool) -> None:
    """Print the results; exit code 1 if one misses its target."""
    if as_json:
        click.echo(json.dumps(documents, indent=2))
    else:
        _print(table)
    sys.exit(0 if all(own["met"] for own in documents) else 1)


def _print(*items: RenderableType) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=FILE_WIDTH)
    for item in items:
        console.print(item, markup=False, highlight=False)


if __name__ == "__main__":
    main()
