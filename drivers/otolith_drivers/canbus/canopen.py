"""Reading electronic data sheets: what of them the ``canopen`` library can be trusted with.

Sheets are INI files that people edit: sections stand twice, keys are missing, numbers are words. The library refuses a
whole sheet for one such object; here the object is left out.

What CANopen drives send by themselves: process data objects, as their electronic data sheet (EDS) maps them.

Nothing here has a network: a drive is never asked for anything.

What a CANopen drive says of itself beside its values: emergencies and heartbeats (CiA 301). No clock in here.
"""

import io
import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from otolith_drivers.config_files import content
from otolith_drivers.errors import ConfigurationError

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary
from dataclasses import dataclass

from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion

from otolith_drivers.base import Signal
from otolith_drivers.canbus.options import CLASSIC_BITS, MOST_PDOS, OBJECT, MappedObject, PdoTable
from otolith_drivers.canbus.signals import EXTENDED_LIMIT, STANDARD_LIMIT, SignalRequest, Source, wanted_of
from otolith_drivers.errors import nearest

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary, ODVariable
from collections.abc import Callable

from otolith_drivers.canbus.monitoring import PeriodEstimator, period_text

Sections = dict[str, dict[str, str]]

OBJECT_SECTION = re.compile(r"([0-9A-Fa-f]{4})(?:[Ss]ub([0-9A-Fa-f]{1,2}))?")
TYPE_SECTION = re.compile(r"[0-9A-Fa-f]{1,3}(?:[Ss]ub[0-9A-Fa-f]{1,2})?")  # where a type of the maker's own is told
NUMBER = re.compile(r"0[xX][0-9A-Fa-f]{1,8}|\d{1,10}")
KEPT = ("ParameterName", "ObjectType", "DataType", "DefaultValue", "ParameterValue", "CompactSubObj")
SIMPLE = {"0x2", "0x7", "2", "7", "0x02", "0x07"}
LONGEST_VALUE = 200  # characters
SIZE_LIMIT = 4 << 20  # bytes; the sheets of large drives have 1 MB

logging.getLogger("canopen").setLevel(logging.ERROR)  # what it warns of concerns objects that nobody wants


def dictionary_of(path: Path, node: int, warnings: list[str]) -> "ObjectDictionary":
    """The object dictionary in the sheet at ``path``; to ``warnings`` is added which of its objects cannot be read.

    Raises:
        ConfigurationError: no such file, or no electronic data sheet.
    """
    from canopen.objectdictionary import eds  # noqa: PLC0415 - a tenth of a second that only CANopen drives cost

    key = ("driver", "eds")
    data = content(path, SIZE_LIMIT, key)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    sections, unread = usable_sections(text)
    if not sections:
        raise ConfigurationError(f"{path}: not an electronic data sheet: it describes no objects", key)
    if unread:
        names = ", ".join(unread[:3]) + (" ..." if len(unread) > 3 else "")
        warnings.append(f"{path.name}: {len(unread)} objects cannot be read: {names}")
    try:
        sheet = io.StringIO(written(sections))
        found: ObjectDictionary = eds.import_eds(sheet, node)  # type: ignore[no-untyped-call]  # the library has no types
    except Exception as error:
        cause = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigurationError(f"{path}: not an electronic data sheet: {cause}", key) from error
    return found


def usable_sections(text: str) -> tuple[Sections, list[str]]:
    """The objects of a sheet that can be read, and the names of the sections that cannot."""
    usable: Sections = {}
    unread: list[str] = []
    for name, entries in _sections(text.splitlines()).items():
        match = OBJECT_SECTION.fullmatch(name)
        if match is None:
            if TYPE_SECTION.fullmatch(name) and "DefaultValue" in entries:
                usable[name.replace("Sub", "sub")] = {"DefaultValue": entries["DefaultValue"]}
            continue
        if match[2] is not None and match[1] not in usable:
            unread.append(name)
            continue
        kept = _completed(name, entries, is_part=match[2] is not None)
        if kept is None:
            unread.append(name)
        else:
            usable[name] = kept
    return usable, unread


