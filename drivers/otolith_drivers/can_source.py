"""What a machine file may say of where a signal is in the frames."""

from typing import Annotated, Literal, Self

from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion
from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.can_fields import bytes_needed
from otolith_drivers.toml_files import Closed

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


class Bits(Closed):
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


BITS = tuple(Bits.model_fields)
KINDS: dict[str, tuple[str, ...]] = {
    "signal": ("message",),
    "id": ("extended", "fd", *BITS),
    "node": ("object",),
}
"""The key that says where a signal is, and the keys that go with it alone."""


class Source(Closed):
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

    def bits(self) -> Bits:
        """Where the bits of ``id`` are.

        Raises:
            ValueError: they do not fit into its frames.
        """
        assert self.id is not None  # noqa: S101 - asked for only then
        if self.start is None or self.length is None:
            raise ValueError("'start' and 'length' (bits) are missing beside 'id'")
        if self.id > STANDARD_LIMIT and not self.extended:
            raise ValueError(f"id 0x{self.id:X} needs 29 bits: set extended = true")
        found = Bits(
            start=self.start, length=self.length, byte_order=self.byte_order, signed=self.signed, float=self.float
        )
        size = FD_LENGTH if self.fd else CLASSIC_LENGTH
        if (needed := bytes_needed(found.as_signal(""))) > size:
            way_out = "" if self.fd or needed > FD_LENGTH else ", or set fd = true"
            place = f"{self.length} bits from bit {self.start}"
            raise ValueError(f"{place} reach into byte {needed} of a frame of {size}: correct start or length{way_out}")
        return found
