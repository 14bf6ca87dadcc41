"""Changes of simulated machines, and what the reports state of them."""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
from rich.table import Table

from benchmarks.changes import calibration, classes, healthy, reports, steps
from benchmarks.changes.observe import CHANGED_WINDOWS, HEALTHY_WINDOWS, observe_all
from benchmarks.command_line import Options, in_processes, print_pages, with_options

Command = Callable[..., None]


def _runs(command: Command) -> Command:
    """Add the options of all commands."""
    runs = click.option("--runs", default=20, show_default=True, type=click.IntRange(1), help="Runs of each case.")
    return runs(with_options(command))


def _cases(command: Command) -> Command:
    """Add the options and the argument of the commands whose cases have a change."""
    for option in (
        click.option("--changed", default=CHANGED_WINDOWS, show_default=True, help="Windows after the change."),
        click.option("--healthy", default=HEALTHY_WINDOWS, show_default=True, help="Windows before the change."),
        click.option(
            "--onset",
            default=0.0,
            show_default=True,
            type=click.FloatRange(0.0, 1.0, max_open=True),
            help="Share of a window before the change.",
        ),
        click.argument("names", nargs=-1),
    ):
        command = option(command)
    return _runs(command)


@click.group(help=__doc__, context_settings={"max_content_width": 80})
def main() -> None:
    """All commands."""


@main.command("classes")
@_cases
def classes_command(
    options: Options, names: tuple[str, ...], healthy: int, onset: float, changed: int, runs: int
) -> None:
    """Changes that the data cannot distinguish, or can.

    Only pairs and changes whose names contain one of NAMES; all by default. The exit code is 1 if a target is missed.
    """
    trials = _selected(classes.trials(healthy, changed), names, lambda trial: f"{trial.pair}: {trial.truth}")
    results = observe_all([replace(trial.case, onset=onset) for trial in trials], runs, options.seed, options.processes)
    summaries = [classes.summarise(trial, own) for trial, own in zip(trials, results, strict=True)]
    documents = list(map(classes.document, summaries))
    table = Table("pair", "truth", "expected", "right", "verdicts", "first", "equal", "coverage", "met")
    for own in documents:
        verdicts = ", ".join(f"{count} {name}" for name, count in own["verdicts"].items() if name)
        covered = _by_name(own["coverage"])
        equal = "" if own["equal"] is None else f"{own['equal']:.0%}"
        first = "" if own["first"] is None else str(own["first"])
        row = (own["pair"], own["truth"], own["expected"], f"{own['right']:.1%}", verdicts, first, equal, covered)
        table.add_row(*row, "yes" if own["met"] else "no")
    _finish(documents, table, options)


@main.command("steps")
@_cases
def steps_command(
    options: Options, names: tuple[str, ...], healthy: int, onset: float, changed: int, runs: int
) -> None:
    """Steps of 20 % of each parameter of the library's twins.

    Only steps whose names contain one of NAMES; all by default. The exit code is 1 if a target is missed.
    """
    selected = _selected(steps.steps(healthy, changed), names, lambda step: step.case.name)
    results = observe_all([replace(step.case, onset=onset) for step in selected], runs, options.seed, options.processes)
    documents = [steps.summarise(step, own) for step, own in zip(selected, results, strict=True)]
    table = Table("case", "held", "published", "half-width", "sensor", "others", "statuses", "met")
    for own in documents:
        statuses = ", ".join(f"{count} {name}" for name, count in own["statuses"].items())
        width = "" if own["half_width"] is None else f"{own['half_width']:.2%}"
        row = (
            own["case"],
            _percent(own["held"]),
            f"{own['published']:.0%}",
            width,
            f"{own['sensor']:.1%}",
            _by_name(own["others"]),
            statuses,
        )
        table.add_row(*row, "yes" if own["met"] else "no")
    _finish(documents, table, options)