def written(sections: Sections) -> str:
    """The same as a sheet."""
    lines = ["[DeviceInfo]", ""]  # of which the library misses the name alone
    for name, entries in sections.items():
        lines += [f"[{name}]", *(f"{key}={value}" for key, value in entries.items()), ""]
    return "\n".join(lines)


def _sections(lines: Iterable[str]) -> Sections:
    """By name; of keys that stand twice the first holds."""
    found: Sections = {}
    current: dict[str, str] = {}
    for line in lines:
        if match := re.match(r"\s*\[([^\]]*)\]", line):
            current = found.setdefault(match[1].strip(), {})
        elif "=" in line and not line.lstrip().startswith((";", "#")):
            key, _, value = line.partition("=")
            current.setdefault(_canonical(key), value.split(";")[0].strip()[:LONGEST_VALUE])
    return found


def _canonical(key: str) -> str:
    plain = key.strip()
    return next((kept for kept in KEPT if kept.casefold() == plain.casefold()), plain)


def _completed(name: str, entries: dict[str, str], *, is_part: bool) -> dict[str, str] | None:
    """What the library needs of an object; None where that cannot be had."""
    kept = {key: entries[key] for key in KEPT if entries.get(key)}
    kept.setdefault("ParameterName", name)
    kept["AccessType"] = "ro"
    if any(not NUMBER.fullmatch(kept.get(key, "0")) for key in ("ObjectType", "DataType")):
        return None
    if "DataType" not in kept and (is_part or kept.get("ObjectType", "7").lower() in SIMPLE):
        return None
    return kept


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


class CanopenDrive:
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

    def find(self, signal: Signal) -> SignalRequest:
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


HEARTBEAT = 0x700
STATES = {0x00: "starting up", 0x04: "stopped", 0x05: "operational", 0x7F: "pre-operational"}
OPERATIONAL = 0x05
CAUSES = {
    0x10: "generic",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current inside",
    0x23: "current at the output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "temperature of the device",
    0x50: "hardware",
    0x60: "software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x71: "power",
    0x73: "sensor",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x84: "speed control",
    0x86: "position control",
    0x90: "external",
    0xF0: "additional functions",
    0xFF: "of the maker's own",
}
"""High byte of the code, by CiA 301 and CiA 402."""
Note = Callable[[bytes | bytearray, float], None]


class NodeWatch:
    """Listens to one node."""

    def __init__(self, node: int, emergency: int) -> None:
        """``emergency`` is the arbitration ID of its emergencies."""
        self.node = node
        self._emergency = emergency
        self._code = 0
        self._at = 0.0
        self._state: int | None = None
        self._beat = PeriodEstimator()

    def frames(self) -> dict[int, Note]:
        """Which frames it is to be shown."""
        return {self._emergency: self._note_emergency, HEARTBEAT + self.node: self._note_heartbeat}

    def warnings(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s), a line each."""
        lines = []
        if self._code:
            cause = CAUSES.get(self._code >> 8) or CAUSES.get(self._code >> 8 & 0xF0, "unknown")
            age = max(now - self._at, 0.0)
            lines.append(f"drive {self.node} reports emergency 0x{self._code:04X} ({cause}), {age:.1f} s ago")
        if self._state is not None and self._state != OPERATIONAL:
            state = STATES.get(self._state, f"in state 0x{self._state:02X}")
            lines.append(f"drive {self.node} is not operational, but {state}: it sends no process data")
        if (silence := self._beat.silent_for(now)) is not None:
            came = period_text(self._beat.period or 0.0)
            lines.append(f"the heartbeat of drive {self.node} has been away for {silence:.1f} s; it came every {came}")
        return lines

    def _note_emergency(self, data: bytes | bytearray, time: float) -> None:
        if len(data) >= 2:  # a code of 0 takes back what was reported
            self._code, self._at = int.from_bytes(data[:2], "little"), time

    def _note_heartbeat(self, data: bytes | bytearray, time: float) -> None:
        if data:
            self._state = data[0] & 0x7F  # the highest bit toggles where a master guards the node
            self._beat.note(time)
