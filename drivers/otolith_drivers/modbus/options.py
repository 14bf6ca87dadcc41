"""The Modbus tables of a machine file: the line, the devices on it, and the registers of each signal.

A register has 16 bits, high byte first on the wire (Modbus Application Protocol V1.1b3, section 4.2). The standard
does not define the order of the registers of a longer number, so all orders occur. They are named by the positions of
the bytes A (highest) to D (lowest) of a 32-bit number; 64-bit numbers follow the same rule.
"""

import math
import re
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self, get_args

from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import Conversion, ScaledSource, Signal
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.units import Quantity

MAX_REGISTERS = 125  # of one request (Modbus Application Protocol V1.1b3, sections 6.3 and 6.4)
HIGHEST_ADDRESS = 65535
REQUEST_BYTES, REPLY_BYTES = 8, 5  # of RTU; the reply has two more for each register
SILENT_CHARACTERS = 3.5  # between frames (Modbus over Serial Line V1.02, section 2.5.1.1)

MAX_EXPONENT = 10  # magnitude of an exponent in a register: that of SunSpec's scale factors
MAX_DECIMALS = 9  # digits behind the point; more are no decimals register

TypeName = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]
Order = Literal["ABCD", "CDAB", "BADC", "DCBA"]
ORDERS: tuple[Order, ...] = get_args(Order)
WORDS_SWAPPED: frozenset[Order] = frozenset({"CDAB", "DCBA"})  # Orders with the lowest register first
BYTES_SWAPPED: frozenset[Order] = frozenset({"BADC", "DCBA"})  # Orders with the low byte of each register first
LETTERS: dict[TypeName, str] = dict(zip(get_args(TypeName), "hHiIqQfd", strict=True))  # Of struct, by type
BITS = re.compile(r"(\d{1,2})(?:\.\.(\d{1,2}))?")

Table = Literal["holding", "input", "coil", "discrete"]
BIT_TABLES: dict[Table, str] = {"coil": "coil", "discrete": "discrete input"}  # Tables of bits, and their names
Device = Annotated[int, Field(ge=0, le=255)]


def registers_of(kind: TypeName) -> int:
    """Return the number of registers of a number."""
    return struct.calcsize(f">{LETTERS[kind]}") // 2


def is_float(kind: TypeName) -> bool:
    """Whether the type is a float."""
    return kind.startswith("float")


def orders_of(kind: TypeName) -> tuple[Order, ...]:
    """Return the orders that differ for this type: a single register has no word order."""
    return ORDERS if registers_of(kind) > 1 else ("ABCD", "BADC")


def reader(kind: TypeName, order: Order) -> Callable[[Sequence[int]], float]:
    """Return a function from a number's registers (each 0 to 65535, in the order of addresses) to the number."""
    words = struct.Struct(f"{'<' if order in BYTES_SWAPPED else '>'}{registers_of(kind)}H")
    number = struct.Struct(f">{LETTERS[kind]}")
    backwards = order in WORDS_SWAPPED

    def read(registers: Sequence[int]) -> float:
        value: float = number.unpack(words.pack(*(registers[::-1] if backwards else registers)))[0]
        return value

    return read


def bit_reader(written: str, kind: TypeName) -> Callable[[float], int]:
    """Return a function from an integer to its bits ``"3"`` or ``"4..7"``; bit 0 is the lowest.

    Raises:
        ValueError: malformed, not ascending, a field of a float, or beyond the bits of the type.
    """
    match = BITS.fullmatch(written.strip())
    if match is None:
        raise ValueError(f'bits {written!r}: write one bit like "3", or the lowest and highest like "4..7"')
    low, high = int(match[1]), int(match[2] or match[1])
    width = 16 * registers_of(kind)
    if is_float(kind):
        raise ValueError(f"bits {written!r}: a {kind} has no bit fields")
    if not low <= high < width:
        raise ValueError(f"bits {written!r}: {kind} has bits 0 to {width - 1}; write the lower one first")
    mask = (1 << (high - low + 1)) - 1
    return lambda value: int(value) >> low & mask


