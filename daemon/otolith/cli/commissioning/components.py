"""``otolith components`` and ``reset``: what a twin lacks, and forgetting what was learned."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from otolith.cli.common import AS_JSON, MACHINE_FILE, local_time, use_state_of_service
from otolith.cli.terminal import echo, echo_json

if TYPE_CHECKING:
    from otolith.adaptation.state import ComponentRecord, OperatorDecisions
    from otolith.machine import LoadedMachine
    from otolith.storage.state_store import StateStore


@click.group()
def components() -> None:
    """List discovered components, and decide what becomes of them.

    A running daemon obeys a decision from its next window on.

    \b
    Examples:
      otolith components list my-machine.toml
      otolith components approve my-machine.toml shaft/periodic/t
      otolith components reject my-machine.toml shaft/Coulomb/omega
      otolith components forget my-machine.toml shaft/periodic/t
    """


@components.command("list")
@MACHINE_FILE
@AS_JSON
def list_(file: Path, as_json: bool) -> None:
    """List components: key, equation, onset and decision.

    \b
    Example:
      otolith components list my-machine.toml
    """
    from pydantic import TypeAdapter

    from otolith.adaptation.state import ComponentRecord

    machine, store = loaded(file)
    decisions, labels = store.decisions(), store.labels()
    records = [
        replace(record, adopted=replace(record.adopted, onset=labels.unix(record.adopted.onset)))
        for record in store.components()
    ]
    if as_json:
        rows = [TypeAdapter(ComponentRecord).dump_python(record, mode="json") for record in records]
        keys = {"approved": sorted(decisions.approved), "rejected": sorted(decisions.rejected)}
        echo_json({"components": rows, **keys})
        return
    for record in records:
        onset, decision = local_time(record.adopted.onset, machine.plan.timezone), _decision(record, decisions)
        echo(f"{key_of_record(record)}  {equation_of(machine, record)}  since {onset}  {decision}")
    for key in sorted(decisions.rejected - {key_of_record(record) for record in records}):
        echo(f"{key}  rejected: not searched for")
    if not records and not decisions.rejected:
        echo(f"{machine.file.machine.name}: no component has been found", err=True)


def key_of_record(record: "ComponentRecord") -> str:
    """Return the key of a component."""
    return record.adopted.component.key


def _decision(record: "ComponentRecord", decisions: "OperatorDecisions") -> str:
    key = key_of_record(record)
    if decisions.forgotten.get(key, -math.inf) > record.adopted.onset:
        return "forgotten: it will be discovered again if it is present"
    return "approved" if key in decisions.approved else "rejected" if key in decisions.rejected else "open"


def equation_of(machine: "LoadedMachine", record: "ComponentRecord") -> str:
    """Return a component as text, with its amplitude."""
    from otolith.estimation.problem import equation, site_of
    from otolith.health.text import interval_text
    from otolith_drivers.units import equation_text

    component = record.adopted.component
    text = equation_text(equation(machine.twin, component, record.values))
    unit = site_of(machine.twin, component.site).unit
    return f"{text} (amplitude {interval_text(record.values[0], record.deviations[0], unit)})"


@components.command()
@MACHINE_FILE
@click.argument("component")
def approve(file: Path, component: str) -> None:
    """Decide that COMPONENT belongs to the healthy machine.

    It stays in the twin and is no longer reported as a finding.

    \b
    Example:
      otolith components approve my-machine.toml shaft/periodic/t
    """
    _decide(file, component, "approved", lambda rest: replace(rest, approved=rest.approved | {component}))


@components.command()
@MACHINE_FILE
@click.argument("component")
def reject(file: Path, component: str) -> None:
    """Decide that COMPONENT does not exist.

    It leaves the twin and is not searched for again.

    \b
    Example:
      otolith components reject my-machine.toml shaft/Coulomb/omega
    """
    _decide(file, component, "rejected", lambda rest: replace(rest, rejected=rest.rejected | {component}))


@components.command()
@MACHINE_FILE
@click.argument("component")
def forget(file: Path, component: str) -> None:
    """Forget COMPONENT and the decision on it.

    If the component is present, it will be discovered again.

    \b
    Example:
      otolith components forget my-machine.toml shaft/periodic/t
    """
    now = time.time()
    _decide(file, component, "forgotten", lambda rest: replace(rest, forgotten={**rest.forgotten, component: now}))


def _decide(file: Path, component: str, decision: str, add: "Callable[[OperatorDecisions], OperatorDecisions]") -> None:
    """Apply ``add`` to the decisions without ``component``; raise ConfigurationError if it was never found."""
    from otolith_drivers.errors import ConfigurationError, nearest

    _, store = loaded(file)
    found = {key_of_record(record) for record in store.components()}

    def changed(decisions: "OperatorDecisions") -> "OperatorDecisions":
        known = found | decisions.approved | decisions.rejected
        if component not in known:
            raise ConfigurationError(f"no component {component!r}: {nearest(component, sorted(known))}")
        return add(decisions.without(component))

    store.operator.change(changed)
    echo(f"{component} is {decision}")


@click.command()
@MACHINE_FILE
@click.argument("names", nargs=-1, metavar="[PARAMETER|COMPONENT]...")
@click.option("--dry-run", is_flag=True, help="Only show what would be forgotten.")
def reset(file: Path, names: tuple[str, ...], dry_run: bool) -> None:
    """Forget what was learned of the machine in FILE.

    Without names that is everything: parameters, components and accepted noise.
    A running daemon starts anew with its next window, another one when it
    starts. Approved and rejected components stay so.

    \b
    Examples:
      otolith reset my-machine.toml --dry-run
      otolith reset my-machine.toml R_a
      otolith reset my-machine.toml R_a shaft/periodic/t
      otolith reset my-machine.toml
    """
    from otolith.adaptation.state import EVERYTHING
    from otolith_drivers.errors import ConfigurationError, OtolithError, nearest

    machine, store = loaded(file)
    known = [parameter.name for parameter in machine.problem.free]
    try:
        known += map(key_of_record, store.components())
    except OtolithError as error:
        echo(f"components cannot be named: {error}", err=True)
    for name in names:
        if name not in known:
            raise ConfigurationError(f"no parameter or component {name!r}: {nearest(name, known)}")
    if not dry_run:
        times = dict.fromkeys(names or (EVERYTHING,), time.time())
        store.operator.change(lambda before: replace(before, resets={**before.resets, **times}))
    echo(*(f"{name} {'would be' if dry_run else 'is'} forgotten" for name in names or known))


def loaded(file: Path) -> "tuple[LoadedMachine, StateStore]":
    """Return the machine of a file and its store, which is that of the service if the file is installed."""
    from otolith.machine import load_machine
    from otolith.storage.state_store import store_of

    use_state_of_service(file)
    machine = load_machine(file, with_driver=False)
    machine.try_fmu()
    return machine, store_of(machine)
