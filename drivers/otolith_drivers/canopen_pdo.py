"""What CANopen drives send by themselves: process data objects, as their electronic data sheet (EDS) maps them.

Nothing here has a network: a drive is never asked for anything.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion

from otolith_drivers.base import Signal
from otolith_drivers.can_options import CLASSIC_BITS, MOST_PDOS, OBJECT, MappedObject, PdoTable
from otolith_drivers.can_signals import Wanted, wanted_of
from otolith_drivers.can_source import EXTENDED_LIMIT, STANDARD_LIMIT, Source
from otolith_drivers.canopen_sheet import dictionary_of
from otolith_drivers.errors import ConfigurationError, nearest

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary, ODVariable

EMERGENCY_OBJECT, COMMUNICATION, MAPPING = 0x1014, 0x1800, 0x1A00  # CiA 301
PDO_IS_OFF = 1 << 31


@dataclass(frozen=True, slots=True)
class Mapped:
    """An object in a frame."""

    index: int
    subindex: int
    name: str
    """In the object dictionary; empty where it is not there."""
    signal: CanSignal
    typed: bool
    """Whether anybody says what kind of number it is."""

    @property
    def address(self) -> str:
        """As CANopen people write it."""
        return f"0x{self.index:04X}:{self.subindex:02X}"


@dataclass(frozen=True, slots=True)
class Pdo:
    """A process data object that the drive sends."""

    message: Message
    objects: tuple[Mapped, ...]
    enabled: bool = True


class Drive:
    """A node: what it sends, as far as its sheet and the machine file say."""

    def __init__(self, node: int, sheet: Path | None, tables: tuple[PdoTable, ...]) -> None:
        """Read ``sheet``; ``tables`` take precedence over it.

        Raises:
            ConfigurationError: no such file, no EDS, or a table names objects whose type nobody says.
        """
        self.node = node
        self.warnings: list[str] = []
        self.emergency = 0x80 + node
        self._sheet = sheet
        self._dictionary = dictionary_of(sheet, node, self.warnings) if sheet is not None else None
        pdos = {} if self._dictionary is None else self._pdos_of_the_sheet(self._dictionary)
        self.pdos = {**pdos, **{table.number: self._pdo_of_a_table(table) for table in tables}}
        if not self.pdos:
            raise ConfigurationError(
                f"node {node}: nothing says what it sends: set eds in [driver], or [[driver.pdo]]", ("driver",)
            )

    def find(self, signal: Signal) -> Wanted:
        """``signal`` in what the drive sends.

        Raises:
            ConfigurationError: it is mapped nowhere, or in a PDO that is off, or measures something else.
        """
        source: Source = signal.source
        key = ("signals", signal.name)
        number, pdo, entry = self._where(str(source.object), key)
        if not entry.typed or (entry.signal.conversion.is_float and entry.signal.length not in (32, 64)):
            raise ConfigurationError(
                f"{self._title()}: {entry.address} is in TPDO {number}, but its type is not known: "
                "say what the PDO holds by [[driver.pdo]]",
                key,
            )
        origin = f"node {self.node} {entry.name or entry.address} ({entry.address}), TPDO {number}"
        return wanted_of(signal, pdo.message, entry.signal, origin)

    def _where(self, written: str, key: tuple[str, ...]) -> tuple[int, Pdo, Mapped]:
        """The object ``written``, and the PDO that it is in and its number."""
        sent = [(number, pdo, entry) for number, pdo in sorted(self.pdos.items()) for entry in pdo.objects]
        found = [place for place in sent if _is_meant(place[2], written)]
        if not found:
            known = nearest(written, [f"{entry.name} ({entry.address})" for _, _, entry in sent])
            raise ConfigurationError(f"{self._title()} sends no object {written!r}: {known}", key)
        enabled = [place for place in found if place[1].enabled]
        if not enabled:
            number = found[0][0]
            raise ConfigurationError(
                f"{self._title()} sends {written} only in TPDO {number}, which the sheet switches off: "
                "if the drive was set up otherwise, say so by [[driver.pdo]]",
                key,
            )
        if len({entry.address for _, _, entry in enabled}) > 1:
            addresses = ", ".join(sorted({entry.address for _, _, entry in enabled}))
            raise ConfigurationError(f"{self._title()} has {written!r} at {addresses}: write one of them", key)
        return enabled[0]

    def _title(self) -> str:
        return f"node {self.node}" if self._sheet is None else f"node {self.node} ({self._sheet})"

    def _pdos_of_the_sheet(self, dictionary: "ObjectDictionary") -> dict[int, Pdo]:
        emergency = _value(dictionary, EMERGENCY_OBJECT, 0)
        if emergency is not None and emergency & STANDARD_LIMIT:
            self.emergency = emergency & STANDARD_LIMIT
        found = {}
        for number in range(1, MOST_PDOS + 1):
            if COMMUNICATION + number - 1 not in dictionary or MAPPING + number - 1 not in dictionary:
                continue
            try:
                found[number] = self._pdo_of_the_sheet(dictionary, number)
            except (ConfigurationError, ValueError) as error:
                self.warnings.append(f"{self._title()}: TPDO {number} cannot be read: {error}")
        return found

    def _pdo_of_the_sheet(self, dictionary: "ObjectDictionary", number: int) -> Pdo:
        """The library's own reader leaves out what it does not know, and reads what follows in the wrong place."""
        identifier = _value(dictionary, COMMUNICATION + number - 1, 1)
        count = _value(dictionary, MAPPING + number - 1, 0)
        if identifier is None or count is None or not 0 <= count <= CLASSIC_BITS:
            raise ValueError("the sheet does not say its COB-ID or what is mapped")
        entries, start = [], 0
        for place in range(1, count + 1):
            word = _value(dictionary, MAPPING + number - 1, place)
            if not word:
                raise ValueError(f"the sheet does not say what is mapped in place {place}")
            entry = MappedObject(index=word >> 16 & 0xFFFF, subindex=word >> 8 & 0xFF, length=word & 0xFF)
            entries.append(_mapped(entry, self._look_up(entry), start))
            start += entry.length
        frame = identifier & EXTENDED_LIMIT
        return self._assembled(number, frame, entries, enabled=not identifier & PDO_IS_OFF and bool(entries))

    def _pdo_of_a_table(self, table: PdoTable) -> Pdo:
        entries, start = [], 0
        for entry in table.objects:
            known = self._look_up(entry)
            if known is None and entry.type is None:
                raise ConfigurationError(
                    f"node {self.node}: nobody says the type of {_address(entry)}: "
                    'write it behind, like "0x6064:00 i32", or set eds',
                    ("driver", "pdo"),
                )
            mapped = _mapped(entry, known, start)
            entries.append(mapped)
            start += mapped.signal.length
        return self._assembled(table.number, table.identifier(), entries, enabled=True)

    def _look_up(self, entry: MappedObject) -> "ODVariable | None":
        from canopen.objectdictionary import ODVariable  # noqa: PLC0415 - see canopen_sheet

        try:
            found = self._dictionary[entry.index] if self._dictionary is not None else None
            return found if found is None or isinstance(found, ODVariable) else found[entry.subindex]
        except KeyError:
            return None

    def _assembled(self, number: int, identifier: int, entries: list[Mapped], *, enabled: bool) -> Pdo:
        bits = sum(entry.signal.length for entry in entries)
        if bits > CLASSIC_BITS:
            raise ConfigurationError(
                f"node {self.node}: TPDO {number} has {bits} bits, but a frame {CLASSIC_BITS}", ("driver", "pdo")
            )
        name, signals = f"node{self.node}.TPDO{number}", [entry.signal for entry in entries]
        extended = identifier > 0x7FF
        message = Message(identifier, name, (bits + 7) // 8, signals, is_extended_frame=extended, strict=False)
        return Pdo(message, tuple(entries), enabled)


def _value(dictionary: "ObjectDictionary", index: int, subindex: int) -> int | None:
    """What the sheet says that the drive has there: set up (in a DCF), or by default."""
    from canopen.objectdictionary import ODVariable  # noqa: PLC0415 - see canopen_sheet

    try:
        found = dictionary[index]
        entry = found if isinstance(found, ODVariable) else found[subindex]
    except KeyError:
        return None
    said = entry.default if entry.value is None else entry.value
    return said if isinstance(said, int) else None


def _address(entry: MappedObject) -> str:
    return f"0x{entry.index:04X}:{entry.subindex:02X}"


def _mapped(entry: MappedObject, known: "ODVariable | None", start: int) -> Mapped:
    """``entry`` from bit ``start`` on; what it does not say itself is as ``known``, else unsigned."""
    from canopen.objectdictionary import datatypes  # noqa: PLC0415 - see canopen_sheet

    type_known = known.data_type if known is not None else None
    signed = entry.type == "i" if entry.type else type_known in datatypes.SIGNED_TYPES
    is_float = entry.type == "f" if entry.type else type_known in datatypes.FLOAT_TYPES
    length = entry.length or (len(known) if known is not None else 0)
    if not 0 < length <= CLASSIC_BITS:
        raise ConfigurationError(f"{_address(entry)} has {length} bits, but a frame {CLASSIC_BITS}", ("driver", "pdo"))
    conversion = BaseConversion.factory(is_float=is_float)
    signal = CanSignal(_address(entry), start, length, is_signed=signed, conversion=conversion)
    name = known.qualname if known is not None else ""
    return Mapped(entry.index, entry.subindex, name, signal, known is not None or entry.type is not None)


def _is_meant(entry: Mapped, written: str) -> bool:
    wish = written.strip()
    if entry.name and entry.name.casefold() == wish.casefold():
        return True
    match = OBJECT.fullmatch(wish) if wish[:2].lower() == "0x" else None
    if match is None:
        return False
    return entry.index == int(match[1], 16) and (match[2] is None or entry.subindex == int(match[2], 16))
