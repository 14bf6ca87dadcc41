"""CANopen drives, only listened to: their process data by an electronic data sheet (EDS), emergencies and heartbeats.

The ``canopen`` library reads the sheets. It refuses a whole sheet for one faulty object, and people edit sheets by
hand; so the faulty objects are removed first. A drive is never asked for anything.
"""

import io
import logging
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.conversion import BaseConversion

from otolith_drivers.base import Signal
from otolith_drivers.canbus.database import EXTENDED_LIMIT, STANDARD_LIMIT
from otolith_drivers.canbus.options import (
    CLASSIC_BITS,
    MAX_PDOS,
    OBJECT,
    CanSource,
    MappedObject,
    PdoTable,
    SignalRequest,
    request_for,
)
from otolith_drivers.common.message_times import PeriodEstimator, period_text
from otolith_drivers.config_files import content
from otolith_drivers.errors import ConfigurationError, nearest

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary, ODVariable

SIZE_LIMIT = 4 << 20  # bytes; the sheets of large drives have 1 MB
MAX_VALUE_LENGTH = 200  # characters of a value in a sheet; longer ones are cut
EMERGENCY_OBJECT, COMMUNICATION, MAPPING = 0x1014, 0x1800, 0x1A00  # indices in the object dictionary: CiA 301
EMERGENCY_ID, HEARTBEAT_ID = 0x80, 0x700  # plus the node: CiA 301
PDO_DISABLED = 1 << 31  # bit of a COB-ID: CiA 301
EDS_KEY, PDO_KEY = ("driver", "eds"), ("driver", "pdo")

OBJECT_SECTION = re.compile(r"([0-9A-Fa-f]{4})(?:[Ss]ub([0-9A-Fa-f]{1,2}))?")
TYPE_SECTION = re.compile(r"[0-9A-Fa-f]{1,3}(?:[Ss]ub[0-9A-Fa-f]{1,2})?")  # describes a data type of the vendor
NUMBER = re.compile(r"0[xX][0-9A-Fa-f]{1,8}|\d{1,10}")
USED_KEYS = ("ParameterName", "ObjectType", "DataType", "DefaultValue", "ParameterValue", "CompactSubObj")
VARIABLES = {"0x2", "0x7", "2", "7", "0x02", "0x07"}  # Object types that have a data type of their own

OPERATIONAL = 0x05
STATES = {0x00: "starting up", 0x04: "stopped", OPERATIONAL: "operational", 0x7F: "pre-operational"}
EMERGENCIES = {
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
    0xFF: "specific to the vendor",
}
"""By the high byte of the error code: CiA 301 and CiA 402."""

logging.getLogger("canopen").setLevel(logging.ERROR)  # its warnings concern objects that are not used here
Sections = dict[str, dict[str, str]]
FrameHandler = Callable[[bytes | bytearray, float], None]


@dataclass(frozen=True, slots=True)
class PdoVariable:
    """An object in a process data object."""

    index: int
    subindex: int
    address: str
    name: str  # In the object dictionary; empty if it is not there
    signal: CanSignal
    typed: bool  # Whether the sheet or the machine file gives its data type

    def is_named(self, written: str) -> bool:
        """Whether ``written`` is the name of the object or its address; without subindex any subindex matches."""
        written = written.strip()
        if self.name and self.name.casefold() == written.casefold():
            return True
        match = OBJECT.fullmatch(written) if written[:2].lower() == "0x" else None
        if match is None:
            return False
        return self.index == int(match[1], 16) and (match[2] is None or self.subindex == int(match[2], 16))


@dataclass(frozen=True, slots=True)
class Pdo:
    """A process data object that the drive sends."""

    number: int
    message: Message
    variables: tuple[PdoVariable, ...]
    enabled: bool