@main.command("healthy")
@click.argument("names", nargs=-1)
@click.option("--windows", default=25, show_default=True, help="Windows of each run.")
@_runs
def healthy_command(options: Options, names: tuple[str, ...], windows: int, runs: int) -> None:
    """Healthy machines with ripple, quantisation, jitter or wear.

    Only cases whose names contain one of NAMES; all by default. The exit code is 1 if a component is adopted or a
    verdict stated.
    """
    cases = _selected(healthy.cases(windows, names), names, lambda case: case.name)
    results = observe_all(cases, runs, options.seed, options.processes)
    documents = [healthy.summarise(case, own) for case, own in zip(cases, results, strict=True)]
    table = Table("case", "windows", "adopted", "verdicts", "per 1000", "open", "cost", "held", "met")
    for own in documents:
        rate = f"{1e3 * (own['adopted'] + own['verdicts']) / own['windows']:.1f}"
        row = (own["case"], *(str(own[key]) for key in ("windows", "adopted", "verdicts")), rate, str(own["open"]))
        table.add_row(*row, f"{own['cost']:.2f}", _by_name(own["held"]), "yes" if own["met"] else "no")
    _finish(documents, table, options)


@main.command("calibration")
@click.option("--list", "listed", is_flag=True, help="Print a line for each case.")
@_runs
def calibration_command(options: Options, runs: int, *, listed: bool) -> None:
    """Stated probabilities beside the shares that are right.

    Each run is a random case. The exit code is 1 if hypotheses of 95 % and more are right in less than 90 %.
    """
    jobs = [partial(calibration.run_case, number, options.seed) for number in range(runs)]
    results = in_processes(jobs, options.processes)
    bins, decisions = calibration.table(results), calibration.decisions(results)
    if options.as_json:
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
        print_pages(stated, kinds, *(lines if listed else ()))
    sys.exit(0 if calibration.met(results) else 1)


@main.command("reports")
@click.argument("names", nargs=-1)
@click.option("--against", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="File of --json before.")
@with_options
def reports_command(options: Options, names: tuple[str, ...], against: Path | None) -> None:
    """Reports of fixed runs, to show that a change of the code leaves them as they were.

    Only runs whose names contain one of NAMES; all by default. The exit code is 1 if one differs from the file AGAINST
    by more than 1e-6 of a number.
    """
    selected = _selected(reports.names(), names, str)
    results = in_processes([partial(reports.run, name, options.seed) for name in selected], options.processes)
    documents = dict(zip(selected, results, strict=True))
    if options.as_json:
        click.echo(json.dumps(documents))
        return
    before = {} if against is None else json.loads(against.read_text())
    table = Table("run", "fingerprint", "decisions", "against the file")
    is_close = True
    for name, own in documents.items():
        difference = reports.compare(own, before[name]) if name in before else None
        is_close = is_close and (difference is None or difference.is_close)
        decisions = " ".join(document["decision"][:10] for document in own)
        table.add_row(name, reports.fingerprint(own), decisions, "" if difference is None else difference.text)
    print_pages(table)
    sys.exit(0 if is_close else 1)


def _selected(items: list[Any], names: Sequence[str], name_of: Callable[[Any], str]) -> list[Any]:
    chosen = [item for item in items if not names or any(name in name_of(item) for name in names)]
    if not chosen:
        raise click.BadParameter("no case's name contains one of them", param_hint="NAMES")
    return chosen


def _finish(documents: list[dict[str, Any]], table: Table, options: Options) -> None:
    """Print the results; exit code 1 if one misses its target."""
    if options.as_json:
        click.echo(json.dumps(documents, indent=2))
    else:
        print_pages(table)
    sys.exit(0 if all(own["met"] for own in documents) else 1)


def _by_name(shares: Mapping[str, float | None]) -> str:
    return ", ".join(f"{name} {_percent(share)}" for name, share in shares.items())


def _percent(share: float | None) -> str:
    """Return a share as text; None is the share of no interval at all."""
    return "no interval" if share is None else f"{share:.1%}"


if __name__ == "__main__":
    main()
