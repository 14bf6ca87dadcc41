"""The ways in which bytes can be a number: those of Modbus registers, and those of CAN frames. Pure."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from otolith_drivers.modbus_plausible import fault_of_floats
from otolith_drivers.modbus_types import (
    BYTES_SWAPPED,
    LETTERS,
    WORDS_SWAPPED,
    Order,
    TypeName,
    is_float,
    orders_of,
    registers_of,
)

Bytes = NDArray[np.uint8]
"""Readings by bytes."""
Floats = NDArray[np.float64]
Ranks = NDArray[np.int64] | NDArray[np.uint64]

LIKELY_FLOATS = (1e-6, 1e8)  # magnitudes of most readings in the units that people use
BIAS = {2: 0x8000, 4: 0x8000_0000, 8: 0x8000_0000_0000_0000}
LARGEST_INTEGER = 2.0**24  # magnitude, beyond which an integer that reads as a likely float is taken for one


@dataclass(frozen=True)
class Layout:
    """How so many bytes are read as a number."""

    kind: str
    """``"int16"``, ``"uint24"``, ``"float32"``."""
    order: str
    """As the machine file writes it: ``"CDAB"``, ``"little"``."""
    places: tuple[int, ...]
    """Where the bytes of the number stand, the highest first."""
    handicap: float
    """Bits: how much less common it is than others."""

    @property
    def width(self) -> int:
        """Bytes."""
        return len(self.places)

    @property
    def is_float(self) -> bool:
        """Whether it has an exponent."""
        return self.kind.startswith("float")

    @property
    def signed(self) -> bool:
        """Whether it can be negative."""
        return not self.kind.startswith("u")

    @cached_property
    def name(self) -> str:
        """In words."""
        return self.kind if self.width == 1 or (self.width, self.order) == (2, "ABCD") else f"{self.kind} {self.order}"

    def numbers(self, data: Bytes) -> Floats:
        """What the readings ``data`` say, read like this."""
        if self.is_float:
            high_first = np.ascontiguousarray(data[:, self.places])
            with np.errstate(invalid="ignore"):
                found: Floats = high_first.view(f">f{self.width}")[:, 0].astype(np.float64)
            return found
        return self.ranks(data).astype(np.float64)

    def ranks(self, data: Bytes) -> Ranks:
        """Integers in the order of the numbers: themselves, or for floats how many lie between one and zero."""
        whole = np.zeros(len(data), dtype=np.uint64)
        for place in self.places:
            whole = (whole << np.uint64(8)) | data[:, place].astype(np.uint64)
        if self.is_float:
            sign = np.uint64(BIAS[self.width])
            size = (whole & ~sign).view(np.int64)
            return np.where(whole & sign, -size, size)
        if not self.signed:
            return whole if self.width == 8 else whole.view(np.int64)
        spare = 64 - 8 * self.width
        return (whole << np.uint64(spare)).view(np.int64) >> np.int64(spare)

    def fault(self, numbers: Floats) -> str:
        """Why these cannot be the readings of a machine; empty where they can. Integers always can."""
        if not self.is_float:
            return ""
        return fault_of_floats(numbers) if (numbers != 0.0).any() else "it is always zero, with or without a sign"

    def likely(self, numbers: Floats) -> bool:
        """Whether these are floats as most readings are."""
        sizes = np.abs(numbers[numbers != 0.0])
        if not self.is_float or not len(sizes) or not np.isfinite(sizes).all():
            return False
        low, high = LIKELY_FLOATS
        return bool(low <= float(np.median(sizes)) <= high)


def register_layouts(kind: TypeName) -> tuple[Layout, ...]:
    """Of a type, in every order, as Modbus registers carry it."""
    width = 2 * registers_of(kind)
    return tuple(Layout(kind, order, _places(width, order), _handicap(kind, order)) for order in orders_of(kind))


def _places(width: int, order: Order) -> tuple[int, ...]:
    words = [(at, at + 1) for at in range(0, width, 2)]
    if order in BYTES_SWAPPED:
        words = [(second, first) for first, second in words]
    if order in WORDS_SWAPPED:
        words = words[::-1]
    return tuple(place for word in words for place in word)


def _handicap(kind: TypeName, order: Order) -> float:
    """Seldom: swapped bytes, 64 bits; a float wants no explanation where its numbers are likely."""
    common = {1: 2.0, 2: 1.0 if is_float(kind) else 5.0, 4: 6.0 if is_float(kind) else 8.0}[registers_of(kind)]
    swapped = {"ABCD": 0.0, "CDAB": 0.25, "BADC": 5.0, "DCBA": 5.25}[order]
    return common + swapped + (0.5 if kind.startswith("u") else 0.0)


REGISTERS: tuple[Layout, ...] = tuple(layout for kind in LETTERS for layout in register_layouts(kind))
"""All that registers can be."""


def _frame_layouts() -> tuple[Layout, ...]:
    found = []
    for width, handicap in ((1, 6.0), (2, 1.0), (3, 4.0), (4, 3.0)):
        for order, places in (("little", tuple(range(width))[::-1]), ("big", tuple(range(width)))):
            if width == 1 and order == "big":
                continue
            for kind, extra in (("int", 0.0), ("uint", 0.5)):
                found.append(Layout(f"{kind}{8 * width}", order, places, handicap + extra))
            if width == 4:
                found.append(Layout("float32", order, places, handicap))
    return tuple(found)


FRAMES: tuple[Layout, ...] = _frame_layouts()
"""All that whole bytes of a CAN frame can be."""
