"""Reading CAN databases (DBC, KCD, SYM, ARXML), also those with faults.

cantools reads them. A file that it refuses is read less strictly, and if that fails message by message. What is wrong
becomes a fault of the file, of a message or of a signal; only a fault of a requested signal is an error.
"""

import logging
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cantools
from cantools.database import Message
from cantools.database import Signal as CanSignal
from cantools.database.can.database import Database
from cantools.database.errors import UnsupportedDatabaseFormatError

from otolith_drivers.config_files import content
from otolith_drivers.errors import ConfigurationError, some_names

SIZE_LIMIT = 4 << 20  # bytes; databases of large vehicles have 2 MB, and take some seconds each
MAX_MESSAGE_LENGTH = 4096  # bytes; CAN FD has 64, the transport protocol of SAE J1939 1785
STANDARD_LIMIT, EXTENDED_LIMIT = 0x7FF, 0x1FFFFFFF  # arbitration IDs of 11 and of 29 bits
MAX_RANGE = 1 << 16  # values of one multiplexer, and arbitration IDs of one message
MAX_VALUES = 1 << 20  # of all multiplexers, or arbitration IDs of all messages
MAX_WORK = 1 << 24  # pairs of signals of one message, and bits of signals, of all messages: what reading a file costs
MAX_MESSAGES = 1 << 14  # of a DBC; that of all of SAE J1939 has some 3000
MAX_PAIRS_NAMED = 20  # overlaps of one message that are named as pairs
SHEETS = (".eds", ".dcf")
FORMATS = {".dbc": "dbc", ".kcd": "kcd", ".sym": "sym", ".arxml": "arxml"}
KEY = ("driver", "dbc")

# cantools makes lists as long as these numbers, so a wrong one could fill the memory.
LENGTHS = re.compile(
    r"(?:^[ \t]*BO_\s+\d+\s+\S+\s*:\s*|\|\s*(?=\d+\s*@)|:\s*(?=\d+\s*\|)|\blength=[\"']|\boffset=[\"']|\bLen\s*=\s*|"
    r"\b(?:un)?signed\s+|<(?:[\w-]*LENGTH|START-POSITION)>\s*)(\d+)",
    re.MULTILINE,
)
SYM_PLACES = re.compile(r"^[ \t]*(?:Mux|Var|Sig)\s*=[^/\n]*?\s(\d+)\s*(?:,\s*(\d+)|-|/|$)", re.MULTILINE)
MULTIPLEXERS = re.compile(r"\bSG_MUL_VAL_\s[^;]*+(?:;|\Z)")  # one without an end is read once, not from each place
RANGES = re.compile(r"\b(\d+)\s*-\s*(\d+)\s*[,;]")
IDENTIFIERS = re.compile(r"^[ \t]*ID\s*=\s*([0-9A-Fa-f]+)h\s*-\s*([0-9A-Fa-f]+)h", re.MULTILINE)
# The parts of a DBC that describe frames; comments, attributes and tables of values may be broken.
DBC_MESSAGE = re.compile(r"^[ \t]*BO_ .*(?:\r?\n[ \t]*(?:\r?\n[ \t]*)*SG_ .*)*", re.MULTILINE)
DBC_REFERENCE = re.compile(r"(\b(?:BO_|SG_|VAL_|SIG_VALTYPE_|SG_MUL_VAL_|SIG_GROUP_|BO_TX_BU_)\s+)(\d+)\b")
DBC_MULTIPLEXED = re.compile(r"^[ \t]*SG_\s+\S+\s+m\d+M?\s*:\s*(\d+)\s*\|\s*(\d+)", re.MULTILINE)
# Without a receiver or a sender cantools drops the signal, or refuses the file.
DBC_WITHOUT_NODE = re.compile(
    r'^([ \t]*(?:SG_ [^"\n]*"[^"\n]*"|BO_[ \t]+\d+[ \t]+\w+[ \t]*:[ \t]*\d+))[ \t]*$', re.MULTILINE
)
EXTENDED_FLAG = 1 << 31  # of an identifier in a DBC
# What else says how a message is read: types, multiplexers, values that are no readings, its protocol and its period.
# A statement ends with a semicolon, or incomplete where the next line begins another one.
DBC_REST = r'\s(?:[^;"\n]|"[^"\n]*+"|\n(?![ \t]*[A-Z][A-Z_]*_\b))*+;?'
DBC_ATTRIBUTE = r'"(?:VFrameFormat|GenMsgCycleTime)"'
DBC_TYPES = re.compile(rf"^[ \t]*(?:SIG_VALTYPE_|SG_MUL_VAL_)\s+(\d+){DBC_REST}", re.MULTILINE)
DBC_VALUES = re.compile(rf"^[ \t]*(?:VAL_|BA_\s+{DBC_ATTRIBUTE}\s+BO_)\s+(\d+){DBC_REST}", re.MULTILINE)
DBC_DEFINITION = re.compile(rf"^[ \t]*(BA_DEF_(?:DEF_)?\s+(?:BO_\s+)?{DBC_ATTRIBUTE}){DBC_REST}", re.MULTILINE)
DBC_SIGNAL = re.compile(r'^[ \t]*SG_ [^"\n]*"[^"\n]*"', re.MULTILINE)  # as far as its unit
DBC_STATEMENT = re.compile(r"\s*(?:VAL_|BA_|CM_|SIG_|SG_MUL_VAL_|BO_TX_BU_|EV_)")  # that a semicolon ends
MAX_TABLES = 100  # of a message that are tried alone: engineering choice, bounds the time

