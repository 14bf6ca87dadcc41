"""Options that describe the frames; the same for a live bus and for a log of one."""

import re
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from otolith_drivers.canbus.signals import BitRange, Identifier, whole_number
from otolith_drivers.config_files import StrictModel
from otolith_drivers.units import Quantity

CLASSIC_BITS = 64  # of a classic CAN frame
MAX_PDOS = 512  # TPDOs of a node: CiA 301
NUMBER_LENGTHS = {"i": range(1, 65), "u": range(1, 65), "f": (32, 64)}  # bits
OBJECT = re.compile(r"(?:0x)?([0-9A-Fa-f]{1,4})(?::([0-9A-Fa-f]{1,2}))?(?:\s+(?:(bool)|([iuf])(\d{1,2})))?")

FramePeriod = Annotated[float, BeforeValidator(Quantity("s", 1e-4, 3600.0))]
HexBytes = Annotated[str, Field(pattern=r"^(?:[0-9A-Fa-f]{2}[ :]?){0,16}$")]
NodeKey = Annotated[str, Field(pattern=r"^(?:0[xX][0-9A-Fa-f]{1,2}|\d{1,3})$")]
ChecksumKind = Literal["crc8-sae-j1850", "crc8-sae-j1850-zero", "crc8-autosar", "crc16-ccitt-false", "xor", "sum8"]


class ChecksumTable(StrictModel):
    """The checksum of a message."""

    signal: str | BitRange
    """Its name in the database, or its bits."""
    kind: ChecksumKind
    over: tuple[int, int] | None = None
    """First and last byte that it covers, counted from 0, without its own; by default the whole frame."""
    prefix: HexBytes = ""
    suffix: HexBytes = ""
    """Bytes that it covers before or after those of the frame (AUTOSAR's data ID)."""


class MessageTable(StrictModel):
    """``[driver.messages.Name]``: what is known of a message beyond its database."""

    counter: str | BitRange | Literal[False] | None = None
    """The signal that counts the frames, or its bits; ``false`` if one only has the name of a counter."""
    modulo: Annotated[int, Field(ge=2, le=1 << 32)] | None = None
    """One more than the highest count."""
    checksum: ChecksumTable | None = None
    period: FramePeriod | None = None
    """s from frame to frame; estimated by default."""


class MappedObject(StrictModel):
    """An object in a PDO, written as ``"0x6078:00 i16"``; the EDS may give the type instead."""

    index: int
    subindex: int
    type: Literal["bool", "i", "u", "f"] | None = None
    length: int = 0
    """Bits; 0 if they are not given."""

    @classmethod
    def parse(cls, written: object) -> "MappedObject":
        """The object that ``written`` names.

        Raises:
            ValueError: it names none, or a type that does not exist.
        """
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
    number: Annotated[int, Field(ge=1, le=MAX_PDOS)]
    """1 for TPDO 1."""
    id: Identifier | None = None
    """Arbitration ID of its frames; that of TPDO 1 to 4 follows from the node."""
    objects: Annotated[
        tuple[Annotated[MappedObject, BeforeValidator(MappedObject.parse)], ...], Field(min_length=1, max_length=64)
    ]
    """In their order in the frame."""

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

    dbc: Path | tuple[Path, ...] = ()
    """The CAN database (DBC, KCD, SYM or ARXML), or several."""
    eds: Path | dict[NodeKey, Path] | None = None
    """The electronic data sheet (or DCF) of the CANopen drives, or one for each node: ``{ 5 = "x.eds" }``."""
    pdo: Annotated[tuple[PdoTable, ...], Field(max_length=MAX_PDOS)] = ()
    messages: dict[str, MessageTable] = Field(default_factory=dict)
    """By the name in the database, or by arbitration ID (``"0x181"``)."""

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
