"""What a machine file may say of where a signal is in the frames.

Taking one signal out of the bytes of a frame, as fast as plain Python can.

The layout is that of a :class:`cantools.database.Signal`, wherever that came from: a database, a line of the machine
file or the object dictionary of a drive. What comes out is the raw number; scales, ranges and units come later.

Where in the frames a signal is: in a database, in bits that the machine file names, or in an object of a drive.
"""

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import Signal
from otolith_drivers.canbus.database import Loaded
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import factor

FLOATS = {16: "e", 32: "f", 64: "d"}
INTEGERS = {8: "b", 16: "h", 32: "i", 64: "q"}
ORDERS = {"little_endian": "<", "big_endian": ">"}

BitField = Callable[[bytes | bytearray], float]
"""From the data of a frame that is long enough (see :func:`bytes_needed`) to the raw number."""


def bytes_needed(signal: CanSignal) -> int:
    """How long a frame must be to hold ``signal``."""
    return (_first_bit(signal) + signal.length + 7) // 8


def field(signal: CanSignal) -> BitField:
    """How to read ``signal``.

    Raises:
        ValueError: a floating-point number of a length that there is not, or nothing to be read.
    """
    if signal.length < 1 or signal.start < 0:
        raise ValueError(f"{signal.length} bits from bit {signal.start} are no signal")
    if signal.is_float and signal.length not in FLOATS:
        raise ValueError(f"a floating-point number has 16, 32 or 64 bits, not {signal.length}")
    return _whole_bytes(signal) or _any_bits(signal)