logging.getLogger("cantools").setLevel(logging.ERROR)  # its warnings become faults here


@dataclass(frozen=True, slots=True)
class DatabaseFault:
    """Something wrong in a database that can still be read."""

    text: str
    message: str | None = None
    signal: str | None = None


@dataclass(frozen=True, slots=True)
class CanDatabase:
    """The readable part of a database, and its faults."""

    path: Path
    messages: tuple[Message, ...]
    faults: tuple[DatabaseFault, ...] = ()
    unread: dict[str, str] = field(default_factory=dict)  # Names of the messages that cannot be read, and why

    def warnings(self) -> list[str]:
        """The faults, a line each."""
        return list(dict.fromkeys(f"{self.path.name}: {fault.text}" for fault in self.faults))

    def faults_of(self, message: Message, signal: str) -> list[DatabaseFault]:
        """The faults of one signal."""
        return [fault for fault in self.faults if fault.message == message.name and fault.signal == signal]


def load_dbc(path: Path) -> Database:
    """The readable part of the database at ``path``; raise ConfigurationError if there is none."""
    return Database(messages=list(load_database(path).messages), strict=False)


def load_database(path: Path) -> CanDatabase:
    """The database at ``path`` with its faults.

    Raises:
        ConfigurationError: no such file, not a CAN database, or one with numbers so large that they would fill the
            memory.
    """
    if path.suffix.lower() in SHEETS:
        text = f'{path}: the data sheet of a CANopen drive, not a CAN database: set eds = "..." in [driver] instead'
        raise ConfigurationError(text, KEY)
    text, faults = _text(path)
    if excess := _excess(text) if text.strip() else "it is empty":
        raise ConfigurationError(f"{path}: not a CAN database: {excess}", KEY)
    kind = FORMATS.get(path.suffix.lower())
    multiplexed: set[tuple[int, int, int]] = set()
    if is_dbc := kind in (None, "dbc"):
        text, flagged = _with_extended_flags(DBC_WITHOUT_NODE.sub(r"\1 Vector__XXX", text.replace("\r\n", "\n")))
        faults += flagged
        multiplexed = _multiplexed_places(text)
    unread: dict[str, str] = {}
    try:
        if is_dbc and (end := _end_of(text)):
            raise ValueError(end)  # noqa: TRY301 - as what the parser finds
        parsed = _parse(text, kind)
    except Exception as error:  # parsers raise exceptions of many types
        parsed, unread, lost = _parse_each_message(text) if is_dbc else ([], {}, [])
        if not parsed:
            raise ConfigurationError(f"{path}: not a CAN database: {_cause(error)}", KEY) from error
        faults += [DatabaseFault(f"only its messages could be read: {_cause(error)}"), *lost]
        faults += [DatabaseFault(f"message {name} cannot be read: {why}", name) for name, why in unread.items()]
    if excess := _excessive_work((len(row.signals), sum(abs(each.length) for each in row.signals)) for row in parsed):
        raise ConfigurationError(f"{path}: not a CAN database: {excess}", KEY)
    messages = []
    for message in parsed:
        if why := _why_unusable(message):
            unread[str(message.name)] = why
            faults.append(DatabaseFault(f"message {message.name} cannot be used: {why}"))
        else:
            messages.append(message)
            faults += [*_multiplexer_faults(message, multiplexed), *_signal_faults(message)]
    return CanDatabase(path, tuple(messages), (*faults, *_shared_frames(messages)), unread)


