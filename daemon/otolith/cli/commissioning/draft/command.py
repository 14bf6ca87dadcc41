"""``otolith init``: from nothing to a machine file that ``otolith check`` accepts."""

import os
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.commissioning.draft.questions import Questions
from otolith.cli.commissioning.probe import MAX_REGISTERS, Range
from otolith.cli.common import FILE, StopSignal
from otolith.cli.terminal import echo

if TYPE_CHECKING:
    from otolith.cli.commissioning.draft.answers import Answers
    from otolith.cli.commissioning.draft.offers import OfferedSource

OF_THE_SOURCE = ("units", "scales")  # options by the names of the source, which may be any text
SOURCES = ("csv", "dbc", "modbus", "opcua", "mqtt")


def _pairs(_: click.Context, option: click.Parameter, written: tuple[str, ...]) -> dict[str, str]:
    """Return the texts ``NAME=VALUE`` of a repeated option; only names of the source may have a '='."""
    pairs = {}
    for text in written:
        name, equals, value = text.rpartition("=") if option.name in OF_THE_SOURCE else text.partition("=")
        if not (name and equals and value):
            raise click.BadParameter(f"{text!r}: write NAME=VALUE")
        pairs[name] = value
    return pairs


@click.command()
@click.argument("file", type=FILE)
@click.option("--csv", type=FILE, help="A table with recorded data.")
@click.option("--dbc", type=FILE, help="The database of a CAN bus; with --log, else the bus is listened to.")
@click.option("--modbus", metavar="HOST[:PORT]|/dev/ttyUSB0", help="A Modbus device.")
@click.option("--opcua", metavar="ENDPOINT", help="An OPC UA server.")
@click.option("--mqtt", metavar="HOST[:PORT]", help="An MQTT broker.")
@click.option("--log", type=FILE, help="A log of the CAN bus, as candump -L writes it, .blf, .asc, .trc, .mf4.")
@click.option("--no-bus", is_flag=True, help="Do not listen to the CAN bus: propose from its database alone.")
@click.option("--interface", default="auto", help="Of python-can: socketcan, pcan, kvaser, slcan ...")
@click.option("--channel", help="As 'ip link' or python-can names it.  [default: vcan0]")
@click.option("--port", type=click.IntRange(1024, 65535), default=43113, help="Of udp_multicast.")
@click.option("--bitrate", type=click.IntRange(1000, 1_000_000), help="For interfaces that set it themselves.")
@click.option("--registers", type=Range(0, 65536, MAX_REGISTERS), help="Of Modbus.  [default: the first 64]")
@click.option("--table", type=click.Choice(["holding", "input"]), default="holding", help="Of Modbus.")
@click.option("--topics", default="#", help="Of MQTT; '#' and '+' stand for any.")
@click.option("--driver", "keys", multiple=True, callback=_pairs, metavar="KEY=VALUE",
              help="Another key of [driver], of Modbus, OPC UA or MQTT: device=5, user=otolith.")  # fmt: skip
@click.option("--seconds", type=click.FloatRange(0.1, 3600.0), default=5.0, help="How long to listen or read.")
@click.option("--twin", help="A twin of the library.  [default: the one that fits best]")
@click.option("--signal", "signals", multiple=True, callback=_pairs, metavar="SIGNAL=NAME",
              help="Which signal of the source an input or output of the twin is.")  # fmt: skip
@click.option("--unknown", multiple=True, callback=_pairs, metavar="INPUT=KIND",
              help="An input without a sensor: constant, slow or friction.")  # fmt: skip
@click.option("--unit", "units", multiple=True, callback=_pairs, metavar="NAME=UNIT",
              help="Unit of a signal of the source.")  # fmt: skip
@click.option("--scale", "scales", multiple=True, callback=_pairs, metavar="NAME=FACTOR",
              help="What one step of a number is worth in its unit, as 0.48 for percent of 48 N*m.")  # fmt: skip
@click.option("--display", "displays", multiple=True, callback=_pairs, metavar="SIGNAL=VALUE",
              help='Of Modbus: what the display of the drive shows meanwhile, as "omega=1450 rpm".')  # fmt: skip
@click.option("--noise", "noises", multiple=True, callback=_pairs, metavar="SIGNAL=LEVEL",
              help='Standard deviation of a sensor, as "i=5 mA".')  # fmt: skip
@click.option("--name", help="Of the machine.  [default: that of FILE]")
@click.option("--site", help="Where the machine is.")
@click.option("--sample-period", help='As "10 ms".  [default: that of the fastest signal]')
@click.option("--window", help='Length of a window, as "2 s".  [default: 200 sample periods]')
@click.option("--ask/--no-ask", default=None, help="Ask for each answer.  [default: if input is a terminal]")
@click.option("--force", is_flag=True, help="Overwrite FILE.")
@click.option("--commission", "commissions", is_flag=True,
              help="The log is of the healthy machine: also do 'otolith commission FILE LOG --write'.")  # fmt: skip
