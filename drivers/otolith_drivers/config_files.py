"""TOML files as typed, bounded, closed models: each fault is one line with file, line, key, value and remedy."""

import re
import tomllib
import types
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, ValidationError, model_validator
from pydantic_core import PydanticSerializationError

from otolith_drivers.errors import ConfigurationError, nearest, shown
from otolith_drivers.grammars.json_lines import escaped, json_text
from otolith_drivers.outside_text import visible
from otolith_drivers.toml_bounds import MAX_TEXT, depth_fault, text_faults

FILE_SIZE_LIMIT = 1 << 20  # bytes of a TOML file: engineering choice, 100 times the largest machine file
MAX_FAULTS = 20  # lines of an error: engineering choice, more than a person mends at once
SHOWN_KEY = 64  # characters of a key in an error
MAX_WRITTEN = 200  # characters of a text with a pattern: engineering choice, longer than a path in a message

Location = Sequence[int | str]  # Keys and list indices that lead to a value
Model = TypeVar("Model", bound=BaseModel)

NUMBER = (int, float)  # A boolean is an integer as well
SECTION = re.compile(r"\s*+(\[\[?)([^\]]++)\]\]?\s*+(?:#.*)?$")
ASSIGNMENT = re.compile(r"\s*+([\w\-.\"' ()\t]++)=")
KEY_PART = re.compile(r"\"[^\"]*\"|'[^']*'|[^.]+")
TOML_TYPES = {
    "tuple_type": "a list, in [ ]",
    "list_type": "a list, in [ ]",
    "dict_type": "a table",
    "model_type": "a table",
    "string_type": "a text, in quotes",
    "path_type": "a text, in quotes",
}
"""How TOML writes what pydantic's error type asks for."""
KINDS = {
    "plant": ("a scenario of the simulated plant", "otolith plant"),
    "machine": ("a machine file", "otolith run"),
    "equations": ("a twin", "otolith twin check"),
    "service": ("the file of a service", "otolith run DIRECTORY"),
}
"""By the key that only this kind of file has: its name, and the command that reads it."""


def _one_or_two(written: object) -> object:
    """Return limits, one alone or two in a list, as a list; raise ValueError for more, and for what is no limit."""
    limits = written if isinstance(written, list | tuple) else (written,)
    if len(limits) > 2:
        raise ValueError(f"{written!r} are {len(limits)} limits: write one, or two in a list")
    for limit in limits:
        if isinstance(limit, bool) or not isinstance(limit, str | int | float):  # pydantic would turn true into 1.0
            text = str(limit).lower() if isinstance(limit, bool) else repr(limit)
            raise ValueError(f'{text} is not a limit: write a percentage like "-3 %", or a quantity with its unit')  # noqa: TRY004 - a fault of a file
    return limits


Limits = Annotated[tuple[str | float, ...], BeforeValidator(_one_or_two)]
"""One limit or a list of two, relative to the nominal value or with a unit."""


def _in_order(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"range {list(limits)}: the lower end comes first")
    return limits


Range = Annotated[tuple[float, float], AfterValidator(_in_order)]