class LineOptions(StrictModel):
    """The line: a host or a serial port."""

    host: str | None = None
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    framing: Literal["tcp", "rtu"] = "tcp"  # Of a host; rtu for a gateway that forwards serial frames unchanged
    serial: str | None = None  # The serial port, like /dev/ttyUSB0
    baudrate: Annotated[int, Field(ge=300, le=4_000_000)] = 19200
    parity: Literal["N", "E", "O"] = "E"
    stop_bits: Literal[1, 2] = 1
    timeout: Annotated[float, BeforeValidator(Quantity("s", 0.01, 10.0))] = 0.5  # Longest, from request to answer
    pause: Annotated[float, BeforeValidator(Quantity("s", 0.0, 1.0))] = 0.0  # Between requests, if a device needs one
    reply_device: Device | None = None  # In the answers, if they do not repeat that of the request (TCP)
    reply_transaction: Annotated[int, Field(ge=0, le=65535)] | None = None  # In the answers, if not repeated (TCP)

    @model_validator(mode="after")
    def _host_or_serial(self) -> Self:
        if (self.host is None) == (self.serial is None):
            raise ValueError('write either host = "192.168.0.10" or serial = "/dev/ttyUSB0"')
        if not self.is_tcp and (self.reply_device is not None or self.reply_transaction is not None):
            raise ValueError("reply_device and reply_transaction are of Modbus TCP, which repeats both numbers")
        return self

    @property
    def is_tcp(self) -> bool:
        """Whether the frames are those of Modbus TCP, with a header instead of a checksum."""
        return self.host is not None and self.framing == "tcp"

    def title(self) -> str:
        """Return the line in a few words."""
        if self.host is not None:
            return f"Modbus {'TCP' if self.framing == 'tcp' else 'RTU over TCP'} {self.host}:{self.port}"
        return f"Modbus RTU {self.serial}, {self.baudrate} baud 8{self.parity}{self.stop_bits}"

    def least_time(self, registers: int) -> float:
        """Return the shortest time (s) of a request for so many registers; 0 for a host, whose speed is unknown."""
        if self.serial is None:
            return 0.0
        characters = REQUEST_BYTES + REPLY_BYTES + 2 * registers + 2 * SILENT_CHARACTERS
        character_bits = 1 + 8 + (self.parity != "N") + self.stop_bits  # start, data, parity, stop
        return characters * character_bits / self.baudrate + self.pause


class ModbusOptions(LineOptions):
    """``[driver]`` with ``type = "modbus"``."""

    device: Device = 1  # Device number (also called unit or slave) of the signals that name none
    order: Order = "ABCD"  # Byte order of the signals that name none
    first_address: Literal[0, 1] = 0  # Of the manual; with 1, an address in the file is one more than on the wire
    max_gap: Annotated[int, Field(ge=0, lt=MAX_REGISTERS)] = 8  # Most unneeded registers in a row that are read along
    max_registers: Annotated[int, Field(ge=1, le=MAX_REGISTERS)] = MAX_REGISTERS  # Most that the device returns at once


