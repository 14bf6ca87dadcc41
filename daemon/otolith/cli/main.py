"""The command line: speech only. Each command imports what it needs, so that ``otolith --help`` is quick.

``otolith plant``: a simulated machine on a bus of its own.
"""

import math
import re
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from otolith import __version__
from otolith.cli.common import NobodyReads, StopSignal, log_to_stderr
from otolith.cli.components import commission, components
from otolith.cli.noise import noise
from otolith.cli.probe import probe
from otolith.cli.twin import twin

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

    from otolith_drivers.plant.realtime import TruthFile, open_node, write_summary
    from otolith_drivers.plant.scenario import load_scenario
    from otolith_drivers.user_dirs import check_writable

    loaded = load_scenario(scenario)
    if summary is not None:
        check_writable(summary.absolute().parent)
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


INTERRUPTED = 128 + signal.SIGINT
EXIT_CODES = """\b
Exit codes:
  0    done; run and plant also when stopped by SIGTERM
  1    the demo's estimate was wrong, probe has found nothing, or check missed a signal
  2    a file, option, bus or port cannot be used; the message says which and what to do
  130  interrupted by Ctrl-C (128 + the number of any other signal)"""


def _endpoints(_: click.Context, __: click.Parameter, written: tuple[str, ...]) -> tuple[str, ...]:
    for endpoint in written:
        if not re.fullmatch(r"[a-z-]+/\S+", endpoint):
            raise click.BadParameter(f"{endpoint!r} is no endpoint: write it like tcp/127.0.0.1:7447")
    return written


def _rrd(_: click.Context, __: click.Parameter, path: Path | None) -> Path | None:
    if path is not None and path.suffix != ".rrd":
        raise click.BadParameter(f"{str(path)!r}: a recording ends in .rrd")
    if path is not None and path.exists():
        raise click.BadParameter(f"{str(path)!r} is there already and would be lost")
    return path


def _machine_name(_: click.Context, __: click.Parameter, name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9_\-*]+", name):
        raise click.BadParameter(f"{name!r} is no name of a machine")
    return name


class _Commands(click.Group):
    def make_context(self, *arguments: Any, **more: Any) -> click.Context:
        with _read_or_not():
            return super().make_context(*arguments, **more)

    def invoke(self, ctx: click.Context) -> object:
        with _read_or_not():
            return super().invoke(ctx)


@contextmanager
def _read_or_not() -> Iterator[None]:
    try:
        yield
    except BrokenPipeError as error:
        raise NobodyReads from error


@click.group(
    cls=_Commands, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110}, epilog=EXIT_CODES
)
@click.version_option(__version__, prog_name="otolith")
def cli() -> None:
    """Otolith makes an industrial machine aware of itself.

    It listens to the drive, fits a white-box twin to every window of a few seconds, and says in physical terms what has
    changed.

    \b
    Start here:
      otolith demo                          a simulated motor, a daemon and a live table, for 90 s
      otolith check config/dc-motor.toml    read a machine file and say what would be done
      otolith run config/dc-motor.toml      the daemon, in the foreground
    """


@cli.command()
@click.argument("file", type=FILE)
@click.option(
    "--listen",
    multiple=True,
    callback=_endpoints,
    metavar="ENDPOINT",
    help="Publish here instead of where the file says.",
)
@click.option(
    "--recording", type=FILE, callback=_rrd, help="Record into this file instead of a new one in the state directory."
)
@click.option("-v", "--verbose", is_flag=True, help="Say more.")
def run(file: Path, listen: tuple[str, ...], recording: Path | None, verbose: bool) -> int:
    """Run the daemon for the machine in FILE until SIGTERM or Ctrl-C.

    \b
    Examples:
      otolith run config/dc-motor.toml
      otolith run config/dc-motor.toml --listen tcp/127.0.0.1:7450
    """
    from otolith.machine import load_machine
    from otolith.runtime.service import Service

    log_to_stderr(verbose=verbose)
    ended_by = Service(load_machine(file), listen or None, recording).run()
    return INTERRUPTED if ended_by == signal.SIGINT else 0


@cli.command()
@click.argument("file", type=FILE)
@click.option("--no-device", is_flag=True, help="Do not try to open the machine's bus.")
def check(file: Path, no_device: bool) -> int:
    """Read the machine file FILE, say what the daemon would do, and listen whether the signals come.

    \b
    Examples:
      otolith check config/dc-motor.toml
      otolith check --no-device config/dc-motor.toml
    """
    from otolith.cli.check import check_machine

    return 0 if check_machine(file, click.echo, with_device=not no_device) else 1


