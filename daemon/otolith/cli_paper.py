"""``otolith paper``: the paper's scenarios, and our figures beside the paper's."""

import signal
from pathlib import Path

import click

from otolith.paper.rows import NAMES
from otolith.paper.unknowns import UNKNOWN_NAMES


@click.command()
@click.option(
    "--scenario",
    multiple=True,
    type=click.Choice((*NAMES, *UNKNOWN_NAMES)),
    help="Only this one; may be given more than once.",
)
@click.option("--quick", is_flag=True, help="Only the first 300 s of each.")
@click.option("--noise", is_flag=True, help="Again with noisy sensors; and how much noise hides the lift's damping.")
@click.option(
    "--plots",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    help="Draw into this folder instead of a new one in the state directory.",
)
@click.option("--no-plots", is_flag=True, help="Draw nothing.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON document instead of tables.")
def paper(
    scenario: tuple[str, ...], quick: bool, noise: bool, plots: Path | None, no_plots: bool, as_json: bool
) -> int:
    """Run the paper's scenarios through the daemon's estimation; compare what is found with the truth and the paper.

    Each machine is simulated; drifting parameters are estimated in windows of 0.1, 1, 2, 4 and 10 s, unknown components
    discovered in windows of 2 s. That takes minutes.

    \b
    Examples:
      otolith paper
      otolith paper --quick --scenario armature-resistance
      otolith paper --noise --plots figures
      otolith paper --json --no-plots | jq '.scenarios[].published'
    """
    from otolith.paper.comparison import compare, new_folder

    if plots is not None and no_plots:
        raise click.UsageError("--plots and --no-plots exclude each other")
    signal.signal(signal.SIGINT, signal.default_int_handler)  # so that bars and processes are put away
    folder = None if no_plots else plots or new_folder()
    return compare(scenario, folder, noise=noise, quick=quick, as_json=as_json)