def _text(path: Path) -> tuple[str, list[DatabaseFault]]:
    data = content(path, SIZE_LIMIT, KEY)
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace"), []
    # Tools write UTF-8 or Windows-1252 and seldom say which; Windows-1252 text is hardly ever valid UTF-8.
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return data.decode(encoding), []
        except UnicodeDecodeError as error:
            place = error.start
    return data.decode("cp1252", errors="replace"), [DatabaseFault(f"neither UTF-8 nor Windows-1252 (byte {place})")]


def _excess(text: str) -> str:
    """What in ``text`` could do harm to the parser; empty if there is nothing."""
    if "\0" in text:
        return "it contains zero bytes"
    if text.lstrip().startswith("<") and re.search(r"<!(?:DOCTYPE|ENTITY)", text):
        return "it defines XML entities, which no database needs"
    numbers = {*LENGTHS.findall(text), *(number for pair in SYM_PLACES.findall(text) for number in pair if number)}
    if any(len(number) > 5 or int(number) > 8 * MAX_MESSAGE_LENGTH for number in numbers):
        return f"it has a length or a start beyond {MAX_MESSAGE_LENGTH} bytes"
    ranges = [_length(match, 10) for line in MULTIPLEXERS.findall(text) for match in RANGES.finditer(line)]
    if max(ranges, default=0) > MAX_RANGE or sum(ranges) > MAX_VALUES:
        return f"it has a multiplexer of more than {MAX_RANGE} values, or more than {MAX_VALUES} values in all"
    ranges = [_length(match, 16) for match in IDENTIFIERS.finditer(text)]
    if max(ranges, default=0) > MAX_RANGE or sum(ranges) > MAX_VALUES:
        return f"it has a message of more than {MAX_RANGE} arbitration IDs, or more than {MAX_VALUES} of all messages"
    sizes = [(block.count("SG_ "), 0) for _, _, block in _dbc_messages(text)]  # none of another format
    sizes += [(element.count("<Signal "), 0) for element in text.split("<Message ")[1:]]  # of KCD
    return f"it has more than {MAX_MESSAGES} messages" if len(sizes) > MAX_MESSAGES else _excessive_work(sizes)


def _excessive_work(messages: Iterable[tuple[int, int]]) -> str:
    """What makes messages, with so many signals and bits of signals each, too much work; empty if nothing does."""
    rows = list(messages)
    if sum(signals**2 + bits for signals, bits in rows) <= MAX_WORK:
        return ""
    most = max(signals for signals, _ in rows)
    return f"more than {MAX_WORK} pairs of signals of a message and bits of signals; one message has {most} signals"


def _dbc_messages(text: str) -> Iterator[tuple[str, str, str]]:
    """Identifier, name and text of each message of a DBC; the identifier is empty if the first line is incomplete."""
    for block in DBC_MESSAGE.findall(text):
        words = block.split(None, 3)
        yield (words[1], words[2].rstrip(":"), block) if len(words) > 2 else ("", block[:40].strip(), block)


def _with_extended_flags(text: str) -> tuple[str, list[DatabaseFault]]:
    """A DBC with bit 31 in each identifier that needs 29 bits, as the format asks for; and what was changed."""
    names = [name for number, name, _ in _dbc_messages(text) if number.isdecimal() and _needs_flag(int(number))]
    if not names:
        return text, []

    def flag(match: re.Match[str]) -> str:
        identifier = int(match[2])
        return f"{match[1]}{identifier | EXTENDED_FLAG if _needs_flag(identifier) else identifier}"

    fault = f"identifiers over 11 bits without bit 31 are read as extended: {some_names(names)}"
    return DBC_REFERENCE.sub(flag, text), [DatabaseFault(fault)]


def _needs_flag(identifier: int) -> bool:
    return STANDARD_LIMIT < identifier <= EXTENDED_LIMIT


def _length(match: re.Match[str], base: int) -> int:
    if max(len(match[1]), len(match[2])) > 10:
        return MAX_RANGE + 1
    return max(0, int(match[2], base) - int(match[1], base))


def _parse(text: str, kind: str | None) -> list[Message]:
    # Not strict: its check of the layout takes the square of the length for each signal. It is that of _signal_faults.
    database = cantools.database.load_string(text, kind, strict=False)
    if not isinstance(database, Database):
        raise ValueError("a diagnostics database; a CAN database (DBC, KCD, SYM, ARXML) is needed")  # noqa: TRY004 - a fault of a file
    if not database.messages and re.search(r"^[ \t]*BO_ ", text, re.MULTILINE):
        raise ValueError("none of its messages can be read")
    return database.messages


