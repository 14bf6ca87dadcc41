"""``otolith twin``: the library, one twin as people read it, and a check of one's own."""

import json
from pathlib import Path
from typing import Any

import click

FILE = click.Path(path_type=Path, dir_okay=False)


@click.group(name="twin")
def twin() -> None:
    """Twins: pages of equations that describe machines.

    \b
    Examples:
      otolith twin list
      otolith twin show dc_motor
      otolith twin check my-twin.toml
    """


@twin.command(name="list")
@click.option("--json", "as_json", is_flag=True, help="As JSON.")
def list_(as_json: bool) -> None:
    """List the twins of the library.

    \b
    Example:
      otolith twin list
    """
    from otolith.machine import find_twin, library_twins

    found = [find_twin(name) for name in library_twins()]
    if as_json:
        click.echo(json.dumps([{"name": entry.name, "title": entry.title} for entry in found]))
        return
    width = max(len(entry.name) for entry in found)
    for entry in found:
        click.echo(f"{entry.name:{width}}  {entry.title}")


@twin.command()
@click.argument("name")
@click.option("--latex", is_flag=True, help="Only the equations, as LaTeX.")
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def show(name: str, latex: bool, as_json: bool) -> None:
    """Show the twin NAME of the library, or of a file: equations, parameters, what could be estimated.

    \b
    Examples:
      otolith twin show hydraulic_actuator
      otolith twin show dc_motor --latex
      otolith twin show my-twin.toml
    """
    from otolith.machine import find_twin, load_twin

    definition = load_twin(Path(name)) if name.endswith(".toml") else find_twin(name)
    if latex:
        from otolith.twin.symbolic import latex_page

        click.echo(latex_page(definition))
    elif as_json:
        click.echo(json.dumps(_document(definition), indent=2, ensure_ascii=False))
    else:
        _print(definition)


@twin.command()
@click.argument("file", type=FILE)
def check(file: Path) -> None:
    """Check the twin in FILE: grammar, units on both sides, and what could be estimated from its outputs.

    \b
    Example:
      otolith twin check my-twin.toml
    """
    from otolith.machine import load_twin

    _print(load_twin(file))


def _document(definition: Any) -> dict[str, Any]:
    from dataclasses import asdict

    from otolith.twin.identifiability import structure_of

    return asdict(definition) | {"structure": [asdict(entry) for entry in structure_of(definition)]}


def _print(definition: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    from otolith.twin.identifiability import structure_of
    from otolith.twin.symbolic import unicode_page

    console = Console(width=max(Console().width, 100), highlight=False)
    say = console.print
    say(f"[bold]{definition.title}[/bold] ({definition.name})")
    say(f"source: {definition.source}", markup=False)
    if definition.validity:
        say(f"valid: {definition.validity}", markup=False)
    say("")
    say(unicode_page(definition), markup=False, soft_wrap=True)
    say("")
    structure = {entry.name: entry for entry in structure_of(definition)}
    table = Table("parameter", "nominal", "bounds", "unit", "role", "could be estimated", "meaning")
    for entry in definition.parameters:
        found = structure[entry.name]
        verdict = "yes" if found.identifiable else f"no: {found.reason}"
        bounds = f"{entry.low:g} to {entry.high:g}"
        table.add_row(entry.name, f"{entry.nominal:g}", bounds, entry.unit, entry.role, verdict, entry.meaning)
    say(table)
    signals = Table("signal", "", "unit", "meaning")
    for entry in definition.inputs:
        signals.add_row(entry.name, f"input, {entry.hold}", entry.unit, entry.meaning)
    for entry in definition.outputs:
        signals.add_row(entry.name, f"output, noise {entry.noise:g}", entry.unit, entry.meaning)
    for entry in definition.constants:
        signals.add_row(entry.name, f"constant {entry.value:g}", entry.unit, entry.meaning)
    for entry in definition.sites:
        signals.add_row(entry.name, f"site, {entry.mode} into {entry.into}", entry.unit, entry.meaning)
    say(signals)
