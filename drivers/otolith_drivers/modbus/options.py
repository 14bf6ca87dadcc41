"""What a machine file says of a Modbus drive: the line, the devices on it, and where each signal is."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.base import Signal
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.modbus.protocol import Order, TypeName, bits, reader, registers_of
from otolith_drivers.units import Quantity, factor

MOST_REGISTERS = 125  # of one request (Modbus Application Protocol V1.1b3, sections 6.3 and 6.4)
HIGHEST_ADDRESS = 65535
BYTES_OF_A_REQUEST, BYTES_OF_A_REPLY = 8, 5  # of RTU; the reply has two more for each register
SILENCE = 3.5  # characters between frames (Modbus over Serial Line V1.02, section 2.5.1.1)

Table = Literal["holding", "input"]
Device = Annotated[int, Field(ge=0, le=255)]


class LineOptions(StrictModel):
    """Which line: a host, or a serial port."""

    host: str | None = None
    port: Annotated[int, Field(ge=1, le=65535)] = 502
    framing: Literal["tcp", "rtu"] = "tcp"
    """Of a host; ``rtu`` for a gateway that passes the frames of a serial line on as they are."""
    serial: str | None = None
    """The port, like ``/dev/ttyUSB0``."""
    baudrate: Annotated[int, Field(ge=300, le=4_000_000)] = 19200
    parity: Literal["N", "E", "O"] = "E"
    stop_bits: Literal[1, 2] = 1
    timeout: Annotated[float, BeforeValidator(Quantity("s", 0.01, 10.0))] = 0.5
    """How long a device may take to answer."""
    pause: Annotated[float, BeforeValidator(Quantity("s", 0.0, 1.0))] = 0.0
    """Between two requests, for devices that need one."""

    @model_validator(mode="after")
    def _one_line(self) -> Self:
        if (self.host is None) == (self.serial is None):
            raise ValueError('write either host = "192.168.0.10" or serial = "/dev/ttyUSB0"')
        return self

    def title(self) -> str:
        """The line in a few words."""
        if self.host is not None:
            return f"Modbus {'TCP' if self.framing == 'tcp' else 'RTU over TCP'} {self.host}:{self.port}"
        return f"Modbus RTU {self.serial}, {self.baudrate} baud 8{self.parity}{self.stop_bits}"

    def least_time(self, registers: int) -> float:
        """Seconds that a request for so many registers takes at least; 0 where the line's speed is not known."""
        if self.serial is None:
            return 0.0
        characters = BYTES_OF_A_REQUEST + BYTES_OF_A_REPLY + 2 * registers + 2 * SILENCE
        bits = 1 + 8 + (self.parity != "N") + self.stop_bits  # of a character: start, data, parity, stop
        return characters * bits / self.baudrate + self.pause


class Options(LineOptions):
    """``[driver]`` with ``type = "modbus"``."""

    device: Device = 1
    """Also called unit or slave; of the signals that name none."""
    order: Order = "ABCD"
    """Of the bytes in numbers of more than one register, for the signals that name none."""
    first_address: Literal[0, 1] = 0
    """What the manual calls the first register: with 1 every address in the file is one more than on the wire."""
    max_gap: Annotated[int, Field(ge=0, lt=MOST_REGISTERS)] = 8
    """Registers that nobody wants, read along to save a request."""
    max_registers: Annotated[int, Field(ge=1, le=MOST_REGISTERS)] = MOST_REGISTERS
    """That the device gives at once."""


class Source(StrictModel):
    """Where a signal is: ``{ register = 100, type = "float32", unit = "V" }``."""

    register_: Annotated[int, Field(ge=0, le=HIGHEST_ADDRESS + 1, alias="register")]
    table: Table = "holding"
    type: TypeName
    unit: str
    device: Device | None = None
    order: Order | None = None
    scale: float = 1.0
    """The value is ``scale * number + offset``, in ``unit``."""
    offset: float = 0.0
    bits: str | None = None
    """``"3"`` or ``"4..7"``: only these bits of an integer are the number."""
    trusted: bool = False
    """The order of its bytes is right, however the numbers look."""
    range: tuple[float, float] | None = None
    """In ``unit``; a value beyond is no reading."""

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if self.bits is not None:
            bits(self.bits, self.type)
        if self.scale == 0.0:
            raise ValueError("scale 0 makes every value the same: leave it out, or write what one step is worth")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"range {list(self.range)}: the lower end comes first")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class Item:
    """A signal as the registers carry it."""

    name: str
    target_unit: str
    device: int
    table: Table
    address: int
    """On the wire, from 0."""
    kind: TypeName
    order: Order
    source: Source
    number: Callable[[Sequence[int]], float]
    """From registers to the number in them."""
    scale: float
    offset: float
    """From the number to the target unit."""

    @property
    def count(self) -> int:
        """Registers."""
        return registers_of(self.kind)

    @property
    def end(self) -> int:
        """The first address behind it."""
        return self.address + self.count

    def value(self, registers: Sequence[int]) -> float:
        """In the target unit; not a number where the device has no reading (no finite number, or out of range)."""
        found = self.number(registers)
        if self.source.range is not None:
            low, high = self.source.range
            if not low <= self.source.scale * found + self.source.offset <= high:
                return math.nan
        found = self.scale * found + self.offset
        return found if math.isfinite(found) else math.nan

    def describe(self) -> str:
        """Where it is read, in words."""
        order = f" {self.order}" if self.count > 1 else ""
        part = f" bits {self.source.bits}" if self.source.bits else ""
        return f"device {self.device}, {self.table} register {self.source.register_}, {self.kind}{order}{part}"


def item_of(signal: Signal, options: Options) -> Item:
    """Where ``signal`` is read, and how its number becomes a value.

    Raises:
        ConfigurationError: the unit measures something else, or the registers lie beyond the last one.
    """
    source: Source = signal.source
    key = ("signals", signal.name)
    address = source.register_ - options.first_address
    if not 0 <= address <= HIGHEST_ADDRESS + 1 - registers_of(source.type):
        last = HIGHEST_ADDRESS + options.first_address
        raise ConfigurationError(f"register {source.register_} as {source.type}: registers go from "
                                 f"{options.first_address} to {last}", key)  # fmt: skip
    if registers_of(source.type) > options.max_registers:
        raise ConfigurationError(f"{source.type} has more registers than driver.max_registers allows at once", key)
    try:
        scale, offset = factor(source.unit, signal.unit)
    except ValueError as error:
        raise ConfigurationError(str(error), key) from error
    order = source.order or options.order
    return Item(
        name=signal.name,
        target_unit=signal.unit,
        device=options.device if source.device is None else source.device,
        table=source.table,
        address=address,
        kind=source.type,
        order=order,
        source=source,
        number=_number(source, order),
        scale=scale * source.scale,
        offset=scale * source.offset + offset,
    )


def _number(source: Source, order: Order) -> Callable[[Sequence[int]], float]:
    whole = reader(source.type, order)
    if source.bits is None:
        return whole
    part = bits(source.bits, source.type)
    return lambda registers: part.of(whole(registers))
