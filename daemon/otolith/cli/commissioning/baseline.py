"""``otolith baseline``: relative limits refer to what the healthy machine was like."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from otolith.cli.common import MACHINE_FILE, local_time

if TYPE_CHECKING:
    from collections.abc import Mapping

    from otolith.health.prognosis import History
    from otolith.machine import LoadedMachine
    from otolith.storage.state_store import StateStore


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
    from otolith.machine import load_machine
    from otolith.storage.state_store import store_of

    machine = load_machine(file, with_driver=False)
    store = store_of(machine)
    if clear:
        store.save_decisions(replace(store.decisions(), baselines={}))
        click.echo("limits in percent refer to the nominal values of the machine file")
    else:
        keep_baseline(machine, store, store.histories())


def keep_baseline(machine: "LoadedMachine", store: "StateStore", histories: "Mapping[str, History]") -> None:
    """Store the baselines of ``histories``, and print them.

    Raises:
        ConfigurationError: no parameter with limits has enough estimates.
    """
    from otolith.health.baseline import baselines
    from otolith.health.prognosis import MIN_POINTS
    from otolith.health.text import interval_text
    from otolith_drivers.errors import ConfigurationError

    limited = {name: row for name, row in machine.plan.parameters.items() if row.limits}
    kept = {name: item for name, item in baselines(histories).items() if name in limited}
    if not kept:
        names = ", ".join(limited) or "none"
        needed = f"a parameter with limits ({names}) needs {MIN_POINTS} estimates: let 'otolith run' estimate it first"
        raise ConfigurationError(f"{machine.path}: no baseline: {needed}")
    store.save_decisions(replace(store.decisions(), baselines={**store.decisions().baselines, **kept}))
    for name, item in kept.items():
        text = interval_text(item.value, item.sd, limited[name].unit)
        click.echo(f"baseline {name} = {text}, mean of {item.windows} estimates until {local_time(item.end)}", err=True)
    for name in limited.keys() - kept.keys():
        click.echo(f"{name} has fewer than {MIN_POINTS} estimates: its limits stay as they were", err=True)
