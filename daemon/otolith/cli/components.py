"""``otolith components`` and ``otolith commission``: what the twin of a machine lacks, and what belongs to it."""

import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

if TYPE_CHECKING:
    from otolith.adaptation.state import AdaptationState, ComponentRecord, OperatorDecisions
    from otolith.machine import LoadedMachine
    from otolith.runtime.state_store import StateStore


FILE = click.Path(path_type=Path, dir_okay=False)


@click.group()
def components() -> None:
    """List the components that were found in a machine, and say what they are.

    A running daemon hears what is said here with its next window, and a later one when it starts.

    \b
    Examples:
      otolith components list my-machine.toml
      otolith components approve my-machine.toml shaft/periodic/t
      otolith components reject my-machine.toml shaft/Coulomb/omega
      otolith components forget my-machine.toml shaft/periodic/t
    """


@components.command("list")
@click.argument("file", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def list_them(file: Path, as_json: bool) -> None:
    """List the components of the machine in FILE."""
    import json

    from pydantic import TypeAdapter

    from otolith.adaptation.state import ComponentRecord

    plan, keeper = _keeper(file)
    found, decisions = keeper.components(), keeper.decisions()
    if as_json:
        rows = [TypeAdapter(ComponentRecord).dump_python(entry, mode="json") for entry in found]
        said = {"approved": sorted(decisions.approved), "rejected": sorted(decisions.rejected)}
        click.echo(json.dumps({"components": rows, **said}, ensure_ascii=False))
        return
    for entry in found:
        key = entry.adopted.component.key
        word = "approved" if key in decisions.approved else "rejected" if key in decisions.rejected else "open"
        if decisions.forgotten.get(key, 0.0) > entry.adopted.onset:
            word = "forgotten: it will be found anew if it is there"
        click.echo(f"{key}  {_words(plan, entry)}  since {_moment(entry.adopted.onset)}  {word}")
    known = {entry.adopted.component.key for entry in found}
    for key in sorted(decisions.rejected - known):
        click.echo(f"{key}  is not looked for: rejected")
    if not found and not decisions.rejected:
        click.echo(f"{plan.file.machine.name}: no component has been found", err=True)


def _moment(seconds: float) -> str:
    return time.strftime("%F %T", time.localtime(seconds))


def _words(plan: "LoadedMachine", entry: "ComponentRecord") -> str:
    from otolith.estimation.augmented import equation

    sd = f" (amplitude ± {1.96 * entry.deviations[0]:.2g})"
    return equation(plan.twin, entry.adopted.component, entry.values) + sd


@components.command()
@click.argument("file", type=FILE)
@click.argument("component")
def approve(file: Path, component: str) -> None:
    """COMPONENT belongs to the healthy machine: it stays in the twin and is no finding."""
    _say(file, component, "approved", lambda said: replace(said, approved=said.approved | {component}))


@components.command()
@click.argument("file", type=FILE)
@click.argument("component")
def reject(file: Path, component: str) -> None:
    """COMPONENT is none: it leaves the twin and is not looked for again."""
    _say(file, component, "rejected", lambda said: replace(said, rejected=said.rejected | {component}))


@components.command()
@click.argument("file", type=FILE)
@click.argument("component")
def forget(file: Path, component: str) -> None:
    """Forget COMPONENT and what was said of it: if it is there, it will be found anew."""
    moment = time.time()
    _say(file, component, "forgotten", lambda said: replace(said, forgotten={**said.forgotten, component: moment}))


def _say(file: Path, component: str, word: str, more: "Callable[[OperatorDecisions], OperatorDecisions]") -> None:
    """Keep ``more`` in the place of what has been said of ``component``."""
    _, keeper = _keeper(file)
    keeper.decide(more(_unsaid(keeper, component)))
    click.echo(f"{component} is {word}")


def _keeper(file: Path) -> "tuple[LoadedMachine, StateStore]":
    from otolith.machine import load_machine
    from otolith.runtime.state_store import StateStore

    plan = load_machine(file, with_driver=False)
    return plan, StateStore(
        plan.file.machine.site, plan.file.machine.name, plan.twin, signal_fingerprint=plan.signal_fingerprint
    )


def _unsaid(keeper: "StateStore", component: str) -> "OperatorDecisions":
    """What has been said, but for what was said of ``component``.

    Raises:
        ConfigurationError: it has never been heard of; with the nearest one that has.
    """
    from otolith_drivers.errors import ConfigurationError, nearest

    said = keeper.decisions()
    known = {entry.adopted.component.key for entry in keeper.components()} | said.approved | said.rejected
    if component not in known:
        raise ConfigurationError(f"no component {component!r}: {nearest(component, sorted(known))}")
    return replace(said, approved=said.approved - {component}, rejected=said.rejected - {component})


@click.command()
@click.argument("file", type=FILE)
@click.argument("data", type=FILE)
@click.option("--yes", is_flag=True, help="Every component that is found belongs to the healthy machine.")
@click.option("--windows", type=click.IntRange(1, 1000), default=30, show_default=True, help="To learn noise from.")
def commission(file: Path, data: Path, yes: bool, windows: int) -> None:
    """Learn what is normal for the machine in FILE from the table DATA, recorded while it was in good health.

    Looks for components that the twin lacks, and learns the levels of noise. You say of each component whether it
    belongs to the machine; afterwards only change is a finding. The daemon knows what you approved when it starts.

    \b
    Examples:
      otolith commission my-machine.toml monday.csv
      otolith commission my-machine.toml monday.csv --yes
    """
    from otolith.cli.noise import learned_noise, lines_of

    signal.signal(signal.SIGINT, signal.default_int_handler)
    plan, keeper = _keeper(file)
    state = _lived(plan, data)
    found = learned_noise(plan, data, windows)
    if not state.catalogue:  # what the noise of the file may have hidden
        state = _lived(replace(plan, problem=found.applied(plan.problem)), data)
    for line in lines_of(plan, found):
        click.echo(line)
    if state.catalogue:
        click.echo(
            "# process noise was learned without the components below and contains them: keep what the file says"
        )
    click.echo("# put these tables into the machine file in place of its own", err=True)
    _ask(plan, keeper, state, yes=yes)


def _lived(plan: "LoadedMachine", data: Path) -> "AdaptationState":
    """The state after all windows of the table."""
    from otolith.runtime.replay import Replay, open_recorded

    with open_recorded(plan, data) as recorded:
        run = Replay(plan, recorded)
        for report in run.reports():
            for line in _told(report.document.findings):
                click.echo(f"window {report.document.window.index}: {line}", err=True)
        for line in run.warnings():
            click.echo(f"{data}: {line}", err=True)
        return run.state


def _told(findings: object) -> Iterator[str]:
    for finding in findings if isinstance(findings, tuple) else ():
        yield finding.text


def _ask(plan: "LoadedMachine", keeper: "StateStore", state: "AdaptationState", *, yes: bool) -> None:
    from otolith.adaptation.state import component_records

    said = keeper.decisions()
    approved, rejected = set[str](), set[str]()
    found = component_records(state)
    for entry in found:
        key = entry.adopted.component.key
        click.echo(f"found {key}: {_words(plan, entry)}", err=True)
        (approved if yes or _belongs() else rejected).add(key)
    keeper.keep(tuple(entry for entry in found if entry.adopted.component.key in approved))
    keeper.decide(replace(said, approved=said.approved | approved, rejected=(said.rejected | rejected) - approved))
    if not found:
        click.echo("no component was found: the twin explains the machine up to the noise", err=True)
    for name, parameter in _parameters(state):
        click.echo(f"{name} = {parameter}", err=True)


def _belongs() -> bool:
    try:
        return click.confirm("does it belong to the healthy machine?", err=True)
    except click.Abort:
        click.echo("\nnot answered: nothing is kept; answer y or n, or give --yes", err=True)
        raise


def _parameters(state: "AdaptationState") -> Iterator[tuple[str, str]]:
    from otolith.estimation.imm_filter import moment_match

    known = moment_match(state.memory.belief, state.problem)
    for index, entry in enumerate(state.problem.free):
        if not entry.name.startswith("_"):
            sd = float(known.covariance[index, index]) ** 0.5
            yield entry.name, f"{known.mean[index]:.5g} ± {1.96 * sd:.2g} {entry.unit}"
