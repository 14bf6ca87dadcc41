"""``otolith probe``: what is on a bus, and lines for the machine file."""

import contextlib
import re
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import AS_JSON, FILE, StopSignal, progress_line
from otolith.cli.terminal import echo, echo_json

if TYPE_CHECKING:
    from asyncua import Client

    from otolith.cli.commissioning.probe_view import DeviceProbe
    from otolith_drivers.canbus.bus import BusOptions
    from otolith_drivers.canbus.probe import Picture
    from otolith_drivers.modbus.probe import Answer, Place
    from otolith_drivers.opcua.connection import OpcuaOptions, Variable

NOTHING_THERE = 1  # exit code
MAX_REGISTERS = 1000  # in one call
MAX_NUMBER_REGISTERS = 4  # registers of the longest number, of 64 bits
MODBUS_PORT = 502
DEVICES = (1, 247)  # device numbers that the Modbus specification allows
RECEIVE_TIMEOUT = 0.1  # s; how late a stop is noticed
REFRESH = 4.0  # Hz of the live table
SHOWN_VALUE = 40  # characters of a value of OPC UA
Span = tuple[int, int]
NUMBER = r"0x[0-9A-Fa-f]{1,4}|\d{1,5}"  # manuals write registers in either way


class Range(click.ParamType[Span]):
    """``"7"`` or ``"0..63"``, also ``"0xFD00..0xFD1F"``: the first and the last number, within bounds."""

    name = "N | LOW..HIGH"

    def __init__(self, low: int, high: int, max_count: int) -> None:
        self._low, self._high, self._max_count = low, high, max_count

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Span:
        """First and last."""
        match = re.fullmatch(rf"({NUMBER})(?:\.\.({NUMBER}))?", str(value).strip())
        if match is None:
            self.fail(f"{value!r}: write one number like 7, or the first and the last like 0..63", param, ctx)
        first, last = (int(number, 16 if "x" in number else 10) for number in (match[1], match[2] or match[1]))
        if not self._low <= first <= last <= self._high:
            self.fail(f"{value!r}: from {self._low} to {self._high}, the lower one first", param, ctx)
        if last - first >= self._max_count:
            self.fail(f"{value!r}: at most {self._max_count} at once", param, ctx)
        return first, last


@click.group()
def probe() -> None:
    """Show what is on a bus, and print lines for the machine file.

    The commands only listen or read; they never write.

    \b
    Examples:
      otolith probe can
      otolith probe can --channel can0 --database drive.dbc
      otolith probe modbus 192.168.0.10
      otolith probe modbus /dev/ttyUSB0 --baudrate 9600 --parity N --scan
      otolith probe opcua opc.tcp://192.168.0.10:4840
    """


@probe.command()
@click.argument("target", metavar="HOST[:PORT]|/dev/ttyUSB0")
@click.option("--device", type=Range(0, 255, 256),
              help="Device number (unit, slave); with --scan a range.  [default: 1]")  # fmt: skip
@click.option("--registers", type=Range(0, 65536, MAX_REGISTERS),
              help="Which, or one to show in every type and order.  [default: the first 64]")  # fmt: skip
@click.option("--table", type=click.Choice(["holding", "input"]), default="holding")
@click.option("--first-address", type=click.IntRange(0, 1), default=0, help="What the manual calls the first register.")
@click.option("--baudrate", type=click.IntRange(300, 4_000_000), default=19200, help="Of a serial line.")
@click.option("--parity", type=click.Choice(["N", "E", "O"]), default="E", help="Of a serial line.")
@click.option("--stop-bits", type=click.Choice(["1", "2"]), default="1", help="Of a serial line.")
@click.option("--framing", type=click.Choice(["tcp", "rtu"]), default="tcp",
              help="Of a host; rtu for a gateway that passes serial frames on.")  # fmt: skip
