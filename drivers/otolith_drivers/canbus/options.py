"""The CAN tables of a machine file: what describes the frames, and where each signal is in them.

A signal is in a database, in bits that the machine file names, or in a CANopen object. Each way leads to the layout of
a :class:`cantools.database.Signal`. :func:`raw_reader` makes of it a function that reads the raw number; a
:class:`SignalRequest` adds range, scale and unit. All is the same for a live bus and for a log of one.
"""

import math
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated, Literal, Self

from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import ScaledSource, Signal
from otolith_drivers.canbus.database import EXTENDED_LIMIT, STANDARD_LIMIT, CanDatabase
from otolith_drivers.config_files import StrictModel, written_as
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.units import Quantity, UnitNameError, factor

CLASSIC_LENGTH, FD_LENGTH = 8, 64  # bytes of a frame
MAX_VALUE = 1e300  # of a float, raw or scaled; the largest double is 1.8e308
PLACEHOLDER_SHARE = 0.25  # of the raw numbers, below which a range of [0|1] is a placeholder of the tool
RANGE_TOLERANCE = 1e-6  # of a bound: 0.1 in a frame of 32-bit floats is above 0.1
MIN_NUMBER_BITS = 8  # of a signal whose named numbers may stand for no reading; fewer bits are a state
NO_READING = re.compile(
    r"(?<![a-z])(?:sna|n/?a|init\w*|no[ _]?data|reserved)(?![a-z])|not[ _]?(?:avail|valid|def)|invalid|unavail|undef"
    r"|unknown|error|fault|fail|ung[uü]ltig|fehler|nicht[ _]verf",
    re.IGNORECASE,
)  # how databases name such a number

FLOAT_CODES = {16: "e", 32: "f", 64: "d"}
INTEGER_CODES = {8: "b", 16: "h", 32: "i", 64: "q"}
RawReader = Callable[[bytes | bytearray], float]  # From the data of a frame of bytes_needed to the raw number


def bytes_needed(signal: CanSignal) -> int:
    """Bytes that a frame must have to contain ``signal``."""
    return (_first_bit(signal) + signal.length + 7) // 8


def raw_reader(signal: CanSignal) -> RawReader:
    """A function that reads the raw number; raise ValueError without bits, or for an unknown length of a float."""
    if signal.length < 1 or signal.start < 0:
        raise ValueError(f"{signal.length} bits from bit {signal.start} are no signal")
    codes = FLOAT_CODES if signal.is_float else INTEGER_CODES
    if signal.is_float and signal.length not in codes:
        raise ValueError(f"a floating-point number has 16, 32 or 64 bits, not {signal.length}")
    place, odd = divmod(_first_bit(signal), 8)
    if odd or signal.length not in codes:
        return _bit_reader(signal)
    code = codes[signal.length] if signal.is_float or signal.is_signed else codes[signal.length].upper()
    unpack = struct.Struct(("<" if signal.byte_order == "little_endian" else ">") + code).unpack_from

    def read(data: bytes | bytearray) -> float:
        value: float = unpack(data, place)[0]
        return value

    return read


