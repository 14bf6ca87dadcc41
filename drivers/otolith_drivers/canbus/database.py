"""Reading CAN databases (DBC, KCD, SYM, ARXML) as vendors write them: what is wrong is named, what is right is used.

cantools reads them. A file that it refuses is read less strictly, and at last message by message; what was wrong
becomes a fault of the file, of a message or of a signal. Whoever wants that signal decides what to make of it.
"""

import logging
import re
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import cantools
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.can.database import Database

from otolith_drivers.config_files import content
from otolith_drivers.errors import ConfigurationError

SIZE_LIMIT = 4 << 20  # bytes; large vehicles have databases of 2 MB, and each takes some seconds
LONGEST_FRAME = 4096  # bytes; CAN FD has 64, the transport protocol of SAE J1939 1785
MOST_MULTIPLEXERS = 1 << 16  # values of one multiplexer, and arbitration IDs of one message
SHEETS = (".eds", ".dcf")
FORMATS = {".dbc": "dbc", ".kcd": "kcd", ".sym": "sym", ".arxml": "arxml"}

# cantools makes lists as long as these numbers say, so a slip (or worse) in one of them could fill the memory.
LENGTHS = re.compile(
    r"(?:^\s*BO_\s+\d+\s+\S+\s*:\s*|\|\s*(?=\d+\s*@)|:\s*(?=\d+\s*\|)|\blength=[\"']|\boffset=[\"']|\bLen\s*=\s*|"
    r"\b(?:un)?signed\s+|<(?:[\w-]*LENGTH|START-POSITION)>\s*)(\d+)",
    re.MULTILINE,
)
RANGES = re.compile(r"\b(\d+)\s*-\s*(\d+)\s*[,;]")
IDENTIFIERS = re.compile(r"^\s*ID\s*=\s*([0-9A-Fa-f]+)h\s*-\s*([0-9A-Fa-f]+)h", re.MULTILINE)
# All that a DBC needs to say of frames; comments, attributes and tables of values may be broken.
DBC_MESSAGE = re.compile(r"^[ \t]*BO_ .*(?:\r?\n[ \t]*(?:\r?\n[ \t]*)*SG_ .*)*", re.MULTILINE)
DBC_EXTRA = re.compile(r"^[ \t]*(?:SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+)\s[^;]*;", re.MULTILINE)

logging.getLogger("cantools").setLevel(logging.ERROR)  # what it warns of is named here, once and with its file


@dataclass(frozen=True, slots=True)
class DatabaseFault:
    """Something wrong in a database that can still be read."""

    text: str
    message: str | None = None
    signal: str | None = None


@dataclass(frozen=True, slots=True)
class Loaded:
    """A database as far as it could be read."""

    path: Path
    messages: tuple[Message, ...]
    faults: tuple[DatabaseFault, ...] = ()
    unread: dict[str, str] = field(default_factory=dict)
    """Names of the messages that could not be read at all, and why."""

    def warnings(self) -> list[str]:
        """What is wrong with the file, a line each."""
        return list(dict.fromkeys(f"{self.path.name}: {fault.text}" for fault in self.faults))

    def faults_of(self, message: Message, signal: str) -> list[DatabaseFault]:
        """What is wrong with one signal."""
        return [fault for fault in self.faults if fault.message == message.name and fault.signal == signal]


def load_dbc(path: Path) -> Database:
    """The database, as cantools has it, with what can be read of it.

    Raises:
        ConfigurationError: no such file, or not a CAN database.
    """
    return Database(messages=list(load_database(path).messages), strict=False)


def load_database(path: Path) -> Loaded:
    """What is in the database at ``path``, and what is wrong with it.

    Raises:
        ConfigurationError: no such file, no CAN database, or one that could only be meant to do harm.
    """
    if path.suffix.lower() in SHEETS:
        raise ConfigurationError(
            f'{path}: the data sheet of a CANopen drive, not a CAN database: name it by eds = "..." in [driver]',
            ("driver", "dbc"),
        )
    text, faults = _text(path)
    _refuse_excess(text, path)
    kind = FORMATS.get(path.suffix.lower())
    unread: dict[str, str] = {}
    try:
        messages = _parse(text, kind, strict=True)
    except Exception as strictly:  # noqa: BLE001 - parsers raise what they like
        try:
            messages = _parse(text, kind, strict=False)
        except Exception as error:
            messages, unread = _message_by_message(text) if kind in (None, "dbc") else ([], {})
            if not messages:
                raise ConfigurationError(
                    f"{path}: not a CAN database: {_cause(strictly)}", ("driver", "dbc")
                ) from error
            faults.append(DatabaseFault(f"only its messages could be read: {_cause(error)}"))
            faults += [DatabaseFault(f"message {name} cannot be read: {why}", name) for name, why in unread.items()]
    for message in list(messages):
        if why := _without_sense(message):
            messages.remove(message)
            unread[str(message.name)] = why
            faults.append(DatabaseFault(f"message {message.name} cannot be used: {why}"))
        else:
            faults += _faults_of_layout(message)
    return Loaded(path, tuple(messages), (*faults, *_duplicates(messages)), unread)


def _text(path: Path) -> tuple[str, list[DatabaseFault]]:
    data = content(path, SIZE_LIMIT, ("driver", "dbc"))
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), []
    # The tools write Windows-1252 or UTF-8 and seldom say which; text in the one is hardly ever text in the other.
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return data.decode(encoding), []
        except UnicodeDecodeError as error:
            place = error.start
    return data.decode("cp1252", errors="replace"), [DatabaseFault(f"neither UTF-8 nor Windows-1252 (byte {place})")]