@click.option("--timeout", type=click.FloatRange(0.01, 10.0), metavar="SECONDS",
              help="How long a device may take.  [default: 0.5; with --scan 0.2]")  # fmt: skip
@click.option("--seconds", type=click.FloatRange(0.0, 3600.0), default=3.0, help="How long to read.")
@click.option("--wide", is_flag=True, help="Show numbers of 64 bits as well.")
@click.option("--scan", is_flag=True, help="Ask all devices of a line for one register, and list those that answer.")
@AS_JSON
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
    """Read Modbus registers repeatedly, and infer their numbers.

    Type and byte order are inferred from values that change, so let the machine move meanwhile. Registers that the
    device refuses are listed. TARGET is a host, with a port unless it is 502, or a serial port.

    \b
    Examples:
      otolith probe modbus 192.168.0.10
      otolith probe modbus plc:1502 --registers 100..163 --table input
      otolith probe modbus 192.168.0.10 --registers 100
      otolith probe modbus /dev/ttyUSB0 --baudrate 9600 --parity N --device 5
      otolith probe modbus /dev/ttyUSB0 --scan
    """
    from otolith.cli.commissioning.probe_view import modbus_document, show_device, stdout_console
    from otolith_drivers.config_files import validated
    from otolith_drivers.modbus.options import LineOptions
    from otolith_drivers.modbus.probe import Place

    if device is not None and device[0] != device[1] and not scan:
        raise click.BadParameter("a range of devices needs --scan", param_hint="--device")
    first, last = registers or (first_address, first_address + 63)
    if first < first_address:
        raise click.BadParameter("with --first-address 1 there is no register 0", param_hint="--registers")
    keys = {"framing": framing, "baudrate": baudrate, "parity": parity, "stop_bits": int(stop_bits)}
    keys |= address_keys(target) | {"timeout": f"{timeout or (0.2 if scan else 0.5)} s"}
    devices = device or (DEVICES if scan else (1, 1))
    place = Place(validated(keys, LineOptions, ()), devices[0], "holding" if table == "holding" else "input",
                  first_address)  # fmt: skip
    stop = StopSignal()
    if scan:
        answers = _scan(place, devices, first - first_address, stop)
        if as_json:
            rows = [{"device": answer.device, "refused": answer.reply} for answer in answers]
            echo_json({"devices": rows})
        else:
            echo(*_scan_lines(place, devices, answers))
        return stop.code() or (0 if answers else NOTHING_THERE)
    probed = read_registers(place, (first - first_address, last - first_address), seconds, stop)
    if as_json:
        echo_json(modbus_document(probed))
    else:
        show_device(probed, stdout_console(), wide=wide)
    return stop.code() or (0 if probed.survey.blocks else NOTHING_THERE)


def address_keys(target: str) -> dict[str, Any]:
    """Host and port, or serial port, as keys of the machine file."""
    if target.startswith(("/", "COM")):
        return {"serial": target}
    match = re.fullmatch(r"(?:\[([0-9A-Fa-f:.%\w]+)\]|([^\s:/\[\]]+))(?::(\d{1,5}))?", target)
    port = int(match[3] or MODBUS_PORT) if match else 0
    if match is None or not 1 <= port <= 65535:
        raise click.BadParameter(f"{target!r} is no HOST, HOST:PORT or /dev/tty...", param_hint="TARGET")
    return {"host": match[1] or match[2], "port": port}


def _scan(place: "Place", devices: Span, address: int, stop: StopSignal) -> "list[Answer]":
    """The devices that answer for the register at ``address`` (on the wire); raise DeviceError if the line fails."""
    from otolith_drivers.modbus.probe import ProbeClient, opened, scan

    with progress_line("opening") as show, opened(place.options, show) as line:
        client = ProbeClient(line, place.options, devices[0], place.table)
        return scan(client, range(devices[0], devices[1] + 1), address, stop.received, show)