@cli.command()
@click.argument("file", type=FILE)
@click.argument("data", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Print each report as a line of JSON instead of a summary.")
@click.option("--recording", type=FILE, callback=_rrd, help="Record into this file, as the daemon does.")
@click.option("--real-time", is_flag=True, help="Let every window come when it would have ended.")
def replay(file: Path, data: Path, as_json: bool, recording: Path | None, real_time: bool) -> int:
    """Let the daemon of the machine in FILE hear the recorded DATA, as fast as it can, and sum up what it says.

    DATA is a table (CSV: a column 't' in seconds and one for each signal of the twin, in its unit or the one in
    brackets), a recording of ours (.rrd) or a log of a CAN bus (.log of candump, .asc, .blf, .trc, also with .gz).
    FILE needs [driver] and [signals] only for a log of a bus: they say what is in its frames.

    \b
    Examples:
      otolith replay my-machine.toml monday.csv
      otolith replay my-machine.toml monday.blf --real-time
      otolith replay my-machine.toml monday.csv --json | jq .parameters.R_a.value
      otolith replay my-machine.toml monday.csv --recording monday.rrd
    """
    from otolith.cli.replay import replay

    stop = StopSignal()
    replay(file, data, recording, as_json=as_json, stopped=lambda: stop.number is not None, real_time=real_time)
    return stop.code()


@cli.command()
@click.option(
    "--connect",
    multiple=True,
    default=["tcp/127.0.0.1:7447"],
    show_default=True,
    callback=_endpoints,
    metavar="ENDPOINT",
    help="Where daemons are; may be given more than once.",
)
@click.option("--machine", default="*", callback=_machine_name, metavar="NAME", help="Only this machine.")
@click.option("--json", "as_json", is_flag=True, help="Print each report as a line of JSON instead of a table.")
def watch(connect: tuple[str, ...], machine: str, as_json: bool) -> int:
    """Show the live table of a running daemon, from any process that reaches it.

    \b
    Examples:
      otolith watch
      otolith watch --json | jq .parameters.R_a
    """
    from otolith.cli.watch import watch_reports

    stop = StopSignal()
    watch_reports(connect, machine, as_json=as_json, stopped=lambda: stop.number is not None)
    return stop.code()


@cli.command()
@click.argument("file", type=FILE, required=False)
@click.option("--list", "listing", is_flag=True, help="Only list the recordings there are.")
def view(file: Path | None, listing: bool) -> int:
    """Open the recording FILE in the Rerun viewer; without FILE, the newest one.

    \b
    Examples:
      otolith view
      otolith view --list
    """
    from otolith.cli.watch import open_viewer, recordings
    from otolith_drivers.user_dirs import state_directory

    if listing:
        found = recordings()
        for path in found:
            click.echo(path)
        if not found:
            click.echo(f"no recordings under {state_directory()}", err=True)
        return 0
    return open_viewer(file)


@cli.command()
@click.option("--duration", type=click.FloatRange(8, 3600), default=90.0, show_default=True, help="Seconds.")
@click.option("--machine", type=FILE, help="Machine file; the one of the DC motor if not given.")
@click.option("--scenario", type=FILE, help="What happens to the machine; a falling armature resistance if not given.")
@click.option("--json", "as_json", is_flag=True, help="Print the verdict as JSON, and no table.")
def demo(duration: float, machine: Path | None, scenario: Path | None, as_json: bool) -> int:
    """Run plant and daemon as processes on a bus, watch, and compare what was found with what was injected.

    \b
    Examples:
      otolith demo
      otolith demo --duration 30 --json
    """
    from otolith.cli.common import examples_directory
    from otolith.cli.demo import Demo

    examples = examples_directory()
    stop = StopSignal()
    machine = machine or examples / "dc-motor.toml"
    scenario = scenario or examples / "scenarios" / "demo.toml"
    code = Demo(machine, scenario, duration, as_json=as_json).run(lambda: stop.number is not None)
    return code if stop.number is None else stop.code()


cli.add_command(commission)
cli.add_command(components)
cli.add_command(noise)
cli.add_command(plant)
cli.add_command(probe)
cli.add_command(twin)
