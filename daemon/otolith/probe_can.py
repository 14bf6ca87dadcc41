"""What ``otolith probe can`` says: frames and signals on a CAN bus, live and at the end, and lines for the file."""

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.text import Text

from otolith.probe_grids import Row, grids
from otolith_drivers.can_bus import MOST_BAD_IN_A_ROW, BusOptions, is_gone, open_bus
from otolith_drivers.dbc import load_dbc
from otolith_drivers.errors import DeviceError
from otolith_drivers.probe_can import Heard, Picture, within
from otolith_drivers.probe_frames import driver_lines, fields_of, signal_lines, value_text

RECEIVE_TIMEOUT = 0.1  # s; how late an end is noticed
REFRESH = 4.0  # Hz of the live table
MOST_NAMED = 12  # messages in a line
LEGEND = "[..] bytes that have changed    ± half of the width in which 19 of 20 periods lie"


def listen(
    options: BusOptions, database: Path | None, seconds: float, stopped: Callable[[], bool], live: Console | None
) -> Picture:
    """Hear what is on the bus for so many seconds, with a table on ``live`` meanwhile; nothing is sent.

    Raises:
        DeviceError: the bus cannot be opened, or breaks.
        ConfigurationError: the database cannot be read.
    """
    picture = Picture(load_dbc(database) if database is not None else None)
    bus = open_bus(options, listen_only=True)
    shown = Live(_Board(picture, options), console=live, refresh_per_second=REFRESH, transient=True) if live else None
    try:
        with shown or contextlib.nullcontext():
            _receive(bus, options, picture, seconds, stopped)
    finally:
        with contextlib.suppress(Exception):  # it is being given up, and what was heard is what counts
            bus.shutdown()
    return picture


def _receive(bus: Any, options: BusOptions, picture: Picture, seconds: float, stopped: Callable[[], bool]) -> None:
    end = time.monotonic() + seconds
    bad = 0
    while (left := end - time.monotonic()) > 0.0 and not stopped():
        try:
            frame = bus.recv(min(left, RECEIVE_TIMEOUT))
        except Exception as error:  # interfaces raise whatever their vendor's library does
            bad += 1
            picture.unreadable += 1
            if is_gone(error) or bad > MOST_BAD_IN_A_ROW:
                raise DeviceError(f"CAN bus {options.title()}: {error}; was the interface taken down?") from error
            continue
        bad = 0
        if frame is not None:
            picture.take(frame, frame.timestamp or time.monotonic())