def _scan_lines(place: "Place", devices: Span, answers: "list[Answer]") -> Iterator[str]:
    from otolith_drivers.modbus.probe import spans

    asked = devices[1] - devices[0] + 1
    yield f"{place.options.title()}: {len(answers)} of {asked} devices answer"
    for reply in dict.fromkeys(answer.reply for answer in answers):
        alike = spans([answer.device for answer in answers if answer.reply == reply], "device")
        yield alike + (f" (that register is refused: {reply})" if reply else "")
    if len(answers) == asked > 1:
        yield "all of them answer: this host seems to ignore the device number"
    if not answers and place.options.host is None:
        yield "are baud rate, parity and stop bits right, and the two wires not swapped?"
    elif not answers:
        yield "is it the right host, or is it a gateway with framing = rtu?"


def read_registers(place: "Place", addresses: Span, seconds: float, stop: StopSignal) -> "DeviceProbe":
    """What the registers at ``addresses`` (on the wire) hold for ``seconds``; raise DeviceError without an answer."""
    from otolith.cli.commissioning.probe_view import DeviceProbe
    from otolith_drivers.modbus.options import HIGHEST_ADDRESS
    from otolith_drivers.modbus.probe import ProbeClient, numbers_of, opened, speeds, survey, watch

    with progress_line("opening") as show, opened(place.options, show) as line:
        client = ProbeClient(line, place.options, place.device, place.table)
        first, last = addresses
        if first == last:
            last = min(first + MAX_NUMBER_REGISTERS - 1, HIGHEST_ADDRESS)
        surveyed = survey(client, first, last, stop.received, show)
        client.round_trips.clear()  # the first requests take longer
        begun = time.monotonic()
        readings, changes = watch(client, surveyed.blocks, seconds, stop.received, show)
        elapsed = time.monotonic() - begun
        show("comparing")
        requests = speeds(client, surveyed.blocks)
        return DeviceProbe(place, addresses, surveyed, readings, changes, requests, elapsed, numbers_of(readings))


@probe.command("can")
@click.option("--interface", default="auto", help="Of python-can: socketcan, pcan, kvaser, slcan ...")
@click.option("--channel", help="As 'ip link' or python-can names it.  [default: vcan0]")
@click.option("--port", type=click.IntRange(1024, 65535), default=43113, help="Of udp_multicast.")
@click.option("--bitrate", type=click.IntRange(1000, 1_000_000), help="For interfaces that set it themselves.")
@click.option("--fd", is_flag=True, help="Receive frames of CAN FD as well.")
@click.option("--database", type=FILE, help="A CAN database (DBC, KCD, SYM, ARXML) that describes the frames.")
@click.option("--seconds", type=click.FloatRange(0.1, 86400.0), default=3.0, help="How long.")
@AS_JSON
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
    """Listen on a CAN bus, and show frames, periods and changes.

    With a database, its signals are shown with their values. Without one, numbers are inferred from bytes that change,
    so let the machine move meanwhile. Nothing is sent.

    \b
    Examples:
      otolith probe can
      otolith probe can --channel can0 --seconds 60
      otolith probe can --channel can0 --database drive.dbc
      otolith probe can --interface pcan --channel PCAN_USBBUS1 --bitrate 500000
    """
    from otolith.cli.commissioning.probe_view import can_document, remarks, show_bus, stdout_console
    from otolith_drivers.canbus.bus import BusOptions
    from otolith_drivers.config_files import validated

    rate = {} if bitrate is None else {"bitrate": f"{bitrate} bit/s"}
    options = validated({"interface": interface, "channel": channel, "port": port, "fd": fd} | rate, BusOptions, ())
    stop = StopSignal()
    begun = time.monotonic()
    picture = listen(options, database, seconds, stop, live=not as_json)
    elapsed = time.monotonic() - begun
    if as_json:
        echo_json(can_document(picture, options, database, elapsed))
    else:
        show_bus(picture, options, database, elapsed, stdout_console())
        if not picture.frames:
            echo(*remarks(picture), *_hints(options, picture))
    return stop.code() or (0 if picture.frames else NOTHING_THERE)


