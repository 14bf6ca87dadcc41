"""``otolith components``, ``reset``, ``baseline``, ``commission``: what a twin lacks, and what the machine is like."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from otolith.cli.common import (
    AS_JSON,
    DATA_FILE,
    MACHINE_FILE,
    echo_warnings,
    local_time,
    progress_line,
    use_state_of_service,
)
from otolith.cli.terminal import echo, echo_json

if TYPE_CHECKING:
    from otolith.adaptation.state import AdaptationState, ComponentRecord, OperatorDecisions
    from otolith.health.prognosis import History
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

    machine, store = _store(file)
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
        onset, decision = local_time(record.adopted.onset), _decision(record, decisions)
        echo(f"{_key(record)}  {_equation(machine, record)}  since {onset}  {decision}")
    for key in sorted(decisions.rejected - {_key(record) for record in records}):
        echo(f"{key}  rejected: not searched for")
    if not records and not decisions.rejected:
        echo(f"{machine.file.machine.name}: no component has been found", err=True)


def _key(record: "ComponentRecord") -> str:
    return record.adopted.component.key


def _decision(record: "ComponentRecord", decisions: "OperatorDecisions") -> str:
    key = _key(record)
    if decisions.forgotten.get(key, -math.inf) > record.adopted.onset:
        return "forgotten: it will be discovered again if it is present"
    return "approved" if key in decisions.approved else "rejected" if key in decisions.rejected else "open"


def _equation(machine: "LoadedMachine", record: "ComponentRecord") -> str:
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

    _, store = _store(file)
    decisions = store.decisions()
    known = {_key(record) for record in store.components()} | decisions.approved | decisions.rejected
    if component not in known:
        raise ConfigurationError(f"no component {component!r}: {nearest(component, sorted(known))}")
    rest = replace(decisions, approved=decisions.approved - {component}, rejected=decisions.rejected - {component})
    store.save_decisions(add(rest))
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

    machine, store = _store(file)
    decisions, known = store.decisions(), [parameter.name for parameter in machine.problem.free]
    try:
        known += map(_key, store.components())
    except OtolithError as error:
        echo(f"components cannot be named: {error}", err=True)
    for name in names:
        if name not in known:
            raise ConfigurationError(f"no parameter or component {name!r}: {nearest(name, known)}")
    if not dry_run:
        times = dict.fromkeys(names or (EVERYTHING,), time.time())
        store.save_decisions(replace(decisions, resets={**decisions.resets, **times}))
    echo(*(f"{name} {'would be' if dry_run else 'is'} forgotten" for name in names or known))


def _store(file: Path) -> "tuple[LoadedMachine, StateStore]":
    from otolith.machine import load_machine
    from otolith.storage.state_store import store_of

    use_state_of_service(file)
    machine = load_machine(file, with_driver=False)
    return machine, store_of(machine)


@click.command()
@MACHINE_FILE
@DATA_FILE
@click.option("--yes", is_flag=True, help="Approve every component that is found.")
@click.option("--windows", type=click.IntRange(1, 1000), default=30, help="At most so many windows for the noise.")
def commission(file: Path, data: Path, yes: bool, windows: int) -> None:
    """Identify what is normal for the machine in FILE.

    Searches DATA, recorded from the healthy machine, for components that the twin lacks, and identifies the noise
    levels. You decide for each component whether
    it belongs to the machine; afterwards only a change is a finding. Stop the daemon before: it starts with the result.

    \b
    Examples:
      otolith commission my-machine.toml monday.csv
      otolith commission my-machine.toml monday.csv --yes
    """
    machine, store = _store(file)
    with store.locked():
        _commission(machine, store, data, windows, approve_all=yes)


def _commission(machine: "LoadedMachine", store: "StateStore", data: Path, windows: int, *, approve_all: bool) -> None:
    from otolith.adaptation.state import ComponentRecord
    from otolith.cli.commissioning.noise import identified_record, noise_lines
    from otolith.commissioning.identification import explains_no_window
    from otolith_drivers.errors import OtolithError

    record = identified_record(machine, data, windows)
    identified = record.noise_beside(machine) if record.offered else record.noise
    components = tuple(ComponentRecord.of(item) for item in record.offered)
    is_useless = bool(components) or explains_no_window(machine.problem, record.noise, record.windows[0])
    state = None if is_useless else _replayed(machine, data)
    if state is None or not state.adopted:  # the file's noise levels may have hidden a component
        state = _replayed(replace(machine, problem=identified.applied(machine.problem)), data, components)
    echo(*noise_lines(machine, identified))
    if record.offered:
        echo("# this process noise is right with the components below: if you approve them, put it into the file")
    elif state.adopted:
        echo("# this process noise contains the components below: keep that of the file if you approve them")
    else:
        echo("# put these tables into the machine file in place of its own", err=True)
    _review(machine, store, state, components, approve_all=approve_all)
    try:
        keep_baseline(machine, store, state.health.histories)
    except OtolithError as error:  # nothing that has limits, or a record that is too short
        echo(*str(error).split("\n"), err=True)


def _replayed(
    machine: "LoadedMachine", data: Path, components: "tuple[ComponentRecord, ...]" = ()
) -> "AdaptationState":
    """The state after all windows of the data, with ``components`` in the twin from the first window on.

    Findings and warnings are printed to standard error.
    """
    from otolith.adaptation.state import restore_components
    from otolith.runtime.replay import Replay, open_recorded

    with open_recorded(machine, data) as recorded, progress_line("replay") as show:
        run = Replay(machine, recorded)
        run.state = restore_components(run.state, components)
        for report in run.reports():
            show(f"window {report.document.window.index}, {run.progress:.0%} of the data")
            for finding in report.document.findings:
                echo(f"window {report.document.window.index}: {finding.text}", err=True)
        echo_warnings(data, run.warnings())
        return run.state


def _review(
    machine: "LoadedMachine",
    store: "StateStore",
    state: "AdaptationState",
    pooled: "tuple[ComponentRecord, ...]",
    *,
    approve_all: bool,
) -> None:
    """Ask for a decision on each component, keep the approved ones, and print the estimated parameters.

    The values of ``pooled`` components are kept: all windows together are more precise than the filter after them.
    """
    from otolith.adaptation.state import component_records
    from otolith.health.text import interval_text

    precise = {_key(record): record for record in pooled}
    records = tuple(precise.get(_key(record), record) for record in component_records(state))
    approved, rejected = set[str](), set[str]()
    for record in records:
        echo(f"found {_key(record)}: {_equation(machine, record)}", err=True)
        (approved if approve_all or _is_healthy() else rejected).add(_key(record))
    decisions = store.decisions()
    if store.components_path.exists():
        echo(f"what was learned before is kept as {store.set_aside()}", err=True)
    store.save_components(tuple(record for record in records if _key(record) in approved))
    rejected = {*decisions.rejected, *rejected} - approved
    store.save_decisions(replace(decisions, approved=decisions.approved | approved, rejected=frozenset(rejected)))
    if not records:
        echo("no component was found: the twin explains the machine up to the noise", err=True)
    posterior = state.posterior.prior()
    for index, parameter in enumerate(state.problem.free):
        if not parameter.name.startswith("_"):
            mean, variance = float(posterior.mean[index]), float(posterior.covariance[index, index])
            echo(f"{parameter.name} = {interval_text(mean, variance**0.5, parameter.unit)}", err=True)


def _is_healthy() -> bool:
    try:
        return click.confirm(
            "does it belong to the healthy machine? (n rejects it: it is not searched for again)", err=True
        )
    except click.Abort:
        echo("", "no answer: nothing is kept; answer y or n, or give --yes", err=True)
        raise


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
    machine, store = _store(file)
    if clear:
        store.save_decisions(replace(store.decisions(), baselines={}))
        echo("limits in percent refer to the nominal values of the machine file")
    else:
        keep_baseline(machine, store, store.histories())


def keep_baseline(machine: "LoadedMachine", store: "StateStore", histories: "Mapping[str, History]") -> None:
    """Store and print the baselines of ``histories``; raise ConfigurationError if there are too few estimates."""
    from otolith.health.limits import Level
    from otolith.health.prognosis import MIN_POINTS, baselines
    from otolith.health.text import interval_text
    from otolith_drivers.errors import ConfigurationError
    from otolith_drivers.units import quantity_text

    limited = {name: row for name, row in machine.plan.parameters.items() if row.limits}
    kept = {name: item for name, item in baselines(histories).items() if name in limited}
    if not kept:
        names = ", ".join(limited) or "none"
        needed = f"a parameter with limits ({names}) needs {MIN_POINTS} estimates: let 'otolith run' estimate it first"
        raise ConfigurationError(f"{machine.path}: no baseline: {needed}")
    store.save_decisions(replace(store.decisions(), baselines={**store.decisions().baselines, **kept}))
    for name, item in kept.items():
        text, end = interval_text(item.value, item.sd, limited[name].unit), store.labels().unix(item.end)
        echo(f"baseline {name} = {text}, mean of {item.windows} estimates until {local_time(end)}", err=True)
        level, limit = limited[name].level(item.value, item.sd, Level.OK)
        if limit is not None:
            beyond = f"{level} {limit.side} {quantity_text(limit.value, limited[name].unit)}"
            echo(f"{name}: beyond its limit {beyond}; if the machine is not healthy, undo it: --clear", err=True)
    for name in limited.keys() - kept.keys():
        echo(f"{name} has fewer than {MIN_POINTS} estimates: its limits stay as they were", err=True)