class _Board:
    """The tables as they are now."""

    def __init__(self, picture: Picture, options: BusOptions) -> None:
        self._picture, self._options = picture, options

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Drawn anew each time."""
        yield Text(f"{_title(self._options, self._picture)}; Ctrl-C ends it")
        yield Group(*tables(self._picture, options.max_width))


def _title(options: BusOptions, picture: Picture) -> str:
    identifiers = f"{len(picture.heard)} arbitration ID{'s' * (len(picture.heard) != 1)}"
    return f"CAN bus {options.title()}, only listening: {picture.frames} frames of {identifiers}"


def tables(picture: Picture, width: int) -> Iterator[RenderableType]:
    """Frames, and the signals in them that a database knows."""
    if picture.heard:
        yield from grids(("ID", "data"), [_frame(picture, heard) for heard in picture.ordered()], width)
    rows = [_signal(heard.message.name, signal, value) for heard, signal, value in picture.signals() if heard.message]
    if rows:
        yield Text("")
        yield from grids(("signal", "unit"), rows, width)
    yield from (Text(line, style="yellow") for line in remarks(picture))


def _frame(picture: Picture, heard: Heard) -> Row:
    lengths = sorted({min(heard.lengths, default=0), max(heard.lengths, default=0)})
    cells = {"bytes": " to ".join(map(str, lengths)), "frames": f"{heard.count}", "Hz": "", "period": ""}
    if heard.period is not None:
        cells["Hz"] = f"{1.0 / heard.period:.3g}"
        cells["period"] = f"{1e3 * heard.period:.3g} ms ± {1e3 * heard.jitter:.2g}" if heard.regular else "irregular"
    cells["what"] = _what(picture, heard)
    row = Row((heard.name, marked(heard)), cells)
    if heard.message is None and picture.has_database:
        row.marks["what"] = "!"
    return row


def _what(picture: Picture, heard: Heard) -> str:
    if heard.remote == heard.count:
        return "remote frames"
    if heard.message is not None:
        short = f"; {heard.undecodable} not decodable" if heard.undecodable else ""
        return f"{heard.message.name}{short}"
    unknown = "not in the database" if picture.has_database else ""
    return "; ".join(filter(None, [unknown, picture.guess(heard)]))


def marked(heard: Heard) -> str:
    """The latest data in hexadecimal digits, with the bytes that have changed in brackets."""
    text = ""
    for place, byte in enumerate(heard.latest):
        now, before = bool(heard.changed[place]), place > 0 and bool(heard.changed[place - 1])
        text += ("]" if before and not now else "") + (" " if place else "") + ("[" if now and not before else "")
        text += f"{byte:02X}"
    return text + ("]" if heard.latest and heard.changed[len(heard.latest) - 1] else "")


def _signal(message: str, signal: Any, value: Any) -> Row:
    low, high = signal.minimum, signal.maximum
    cells = {
        "now": value_text(signal, value.latest),
        "least": value_text(signal, value.low),
        "most": value_text(signal, value.high),
        "range": f"{low:g} to {high:g}" if low is not None and high is not None and low < high else "",
        "beyond": f"{value.beyond} times" if value.beyond else "",
    }
    row = Row((f"{message}.{signal.name}", signal.unit or ""), cells)
    if value.beyond:
        row.marks["beyond"] = "!"
    if not within(signal, value.latest):
        row.marks["now"] = "!"
    return row


def remarks(picture: Picture) -> Iterator[str]:
    """What else there is to say, a line each."""
    if picture.error_frames:
        kinds = ", ".join(f"{count} {name}" for name, count in picture.errors.most_common())
        yield f"{picture.error_frames} error frames: {kinds}"
    if picture.unreadable:
        yield f"{picture.unreadable} frames could not be unpacked"
    if picture.left_out:
        yield f"{picture.left_out} frames of further arbitration IDs are not shown"
    if missing := [message.name for message in picture.missing()]:
        shown = ", ".join(missing[:MOST_NAMED]) + (
            f" and {len(missing) - MOST_NAMED} more" * (len(missing) > MOST_NAMED)
        )
        yield f"in the database, but not heard: {shown}"


def show_bus(picture: Picture, options: BusOptions, database: Path | None, seconds: float, console: Console) -> None:
    """All that was heard, and lines for the machine file."""
    console.print(f"{_title(options, picture)} in {seconds:.1f} s")
    if not picture.frames:
        for line in (*remarks(picture), *silence(options, picture)):
            console.print(line, markup=False)
        return
    console.print()
    for table in tables(picture, console.width):
        console.print(table)
    console.print(LEGEND, style="dim", markup=False, soft_wrap=True)
    console.print()
    for line in lines_of(picture, options, database):
        console.print(line, markup=False, soft_wrap=True)


def lines_of(picture: Picture, options: BusOptions, database: Path | None) -> list[str]:
    """For the machine file."""
    lines = [
        *driver_lines(options, picture, str(database.absolute()) if database else None),
        "",
        *signal_lines(picture),
    ]
    quiet = [heard.name for heard in picture.ordered() if heard.message is None and not fields_of(heard)]
    if quiet:
        shown = ", ".join(quiet[:MOST_NAMED]) + (" ..." if len(quiet) > MOST_NAMED else "")
        lines.append(f"# no number moves smoothly in {shown}: move the machine and probe again")
    return lines


def silence(options: BusOptions, picture: Picture) -> Iterator[str]:
    """What to try where nothing was heard."""
    interface, channel = options.resolved()
    if interface == "udp_multicast":
        yield "nothing was heard: on this virtual bus only programs of this computer speak, such as 'otolith plant'"
        yield "for a real bus: --channel can0, or what 'ip -brief link show type can' lists"
        return
    if picture.error_frames:
        yield "only error frames were heard: the bit rate is most likely another one, or the wires are swapped"
    else:
        yield "nothing was heard; what to try:"
    if interface == "socketcan":
        yield f"- is it up, and at which bit rate? 'ip -details link show {channel}' says so"
        yield f"- another bit rate: 'ip link set {channel} down && ip link set {channel} up type can bitrate 500000'"
    else:
        yield "- another bit rate: --bitrate 250000, 500000 or 1000000"
    yield "- termination: 60 ohm between CAN-H and CAN-L while everything is switched off"
    yield "- does anybody send? A CANopen drive says nothing but heartbeats until a master starts it"


def document(picture: Picture, options: BusOptions, database: Path | None, seconds: float) -> dict[str, Any]:
    """The same for machines."""
    return {
        "bus": options.title(),
        "seconds": seconds,
        "frames": [_frame_document(picture, heard) for heard in picture.ordered()],
        "signals": [
            {
                "message": heard.message.name if heard.message else None,
                "signal": signal.name,
                "unit": signal.unit,
                "latest": value.latest,
                "low": value.low,
                "high": value.high,
                "beyond": value.beyond,
            }
            for heard, signal, value in picture.signals()
        ],
        "error_frames": picture.error_frames,
        "errors": dict(picture.errors),
        "unreadable": picture.unreadable,
        "not_heard": [message.name for message in picture.missing()],
        "lines": lines_of(picture, options, database) if picture.frames else [],
    }


def _frame_document(picture: Picture, heard: Heard) -> dict[str, Any]:
    return {
        "id": heard.name,
        "extended": heard.extended,
        "count": heard.count,
        "rate_hz": 1.0 / heard.period if heard.period else None,
        "period_s": heard.period,
        "jitter_s": heard.jitter,
        "lengths": sorted(heard.lengths),
        "data": heard.latest.hex(),
        "changed": bytes(heard.changed).hex(),
        "message": heard.message.name if heard.message else None,
        "undecodable": heard.undecodable,
        "guess": picture.guess(heard),
    }
