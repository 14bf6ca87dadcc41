"""``otolith baseline``: the values of the healthy machine, to which limits in percent refer."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from otolith.cli.commissioning.components import loaded
from otolith.cli.common import MACHINE_FILE, local_time
from otolith.cli.terminal import echo

if TYPE_CHECKING:
    from otolith.health.labels import TimeLabels
    from otolith.health.prognosis import Baseline, History
    from otolith.machine import LoadedMachine
    from otolith.storage.state_store import StateStore

MORE_MOTION = "record more changes of speed and load, or set the baseline later by 'otolith baseline'"


@click.command()
@MACHINE_FILE
@click.option("--clear", is_flag=True, help="Return to the nominal values of FILE.")
def baseline(file: Path, clear: bool) -> None:
    """Take the present values of the machine in FILE as baseline.

    It must be healthy. The values are the means of the saved estimates. Limits in percent refer to them
    from then on, also those of a running daemon, with its next window.

    \b
    Examples:
      otolith baseline my-machine.toml
      otolith baseline my-machine.toml --clear
    """
    machine, store = loaded(file)
    if clear:
        store.operator.change(lambda before: replace(before, baselines={}))
        echo("limits in percent refer to the values that the machine file states; others are not judged")
    else:
        keep_baseline(machine, store, store.histories(), {}, store.model())


def keep_baseline(
    machine: "LoadedMachine",
    store: "StateStore",
    histories: "Mapping[str, History]",
    advice: Mapping[str, str],
    model: str,
    *,
    labels: "TimeLabels | None" = None,
) -> None:
    """Store and print the baselines of ``histories``, and of each parameter with limits that has none why.

    They were found with the twin and the values of the fingerprint ``model``; a daemon with others does not use them.
    Times of ``histories`` are those of the service; with ``labels`` they are Unix times.

    Raises:
        ConfigurationError: no parameter has a baseline.
    """
    from otolith.cli.commissioning.check import lines_without_limits
    from otolith.health.prognosis import find_baseline
    from otolith_drivers.errors import ConfigurationError

    limited = {name: row for name, row in machine.plan.parameters.items() if row.has_limits}
    found = {name: find_baseline(histories.get(name, ()), row) for name, row in limited.items()}
    kept = {name: replace(row.baseline, model=model) for name, row in found.items() if row.baseline is not None}
    if labels is not None:
        kept = {name: replace(item, end=labels.last(item.end)) for name, item in kept.items()}
    if kept:
        store.operator.change(lambda before: replace(before, baselines={**before.baselines, **kept}))
    lines = list[str]()
    for name, search in found.items():
        if (item := kept.get(name)) is not None:
            lines += _baseline_lines(machine, labels or store.labels(), name, item)
        else:
            then = "its limits wait for one" if limited[name].waiting else "its limits stay as they were"
            lines.append(f"{name}: no baseline, {then}: {search.reason}")
        if item is None or search.reason:
            lines += [f"  {name} is not known well: {search.reason}"] if item is not None else []
            lines.append(f"  what would determine it: {advice.get(name) or MORE_MOTION}")
        if search.vague:
            few = f"{search.vague} estimates of {name} are not counted"
            why = f"near standstill, or without a change, a window shows it to ±{search.interval:.2g} only"
            lines.append(f"  {few}: {why}")
    lines += lines_without_limits(machine)
    if not kept:
        lines.insert(0, f"no baseline: {'none of its parameters has limits' if not limited else 'too little is known'}")
        raise ConfigurationError("\n".join(f"{machine.path}: {line.strip()}" for line in lines))
    echo(*lines, err=True)


def _baseline_lines(machine: "LoadedMachine", labels: "TimeLabels", name: str, item: "Baseline") -> Iterator[str]:
    from otolith.health.limits import Level
    from otolith.health.text import interval_text
    from otolith_drivers.units import quantity_text

    row = machine.plan.parameters[name]
    text, end = interval_text(item.value, item.sd, row.unit), labels.unix(item.end)
    yield f"baseline {name} = {text}, mean of {item.windows} estimates until {local_time(end, machine.plan.timezone)}"
    level, limit = row.level(item.value, item.sd, Level.OK)
    if limit is not None:
        beyond = f"{level} {limit.side} {quantity_text(limit.value, row.unit)}"
        undo = "if the machine is not healthy, undo it: otolith baseline --clear"
        yield f"{name}: beyond its limit {beyond}; {undo}"
