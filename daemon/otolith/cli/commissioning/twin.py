"""``otolith twin``: the library of twins, one as a page of equations or for other tools, the check of a user's own."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click

from otolith.cli.common import AS_JSON, FILE, MACHINE_FILE, new_file, use_state_of_service
from otolith.cli.terminal import echo, echo_json

if TYPE_CHECKING:
    from otolith.twin.definition import Definition

MIN_WIDTH = 100  # columns; narrower tables of parameters are hard to read, also in a file


@click.group()
def twin() -> None:
    """List, show, check and export twins, the equations of machines.

    \b
    Examples:
      otolith twin list
      otolith twin show dc_motor
      otolith twin check my-twin.toml
      otolith twin export press-3 --modelica
    """


@twin.command("list")
@AS_JSON
def list_(as_json: bool) -> None:
    """List the twins of the library.

    \b
    Example:
      otolith twin list
    """
    from otolith.machine import find_twin, library_twins

    twins = [find_twin(name) for name in library_twins()]
    if as_json:
        echo_json([{"name": twin.name, "title": twin.title} for twin in twins])
        return
    width = max(len(twin.name) for twin in twins)
    for twin in twins:
        echo(f"{twin.name:{width}}  {twin.title}")


@twin.command()
@click.argument("name")
@click.option("--latex", is_flag=True, help="Print only the equations, as LaTeX.")
@AS_JSON
def show(name: str, latex: bool, as_json: bool) -> None:
    """Show equations, signals and parameters of the twin NAME.

    NAME is a twin of the library or a file that ends in .toml.

    \b
    Examples:
      otolith twin show hydraulic_actuator
      otolith twin show dc_motor --latex
      otolith twin show my-twin.toml
    """
    from dataclasses import asdict

    from otolith.machine import find_twin, load_twin
    from otolith.twin.identifiability import structural_identifiability
    from otolith.twin.symbolic import latex_page

    definition = load_twin(Path(name)) if name.endswith(".toml") else find_twin(name)
    if latex:
        echo(*latex_page(definition).split("\n"))
    elif as_json:
        document = asdict(definition) | {"structure": [asdict(row) for row in structural_identifiability(definition)]}
        echo_json(document, indent=2)
    else:
        _print(definition)


@twin.command()
@click.argument("file", type=FILE)
def check(file: Path) -> None:
    """Check grammar, units and identifiability of the twin in FILE.

    \b
    Example:
      otolith twin check my-twin.toml
    """
    from otolith.machine import load_twin

    _print(load_twin(file))


def _print(definition: "Definition") -> None:
    from rich.table import Table
    from rich.text import Text

    from otolith.cli.console import Terminal
    from otolith.twin.definition import Role
    from otolith.twin.identifiability import structural_identifiability
    from otolith.twin.symbolic import unicode_page

    console = Terminal(width=max(Terminal().width, MIN_WIDTH))
    console.print(Text.assemble((definition.title, "bold"), f" ({definition.name})"))
    console.print(f"source: {definition.source}")
    if definition.validity:
        console.print(f"valid: {definition.validity}")
    for line in ("", *unicode_page(definition).split("\n"), ""):
        console.print(line, soft_wrap=True)
    structure = {row.name: row for row in structural_identifiability(definition)}
    table = Table("parameter", "nominal", "bounds", "unit", "role", "could be estimated", "meaning")
    for parameter in definition.parameters:
        row = structure[parameter.name]
        estimable = "yes" if row.identifiable else f"no: {row.reason}"
        bounds = f"{parameter.low:g} to {parameter.high:g}"
        role = "estimated" if parameter.role is Role.ESTIMATED else "known"
        table.add_row(parameter.name, f"{parameter.nominal:g}", bounds, parameter.unit, role, estimable,
                      parameter.meaning)  # fmt: skip
    console.print(table)
    signals = Table("signal", "", "unit", "meaning")
    for driving in definition.inputs:
        signals.add_row(driving.name, f"input, {driving.hold}", driving.unit, driving.meaning)
    for output in definition.outputs:
        signals.add_row(output.name, f"output, noise {output.noise:g}", output.unit, output.meaning)
    for constant in definition.constants:
        signals.add_row(constant.name, f"constant {constant.value:g}", constant.unit, constant.meaning)
    for site in definition.sites:
        signals.add_row(site.name, f"site, {site.mode} into {site.into}", site.unit, site.meaning)
    console.print(signals)


@twin.command()
@MACHINE_FILE
@click.option("--python", "language", flag_value="python", help="As a Python program that needs NumPy alone.")
@click.option("--modelica", "language", flag_value="modelica", help="As a Modelica model.")
@click.option("--fmu", type=FILE, callback=new_file, metavar="FILE",
              help="As this new FMU, for co-simulation and model exchange.")  # fmt: skip
@click.option("--fmi", type=click.Choice(["2", "3"]), default="2", show_default=True, help="Version of the FMU.")
@click.option("--after", "recordings", type=FILE, multiple=True, metavar="DATA",
              help="Adapt the twin to this recording, not to what a daemon has learned; may be repeated.")  # fmt: skip
@click.option("--output", type=FILE, callback=new_file, metavar="FILE", help="Write this new file instead of printing.")
def export(
    file: Path,
    language: str | None,
    fmu: Path | None,
    fmi: Literal["2", "3"],
    recordings: tuple[Path, ...],
    output: Path | None,
) -> None:
    """Print the adapted twin of a machine with its discovered components.

    The text has the equations, the values with their intervals, and where each is
    from. It can be read, changed and run without Otolith. An FMU has them as C
    and compiled: other simulators import it. Its compilation needs gcc.

    \b
    Examples:
      otolith twin export press-3 --python > press_3.py
      otolith twin export press-3 --modelica --output press_3.mo
      otolith twin export press-3 --fmu press_3.fmu
      otolith twin export my-machine.toml --after monday.csv --python
    """
    from otolith.cli.common import progress_line
    from otolith.cli.operation.history import write_page
    from otolith.notebook import Twin

    if (language is None) == (fmu is None):
        raise click.UsageError("give one of --python, --modelica and --fmu")
    if fmu is not None and output is not None:
        raise click.UsageError("--fmu names the new file: leave --output out")
    use_state_of_service(file)
    with progress_line("exporting"):
        adapted = Twin.fresh(file).adapted(*recordings) if recordings else Twin.load(file)
        if fmu is not None:
            write_page(fmu, adapted.fmu(fmi))
            return
        text = adapted.python() if language == "python" else adapted.modelica()
    if output is None:
        echo(*text.rstrip("\n").split("\n"))
    else:
        write_page(output, text.encode())