class CanopenDrive:
    """A node, and what it sends according to its sheet and the machine file."""

    def __init__(self, node: int, sheet: Path | None, tables: tuple[PdoTable, ...]) -> None:
        """Read ``sheet``; ``tables`` take precedence over it.

        Raises:
            ConfigurationError: no such file, no EDS, or the type of an object in a table is not known.
        """
        self.node = node
        self.warnings: list[str] = []  # What is wrong with the sheet, a line each
        self._title = f"node {node}" if sheet is None else f"node {node} ({sheet})"
        self._dictionary = read_eds(sheet, node, self.warnings) if sheet is not None else None
        emergency = (self._value(EMERGENCY_OBJECT, 0) or 0) & STANDARD_LIMIT
        self.monitor = NodeMonitor(node, emergency or EMERGENCY_ID + node)
        pdos = self._pdos_of_sheet() | {table.number: self._pdo_of_table(table) for table in tables}
        self._pdos = [pdos[number] for number in sorted(pdos)]
        if not pdos:
            text = f"node {node}: it is not known what it sends: set eds in [driver], or write [[driver.pdo]]"
            raise ConfigurationError(text, ("driver",))

    def request(self, signal: Signal) -> SignalRequest:
        """The request for ``signal``; raise ConfigurationError if no PDO contains it, or its type or unit is wrong."""
        source: CanSource = signal.source
        key = ("signals", signal.name)
        pdo, variable = self._find(str(source.object), key)
        if not variable.typed or (variable.signal.conversion.is_float and variable.signal.length not in (32, 64)):
            raise ConfigurationError(
                f"{self._title}: {variable.address} is in TPDO {pdo.number}, but its type is not known: "
                "give it in [[driver.pdo]]",
                key,
            )
        origin = f"node {self.node} {variable.name or variable.address} ({variable.address}), TPDO {pdo.number}"
        return request_for(signal, pdo.message, variable.signal, origin)

    def _find(self, written: str, key: tuple[str, ...]) -> tuple[Pdo, PdoVariable]:
        """The object ``written`` and the first enabled PDO that contains it."""
        sent = [(pdo, variable) for pdo in self._pdos for variable in pdo.variables]
        matches = [(pdo, variable) for pdo, variable in sent if variable.is_named(written)]
        if not matches:
            known = nearest(written, [f"{variable.name} ({variable.address})" for _, variable in sent])
            raise ConfigurationError(f"{self._title} sends no object {written!r}: {known}", key)
        enabled = [(pdo, variable) for pdo, variable in matches if pdo.enabled]
        if not enabled:
            raise ConfigurationError(
                f"{self._title} sends {written} only in TPDO {matches[0][0].number}, which the sheet disables: "
                "if the drive was set up otherwise, write [[driver.pdo]]",
                key,
            )
        addresses = sorted({variable.address for _, variable in enabled})
        if len(addresses) > 1:
            text = f"{self._title} has {written!r} at {', '.join(addresses)}: write one of these addresses"
            raise ConfigurationError(text, key)
        return enabled[0]

    def _pdos_of_sheet(self) -> dict[int, Pdo]:
        if self._dictionary is None:
            return {}
        pdos = {}
        for number in range(1, MAX_PDOS + 1):
            if COMMUNICATION + number - 1 in self._dictionary and MAPPING + number - 1 in self._dictionary:
                try:
                    pdos[number] = self._pdo_of_sheet(number)
                except (ConfigurationError, ValueError) as error:
                    self.warnings.append(f"{self._title}: TPDO {number} cannot be read: {error}")
        return pdos

    def _pdo_of_sheet(self, number: int) -> Pdo:
        """TPDO ``number``. The library's own reader omits unknown objects, and misplaces what follows them."""
        identifier = self._value(COMMUNICATION + number - 1, 1)
        count = self._value(MAPPING + number - 1, 0)
        if identifier is None or count is None or not 0 <= count <= CLASSIC_BITS:
            raise ValueError("the sheet does not give its COB-ID or what is mapped")
        objects = []
        for place in range(1, count + 1):
            word = self._value(MAPPING + number - 1, place)
            if not word:
                raise ValueError(f"the sheet does not give what is mapped in place {place}")
            objects.append(MappedObject(index=word >> 16 & 0xFFFF, subindex=word >> 8 & 0xFF, length=word & 0xFF))
        enabled = not identifier & PDO_DISABLED and bool(objects)
        return self._pdo(number, identifier & EXTENDED_LIMIT, objects, enabled=enabled)

    def _pdo_of_table(self, table: PdoTable) -> Pdo:
        for mapped in table.objects:
            if mapped.type is None and self._variable(mapped.index, mapped.subindex) is None:
                raise ConfigurationError(
                    f"node {self.node}: the type of {mapped.address} is not known: "
                    'write it behind, like "0x6064:00 i32", or set eds',
                    PDO_KEY,
                )
        return self._pdo(table.number, table.identifier(), table.objects, enabled=True)

    def _pdo(self, number: int, identifier: int, objects: Iterable[MappedObject], *, enabled: bool) -> Pdo:
        variables: list[PdoVariable] = []
        bits = 0
        for mapped in objects:
            variables.append(_pdo_variable(mapped, self._variable(mapped.index, mapped.subindex), bits))
            bits += variables[-1].signal.length
        if bits > CLASSIC_BITS:
            text = f"node {self.node}: TPDO {number} has {bits} bits, but a frame {CLASSIC_BITS}"
            raise ConfigurationError(text, PDO_KEY)
        name, signals = f"node{self.node}.TPDO{number}", [variable.signal for variable in variables]
        extended = identifier > STANDARD_LIMIT
        message = Message(identifier, name, (bits + 7) // 8, signals, is_extended_frame=extended, strict=False)
        return Pdo(number, message, tuple(variables), enabled)

    def _variable(self, index: int, subindex: int) -> "ODVariable | None":
        """The object in the object dictionary; None if it is not there."""
        from canopen.objectdictionary import ODVariable  # noqa: PLC0415 - see read_eds

        try:
            variable = self._dictionary[index] if self._dictionary is not None else None
            return variable if variable is None or isinstance(variable, ODVariable) else variable[subindex]
        except KeyError:
            return None

    def _value(self, index: int, subindex: int) -> int | None:
        """The value in the sheet: as set up (in a DCF), or the default; None if there is none."""
        variable = self._variable(index, subindex)
        if variable is None:
            return None
        value = variable.default if variable.value is None else variable.value
        return value if isinstance(value, int) else None


def _pdo_variable(mapped: MappedObject, known: "ODVariable | None", start: int) -> PdoVariable:
    """``mapped`` from bit ``start`` on. What it does not give itself is as in ``known``, else an unsigned number."""
    from canopen.objectdictionary import datatypes  # noqa: PLC0415 - see read_eds

    data_type = known.data_type if known is not None else None
    signed = mapped.type == "i" if mapped.type else data_type in datatypes.SIGNED_TYPES
    is_float = mapped.type == "f" if mapped.type else data_type in datatypes.FLOAT_TYPES
    length = mapped.length or (len(known) if known is not None else 0)
    if not 0 < length <= CLASSIC_BITS:
        raise ConfigurationError(f"{mapped.address} has {length} bits, but a frame {CLASSIC_BITS}", PDO_KEY)
    conversion = BaseConversion.factory(is_float=is_float)
    signal = CanSignal(mapped.address, start, length, is_signed=signed, conversion=conversion)
    name = known.qualname if known is not None else ""
    typed = known is not None or mapped.type is not None
    return PdoVariable(mapped.index, mapped.subindex, mapped.address, name, signal, typed)


def read_eds(path: Path, node: int, warnings: list[str]) -> "ObjectDictionary":
    """The dictionary in a sheet; unreadable objects go to ``warnings``; raise ConfigurationError if it is no sheet."""
    from canopen.objectdictionary import eds  # noqa: PLC0415 - a tenth of a second that only CANopen drives cost

    data = content(path, SIZE_LIMIT, EDS_KEY)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", errors="replace")
    sections, unread = usable_sections(text)
    if not sections:
        raise ConfigurationError(f"{path}: not an electronic data sheet: it describes no objects", EDS_KEY)
    if unread:
        names = ", ".join(unread[:3]) + (" ..." if len(unread) > 3 else "")
        warnings.append(f"{path.name}: {len(unread)} objects cannot be read: {names}")
    lines = ["[DeviceInfo]", ""]  # the library fails without this name
    for name, values in sections.items():
        lines += [f"[{name}]", *(f"{key}={value}" for key, value in values.items()), ""]
    try:
        dictionary: ObjectDictionary = eds.import_eds(io.StringIO("\n".join(lines)), node)  # type: ignore[no-untyped-call]  # the library has no types
    except Exception as error:  # the library raises anything for a damaged sheet
        cause = " ".join(str(error).split())[:200] or type(error).__name__
        raise ConfigurationError(f"{path}: not an electronic data sheet: {cause}", EDS_KEY) from error
    return dictionary


def usable_sections(text: str) -> tuple[Sections, list[str]]:
    """The sections of a sheet that the library can read, and the names of the objects that it cannot."""
    usable: Sections = {}
    unread: list[str] = []
    for name, values in _sections(text).items():
        match = OBJECT_SECTION.fullmatch(name)
        if match is None:
            if TYPE_SECTION.fullmatch(name) and "DefaultValue" in values:
                usable[name.replace("Sub", "sub")] = {"DefaultValue": values["DefaultValue"]}
            continue
        is_part = match[2] is not None
        if (is_part and match[1] not in usable) or not _is_readable(values, is_part=is_part):
            unread.append(name)
        else:
            usable[name] = {"ParameterName": name, **values, "AccessType": "ro"}
    return usable, unread


def _sections(text: str) -> Sections:
    """The used keys of each section that have a value. Of a key that is given twice the first counts."""
    canonical = {key.casefold(): key for key in USED_KEYS}
    sections: Sections = {}
    current: dict[str, str] = {}
    for line in text.splitlines():
        if match := re.match(r"\s*\[([^\]]*)\]", line):
            current = sections.setdefault(match[1].strip(), {})
        elif "=" in line and not line.lstrip().startswith((";", "#")):
            key, _, value = line.partition("=")
            if used := canonical.get(key.strip().casefold()):
                current.setdefault(used, value.split(";")[0].strip()[:MAX_VALUE_LENGTH])
    return {name: {key: value for key, value in values.items() if value} for name, values in sections.items()}


def _is_readable(values: dict[str, str], *, is_part: bool) -> bool:
    """Whether an object has what the library needs; ``is_part`` if it is a subindex of another object."""
    if any(not NUMBER.fullmatch(values.get(key, "0")) for key in ("ObjectType", "DataType")):
        return False
    return "DataType" in values or not (is_part or values.get("ObjectType", "7").lower() in VARIABLES)


class NodeMonitor:
    """Follows the emergencies and heartbeats of one node (CiA 301)."""

    def __init__(self, node: int, emergency: int) -> None:
        """``emergency`` is the arbitration ID of its emergencies."""
        self.node = node
        self._code = 0
        self._code_time = 0.0
        self._state: int | None = None
        self._heartbeats = PeriodEstimator()
        self.handlers: dict[int, FrameHandler] = {
            emergency: self._note_emergency,
            HEARTBEAT_ID + node: self._note_heartbeat,
        }
        """By arbitration ID, what takes the data of a frame and its time (s)."""

    def warnings(self, now: float) -> list[str]:
        """What is wrong at ``now`` (s), a line each."""
        lines = []
        if self._code:
            cause = EMERGENCIES.get(self._code >> 8) or EMERGENCIES.get(self._code >> 8 & 0xF0, "unknown")
            age = max(now - self._code_time, 0.0)
            lines.append(f"drive {self.node} reports emergency 0x{self._code:04X} ({cause}), {age:.1f} s ago")
        if self._state is not None and self._state != OPERATIONAL:
            state = STATES.get(self._state, f"in state 0x{self._state:02X}")
            lines.append(f"drive {self.node} is not operational, but {state}: it sends no process data")
        if (silence := self._heartbeats.silence(now)) is not None:
            period = period_text(self._heartbeats.period or 0.0)
            lines.append(f"no heartbeat of drive {self.node} for {silence:.1f} s; it came every {period}")
        return lines

    def _note_emergency(self, data: bytes | bytearray, time: float) -> None:
        if len(data) >= 2:  # a code of 0 takes back what was reported
            self._code, self._code_time = int.from_bytes(data[:2], "little"), time

    def _note_heartbeat(self, data: bytes | bytearray, time: float) -> None:
        if data:
            self._state = data[0] & 0x7F  # the highest bit toggles where a master guards the node
            self._heartbeats.lost_before(time)
