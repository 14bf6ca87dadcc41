"""What a CAN bus or its log offers, with a database."""

from collections import Counter
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from otolith.cli.commissioning.draft.offers import Offer, OfferedSource
from otolith.cli.commissioning.draft.recorded import seen_from
from otolith_drivers.canbus.bus import BusOptions
from otolith_drivers.canbus.database import load_dbc
from otolith_drivers.canbus.probe import COUNTER_OR_CHECKSUM, Picture, can_driver_lines
from otolith_drivers.errors import ConfigurationError, DeviceError, counted, some_names
from otolith_drivers.grammars.toml_lines import toml_value
from otolith_drivers.replay.can_log import frames_in
from otolith_drivers.units import is_unit

if TYPE_CHECKING:
    from otolith.cli.common import StopSignal

MAX_FRAMES = 200_000  # of a log that are looked at


def log_offers(log: Path, database: Path, bus: BusOptions, folder: Path) -> OfferedSource:
    """Return what a log offers; raise ConfigurationError if no frame of it is in the database."""
    picture = Picture(load_dbc(database))
    first = last = None
    for frame in islice(frames_in(log), MAX_FRAMES):
        picture.take(frame, frame.timestamp)
        last = frame.timestamp
        first = last if first is None else first
    duration = (last or 0.0) - (first or 0.0)
    title = f"{log}: {counted(picture.frames, 'frame')} in {duration:.6g} s"
    offers = _offers(picture)
    if not offers:
        raise ConfigurationError(f"{log}: no signal of {database} is in any of its {picture.frames} frames")
    driver = can_driver_lines(bus, picture, seen_from(database, folder))
    return OfferedSource(title, driver, offers, duration, check=str(log), remarks=_remarks(picture))


def bus_offers(database: Path, bus: BusOptions, seconds: float, folder: Path, stop: "StopSignal") -> OfferedSource:
    """Return what came from a bus within ``seconds``; raise DeviceError if no frame of the database came."""
    from otolith.cli.commissioning.probe import listen

    picture = listen(bus, database, seconds, stop, live=False)
    title = f"CAN bus {bus.title()}: {counted(picture.frames, 'frame')} in {seconds:g} s"
    offers = _offers(picture)
    if not offers:
        asked = f"no signal of {database} came in {seconds:g} s: is the machine on?"
        remedy = "'otolith probe can' shows what is on the bus; --no-bus proposes from the database alone"
        raise DeviceError(f"CAN bus {bus.title()}: {asked} {remedy}")
    driver = can_driver_lines(bus, picture, seen_from(database, folder))
    return OfferedSource(title, driver, offers, 0.0, remarks=_remarks(picture))


def database_offers(database: Path, bus: BusOptions, folder: Path) -> OfferedSource:
    """Return what a database describes, with nothing received; raise ConfigurationError if it has no signal."""
    found = load_dbc(database)
    rows = [
        (message, signal)
        for message in found.messages
        for signal in message.signals
        if signal.unit or not COUNTER_OR_CHECKSUM.search(signal.name)
    ]
    if not rows:
        raise ConfigurationError(f"{database}: no signal beside counters and checksums")
    names = Counter(signal.name for _, signal in rows)
    offers = []
    for message, signal in rows:
        is_unique = names[signal.name] == 1
        keys = {"signal": signal.name} | ({} if is_unique else {"message": message.name})
        cycle = message.cycle_time if isinstance(message.cycle_time, int | float) and message.cycle_time > 0 else None
        ends = [end for end in (signal.minimum, signal.maximum) if end is not None]
        unit = signal.unit if signal.unit and is_unit(signal.unit) else None
        interval = None if cycle is None else 1e-3 * float(cycle)
        name = signal.name if is_unique else f"{message.name}.{signal.name}"
        offers.append(Offer(name, unit, keys, np.array(ends if len(ends) == 2 else [], dtype=float), interval))
    lines = [*can_driver_lines(bus, Picture(found), None), f"dbc = {toml_value(seen_from(database, folder))}"]
    remark = "nothing was received: least and most are ranges of the database, and 'every' is its cycle time"
    title = f"{database}: {counted(len(offers), 'signal')}"
    return OfferedSource(title, lines, offers, 0.0, remarks=[remark], doubt="not received yet: confirm it")


def _offers(picture: Picture) -> list[Offer]:
    """Return the signals that came, without counters and checksums; of several sources of one message the first."""
    rows = [row for row in picture.signals() if row[1].unit or not COUNTER_OR_CHECKSUM.search(row[1].name)]
    titles: dict[str, str] = {}
    for frames, _, _ in rows:
        titles.setdefault(frames.message.name if frames.message else "", frames.title)
    rows = [row for row in rows if row[0].message and row[0].title == titles[row[0].message.name]]
    names = Counter(signal.name for _, signal, _ in rows)
    series = {title: frames.series() for title, frames in {row[0].title: row[0] for row in rows}.items()}
    offers = []
    for frames, signal, _ in rows:
        message = frames.message.name if frames.message else ""
        keys = {"signal": signal.name} | ({"message": message} if names[signal.name] > 1 else {})
        name = signal.name if names[signal.name] == 1 else f"{message}.{signal.name}"
        unit = signal.unit if signal.unit and is_unit(signal.unit) else None
        offers.append(Offer(name, unit, keys, np.array(series[frames.title][signal.name]), frames.period))
    return offers


def _remarks(picture: Picture) -> list[str]:
    missing = [message.name for message in picture.missing()]
    return [f"in the database, but not received: {some_names(missing)}"] if missing else []