def _first_bit(signal: CanSignal) -> int:
    """Counted from the first bit of the frame in the order of the signal's bytes."""
    if signal.byte_order == "little_endian":
        return signal.start
    return 8 * (signal.start // 8) + 7 - signal.start % 8


def _whole_bytes(signal: CanSignal) -> BitField | None:
    """What the processor has a type for is unpacked at once."""
    codes = FLOATS if signal.is_float else INTEGERS
    place, odd = divmod(_first_bit(signal), 8)
    if odd or signal.length not in codes:
        return None
    code = codes[signal.length]
    code = code if signal.is_float or signal.is_signed else code.upper()
    unpack = struct.Struct(ORDERS[signal.byte_order] + code).unpack_from

    def read(data: bytes | bytearray) -> float:
        value: float = unpack(data, place)[0]
        return value

    return read


def _any_bits(signal: CanSignal) -> BitField:
    """Everything else by shifts of the whole frame as one integer."""
    first, mask = _first_bit(signal), (1 << signal.length) - 1
    end = bytes_needed(signal)
    order = "little" if signal.byte_order == "little_endian" else "big"
    shift = first if order == "little" else 8 * end - first - signal.length
    from_bytes = int.from_bytes

    def unsigned(data: bytes | bytearray) -> int:
        return (from_bytes(data[:end], order) >> shift) & mask  # type: ignore[arg-type]

    if signal.is_float:
        size, unpack = signal.length // 8, struct.Struct("<" + FLOATS[signal.length]).unpack
        return lambda data: float(unpack(unsigned(data).to_bytes(size, "little"))[0])
    if not signal.is_signed:
        return unsigned
    sign = 1 << (signal.length - 1)
    return lambda data: (unsigned(data) ^ sign) - sign


CLASSIC_LENGTH, FD_LENGTH = 8, 64  # bytes
STANDARD_LIMIT, EXTENDED_LIMIT = 0x7FF, 0x1FFFFFFF


def whole_number(written: object) -> object:
    """An integer, be it written as a number or as a text like ``"0x181"``."""
    if isinstance(written, bool):
        raise ValueError(f"{written!r} is not a whole number")  # noqa: TRY004 - a fault of a file, not a bug
    if isinstance(written, str):
        try:
            return int(written, 0)
        except ValueError:
            raise ValueError(f'{written!r} is not a whole number: write "0x181" or the like') from None
    return written


Identifier = Annotated[int, BeforeValidator(whole_number), Field(ge=0, le=EXTENDED_LIMIT)]


class BitRange(StrictModel):
    """Where some bits lie, in the words of a DBC."""

    start: Annotated[int, Field(ge=0, lt=8 * FD_LENGTH)]
    """As in a DBC: the number of the lowest bit, or with ``byte_order = "big"`` of the highest."""
    length: Annotated[int, Field(ge=1, le=64)]
    """Bits."""
    byte_order: Literal["little", "big"] = "little"
    signed: bool = False
    float: bool = False
    """An IEEE floating-point number; comes last, because it hides the type of that name."""

    @model_validator(mode="after")
    def _a_float_has_a_known_length(self) -> Self:
        if self.float and self.length not in (16, 32, 64):
            raise ValueError(f"a floating-point number has 16, 32 or 64 bits, not {self.length}")
        return self

    def as_signal(self, name: str) -> CanSignal:
        """The same in the words of cantools."""
        return CanSignal(
            name,
            self.start,
            self.length,
            byte_order="little_endian" if self.byte_order == "little" else "big_endian",
            is_signed=self.signed,
            conversion=BaseConversion.factory(is_float=self.float),
        )


BITS = tuple(BitRange.model_fields)
KINDS: dict[str, tuple[str, ...]] = {
    "signal": ("message",),
    "id": ("extended", "fd", *BITS),
    "node": ("object",),
}
"""The key that says where a signal is, and the keys that go with it alone."""


class Source(StrictModel):
    """``signal`` of a database, bits of the frames with ``id``, or ``object`` of the CANopen ``node``."""

    signal: str | None = None
    message: str | None = None
    """Where more than one message has a signal of this name."""

    id: Identifier | None = None
    extended: bool = False
    fd: bool = False
    start: int | None = None
    length: int | None = None
    byte_order: Literal["little", "big"] = "little"
    signed: bool = False

    node: Annotated[int, Field(ge=1, le=127)] | None = None
    object: str | None = None
    """``"0x6078"``, ``"0x6064:00"``, or the name in the object dictionary."""

    unit: str | None = None
    """On the bus; in place of the database's."""
    scale: float = 1.0
    """``unit`` per what is in the frame, or per the database's unit."""
    offset: float = 0.0
    """In ``unit``."""
    range: tuple[float, float] | None = None
    """In ``unit``: what lies beyond is no reading; in place of the database's."""
    float: bool = False

    @model_validator(mode="after")
    def _is_of_one_kind(self) -> Self:
        said = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(said) != 1:
            ways = '{ signal = "..." } of a database, { id = "0x181", start = 0, length = 16, unit = "V" }'
            raise ValueError(f'say where it is by one of {ways} or {{ node = 5, object = "0x6078", unit = "A" }}')
        for kind, keys in KINDS.items():
            if kind != said[0] and (strange := [key for key in keys if key in self.model_fields_set]):
                raise ValueError(f"{strange[0]!r} goes with {kind!r}, not with {said[0]!r}")
        if self.signal is not None and self.unit is None and (self.scale, self.offset) != (1.0, 0.0):
            raise ValueError("'scale' and 'offset' come after those of the database: say by 'unit' what they lead to")
        if self.node is not None and self.object is None:
            raise ValueError("'object' is missing: write object = \"0x6078\" or the like")
        if self.scale == 0.0:
            raise ValueError("a scale of 0 leaves nothing of the signal")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range: {self.range[0]:g} is not under {self.range[1]:g}")
        if self.id is not None:
            self.bits()
        return self

    def bits(self) -> BitRange:
        """Where the bits of ``id`` are.

        Raises:
            ValueError: they do not fit into its frames.
        """
        assert self.id is not None  # noqa: S101 - asked for only then
        if self.start is None or self.length is None:
            raise ValueError("'start' and 'length' (bits) are missing beside 'id'")
        if self.id > STANDARD_LIMIT and not self.extended:
            raise ValueError(f"id 0x{self.id:X} needs 29 bits: set extended = true")
        found = BitRange(
            start=self.start, length=self.length, byte_order=self.byte_order, signed=self.signed, float=self.float
        )
        size = FD_LENGTH if self.fd else CLASSIC_LENGTH
        if (needed := bytes_needed(found.as_signal(""))) > size:
            way_out = "" if self.fd or needed > FD_LENGTH else ", or set fd = true"
            place = f"{self.length} bits from bit {self.start}"
            raise ValueError(f"{place} reach into byte {needed} of a frame of {size}: correct start or length{way_out}")
        return found


LARGEST = 1e300
ROUNDING = 1e-6  # of a bound: 0.1 in a frame of 32-bit floats is above 0.1


@dataclass(frozen=True, slots=True)
class SignalRequest:
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


def wanted_of(signal: Signal, message: Message, found: CanSignal, origin: str) -> SignalRequest:
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
    return SignalRequest(
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


def find_in_databases(signal: Signal, databases: Sequence[Loaded]) -> SignalRequest:
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


def raw_signal(signal: Signal) -> SignalRequest:
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