def listen(options: "BusOptions", database: Path | None, seconds: float, stop: StopSignal, *, live: bool) -> "Picture":
    """What came in ``seconds`` s; ``live`` shows it meanwhile if standard output is a terminal. Nothing is sent.

    Raises:
        DeviceError: the bus cannot be opened, or breaks.
        ConfigurationError: the database cannot be read.
    """
    from rich.console import Group
    from rich.live import Live

    from otolith.cli.commissioning.probe_view import bus_title, stdout_console, tables
    from otolith_drivers.canbus.bus import open_bus
    from otolith_drivers.canbus.database import load_dbc
    from otolith_drivers.canbus.probe import Picture

    picture = Picture(load_dbc(database) if database is not None else None)
    console = stdout_console()

    def draw() -> Group:
        return Group(f"{bus_title(options, picture)}; Ctrl-C ends it", *tables(picture, console.width))

    bus = open_bus(options, listen_only=True)
    shown = Live(get_renderable=draw, console=console, refresh_per_second=REFRESH, transient=True)
    try:
        with shown if live and console.is_terminal else contextlib.nullcontext():
            _receive(bus, options, picture, seconds, stop)
    finally:
        with contextlib.suppress(Exception):  # the frames that came matter more than a clean end
            bus.shutdown()
    return picture


def _receive(bus: Any, options: "BusOptions", picture: "Picture", seconds: float, stop: StopSignal) -> None:
    from otolith_drivers.canbus.bus import MAX_CONSECUTIVE_BAD, is_gone
    from otolith_drivers.errors import DeviceError

    end, bad = time.monotonic() + seconds, 0
    while (left := end - time.monotonic()) > 0.0 and not stop.received():
        try:
            frame = bus.recv(min(left, RECEIVE_TIMEOUT))
        except Exception as error:  # a vendor's library raises types of its own
            bad += 1
            picture.unreadable += 1
            if is_gone(error) or bad > MAX_CONSECUTIVE_BAD:
                raise DeviceError(f"CAN bus {options.title()}: {error}; was the interface taken down?") from error
            continue
        bad = 0
        if frame is not None:
            picture.take(frame, frame.timestamp or time.monotonic())


def _hints(options: "BusOptions", picture: "Picture") -> Iterator[str]:
    """What to try where no frame came."""
    interface, channel = options.resolved()
    if interface == "udp_multicast":
        yield "nothing was received: this virtual bus only has programs of this computer, such as 'otolith plant'"
        yield "for a real bus: --channel can0, or what 'ip -brief link show type can' lists"
        return
    if picture.error_frames:
        yield "only error frames were received: the bit rate is most likely wrong, or the wires are swapped"
    else:
        yield "nothing was received; what to try:"
    if interface == "socketcan":
        yield f"- is it up, and at which bit rate? 'ip -details link show {channel}' prints both"
        yield f"- another bit rate: 'ip link set {channel} down && ip link set {channel} up type can bitrate 500000'"
    else:
        yield "- another bit rate: --bitrate 250000, 500000 or 1000000"
    yield "- termination: 60 ohm between CAN-H and CAN-L while everything is switched off"
    yield "- does any node send? A CANopen drive only sends heartbeats until a master starts it"


@probe.command()
@click.argument("endpoint", metavar="ENDPOINT")
@click.option("--security", type=click.Choice(["none", "Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss"]),
              default="none")  # fmt: skip