def init(file: Path, ask: bool | None, force: bool, commissions: bool, **options: Any) -> int:
    """Write a first machine file FILE from recorded data or a bus.

    It shows which signals there are and which of them move, proposes a twin and which signal is which of its inputs
    and outputs, and writes a commented file that 'otolith check' accepts. Every proposal can be answered by an
    option; in a terminal it asks. An input that no sensor measures becomes unknown.

    \b
    Examples:
      otolith init drive.toml --csv monday.csv
      otolith init drive.toml --csv montag.csv --unit Drehzahl=1/min --commission
      otolith init drive.toml --dbc drive.dbc --log monday.log
      otolith init drive.toml --dbc drive.dbc --channel can0
      otolith init drive.toml --dbc drive.dbc --no-bus
      otolith init drive.toml --modbus 192.168.0.10 --display "omega=1450 rpm" \\
        --display "i=2.3 A" --display "V_a=24 V"
      otolith init drive.toml --opcua opc.tcp://plc:4840 --driver user=otolith
    """
    from otolith.cli.commissioning.draft.answers import Answers
    from otolith_drivers.errors import OtolithError

    if file.suffix != ".toml":
        raise click.BadParameter(f"{str(file)!r}: the name of a machine file ends in .toml", param_hint="FILE")
    if file.exists() and not force:
        text = f"{str(file)!r} exists: choose another name, or overwrite it by --force"
        raise click.BadParameter(text, param_hint="FILE")
    if not os.access(file.absolute().parent, os.W_OK | os.X_OK):
        text = f"{str(file)!r}: its folder is not there, or this user may not write into it"
        raise click.BadParameter(text, param_hint="FILE")
    questions = Questions(asks=sys.stdin.isatty() if ask is None else ask)
    answers = Answers(**{name.name: options.pop(name.name) for name in fields(Answers)})
    given = [name for name in SOURCES if options[name] is not None]
    if len(given) > 1:
        raise click.UsageError(f"--{' and --'.join(given)}: one source at a time; --log is the log of a bus")
    kind = given[0] if given else questions.choice("What is the source?", list(SOURCES))
    if kind is None:
        raise click.UsageError(
            "what is the source? --csv, --dbc (with --log or --channel), --modbus, --opcua or --mqtt"
        )
    target = str(options[kind] if given else click.prompt("its file or address"))
    answers = _checked(kind, options, answers, commissions=commissions)
    stop = StopSignal()
    try:
        source = _source(kind, target, options, file.parent, stop)
    except OtolithError:
        if not stop.received():
            raise
    if stop.received():
        return stop.code()
    stop.release()
    _finish(file, source, answers, questions, commissions=commissions)
    return 0


def _checked(kind: str, options: dict[str, Any], answers: "Answers", *, commissions: bool) -> "Answers":
    """Return the answers, with the names of registers as the device offers them; nothing is read before.

    Raises:
        UsageError: an option is not of the ``kind`` of source.
        ConfigurationError: an answer is none.
    """
    from otolith.cli.commissioning.draft.choosing import check_answers

    if (options["log"] is not None or options["no_bus"]) and kind != "dbc":
        raise click.UsageError("--log and --no-bus need --dbc, the database of the frames")
    if answers.displays and kind != "modbus":
        raise click.UsageError("--display is for registers of --modbus; --signal and --unit tell it of other sources")
    if commissions and not (kind == "csv" or options["log"] is not None):
        raise click.UsageError("--commission needs a log: --csv, or --dbc with --log")
    check_answers(answers)
    if kind != "modbus":
        return answers
    from otolith.cli.commissioning.draft import network

    return network.with_registers(answers, options["registers"], network.driver_keys(options["keys"]))


def _finish(
    file: Path, source: "OfferedSource", answers: "Answers", questions: Questions, *, commissions: bool
) -> None:
    """Write the file, commission the machine by its log if that is wanted, and name the next command."""
    from otolith.cli.commissioning.check import lines_without_limits
    from otolith.cli.commissioning.commission import WINDOWS, Manner, ask_if_healthy, commission_log
    from otolith.cli.commissioning.draft.choosing import next_lines, write_draft
    from otolith.machine import load_machine

    write_draft(file, source, answers, questions)
    if commissions:
        decide = (
            ask_if_healthy if questions.asks else lambda: None
        )  # what nobody was asked is no part of a healthy machine
        commission_log(file, (Path(source.check),), WINDOWS, Manner(decide, write=True))
    else:
        echo(*lines_without_limits(load_machine(file, with_driver=False)))
    echo(*next_lines(file, source, is_commissioned=commissions))


def _source(kind: str, target: str, options: dict[str, Any], folder: Path, stop: StopSignal) -> "OfferedSource":
    """Return what the source of that kind offers; each kind imports only what it needs."""
    seconds, log = options["seconds"], options["log"]
    if kind == "csv":
        from otolith.cli.commissioning.draft.recorded import table_offers

        return table_offers(Path(target), folder)
    if log is None and not options["no_bus"]:
        echo(f"for {seconds:g} s: let the machine move")
    if kind == "dbc":
        return _can_source(Path(target), options, folder, stop)
    from otolith.cli.commissioning.draft import network

    keys = network.driver_keys(options["keys"])
    if kind == "modbus":
        return network.device_offers(target, options["registers"], options["table"], keys, seconds, stop)
    if kind == "opcua":
        return network.server_offers(target, keys, seconds, folder, stop)
    return network.broker_offers(target, options["topics"], keys, seconds, folder, stop)


def _can_source(database: Path, options: dict[str, Any], folder: Path, stop: StopSignal) -> "OfferedSource":
    from otolith.cli.commissioning.draft.bus import bus_offers, database_offers, log_offers
    from otolith_drivers.canbus.bus import BusOptions
    from otolith_drivers.config_files import validated

    keys = {name: options[name] for name in ("interface", "channel", "port")}
    if options["bitrate"] is not None:
        keys["bitrate"] = f"{options['bitrate']} bit/s"
    bus = validated(keys, BusOptions, ())
    if options["log"] is not None:
        return log_offers(options["log"], database, bus, folder)
    if options["no_bus"]:
        return database_offers(database, bus, folder)
    return bus_offers(database, bus, options["seconds"], folder, stop)