def _refuse_excess(text: str, path: Path) -> None:
    what = None
    if "\0" in text:
        what = "it has zero bytes in it"
    elif text.lstrip().startswith("<") and re.search(r"<!(?:DOCTYPE|ENTITY)", text):
        what = "it defines XML entities, which no database needs"
    elif any(len(match[1]) > 5 or int(match[1]) > 8 * LONGEST_FRAME for match in LENGTHS.finditer(text)):
        what = f"it has a length or a start beyond {LONGEST_FRAME} bytes"
    elif any(_excessive(match, 10) for line in _multiplexings(text) for match in RANGES.finditer(line)):
        what = f"it has a multiplexer of more than {MOST_MULTIPLEXERS} values"
    elif any(_excessive(match, 16) for match in IDENTIFIERS.finditer(text)):
        what = f"it has a message of more than {MOST_MULTIPLEXERS} arbitration IDs"
    if what is not None:
        raise ConfigurationError(f"{path}: not a CAN database: {what}", ("driver", "dbc"))


def _multiplexings(text: str) -> list[str]:
    return [match[0] for match in re.finditer(r"\bSG_MUL_VAL_\s[^;]*;", text)]


def _excessive(match: re.Match[str], base: int) -> bool:
    if max(len(match[1]), len(match[2])) > 10:
        return True
    return int(match[2], base) - int(match[1], base) > MOST_MULTIPLEXERS


def _parse(text: str, kind: str | None, *, strict: bool) -> list[Message]:
    database = cantools.database.load_string(text, kind, strict=strict)
    if not isinstance(database, Database):
        raise ValueError("a diagnostics database; a CAN database (DBC, KCD, SYM, ARXML) is needed")  # noqa: TRY004 - a fault of a file
    if not database.messages and re.search(r"^\s*BO_ ", text, re.MULTILINE):
        raise ValueError("none of its messages can be read")
    return database.messages


def _message_by_message(text: str) -> tuple[list[Message], dict[str, str]]:
    """Every message of a DBC that can be read when it stands alone, and why each of the others cannot."""
    extras: dict[str, list[str]] = defaultdict(list)
    for match in DBC_EXTRA.finditer(text):
        extras[match[1]].append(match[0])
    read: list[Message] = []
    unread: dict[str, str] = {}
    for block in DBC_MESSAGE.findall(text):
        words = block.split(None, 3)
        identifier, name = (words[1], words[2].rstrip(":")) if len(words) > 2 else ("", block[:40].strip())
        alone = "\n".join(['VERSION ""', "NS_ :", "BS_:", "BU_:", block, *extras[identifier], ""])
        try:
            read += _parse(alone, "dbc", strict=False)
        except Exception as error:  # noqa: BLE001 - parsers raise what they like
            unread[name] = re.sub(
                r"at line \d+, column \d+", "at '>>!<<'", _cause(error)
            )  # its lines are not the file's
    return read, unread


def _cause(error: BaseException) -> str:
    text = " ".join(str(error).split())
    text = re.sub(r'^(?:DBC|KCD|SYM|ARXML): "(.*)"$', r"\1", text)
    return text[:200] or type(error).__name__


def bits_of(signal: CanSignal) -> int:
    """The bits that ``signal`` takes, as a mask; bit ``8*n + m`` is bit ``m`` of byte ``n``."""
    if signal.byte_order == "little_endian":
        return ((1 << signal.length) - 1) << signal.start
    mask, place = 0, signal.start
    for _ in range(signal.length):
        mask |= 1 << place
        place = place - 1 if place % 8 else place + 15
    return mask


def _without_sense(message: Message) -> str:
    """What formats allow to be left out, and the rest of this code does not."""
    if not isinstance(message.name, str) or not isinstance(message.frame_id, int) or message.frame_id < 0:
        return "it has no name or no arbitration ID"
    if any(not isinstance(signal.name, str) or signal.start < 0 for signal in message.signals):
        return "one of its signals has no name or no place"
    return ""


def _faults_of_layout(message: Message) -> list[DatabaseFault]:
    """Signals that do not fit into ``message``, or lie upon each other in the same frame."""
    name = message.name
    try:
        message.refresh(strict=True)
    except Exception as error:  # noqa: BLE001 - which is what is to be told more precisely
        found = _signal_faults(message)
        return found or [DatabaseFault(f"message {name}: {_cause(error)}", name)]
    return []


def _signal_faults(message: Message) -> list[DatabaseFault]:
    name, found = message.name, []
    masks = [(signal, bits_of(signal)) for signal in message.signals]
    for place, (signal, mask) in enumerate(masks):
        if mask >> (8 * message.length):
            text = f"{name}.{signal.name} lies beyond the {message.length} bytes of its frame"
            found.append(DatabaseFault(text, name, signal.name))
        for other, taken in masks[:place]:
            if mask & taken and not _never_together(signal, other):
                text = f"{name}.{signal.name} and {name}.{other.name} overlap"
                found += [DatabaseFault(text, name, signal.name), DatabaseFault(text, name, other.name)]
    return found


def _never_together(one: CanSignal, other: CanSignal) -> bool:
    if one.multiplexer_signal is None or one.multiplexer_signal != other.multiplexer_signal:
        return False
    return not set(one.multiplexer_ids or ()) & set(other.multiplexer_ids or ())


def _duplicates(messages: list[Message]) -> list[DatabaseFault]:
    by_frame: dict[tuple[int, bool], list[str]] = defaultdict(list)
    for message in messages:
        by_frame[message.frame_id, message.is_extended_frame].append(message.name)
    return [
        DatabaseFault(f"frame 0x{frame:X} is described {len(names)} times: {', '.join(names)}", names[0])
        for (frame, _), names in by_frame.items()
        if len(names) > 1
    ]