def _end_of(text: str) -> str:
    """The incomplete statement at the end of a DBC, which cantools leaves out silently; empty if there is none."""
    last = text.rstrip().rpartition("\n")[2]
    is_cut = DBC_STATEMENT.match(last) and not last.endswith(";")
    is_cut = is_cut or (last.lstrip().startswith("SG_ ") and not DBC_SIGNAL.match(last))
    return f"the file ends within {last.strip()[:40]!r}" if is_cut else ""


def _parse_each_message(text: str) -> tuple[list[Message], dict[str, str], list[DatabaseFault]]:
    """The messages of a DBC that can be parsed alone, why each of the others cannot, and what is lost of the former."""
    types, values = _by_message(DBC_TYPES, text), _by_message(DBC_VALUES, text)
    definitions = list({match[1]: match[0] for match in DBC_DEFINITION.finditer(text) if match[0][-1] == ";"}.values())
    read: list[Message] = []
    unread: dict[str, str] = {}
    faults: list[DatabaseFault] = []
    for identifier, name, block in _dbc_messages(text):
        whole = [block, *types.pop(identifier, ())]
        if why := _incomplete(whole):
            unread[name] = why
            continue
        beside = values.pop(identifier, [])
        taken = [row for row in beside if row.endswith(";")]
        parsed, why = _parse_alone([*definitions, *whole, *taken])
        if not parsed and taken:
            taken = [row for row in taken[:MAX_TABLES] if _parse_alone([*definitions, *whole, row])[0]]
            parsed, _ = _parse_alone([*definitions, *whole, *taken])
            parsed = parsed or _parse_alone(whole)[0]
        read += parsed
        if not parsed:
            unread[name] = why
        elif len(taken) < len(beside):
            lost = next(row for row in beside if row not in taken).strip()[:40]
            faults.append(
                DatabaseFault(f"values of {name} that are no readings are not known: {lost!r} is broken", name)
            )
    return read, unread, faults


def _incomplete(statements: list[str]) -> str:
    """What of a message and its types is cut off; empty if nothing is."""
    block, *types = statements
    if block.count("SG_ ") > len(DBC_SIGNAL.findall(block)):
        return "one of its signals is cut off"
    return next((f"{row.strip()[:40]!r} is cut off" for row in types if not row.endswith(";")), "")


def _by_message(pattern: re.Pattern[str], text: str) -> dict[str, list[str]]:
    """The statements of a DBC that ``pattern`` finds, also incomplete ones, by the identifier of their message."""
    statements: dict[str, list[str]] = defaultdict(list)
    for match in pattern.finditer(text):
        statements[match[1]].append(match[0])
    return statements


def _parse_alone(statements: list[str]) -> tuple[list[Message], str]:
    """The messages of some statements of a DBC, and why there are none."""
    try:
        return _parse("\n".join(['VERSION ""', "NS_ :", "BS_:", "BU_:", *statements, ""]), "dbc"), ""
    except Exception as error:  # noqa: BLE001 - parsers raise exceptions of many types
        # The line number is that of the text parsed here, not of the file.
        return [], re.sub(r"at line \d+, column \d+", "at '>>!<<'", _cause(error))


def _cause(error: BaseException) -> str:
    if isinstance(error, UnsupportedDatabaseFormatError):  # of each parser that was tried; most databases are DBC
        causes = (error.e_dbc, error.e_kcd, error.e_sym, error.e_arxml)
        error = next((cause for cause in causes if cause is not None), error)
    text = " ".join(str(error).split())
    return text[:200] or type(error).__name__


def _why_unusable(message: Message) -> str:
    """What the formats allow to be absent although the decoder needs it; empty if nothing is."""
    if not isinstance(message.name, str) or not isinstance(message.frame_id, int) or message.frame_id < 0:
        return "it has no name or no arbitration ID"
    if message.length < 0:
        return f"it has {message.length} bytes"
    if any(not isinstance(signal.name, str) or signal.start < 0 for signal in message.signals):
        return "one of its signals has no name or no place"
    if orders := {str(signal.byte_order) for signal in message.signals} - {"little_endian", "big_endian"}:
        return f"one of its signals has the byte order {min(orders)!r}"
    return ""


def _multiplexed_places(text: str) -> set[tuple[int, int, int]]:
    """Arbitration ID, start and length of the multiplexed signals of a DBC: cantools takes some for plain ones."""
    return {
        (int(number) % EXTENDED_FLAG, int(match[1]), int(match[2]))
        for number, _, block in _dbc_messages(text)
        if number.isdecimal()
        for match in DBC_MULTIPLEXED.finditer(block)
    }