class DocumentModel(BaseModel):
    """A document: unknown keys are errors, values are finite and immutable."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    def json_line(self) -> str:
        """Return the document as one line of JSON, without absent keys."""
        try:
            return escaped(self.model_dump_json(exclude_none=True))
        except PydanticSerializationError:  # a text with half a character, such as the name of a file
            return json_text(self.model_dump(mode="python", exclude_none=True))


class StrictModel(DocumentModel):
    """A table of a file: a document that also refuses values of another type."""

    @model_validator(mode="before")
    @classmethod
    def _of_the_written_types(cls, table: object) -> object:
        """Refuse what pydantic converts: a boolean for a number, a number for a boolean."""
        kinds = _written_kinds(cls)
        for key, value in table.items() if isinstance(table, dict) else ():
            if isinstance(value, NUMBER) and key in kinds:
                _check_number(key, value, kinds[key])
        return table


class _ValueFaultError(ValueError):
    """A fault of one key, found in its table."""

    def __init__(self, key: str, message: str) -> None:
        super().__init__(message)
        self.key = key


@cache
def _written_kinds(model: type[BaseModel]) -> dict[str, set[type]]:
    """Return the types of each key of a table; without keys that have a check of their own."""
    return {
        field.alias or name: {kind if isinstance(kind, type) else type(kind) for kind in _kinds(field.annotation)}
        for name, field in model.model_fields.items()
        if not any(isinstance(one, BeforeValidator) for one in field.metadata)
    }


def _check_number(key: str, value: float, kinds: set[type]) -> None:
    if isinstance(value, bool) and kinds & {int, float} and bool not in kinds:
        raise _ValueFaultError(key, f"{str(value).lower()} is a boolean: write a number")
    if not isinstance(value, bool) and bool in kinds and not kinds & {int, float}:
        raise _ValueFaultError(key, f"{value!r} is a number: write true or false")


@dataclass(frozen=True, slots=True)
class SourceFile:
    """A file and its text, to locate faults in it."""

    path: Path
    text: str = ""

    def place(self, location: Location) -> str:
        """Return ``file:line: key.of.the.value``, without the line if it is unknown."""
        line = line_of(self.text, location)
        return f"{self.path}:{line}: {dotted(location)}" if line else f"{self.path}: {dotted(location)}"


@dataclass(frozen=True, slots=True)
class Context:
    """Adds file, line and key to errors of checks that run after the file has been validated."""

    file: SourceFile

    def fail(self, location: Location, message: str) -> None:
        """Raise ``message`` as an error at ``location``."""
        raise ConfigurationError(f"{self.file.place(location)}: {message}")

    @contextmanager
    def at(self, *location: int | str) -> Iterator[None]:
        """Place errors that are raised meanwhile at ``location``."""
        try:
            yield
        except (ValueError, ConfigurationError) as error:
            raise ConfigurationError(f"{self.file.place(location)}: {error}") from error


def _kinds(annotation: Any) -> Iterator[Any]:
    """Yield the types and literals of a union; not those of lists, and not those with a check of their own."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated and not any(isinstance(one, BeforeValidator) for one in arguments):
        yield from _kinds(arguments[0])
    elif origin in (typing.Union, types.UnionType):
        for part in arguments:
            yield from _kinds(part)
    elif origin is typing.Literal:
        yield from arguments
    elif isinstance(annotation, type):
        yield annotation


def content(path: Path, limit: int, key: tuple[str, ...] = ()) -> bytes:
    """Return the bytes of ``path``; ``key`` is the key of the machine file that names it.

    Raises:
        ConfigurationError: the file is missing, unreadable, not a regular file, or larger than ``limit`` bytes.
    """
    try:
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"{path}: is a directory or a device, not a file", key)
        if path.stat().st_size > limit:
            raise ConfigurationError(f"{path}: larger than {limit} bytes, so it is not read", key)
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        raise ConfigurationError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}", key) from error


def read(path: Path, key: tuple[str, ...] = ()) -> SourceFile:
    r"""Return the text of a file that the user named, at ``key`` of the machine file, with line ends ``\n``.

    Raises:
        ConfigurationError: the file is missing, unreadable, too large, or not UTF-8.
    """
    try:
        text = content(path, FILE_SIZE_LIMIT, key).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        text = f"{path}: not UTF-8 text (byte {error.start}): is this the right file? If so, save it in UTF-8"
        raise ConfigurationError(text, key) from error
    return SourceFile(path, re.sub("\r\n?", "\n", text))


