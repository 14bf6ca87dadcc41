"""``otolith plant``: a simulated machine on a bus of its own."""

import math
import signal
from pathlib import Path

import click

from otolith.cli_process import StopSignal

FILE = click.Path(path_type=Path, dir_okay=False)
TRANSPORTS = ("can", "modbus-tcp", "modbus-rtu")  # the keys of plant.nodes.NODES, which takes time to import


@click.command()
@click.argument("scenario", type=FILE)
@click.option(
    "--as",
    "transport",
    type=click.Choice(TRANSPORTS),
    default="can",
    show_default=True,
    help="What to be: a node on the CAN bus, or a Modbus drive on a port or a serial line of its own.",
)
@click.option("--truth", type=FILE, help="Write the parameters as they really are into this CSV file.")
@click.option("--summary", type=FILE, help="Write at the end what was sent, asked and withheld into this JSON file.")
@click.option("--duration", type=click.FloatRange(0.1), default=math.inf, metavar="SECONDS", help="End by then.")
def plant(scenario: Path, transport: str, truth: Path | None, summary: Path | None, duration: float) -> int:
    """Be the simulated machine of SCENARIO, a device on its bus, in real time.

    \b
    Examples:
      otolith plant config/scenarios/demo.toml
      otolith plant config/scenarios/bus-dropouts.toml --as modbus-tcp --summary withheld.json
    """
    from contextlib import ExitStack, closing

    from otolith_drivers.plant.nodes import open_node, write_summary
    from otolith_drivers.plant.plants import load_scenario
    from otolith_drivers.plant.truth import TruthFile
    from otolith_drivers.private import complain_unless_writable

    loaded = load_scenario(scenario)
    if summary is not None:
        complain_unless_writable(summary.absolute().parent)
    stop = StopSignal()
    with ExitStack() as stack:
        true = stack.enter_context(closing(TruthFile(truth))) if truth is not None else None
        node = stack.enter_context(closing(open_node(transport, loaded)))
        click.echo(f"{node.title()}; Ctrl-C ends it", err=True)
        done = node.run(true, lambda: stop.number is not None, duration)
    if summary is not None:
        write_summary(summary, loaded, transport, done)
    click.echo(node.say(done), err=True)
    return stop.code(clean=signal.SIGTERM)
