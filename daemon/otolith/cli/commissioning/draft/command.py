"""``otolith init``: from nothing to a machine file that ``otolith check`` accepts."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.commissioning.draft.questions import Questions
from otolith.cli.common import FILE, StopSignal
from otolith.cli.terminal import echo

if TYPE_CHECKING:
    from otolith.cli.commissioning.draft.offers import OfferedSource

ASSUMPTIONS = ("constant", "slow", "friction")


def _pairs(_: click.Context, option: click.Parameter, written: tuple[str, ...]) -> dict[str, str]:
    """Return the texts ``NAME=VALUE`` of a repeated option; the name may have '=' only with the last one between."""
    pairs = {}
    for text in written:
        name, equals, value = text.rpartition("=") if option.name == "units" else text.partition("=")
        if not (name and equals and value):
            raise click.BadParameter(f"{text!r}: write NAME=VALUE")
        pairs[name] = value
    return pairs


def _assumptions(context: click.Context, option: click.Parameter, written: tuple[str, ...]) -> dict[str, str]:
    pairs = _pairs(context, option, written)
    for name, value in pairs.items():
        if value not in ASSUMPTIONS:
            raise click.BadParameter(f"{name}={value}: write {name}=constant, slow or friction")
    return pairs


@click.command()
@click.argument("file", type=FILE)
@click.option("--csv", type=FILE, help="A table with recorded data.")
@click.option("--dbc", type=FILE, help="The database of a CAN bus; with --log, else the bus is listened to.")
@click.option("--log", type=FILE, help="A log of the CAN bus, as candump -L writes it, .blf, .asc, .trc, .mf4.")
@click.option("--interface", default="auto", help="Of python-can: socketcan, pcan, kvaser, slcan ...")
@click.option("--channel", help="As 'ip link' or python-can names it.  [default: vcan0]")
@click.option("--port", type=click.IntRange(1024, 65535), default=43113, help="Of udp_multicast.")
@click.option("--bitrate", type=click.IntRange(1000, 1_000_000), help="For interfaces that set it themselves.")
@click.option("--seconds", type=click.FloatRange(0.1, 3600.0), default=5.0, help="How long to listen to a bus.")
@click.option("--twin", help="A twin of the library.  [default: the one that fits best]")
@click.option("--signal", "signals", multiple=True, callback=_pairs, metavar="SIGNAL=NAME",
              help="Which signal of the source an input or output of the twin is.")  # fmt: skip
@click.option("--unknown", multiple=True, callback=_assumptions, metavar="INPUT=KIND",
              help="An input without a sensor: constant, slow or friction.")  # fmt: skip
@click.option("--unit", "units", multiple=True, callback=_pairs, metavar="NAME=UNIT",
              help="Unit of a signal of the source.")  # fmt: skip
@click.option("--scale", "scales", multiple=True, callback=_pairs, metavar="NAME=FACTOR",
              help="What one step of a number is worth in its unit; not for --csv.")  # fmt: skip
@click.option("--noise", "noises", multiple=True, callback=_pairs, metavar="SIGNAL=LEVEL",
              help="Standard deviation of a sensor, as \"i=5 mA\".")  # fmt: skip
@click.option("--name", help="Of the machine.  [default: that of FILE]")
@click.option("--site", help="Where the machine is.")
@click.option("--sample-period", help='As "10 ms".  [default: that of the fastest signal]')
@click.option("--window", help='Length of a window, as "2 s".  [default: 200 sample periods]')
@click.option("--ask/--no-ask", default=None, help="Ask for each answer.  [default: if input is a terminal]")
@click.option("--force", is_flag=True, help="Overwrite FILE.")
def init(
    file: Path,
    csv: Path | None,
    dbc: Path | None,
    log: Path | None,
    interface: str,
    channel: str | None,
    port: int,
    bitrate: int | None,
    seconds: float,
    ask: bool | None,
    force: bool,
    **answers: Any,
) -> None:
    """Write a first machine file FILE from recorded data or a bus.

    It shows which signals there are and which of them move, proposes a twin and which signal is which of its inputs
    and outputs, and writes a commented file that 'otolith check' accepts. Every proposal can be answered by an
    option; in a terminal it asks. An input that no sensor measures becomes unknown.

    \b
    Examples:
      otolith init drive.toml --csv monday.csv
      otolith init drive.toml --csv montag.csv --unit Drehzahl=1/min
      otolith init drive.toml --dbc drive.dbc --log monday.log
      otolith init drive.toml --dbc drive.dbc --channel can0
    """
    from otolith.cli.commissioning.draft.choosing import Answers, write_draft

    if file.suffix != ".toml":
        raise click.BadParameter(f"{str(file)!r}: the name of a machine file ends in .toml", param_hint="FILE")
    if file.exists() and not force:
        text = f"{str(file)!r} exists: choose another name, or overwrite it by --force"
        raise click.BadParameter(text, param_hint="FILE")
    questions = Questions(asks=sys.stdin.isatty() if ask is None else ask)
    if csv is None and dbc is None:
        csv, dbc = _asked_source(questions)
    if csv is not None and dbc is not None:
        raise click.UsageError("--csv and --dbc: one source at a time; --log is the log of a bus")
    if log is not None and dbc is None:
        raise click.UsageError("--log needs --dbc, the database of its frames")
    stop, folder = StopSignal(), file.parent
    if csv is not None:
        from otolith.cli.commissioning.draft.recorded import table_offers

        source = table_offers(csv, folder)
    else:
        rate = {} if bitrate is None else {"bitrate": f"{bitrate} bit/s"}
        bus = {"interface": interface, "channel": channel, "port": port} | rate
        source = _can_source(Path(dbc or ""), log, bus, seconds, folder, stop)
    write_draft(file, source, Answers(**answers), questions)


def _asked_source(questions: Questions) -> tuple[Path | None, Path | None]:
    """Return the table or the database that is asked for; raise UsageError where nobody is asked."""
    kind = questions.choice("A table of recorded data, or a CAN bus with its database?", ["csv", "dbc"])
    if kind is None:
        raise click.UsageError("what is the source? --csv FILE, or --dbc FILE with --log FILE or --channel NAME")
    path = Path(click.prompt("its file", type=FILE))
    return (path, None) if kind == "csv" else (None, path)


def _can_source(
    database: Path, log: Path | None, keys: Mapping[str, Any], seconds: float, folder: Path, stop: StopSignal
) -> "OfferedSource":
    from otolith.cli.commissioning.draft.bus import bus_offers, log_offers
    from otolith_drivers.canbus.bus import BusOptions
    from otolith_drivers.config_files import validated

    options = validated(dict(keys), BusOptions, ())
    if log is not None:
        return log_offers(log, database, options, folder)
    echo(f"listening for {seconds:g} s: let the machine move")
    return bus_offers(database, options, seconds, folder, stop)
