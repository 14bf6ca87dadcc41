"""Where in the frames a signal is: in a database, in bits that the machine file names, or in an object of a drive."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cantools.database import Message
from cantools.database import Signal as CanSignal

from otolith_drivers.base import Signal
from otolith_drivers.can_fields import bytes_needed
from otolith_drivers.can_source import Source
from otolith_drivers.dbc import Loaded
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.quantities import factor

LARGEST = 1e300
ROUNDING = 1e-6  # of a bound: 0.1 in a frame of 32-bit floats is above 0.1


@dataclass(frozen=True, slots=True)
class Wanted:
    """A signal of the machine as the frames carry it."""

    name: str
    target_unit: str
    message: Message
    signal: CanSignal
    origin: str
    """Where it is read, in words."""
    raw_low: float
    raw_high: float
    """The raw numbers that are readings; one beyond is a code for "no reading", or wrong."""
    scale: float
    offset: float
    """From a raw number to the target unit."""

    def describe(self) -> str:
        """What is read from where, in words."""
        return f"{self.name} [{self.target_unit}] from {self.origin}"


def wanted_of(signal: Signal, message: Message, found: CanSignal, origin: str) -> Wanted:
    """What ``signal`` is in ``message``, of which it is ``found``.

    Raises:
        ConfigurationError: it has no unit, or one that measures something else.
    """
    key = ("signals", signal.name)
    source: Source = signal.source
    unit = source.unit or found.unit
    if unit is None:
        raise ConfigurationError(f"{origin} has no unit: set 'unit' beside it", key)
    try:
        scale, offset = factor(unit, signal.unit)
    except ValueError as error:
        raise ConfigurationError(f"{origin}: {error}", key) from error
    inner = (float(found.conversion.scale), float(found.conversion.offset))
    slope, zero = source.scale * inner[0], source.scale * inner[1] + source.offset
    if slope == 0.0 or not math.isfinite(slope + zero):
        raise ConfigurationError(f"{origin} has a scale of {inner[0]:g} and an offset of {inner[1]:g}", key)
    if source.range is not None:
        low, high = _raw_ends(*source.range, slope, zero)
    else:
        low, high = _raw_ends(found.minimum, found.maximum, *inner)
    limit = LARGEST / max(1.0, abs(scale * slope))  # beyond the largest float there is no value, in a frame or scaled
    return Wanted(
        name=signal.name,
        target_unit=signal.unit,
        message=message,
        signal=found,
        origin=f"{origin}{_times(source)} [{unit}], frame 0x{message.frame_id:X}",
        raw_low=max(low, -limit),
        raw_high=min(high, limit),
        scale=scale * slope,
        offset=scale * zero + offset,
    )


def _raw_ends(low: float | None, high: float | None, slope: float, zero: float) -> tuple[float, float]:
    """The raw numbers, a little apart, of which ``slope * number + zero`` is ``low`` and ``high``."""
    if low is None or high is None or not low < high:  # [0|0] in a DBC means that nobody said
        return -math.inf, math.inf
    ends = sorted((float(end) - zero) / slope for end in (low, high))
    slack = [ROUNDING * abs(end) if math.isfinite(end) else 0.0 for end in ends]
    return ends[0] - slack[0], ends[1] + slack[1]


def _times(source: Source) -> str:
    scale = "" if source.scale == 1.0 else f" * {source.scale:g}"
    return scale if source.offset == 0.0 else f"{scale} {source.offset:+g}"


def find_in_databases(signal: Signal, databases: Sequence[Loaded]) -> Wanted:
    """``signal`` in the databases.

    Raises:
        ConfigurationError: it is not there, is there twice, measures something else, or what it is remains open.
    """
    key = ("signals", signal.name)
    source: Source = signal.source
    if not databases:
        raise ConfigurationError('no database that describes the frames: set dbc = "..." in [driver]', key)
    where = ", ".join(str(loaded.path) for loaded in databases)
    holders = _holders(source, databases)
    if not holders:
        raise ConfigurationError(f"{where}: {_why_not(source, databases)}", key)
    if len(holders) > 1:
        _refuse_ambiguous(signal, holders, where)
    loaded, message, found = holders[0]
    if message.is_container:
        raise ConfigurationError(f"{where}: {message.name} is a container message, which is not supported", key)
    _refuse_faulty(signal, loaded, message, found, databases)
    try:
        return wanted_of(signal, message, found, f"{message.name}.{found.name}")
    except ConfigurationError as error:
        raise ConfigurationError(f"{loaded.path}: {error}", error.key) from error


def _holders(source: Source, databases: Sequence[Loaded]) -> list[tuple[Loaded, Message, CanSignal]]:
    return [
        (loaded, message, entry)
        for loaded in databases
        for message in loaded.messages
        if source.message in (None, message.name)
        for entry in message.signals
        if entry.name == source.signal
    ]


def _why_not(source: Source, databases: Sequence[Loaded]) -> str:
    """Why there is no such signal, and what there is."""
    unread = {name: why for loaded in databases for name, why in loaded.unread.items()}
    messages = [message for loaded in databases for message in loaded.messages]
    if source.message is not None:
        if source.message in unread:
            return f"message {source.message!r} cannot be read: {unread[source.message]}"
        messages = [message for message in messages if message.name == source.message]
        if not messages:
            names = [message.name for loaded in databases for message in loaded.messages]
            return f"no message {source.message!r}: {nearest(source.message, names)}"
    names = sorted({entry.name for message in messages for entry in message.signals})
    more = f"; {len(unread)} messages cannot be read: {', '.join(list(unread)[:3])}" if unread else ""
    return f"no signal {source.signal!r}: {nearest(str(source.signal), names)}{more}"


def _refuse_ambiguous(signal: Signal, holders: list[tuple[Loaded, Message, CanSignal]], where: str) -> None:
    key = ("signals", signal.name)
    names = sorted({message.name for _, message, _ in holders})
    if len(names) > 1:
        raise ConfigurationError(
            f"{where}: signal {signal.source.signal!r} is in {', '.join(names)}: set 'message' beside it", key
        )
    if len({_layout(message, found) for _, message, found in holders}) > 1:
        raise ConfigurationError(
            f"{where}: {names[0]}.{signal.source.signal} is described {len(holders)} times, and differently: "
            "read it by 'id', 'start' and 'length', or correct the database",
            key,
        )


def _refuse_faulty(
    signal: Signal, loaded: Loaded, message: Message, found: CanSignal, databases: Sequence[Loaded]
) -> None:
    """Refuse what would make the value a matter of opinion."""
    key, way_out = ("signals", signal.name), "read it by 'id', 'start' and 'length', or correct the database"
    if faults := loaded.faults_of(message, found.name):
        raise ConfigurationError(f"{loaded.path}: {faults[0].text}: {way_out}", key)
    if found.conversion.is_float and found.length not in (16, 32, 64):
        raise ConfigurationError(
            f"{loaded.path}: {message.name}.{found.name} is a floating-point number of {found.length} bits: {way_out}",
            key,
        )
    if signal.source.message is not None:
        return
    for other in databases:
        for rival in other.messages:
            same = (rival.frame_id, rival.is_extended_frame) == (message.frame_id, message.is_extended_frame)
            if same and rival.name != message.name:
                raise ConfigurationError(
                    f"{other.path}: frame 0x{message.frame_id:X} is both {message.name} and {rival.name}: "
                    "say which it is by 'message'",
                    key,
                )


def _layout(message: Message, found: CanSignal) -> tuple[object, ...]:
    conversion = found.conversion
    where = (message.frame_id, message.is_extended_frame, found.start, found.length, found.byte_order)
    what = (found.is_signed, conversion.is_float, conversion.scale, conversion.offset, found.unit)
    return (*where, *what, found.multiplexer_signal, tuple(found.multiplexer_ids or ()))


def raw_signal(signal: Signal) -> Wanted:
    """``signal`` by the bits that its source names.

    Raises:
        ConfigurationError: it has no unit, or one that measures something else.
    """
    source: Source = signal.source
    assert source.id is not None  # noqa: S101 - asked for only then
    found = source.bits().as_signal(signal.name)
    size = bytes_needed(found)
    message = Message(
        source.id, f"0x{source.id:X}", size, [found], is_extended_frame=source.extended, is_fd=source.fd, strict=False
    )
    bits = f"bits {source.start}+{source.length}" + (" big" if source.byte_order == "big" else "")
    return wanted_of(signal, message, found, f"{message.name} {bits}")