def parse(file: SourceFile) -> dict[str, Any]:
    """Return the tables of a TOML file; raise ConfigurationError if it is none, or beyond the bounds of one."""
    if fault := depth_fault(file.text):
        raise ConfigurationError(f"{file.path}:{fault}")
    try:
        data = tomllib.loads(file.text)
    except (ValueError, RecursionError) as error:
        hint = "; a key may occur only once in its table" if "overwrite" in str(error) else ""
        raise ConfigurationError(f"{file.path}: not valid TOML: {visible(str(error), MAX_TEXT)}{hint}") from error
    if faults := list(islice(text_faults(data), MAX_FAULTS)):
        raise ConfigurationError("\n".join(f"{file.place(at)}: {message}" for at, message in faults))
    return data


def expect(file: SourceFile, data: dict[str, Any], key: str) -> None:
    """Raise one ConfigurationError for a file of another kind, instead of one for each of its keys."""
    for other, (kind, command) in KINDS.items():
        if other != key and other in data and key not in data:
            raise ConfigurationError(f"{file.path}: this is {kind}, for '{command}'; {KINDS[key][0]} is needed here")


def is_of_another_kind(path: Path, key: str) -> bool:
    """Whether a TOML file is known to be of another kind than that with ``key``; not so if it cannot be read."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return False
    return key not in data and any(other in data for other in KINDS)


def validate(data: Any, model: type[Model], file: SourceFile, under: Location = ()) -> Model:
    """Return ``data``, at location ``under`` of the file, as ``model``; the ConfigurationError has a line per fault."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = list(_faults(error, data, model))
        lines = [f"{file.place([*under, *at])}: {message}" for at, message in faults[:MAX_FAULTS]]
        if len(faults) > MAX_FAULTS:
            lines.append(f"{file.path}: {len(faults) - MAX_FAULTS} more faults: mend these first")
        raise ConfigurationError("\n".join(dict.fromkeys(lines))) from error


def validated(data: Any, model: type[Model], under: tuple[str, ...]) -> Model:
    """Return ``data`` as ``model`` for a caller that does not know the file; the ConfigurationError has the key."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        at, message = next(_faults(error, data, model))
        raise ConfigurationError(message, (*under, *map(str, at))) from error


def written_as(pattern: re.Pattern[str], what: str) -> AfterValidator:
    """Return a validator of texts that all of ``pattern`` matches; its error says that the text is no ``what``."""

    def validated_text(value: str) -> str:
        if pattern.fullmatch(value) is None or len(value) > MAX_WRITTEN:
            raise ValueError(f"{shown(value)} is no {what}")
        return value

    return AfterValidator(validated_text)


def check_name(text: str) -> str:
    """Return ``text``, or raise ValueError if it is no valid name."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_\-]{0,63}", text):
        raise ValueError(
            f"{text!r} is not a valid name: use 1 to 64 letters, digits, '-' and '_', and begin with a letter or digit"
        )
    return text


def dotted(location: Location) -> str:
    """Return ``("setpoints", 2, "speed")`` as ``setpoints[2].speed``."""
    parts = (f"[{key}]" if isinstance(key, int) else f".{visible(key, SHOWN_KEY)}" for key in location)
    return "".join(parts).lstrip(".") or "the file"


def line_of(text: str, location: Location) -> int | None:
    """Return the line (from 1) that writes the value at ``location``, or its nearest table; None if there is neither.

    The standard library's parser reports no positions, so lines are matched one by one. Values that span several
    lines are not followed.
    """
    header: list[int | str] = []
    tables_seen: dict[tuple[int | str, ...], int] = {}
    best, depth = None, 0
    for number, line in enumerate(text.splitlines(), start=1):
        if section := SECTION.match(line):
            header = []
            keys = [part.strip().strip("\"'") for part in section[2].split(".")]
            for position, key in enumerate(keys, start=1):
                header.append(key)
                place = tuple(header)
                if section[1] == "[[" and position == len(keys):
                    tables_seen[place] = tables_seen.get(place, -1) + 1
                if place in tables_seen:  # a table in a list of tables belongs to the last of these
                    header.append(tables_seen[place])
            path = header
        elif assignment := ASSIGNMENT.match(line):
            path = [*header, *(part.strip().strip("\"'") for part in KEY_PART.findall(assignment[1].strip()))]
        else:
            continue
        if len(path) > depth and list(location[: len(path)]) == path:
            best, depth = number, len(path)
    return best