@click.option("--mode", type=click.Choice(["sign", "sign and encrypt"]), default="sign and encrypt")
@click.option("--certificate", type=FILE, help="Of this client; the server must trust it.")
@click.option("--key", type=FILE, help="The private key of the certificate.")
@click.option("--server-certificate", type=FILE, help="The only one that is accepted from the server.")
@click.option("--user", help="With --password-file.")
@click.option("--password-file", type=FILE, help="A file whose first line is the password.")
@click.option("--timeout", type=click.FloatRange(0.1, 60.0), default=4.0, metavar="SECONDS", help="For each answer.")
@click.option("--most", type=click.IntRange(1, 10_000), default=500, help="Variables that are shown.")
@AS_JSON
def opcua(endpoint: str, timeout: float, most: int, as_json: bool, **keys: Any) -> int:
    """List the variables of an OPC UA server with value, type and unit.

    The lines can be copied into [signals]. Nothing is written to the server.

    \b
    Examples:
      otolith probe opcua opc.tcp://192.168.0.10:4840
      otolith probe opcua opc.tcp://plc:4840 --user otolith --password-file pw
    """
    import asyncio

    from otolith.cli.commissioning.probe_view import stdout_console
    from otolith_drivers.base import find_driver
    from otolith_drivers.config_files import validated

    find_driver("opcua")  # names the extra that is missing
    from otolith_drivers.opcua.connection import OpcuaOptions

    given = {name: value for name, value in keys.items() if value is not None}
    options = validated({"endpoint": endpoint, "timeout": f"{timeout} s"} | given, OpcuaOptions, ())
    with progress_line(f"reading {endpoint}"):
        variables = asyncio.run(_browse(options, most))
    if as_json:
        echo_json({"variables": [_opcua_document(one) for one in variables]})
    else:
        console = stdout_console()
        for variable in variables:
            console.print(_opcua_line(variable), soft_wrap=True)
        count = f"{len(variables)} variables" + (", as many as --most allows" if len(variables) == most else "")
        console.print(count if variables else "no variables beside those of OPC UA itself")
    return 0 if variables else NOTHING_THERE


async def _browse(options: "OpcuaOptions", most: int) -> "list[Variable]":
    from otolith_drivers.opcua.connection import browse

    async with opened_server(options, Path()) as client:
        return await browse(client, most)


@contextlib.asynccontextmanager
async def opened_server(options: "OpcuaOptions", folder: Path) -> "AsyncIterator[Client]":
    """A session with the server; DeviceError if it cannot be read. Files of ``options`` are relative to ``folder``."""
    from otolith_drivers.errors import DeviceError
    from otolith_drivers.opcua.connection import OpcUaCredentials, connected, reason

    credentials = OpcUaCredentials.load(options, folder)
    try:
        async with connected(options, credentials) as (client, _):
            yield client
    except Exception as error:  # the library raises anything that a server makes it raise
        refused = isinstance(error, ConnectionRefusedError)
        remedy = "; the host answers, but the port is closed: is the server on, and the port right?" if refused else ""
        raise DeviceError(f"OPC UA {options.endpoint}: {reason(error, options.timeout)}{remedy}") from error


def _opcua_document(variable: "Variable") -> dict[str, Any]:
    value = variable.value if isinstance(variable.value, bool | int | float | str) else None
    rest = {"type": variable.type, "unit": variable.unit, "status": variable.status}
    return {"node": variable.node, "path": variable.path, "value": value} | rest


def _opcua_line(variable: "Variable") -> str:
    """Return a line for [signals], with the rest as a comment."""
    from otolith_drivers.grammars.toml_lines import toml_comment, toml_key, toml_value

    name = "".join(sign if sign.isalnum() else "_" for sign in variable.path.rpartition("/")[2]) or "signal"
    value = str(variable.value)
    short = value if len(value) <= SHOWN_VALUE else f"{value[:SHOWN_VALUE]}..."
    in_unit, unit = (f" {variable.unit}", "") if variable.unit else ("", ', unit = "?"')
    status = "" if variable.status == "Good" else f", status {variable.status}"
    remark = toml_comment(f"{variable.path}: {short}{in_unit}, {variable.type}{status}")
    return f"{toml_key(name)} = {{ node = {toml_value(variable.node)}{unit} }}  {remark}"
