"""``otolith probe``: what is on this bus, and lines for the machine file."""

import json
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from otolith.cli.common import StopSignal

FILE = click.Path(path_type=Path, dir_okay=False)
NOTHING_THERE = 1
MOST_ASKED = 1000  # registers in one go
Span = tuple[int, int]


class Range(click.ParamType[Span]):
    """``"7"`` or ``"0..63"``, within bounds."""

    name = "N | LOW..HIGH"

    def __init__(self, low: int, high: int, most: int) -> None:
        self._low, self._high, self._most = low, high, most

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Span:
        """First and last."""
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"(\d{1,5})(?:\.\.(\d{1,5}))?", str(value).strip())
        if match is None:
            self.fail(f"{value!r}: write one number like 7, or the first and the last like 0..63", param, ctx)
        first, last = int(match[1]), int(match[2] or match[1])
        if not self._low <= first <= last <= self._high:
            self.fail(f"{value!r}: from {self._low} to {self._high}, the lower one first", param, ctx)
        if last - first >= self._most:
            self.fail(f"{value!r}: at most {self._most} at once", param, ctx)
        return first, last


@click.group()
def probe() -> None:
    """Look what is on a bus, and print lines for the machine file. Only listens, or reads; never writes.

    \b
    Examples:
      otolith probe can
      otolith probe can --channel can0 --database drive.dbc
      otolith probe modbus 192.168.0.10
      otolith probe modbus /dev/ttyUSB0 --baudrate 9600 --parity N --scan
    """


@probe.command()
@click.argument("target", metavar="HOST[:PORT]|/dev/ttyUSB0")
@click.option(
    "--device", type=Range(0, 255, 256), help="Device number (unit, slave); with --scan a range.  [default: 1]"
)
@click.option("--registers", type=Range(0, 65536, MOST_ASKED),
              help="Which; a single one is shown in every type and order.  [default: the first 64]")  # fmt: skip
@click.option("--table", type=click.Choice(["holding", "input"]), default="holding", show_default=True)
@click.option("--first-address", type=click.IntRange(0, 1), default=0, show_default=True,
              help="What the manual calls the first register.")  # fmt: skip
@click.option(
    "--baudrate", type=click.IntRange(300, 4_000_000), default=19200, show_default=True, help="Of a serial line."
)
@click.option("--parity", type=click.Choice(["N", "E", "O"]), default="E", show_default=True, help="Of a serial line.")
@click.option("--stop-bits", type=click.Choice(["1", "2"]), default="1", show_default=True, help="Of a serial line.")
@click.option("--framing", type=click.Choice(["tcp", "rtu"]), default="tcp", show_default=True,
              help="Of a host; rtu for a gateway that passes serial frames on.")  # fmt: skip
@click.option("--timeout", type=click.FloatRange(0.01, 10.0), metavar="SECONDS",
              help="How long a device may take.  [default: 0.5; with --scan 0.2]")  # fmt: skip
@click.option("--seconds", type=click.FloatRange(0.0, 3600.0), default=3.0, show_default=True, help="How long to read.")
@click.option("--wide", is_flag=True, help="Show numbers of 64 bits as well.")
@click.option("--scan", is_flag=True, help="Ask all devices of a line for one register, and list those that answer.")
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def modbus(
    target: str,
    device: Span | None,
    registers: Span | None,
    table: str,
    first_address: int,
    baudrate: int,
    parity: str,
    stop_bits: str,
    framing: str,
    timeout: float | None,
    seconds: float,
    wide: bool,
    scan: bool,
    as_json: bool,
) -> int:
    """Read the registers of a Modbus device again and again, and say which numbers are in them.

    What changes tells its type and the order of its bytes; so let the machine move meanwhile. Registers that the device
    refuses are found out. TARGET is a host, with a port unless it is 502, or a serial port.

    \b
    Examples:
      otolith probe modbus 192.168.0.10
      otolith probe modbus plc:1502 --registers 100..163 --table input --seconds 10
      otolith probe modbus 192.168.0.10 --registers 100        one register in every type and order
      otolith probe modbus /dev/ttyUSB0 --baudrate 9600 --parity N --device 5
      otolith probe modbus /dev/ttyUSB0 --scan                 which devices are on the line
    """
    from otolith.cli.probe_view import console, modbus_document, probe_device, scan_line, show_device, show_scan
    from otolith_drivers.config_files import validated
    from otolith_drivers.modbus.options import LineOptions
    from otolith_drivers.modbus.probe_numbers import Place

    if device is not None and device[0] != device[1] and not scan:
        raise click.BadParameter("a range of devices goes with --scan", param_hint="--device")
    registers = registers or (first_address, first_address + 63)
    if registers[0] < first_address:
        raise click.BadParameter("with --first-address 1 there is no register 0", param_hint="--registers")
    keys = _address(target) | {"timeout": f"{timeout or (0.2 if scan else 0.5)} s", "framing": framing}
    options = validated(keys | {"baudrate": baudrate, "parity": parity, "stop_bits": int(stop_bits)}, LineOptions, ())
    devices = device or ((1, 247) if scan else (1, 1))
    place = Place(options, devices[0], "holding" if table == "holding" else "input", first_address)
    on_wire = (registers[0] - first_address, registers[1] - first_address)
    stop = StopSignal()
    if scan:
        with _progress() as told:
            answers = scan_line(place, devices, on_wire[0], lambda: stop.number is not None, told)
        if as_json:
            click.echo(json.dumps({"devices": [{"device": entry.device, "refused": entry.reply} for entry in answers]}))
        else:
            show_scan(place, devices, answers, console())
        return stop.code() or (0 if answers else NOTHING_THERE)
    with _progress() as told:
        found = probe_device(place, on_wire, seconds, lambda: stop.number is not None, told)
    if as_json:
        click.echo(json.dumps(modbus_document(found), ensure_ascii=False))
    else:
        show_device(found, console(), wide=wide)
    return stop.code() or (0 if found.survey.blocks else NOTHING_THERE)