def _faults(error: ValidationError, data: Any, model: type[BaseModel]) -> Iterator[tuple[tuple[int | str, ...], str]]:
    """Yield location and message of each fault; where a union fails, that of its first member."""
    faults: dict[tuple[int | str, ...], Any] = {}
    for fault in error.errors():
        cause = fault.get("ctx", {}).get("error")
        location = (*fault["loc"], cause.key) if isinstance(cause, _ValueFaultError) else fault["loc"]
        faults.setdefault(_written(data, location, is_missing=fault["type"] == "missing"), fault)
    tables = {at[:depth] for at in faults for depth in range(len(at))}
    for at, fault in faults.items():
        if at not in tables:  # a table that fails because of its content adds nothing to the fault of the content
            yield at, _message(dict(fault), at, model)


def _written(data: Any, location: Location, *, is_missing: bool) -> tuple[int | str, ...]:
    """Return ``location`` without what pydantic adds to it for unions and converted values; its end may be missing."""
    written: list[int | str] = []
    for position, key in enumerate(location):
        is_entry = isinstance(data, dict) and key in data
        is_item = isinstance(data, list | tuple) and isinstance(key, int) and key < len(data)
        is_present = is_entry or is_item
        if is_present or (is_missing and position == len(location) - 1):
            written.append(key)
            data = data[key] if is_present else None
    return tuple(written)


def _message(fault: dict[str, Any], location: Location, model: type[BaseModel]) -> str:
    if fault["type"] == "extra_forbidden":
        known = _keys_at(model, fault["loc"][:-1])
        return f"unknown key {location[-1]!r}: {nearest(str(location[-1]), known)}"
    if fault["type"] == "missing":
        return "missing: this key must be set"
    if fault["type"] == "value_error":
        return str(fault["ctx"]["error"])
    if fault["type"] in TOML_TYPES:
        return f"{shown(fault['input'])}: must be {TOML_TYPES[fault['type']]}"
    return f"{shown(fault['input'])}: {re.sub('^Input', 'the value', fault['msg'])}"


def _tags(model: Any) -> set[Any]:
    """Return the values of the keys of a table that have few, by one of which pydantic tells the tables of a union."""
    fields = getattr(model, "model_fields", {}).values()
    literals = (row.annotation for row in fields if typing.get_origin(row.annotation) is typing.Literal)
    return {value for literal in literals for value in typing.get_args(literal)}


def _keys_at(model: Any, location: Location) -> list[str]:
    """Return the keys that the table at ``location`` of ``model`` may have."""
    origin, arguments = typing.get_origin(model), typing.get_args(model)
    if origin is typing.Annotated:
        return _keys_at(arguments[0], location)
    if origin in (typing.Union, types.UnionType):
        if tagged := [part for part in arguments if location and location[0] in _tags(part)]:
            return _keys_at(tagged[0], location[1:])
        return sorted({key for part in arguments for key in _keys_at(part, location)})
    if origin in (dict, tuple, list) and location:
        return _keys_at([part for part in arguments if part is not Ellipsis][-1], location[1:])
    known = model.model_fields if isinstance(model, type) and issubclass(model, BaseModel) else {}
    fields = {field.alias or name: field for name, field in known.items()}
    if not location:
        return sorted(fields)
    if location[0] in fields:
        return _keys_at(fields[str(location[0])].annotation, location[1:])
    # pydantic's location contains the tag of a union's member, which the file does not.
    return _keys_at(model, location[1:]) if fields else []