class ModbusSource(ScaledSource):
    """Registers of a signal: ``{ register = 100, type = "float32", unit = "V" }``."""

    register_: Annotated[int, Field(ge=0, le=HIGHEST_ADDRESS + 1, alias="register")]
    table: Table = "holding"
    type: TypeName  # Not of a coil or discrete input, which is 0 or 1
    unit: str
    device: Device | None = None
    order: Order | None = None
    bits: str | None = None  # "3" or "4..7": the number is this bit field of an integer
    trusted: bool = False  # Whether to skip the plausibility check of the byte order
    decimals: Annotated[int, Field(ge=0, le=HIGHEST_ADDRESS + 1)] | None = None
    """Register with the number of decimals: the number is divided by 10 to its power."""
    exponent: Annotated[int, Field(ge=0, le=HIGHEST_ADDRESS + 1)] | None = None
    """Register with a signed exponent, as SunSpec's scale factors: the number is multiplied by 10 to its power."""

    @model_validator(mode="before")
    @classmethod
    def _give_a_bit_its_type(cls, written: object) -> object:
        if not isinstance(written, dict) or written.get("table") not in tuple(BIT_TABLES):
            return written
        if foreign := [key for key in ("type", "order", "bits", "decimals", "exponent") if key in written]:
            raise ValueError(f"{foreign[0]!r} is of registers: a {written['table']} is 0 or 1")
        return written | {"type": "uint16"}

    @model_validator(mode="after")
    def _has_the_bits(self) -> Self:
        if self.bits is not None:
            bit_reader(self.bits, self.type)
        if self.decimals is not None and self.exponent is not None:
            raise ValueError("'decimals' and 'exponent' both move the point: give the one that the manual names")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class RegisterSignal:
    """A signal, its registers, and the conversion to its value."""

    name: str
    target_unit: str
    device: int
    table: Table
    address: int  # On the wire, from 0
    kind: TypeName
    order: Order
    source: ModbusSource
    number: Callable[[Sequence[int]], float]  # From registers to the number in them
    conversion: Conversion
    decimals: "RegisterSignal | None" = None  # the register with their number, or with minus their number
    is_sampled: bool = True  # False for a register of decimals, which is no signal of its own

    @property
    def place(self) -> tuple[int, str, int]:
        """Device, table and address."""
        return self.device, self.table, self.address

    @property
    def count(self) -> int:
        """Number of registers."""
        return registers_of(self.kind)

    @property
    def end(self) -> int:
        """First address behind the signal."""
        return self.address + self.count

    def value(self, registers: Sequence[int], decimals: float = 0.0) -> float:
        """Return the value in the target unit; NaN if the number is not finite or out of range."""
        if self._wrong_point(decimals):
            return math.nan
        return self.conversion.value(self.number(registers) / 10.0**decimals)

    def why_no_value(self, registers: Sequence[int], decimals: float) -> str:
        """Return why :meth:`value` is NaN, with value and range."""
        return self._wrong_point(decimals) or self.conversion.why_no_value(self.number(registers) / 10.0**decimals)

    def _wrong_point(self, decimals: float) -> str:
        """Return why the number of ``decimals`` cannot be one; empty if it can."""
        if self.source.exponent is not None:
            is_possible = -MAX_EXPONENT <= decimals <= MAX_EXPONENT
            return "" if is_possible else f"has the exponent {-decimals:g}, not -{MAX_EXPONENT} to {MAX_EXPONENT}"
        return "" if 0.0 <= decimals <= MAX_DECIMALS else f"has {decimals:g} decimals, not 0 to {MAX_DECIMALS:g}"

    def describe(self) -> str:
        """Return device, register, type, order and bit field in words."""
        order = f" {self.order}" if self.count > 1 else ""
        field = f" bits {self.source.bits}" if self.source.bits else ""
        point = f" with the decimals of register {self.source.decimals}" if self.source.decimals is not None else ""
        point = (
            f" times 10 to the power in register {self.source.exponent}" if self.source.exponent is not None else point
        )
        if self.table in BIT_TABLES:
            return f"device {self.device}, {BIT_TABLES[self.table]} {self.source.register_}"
        return f"device {self.device}, {self.table} register {self.source.register_}, {self.kind}{order}{field}{point}"


def register_signal(signal: Signal, options: ModbusOptions) -> RegisterSignal:
    """Return the registers of ``signal`` and the conversion to its unit.

    Raises:
        ConfigurationError: the units differ in dimension, a register exceeds the last address, or the number exceeds
            ``max_registers``.
    """
    source: ModbusSource = signal.source
    key = ("signals", signal.name)
    address, count = source.register_ - options.first_address, registers_of(source.type)
    if not 0 <= address <= HIGHEST_ADDRESS + 1 - count:
        bounds = f"registers go from {options.first_address} to {HIGHEST_ADDRESS + options.first_address}"
        raise ConfigurationError(f"register {source.register_} as {source.type}: {bounds}", key)
    if count > options.max_registers:
        text = f"{source.type} has {count} registers, more than driver.max_registers = {options.max_registers}"
        raise ConfigurationError(text, key)
    order = source.order or options.order
    decimals = None
    if (place := source.exponent if source.decimals is None else source.decimals) is not None:
        kind, scale = ("uint16", 1.0) if source.exponent is None else ("int16", -1.0)
        keys = {"register": place, "type": kind, "scale": scale, "unit": "1", "table": source.table}
        hidden = ModbusSource.model_validate(keys | {"device": source.device})
        decimals = replace(register_signal(Signal(f"{signal.name}.decimals", "1", hidden), options), is_sampled=False)
    return RegisterSignal(
        name=signal.name,
        target_unit=signal.unit,
        device=options.device if source.device is None else source.device,
        table=source.table,
        address=address,
        kind=source.type,
        order=order,
        source=source,
        number=_number_reader(source, order),
        conversion=Conversion.for_signal(signal),
        decimals=decimals,
    )


def _number_reader(source: ModbusSource, order: Order) -> Callable[[Sequence[int]], float]:
    whole = reader(source.type, order)
    if source.bits is None:
        return whole
    bits = bit_reader(source.bits, source.type)
    return lambda registers: bits(whole(registers))
