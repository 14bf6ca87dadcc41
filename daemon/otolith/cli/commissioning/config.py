"""``otolith config``: a machine file with all that it leaves to defaults."""

from pathlib import Path

import click

from otolith.cli.common import MACHINE_FILE
from otolith.cli.terminal import echo


@click.group()
def config() -> None:
    """Show what the daemon takes from a machine file.

    \b
    Example:
      otolith config show my-machine.toml
    """


@config.command()
@MACHINE_FILE
def show(file: Path) -> None:
    """Print FILE with every default and unit, and what the driver reads.

    The output is a machine file for the same folder. It means the same: a line with '#' is what the daemon uses
    although FILE does not say it, '##' is prose.

    \b
    Examples:
      otolith config show my-machine.toml
      otolith config show my-machine.toml > complete.toml
    """
    from otolith.cli.commissioning.complete_file import complete_lines
    from otolith.machine import load_machine
    from otolith_drivers.config_files import read

    echo(*complete_lines(load_machine(file, for_replay=True), read(file)))