def _first_bit(signal: CanSignal) -> int:
    """The first bit of ``signal``, counted from that of the frame in the byte order of the signal."""
    if signal.byte_order == "little_endian":
        return signal.start
    return 8 * (signal.start // 8) + 7 - signal.start % 8


def _bit_reader(signal: CanSignal) -> RawReader:
    """The reader of a signal that is no whole number of bytes, or of bytes for which there is no type."""
    end, mask = bytes_needed(signal), (1 << signal.length) - 1
    order: Literal["little", "big"] = "little" if signal.byte_order == "little_endian" else "big"
    shift = _first_bit(signal) if order == "little" else 8 * end - _first_bit(signal) - signal.length
    from_bytes = int.from_bytes

    def unsigned(data: bytes | bytearray) -> int:
        return (from_bytes(data[:end], order) >> shift) & mask

    if signal.is_float:
        size, unpack = signal.length // 8, struct.Struct("<" + FLOAT_CODES[signal.length]).unpack
        return lambda data: float(unpack(unsigned(data).to_bytes(size, "little"))[0])
    if not signal.is_signed:
        return unsigned
    sign = 1 << (signal.length - 1)
    return lambda data: (unsigned(data) ^ sign) - sign


def whole_number(written: object) -> object:
    """``written`` as an integer if it is like ``"0x181"``, else unchanged; raise ValueError for other texts."""
    if isinstance(written, bool):
        raise ValueError(f"{written!r} is not a whole number")  # noqa: TRY004 - a fault of a file, not a bug
    if isinstance(written, str):
        try:
            return int(written, 0)
        except ValueError:
            raise ValueError(f'{written!r} is not a whole number: write "0x181" or the like') from None
    return written


Identifier = Annotated[int, BeforeValidator(whole_number), Field(ge=0, le=EXTENDED_LIMIT)]


class NumberFormat(StrictModel):
    """How bits represent a number."""

    byte_order: Literal["little", "big"] = "little"
    signed: bool = False
    float: bool = False  # Whether it is an IEEE floating-point number


class BitRange(NumberFormat):
    """The bits of a signal, counted as in a DBC."""

    start: Annotated[int, Field(ge=0, lt=8 * FD_LENGTH)]  # The lowest bit; with byte_order = "big" the highest
    length: Annotated[int, Field(ge=1, le=64)]  # Bits

    @model_validator(mode="after")
    def _a_float_has_a_known_length(self) -> Self:
        if self.float and self.length not in FLOAT_CODES:
            raise ValueError(f"a floating-point number has 16, 32 or 64 bits, not {self.length}")
        return self

    def as_signal(self, name: str) -> CanSignal:
        """The same as a signal of cantools."""
        return CanSignal(
            name,
            self.start,
            self.length,
            byte_order="little_endian" if self.byte_order == "little" else "big_endian",
            is_signed=self.signed,
            conversion=BaseConversion.factory(is_float=self.float),
        )


KINDS: dict[str, tuple[str, ...]] = {
    "signal": ("message",),
    "id": ("extended", "fd", *BitRange.model_fields),
    "node": ("object",),
}
"""The key that says where a signal is, and the keys that belong to it alone."""
EXAMPLES = '{ signal = "..." }, { id = "0x181", start = 0, length = 16, unit = "V" } or { node = 5, object = "0x6078" }'


class CanSource(NumberFormat, ScaledSource):
    """Where a signal is: ``signal`` of a database, bits of the frames ``id``, or ``object`` of the CANopen ``node``.

    ``unit`` and ``range`` replace those of the database; ``scale`` is per raw number, or per unit of the database.
    """

    signal: str | None = None
    message: str | None = None  # Needed where several messages have a signal of this name

    id: Identifier | None = None
    extended: bool = False
    fd: bool = False
    start: int | None = None
    length: int | None = None

    node: Annotated[int, Field(ge=1, le=127)] | None = None
    object: str | None = None  # "0x6078", "0x6064:00", or the name in the object dictionary

    @model_validator(mode="after")
    def _is_one_place(self) -> Self:
        kinds = [kind for kind in KINDS if getattr(self, kind) is not None]
        if len(kinds) != 1:
            raise ValueError(f"give one of 'signal', 'id' and 'node': {EXAMPLES}")
        for kind, keys in KINDS.items():
            if kind != kinds[0] and (foreign := [key for key in keys if key in self.model_fields_set]):
                raise ValueError(f"{foreign[0]!r} belongs to {kind!r}, not to {kinds[0]!r}")
        if self.signal is not None and self.unit is None and (self.scale, self.offset) != (1.0, 0.0):
            raise ValueError("'scale' and 'offset' change the unit of the database: set 'unit' to the new one")
        if self.node is not None and self.object is None:
            raise ValueError("'object' is missing: write object = \"0x6078\" or the like")
        if self.id is not None:
            self.bits()
        return self

    def bits(self) -> BitRange:
        """The bits in the frames ``id``; raise ValueError if they are not given, or do not fit into the frames."""
        if self.id is None or self.start is None or self.length is None:
            raise ValueError("'start' and 'length' (bits) are missing beside 'id'")
        if self.id > STANDARD_LIMIT and not self.extended:
            raise ValueError(f"id 0x{self.id:X} needs 29 bits: set extended = true")
        bits = BitRange.model_validate(self.model_dump(include=set(BitRange.model_fields)))
        size, needed = FD_LENGTH if self.fd else CLASSIC_LENGTH, bytes_needed(bits.as_signal(""))
        if needed > size:
            way_out = "" if self.fd or needed > FD_LENGTH else ", or set fd = true"
            raise ValueError(
                f"{self.length} bits from bit {self.start} reach into byte {needed} of a frame of {size}: "
                f"correct start or length{way_out}"
            )
        return bits


@dataclass(frozen=True, slots=True)
class SignalRequest:
    """A signal of the machine, and how to get it out of the frames."""

    name: str
    target_unit: str
    message: Message
    signal: CanSignal
    origin: str  # Where it is read, in words
    raw_low: float
    raw_high: float  # Lowest and highest raw number that is a reading; one beyond is an error code, or wrong
    scale: float
    offset: float  # From a raw number to the target unit

    def describe(self) -> str:
        """What is read from where, in words."""
        return f"{self.name} [{self.target_unit}] from {self.origin}"


def request_for(signal: Signal, message: Message, layout: CanSignal, origin: str) -> SignalRequest:
    """The request for ``signal``, ``layout`` in ``message``; raise ConfigurationError if unit or scale is wrong."""
    key = ("signals", signal.name)
    source: CanSource = signal.source
    unit = source.unit or layout.unit
    if unit is None:
        raise ConfigurationError(f"{origin} has no unit: set 'unit' beside it", key)
    try:
        to_target, target_offset = factor(unit, signal.unit)
    except ValueError as error:
        way_out = "; set 'unit' beside it" if isinstance(error, UnitNameError) and not source.unit else ""
        raise ConfigurationError(f"{origin}: {error}{way_out}", key) from error
    inner = (float(layout.conversion.scale), float(layout.conversion.offset))
    scale, offset = source.scale * inner[0], source.scale * inner[1] + source.offset
    if scale == 0.0 or not math.isfinite(scale + offset):
        raise ConfigurationError(f"{origin} has a scale of {inner[0]:g} and an offset of {inner[1]:g}", key)
    if source.range is not None:
        low, high = _raw_range(*source.range, scale, offset)
    else:
        low, high = _without_named_ends(*_raw_range(*range_of(layout), *inner), layout)
    limit = MAX_VALUE / max(1.0, abs(to_target * scale))
    times = "" if source.scale == 1.0 else f" * {source.scale:g}"
    ignored = source.range is None and has_placeholder_range(layout)
    remark = "; its range [0|1] is taken for a placeholder" if ignored else ""
    plus = "" if source.offset == 0.0 else f" {source.offset:+g}"
    return SignalRequest(
        name=signal.name,
        target_unit=signal.unit,
        message=message,
        signal=layout,
        origin=f"{origin}{times}{plus} [{unit}], frame 0x{message.frame_id:X}{remark}",
        raw_low=max(low, -limit),
        raw_high=min(high, limit),
        scale=to_target * scale,
        offset=to_target * offset + target_offset,
    )


def has_placeholder_range(layout: CanSignal) -> bool:
    """Whether the range is [0|1] although the bits hold many more numbers: tools write it where nobody gave one."""
    numbers = abs(float(layout.conversion.scale)) * 2.0**layout.length
    few = layout.conversion.is_float or PLACEHOLDER_SHARE * numbers > 1.0
    return (layout.minimum, layout.maximum) == (0, 1) and layout.length > 1 and few


def range_of(layout: CanSignal) -> tuple[float, float]:
    """The range in the database, in its unit; infinite if there is none, which a DBC writes as [0|0]."""
    low, high = layout.minimum, layout.maximum
    if low is None or high is None or not low < high or has_placeholder_range(layout):
        return -math.inf, math.inf
    return float(low), float(high)


def _raw_range(low: float, high: float, scale: float, offset: float) -> tuple[float, float]:
    """The raw numbers of the range ``low`` to ``high`` with some tolerance."""
    first, last = sorted((bound - offset) / scale for bound in (low, high))
    slack = [RANGE_TOLERANCE * abs(bound) if math.isfinite(bound) else 0.0 for bound in (first, last)]
    return first - slack[0], last + slack[1]


def names_of_no_reading(layout: CanSignal) -> dict[int, str]:
    """The raw numbers that the database names as no reading, such as 65535 "SNA"; none of a state of some bits."""
    if layout.conversion.is_float or layout.length < MIN_NUMBER_BITS:
        return {}
    names = {int(raw): str(name) for raw, name in (layout.conversion.choices or {}).items()}
    named = {raw: name for raw, name in names.items() if NO_READING.search(name)}
    half, whole = 1 << (layout.length - 1), 1 << layout.length
    # Of a signed number some databases name the bits: 32768 for the lowest of 16 bits.
    return {raw - whole if layout.is_signed and raw >= half else raw: name for raw, name in named.items()}


def _without_named_ends(low: float, high: float, layout: CanSignal) -> tuple[float, float]:
    """Raw numbers ``low`` to ``high`` without those at the ends of the number that are named as no reading."""
    named = names_of_no_reading(layout)
    first = -(1 << (layout.length - 1)) if layout.is_signed else 0
    last = first + (1 << layout.length) - 1
    below = next(number for number in count(first) if number not in named)
    above = next(number for number in count(last, -1) if number not in named)
    return (low if below == first else max(low, below)), (high if above == last else min(high, above))


def request_bits(signal: Signal) -> SignalRequest:
    """The request for ``signal`` by the bits that its source names; raises as :func:`request_for`."""
    source: CanSource = signal.source
    layout, identifier = source.bits().as_signal(signal.name), source.id or 0
    message = Message(
        identifier,
        f"0x{identifier:X}",
        bytes_needed(layout),
        [layout],
        is_extended_frame=source.extended,
        is_fd=source.fd,
        strict=False,
    )
    bits = f"bits {source.start}+{source.length}" + (" big" if source.byte_order == "big" else "")
    return request_for(signal, message, layout, f"{message.name} {bits}")


Holder = tuple[CanDatabase, Message, CanSignal]
WAY_OUT = "read it by 'id', 'start' and 'length', or correct the database"


def request_from_databases(signal: Signal, databases: Sequence[CanDatabase]) -> SignalRequest:
    """The request for a signal in the databases; raise ConfigurationError if it is missing, ambiguous or faulty."""
    key = ("signals", signal.name)
    source: CanSource = signal.source
    if not databases:
        raise ConfigurationError('no database that describes the frames: set dbc = "..." in [driver]', key)
    paths = ", ".join(str(database.path) for database in databases)
    holders = [
        (database, message, layout)
        for database in databases
        for message in database.messages
        if source.message in (None, message.name)
        for layout in message.signals
        if layout.name == source.signal
    ]
    if not holders:
        raise ConfigurationError(f"{paths}: {_why_missing(source, databases)}", key)
    database, message, layout = holders[0]
    if why := _why_ambiguous(source, holders, databases):
        raise ConfigurationError(f"{paths}: {why}", key)
    if message.is_container:
        raise ConfigurationError(f"{paths}: {message.name} is a container message, which is not supported", key)
    if why := _why_faulty(database, message, layout):
        raise ConfigurationError(f"{database.path}: {why}: {WAY_OUT}", key)
    try:
        return request_for(signal, message, layout, f"{message.name}.{layout.name}")
    except ConfigurationError as error:
        raise ConfigurationError(f"{database.path}: {error}", error.key) from error


def _why_missing(source: CanSource, databases: Sequence[CanDatabase]) -> str:
    unread = {name: why for database in databases for name, why in database.unread.items()}
    messages = [message for database in databases for message in database.messages]
    if source.message is not None:
        if source.message in unread:
            return f"message {source.message!r} cannot be read: {unread[source.message]}"
        names = [message.name for message in messages]
        if source.message not in names:
            return f"no message {source.message!r}: {nearest(source.message, names)}"
        messages = [message for message in messages if message.name == source.message]
    names = sorted({layout.name for message in messages for layout in message.signals})
    more = f"; {len(unread)} messages cannot be read: {', '.join(list(unread)[:3])}" if unread else ""
    return f"no signal {source.signal!r}: {nearest(str(source.signal), names)}{more}"


def _why_ambiguous(source: CanSource, holders: Sequence[Holder], databases: Sequence[CanDatabase]) -> str:
    names = sorted({message.name for _, message, _ in holders})
    if len(names) > 1:
        return f"signal {source.signal!r} is in {', '.join(names)}: set 'message' beside it"
    if len({_layout_key(message, layout) for _, message, layout in holders}) > 1:
        return f"{names[0]}.{source.signal} is described {len(holders)} times, and differently: {WAY_OUT}"
    frame = _frame_key(holders[0][1])
    messages = [message for database in databases for message in database.messages if _frame_key(message) == frame]
    others = [message.name for message in messages if message.name != names[0]]
    if others and source.message is None:
        return f"frame 0x{frame[0]:X} is both {names[0]} and {others[0]}: set 'message' to the right one"
    return ""


def _frame_key(message: Message) -> tuple[int, bool]:
    return message.frame_id, message.is_extended_frame


def _layout_key(message: Message, layout: CanSignal) -> tuple[object, ...]:
    conversion = layout.conversion
    where = (*_frame_key(message), layout.start, layout.length, layout.byte_order)
    what = (layout.is_signed, conversion.is_float, conversion.scale, conversion.offset, layout.unit)
    return (*where, *what, layout.multiplexer_signal, tuple(layout.multiplexer_ids or ()))


def _why_faulty(database: CanDatabase, message: Message, layout: CanSignal) -> str:
    if faults := database.faults_of(message, layout.name):
        return faults[0].text
    if layout.conversion.is_float and layout.length not in FLOAT_CODES:
        return f"{message.name}.{layout.name} is a floating-point number of {layout.length} bits"
    return ""


CLASSIC_BITS = 64  # of a classic CAN frame
MAX_PDOS = 512  # TPDOs of a node: CiA 301
NUMBER_LENGTHS = {"i": range(1, 65), "u": range(1, 65), "f": (32, 64)}  # bits
OBJECT = re.compile(r"(?:0x)?([0-9A-Fa-f]{1,4})(?::([0-9A-Fa-f]{1,2}))?(?:\s+(?:(bool)|([iuf])(\d{1,2})))?")

FramePeriod = Annotated[float, BeforeValidator(Quantity("s", 1e-4, 3600.0))]
HEX_BYTES = re.compile(r"(?:[0-9A-Fa-f]{2}[ :]?){0,16}")
NODE_KEY = re.compile(r"0[xX][0-9A-Fa-f]{1,2}|\d{1,3}")
HexBytes = Annotated[str, written_as(HEX_BYTES, "list of at most 16 bytes of two hexadecimal digits, like '1A 2B'")]
NodeKey = Annotated[str, written_as(NODE_KEY, "number of a node, like 5 or 0x05")]
ChecksumKind = Literal["crc8-sae-j1850", "crc8-sae-j1850-zero", "crc8-autosar", "crc16-ccitt-false", "xor", "sum8"]


class ChecksumTable(StrictModel):
    """The checksum of a message."""

    signal: str | BitRange  # Its name in the database, or its bits
    kind: ChecksumKind
    over: tuple[int, int] | None = None  # First and last byte that it covers, from 0, but for its own; by default all
    prefix: HexBytes = ""
    suffix: HexBytes = ""  # Bytes that it covers before or after those of the frame (AUTOSAR's data ID)


class MessageTable(StrictModel):
    """``[driver.messages.Name]``: what is known of a message beyond its database."""

    counter: str | BitRange | Literal[False] | None = None
    """The signal that counts the frames, or its bits; ``false`` if one only has the name of a counter."""
    modulo: Annotated[int, Field(ge=2, le=1 << 32)] | None = None  # One more than the highest count
    checksum: ChecksumTable | None = None
    period: FramePeriod | None = None  # s from frame to frame; estimated by default


class MappedObject(StrictModel):
    """An object in a PDO, written as ``"0x6078:00 i16"``; the EDS may give the type instead."""

    index: int
    subindex: int
    type: Literal["bool", "i", "u", "f"] | None = None
    length: int = 0  # Bits; 0 if they are not given

    @classmethod
    def parse(cls, written: object) -> "MappedObject":
        """The object that ``written`` names; raise ValueError if it names none, or a type that does not exist."""
        if isinstance(written, cls):
            return written
        match = OBJECT.fullmatch(written.strip()) if isinstance(written, str) else None
        if match is None:
            raise ValueError(f'{written!r} is no object: write "0x6078", "0x6064:00" or "0x6064:00 i32"')
        kind = match[3] or match[4]
        length = 1 if match[3] else int(match[5] or 0)
        if match[4] and length not in NUMBER_LENGTHS[match[4]]:
            raise ValueError(f"{written!r}: there is no number of type {match[4]}{length}")
        return cls(index=int(match[1], 16), subindex=int(match[2] or "0", 16), type=kind, length=length)

    @property
    def address(self) -> str:
        """Index and subindex in the notation of CANopen."""
        return f"0x{self.index:04X}:{self.subindex:02X}"


class PdoTable(StrictModel):
    """``[[driver.pdo]]``: a TPDO of a drive that is mapped otherwise than its EDS says."""

    node: Annotated[int, Field(ge=1, le=127)]
    number: Annotated[int, Field(ge=1, le=MAX_PDOS)]  # 1 for TPDO 1
    id: Identifier | None = None  # Arbitration ID of its frames; that of TPDO 1 to 4 follows from the node
    objects: Annotated[
        tuple[Annotated[MappedObject, BeforeValidator(MappedObject.parse)], ...], Field(min_length=1, max_length=64)
    ]  # In their order in the frame

    @model_validator(mode="after")
    def _has_an_identifier(self) -> Self:
        if self.id is None and self.number > 4:
            raise ValueError(f"id is missing: that of TPDO {self.number} does not follow from the node")
        return self

    def identifier(self) -> int:
        """Arbitration ID of its frames, by default that of the predefined connection set of CiA 301."""
        return 0x80 + 0x100 * self.number + self.node if self.id is None else self.id


class FrameOptions(StrictModel):
    """What describes the frames."""

    dbc: Path | tuple[Path, ...] = ()  # The CAN database (DBC, KCD, SYM or ARXML), or several
    eds: Path | dict[NodeKey, Path] | None = None  # Data sheet (or DCF) of the drives, or one by node: { 5 = "x.eds" }
    pdo: Annotated[tuple[PdoTable, ...], Field(max_length=MAX_PDOS)] = ()
    messages: dict[str, MessageTable] = Field(default_factory=dict)  # By name or arbitration ID ("0x181")

    j1939: bool = True
    """Whether a message with 29 bits and the source address 0xFE is one of SAE J1939, from any source."""
    source_address: Annotated[int, BeforeValidator(whole_number), Field(ge=0, le=253)] | None = None
    """Of the J1939 node that is read; by default the one whose frame comes first."""

    def databases(self) -> tuple[Path, ...]:
        """The databases, as written."""
        return (self.dbc,) if isinstance(self.dbc, Path) else self.dbc

    def data_sheet(self, node: int) -> Path | None:
        """The EDS of ``node``, as written; None if it has none."""
        if isinstance(self.eds, dict):
            return {int(key, 0): path for key, path in self.eds.items()}.get(node)
        return self.eds