@probe.command("can")
@click.option(
    "--interface", default="auto", show_default=True, help="Of python-can: socketcan, pcan, kvaser, slcan ..."
)
@click.option("--channel", help="As 'ip link' or python-can names it.  [default: vcan0]")
@click.option("--port", type=click.IntRange(1024, 65535), default=43113, show_default=True, help="Of udp_multicast.")
@click.option("--bitrate", type=click.IntRange(1000, 1_000_000), help="For interfaces that set it themselves.")
@click.option("--fd", is_flag=True, help="Hear frames of CAN FD as well.")
@click.option("--database", type=FILE, help="A CAN database (DBC, KCD, SYM, ARXML) that knows the frames.")
@click.option("--seconds", type=click.FloatRange(0.1, 86400.0), default=3.0, show_default=True, help="How long.")
@click.option("--json", "as_json", is_flag=True, help="Everything, as JSON.")
def can_(
    interface: str,
    channel: str | None,
    port: int,
    bitrate: int | None,
    fd: bool,
    database: Path | None,
    seconds: float,
    as_json: bool,
) -> int:
    """Listen on a CAN bus, and say which frames come, how regularly, and what in them moves.

    With a database its signals are shown with their values; without, what moves as numbers do is found in the bytes: so
    let the machine move meanwhile. Nothing is sent.

    \b
    Examples:
      otolith probe can                                       the bus of 'otolith plant'
      otolith probe can --channel can0 --seconds 60
      otolith probe can --channel can0 --database drive.dbc
      otolith probe can --interface pcan --channel PCAN_USBBUS1 --bitrate 500000
    """
    import time

    from otolith.cli.probe_view import can_document, console, listen, show_bus
    from otolith_drivers.canbus.bus import BusOptions
    from otolith_drivers.config_files import validated

    rate = {} if bitrate is None else {"bitrate": f"{bitrate} bit/s"}
    options = validated({"interface": interface, "channel": channel, "port": port, "fd": fd} | rate, BusOptions, ())
    stop = StopSignal()
    terminal = console()
    begun = time.monotonic()
    live = terminal if terminal.is_terminal and not as_json else None
    picture = listen(options, database, seconds, lambda: stop.number is not None, live)
    elapsed = time.monotonic() - begun
    if as_json:
        click.echo(json.dumps(can_document(picture, options, database, elapsed), ensure_ascii=False))
    else:
        show_bus(picture, options, database, elapsed, terminal)
    return stop.code() or (0 if picture.frames else NOTHING_THERE)


def _address(target: str) -> dict[str, Any]:
    """Host and port, or serial port, as keys of the machine file."""
    if target.startswith(("/", "COM")):
        return {"serial": target}
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([^\s:/\[\]]+))(?::(\d{1,5}))?", target)
    if match is None or not 1 <= int(match[3] or 502) <= 65535:
        raise click.BadParameter(f"{target!r} is no HOST, HOST:PORT or /dev/tty...", param_hint="TARGET")
    return {"host": match[1] or match[2], "port": int(match[3] or 502)}


@contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """A line on standard error, if somebody sees it."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: None
        return
    with console.status("opening") as status:
        yield status.update