def _multiplexer_faults(message: Message, multiplexed: set[tuple[int, int, int]]) -> list[DatabaseFault]:
    """Multiplexed signals whose multiplexer, or one that this depends on, is not in ``message``, or is cut short."""
    signals = {signal.name: signal for signal in message.signals}

    def missing(signal: CanSignal) -> str:
        """Return the multiplexer that is missing; empty if none is."""
        for _ in signals:
            name = signal.multiplexer_signal
            if name is None:
                place = (message.frame_id, signal.start, signal.length)
                return "a signal without a name" if place in multiplexed else ""
            if name not in signals:
                return name or "a signal without a name"
            signal = signals[name]
        return ""  # they depend on each other in a circle

    return [
        DatabaseFault(
            f"{message.name}.{signal.name} is multiplexed by {name}, which the message does not have",
            message.name,
            signal.name,
        )
        for signal in message.signals
        if (name := missing(signal))
    ]


def _signal_faults(message: Message) -> list[DatabaseFault]:
    """Signals of ``message`` that exceed its frame or overlap: all of them, the first overlaps as pairs."""
    name, faults, overlapping, seen = message.name, [], dict[str, str](), _Occupied()
    masks = [(signal, bits_of(signal)) for signal in message.signals]
    for place, (signal, mask) in enumerate(masks):
        if mask >> (8 * message.length):
            text = f"{name}.{signal.name} lies beyond the {message.length} bytes of its frame"
            faults.append(DatabaseFault(text, name, signal.name))
        if not seen.add(signal, mask):
            continue
        for other, other_mask in masks[:place]:
            if mask & other_mask and not _exclude_each_other(signal, other):
                text = f"{name}.{signal.name} and {name}.{other.name} overlap"
                overlapping.setdefault(signal.name, f"{name}.{signal.name} overlaps with others")
                overlapping.setdefault(other.name, f"{name}.{other.name} overlaps with others")
                if len(faults) < MAX_PAIRS_NAMED:
                    faults += [DatabaseFault(text, name, signal.name), DatabaseFault(text, name, other.name)]
    named = {fault.signal for fault in faults if fault.text.endswith("overlap")}
    return [*faults, *(DatabaseFault(text, name, own) for own, text in overlapping.items() if own not in named)]


class _Occupied:
    """The bits of a message that signals take: always, or for one value of a multiplexer."""

    def __init__(self) -> None:
        self._always = self._any = 0
        self._of: dict[str, int] = defaultdict(int)
        self._for: dict[tuple[str, int], int] = defaultdict(int)

    def add(self, signal: CanSignal, mask: int) -> bool:
        """Take the bits of ``mask``; return whether another signal may have some of them."""
        multiplexer, values = signal.multiplexer_signal, signal.multiplexer_ids or ()
        if multiplexer is None:
            taken, self._always = self._any, self._always | mask
        else:
            taken = self._always
            for other, bits in self._of.items():
                taken |= bits if other != multiplexer else 0
            for value in values:
                taken |= self._for[multiplexer, value]
                self._for[multiplexer, value] |= mask
            self._of[multiplexer] |= mask
        self._any |= mask
        return bool(taken & mask)


def bits_of(signal: CanSignal) -> int:
    """The bits of ``signal`` as a mask; bit ``8*n + m`` is bit ``m`` of byte ``n``."""
    if signal.byte_order == "little_endian":
        return ((1 << signal.length) - 1) << signal.start
    mask, place = 0, signal.start
    for _ in range(signal.length):
        mask |= 1 << place
        place = place - 1 if place % 8 else place + 15
    return mask


def _exclude_each_other(one: CanSignal, other: CanSignal) -> bool:
    """Whether two signals of the same multiplexer have no value of it in common."""
    if one.multiplexer_signal is None or one.multiplexer_signal != other.multiplexer_signal:
        return False
    return not set(one.multiplexer_ids or ()) & set(other.multiplexer_ids or ())


def _shared_frames(messages: Sequence[Message]) -> list[DatabaseFault]:
    by_frame: dict[tuple[int, bool], list[str]] = defaultdict(list)
    for message in messages:
        by_frame[message.frame_id, message.is_extended_frame].append(message.name)
    return [
        DatabaseFault(f"frame 0x{frame:X} is described {len(names)} times: {', '.join(names)}", names[0])
        for (frame, _), names in by_frame.items()
        if len(names) > 1
    ]
