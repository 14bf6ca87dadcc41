"""TOML files as typed, bounded, closed models: one line per fault, with file, line, key, value and the way out.

Files that the user named: read whole, and never more than a file of their kind may have.
"""

import re
import tomllib
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from otolith_drivers.errors import ConfigurationError, nearest


def content(path: Path, limit: int, key: tuple[str, ...] = ()) -> bytes:
    """The bytes of ``path``, ``limit`` of them at most; ``key`` is where in the machine file it is named.

    Raises:
        ConfigurationError: no such file, no file at all, a larger one, or one that may not be read.
    """
    try:
        if path.exists() and not path.is_file():
            raise ConfigurationError(f"{path}: is a directory or a device, not a file", key)
        if path.stat().st_size > limit:
            raise ConfigurationError(f"{path}: larger than {limit} bytes, so it is not read", key)
        return path.read_bytes()
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror or error}", key) from error


FILE_SIZE_LIMIT = 1 << 20  # bytes; a machine file has a few thousand
Location = Sequence[int | str]
Model = TypeVar("Model", bound=BaseModel)


class StrictModel(BaseModel):
    """A table of a file: unknown keys are errors, values are finite and do not change."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, slots=True)
class SourceFile:
    """A file and its text, so that a fault can say where it stands."""

    path: Path
    text: str = ""

    def place(self, location: Location) -> str:
        """``file:line: key.of.the.value``, the line left out where it cannot be told."""
        line = line_of(self.text, location)
        return f"{self.path}:{line}: {dotted(location)}" if line else f"{self.path}: {dotted(location)}"


class Context:
    """Says where in the file a fault is, when it is found after the file's own types were right."""

    def __init__(self, page: SourceFile) -> None:
        self.page = page
        self._location: tuple[int | str, ...] = ()

    def fail(self, location: tuple[int | str, ...], message: str) -> None:
        """Raise ``message``, placed at ``location``."""
        raise ConfigurationError(f"{self.page.place(location)}: {message}")

    def at(self, *location: int | str) -> "Context":
        """A context in which whatever is found wrong is placed at ``location``."""
        self._location = location
        return self

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        if isinstance(error, ValueError | ConfigurationError):
            raise ConfigurationError(f"{self.page.place(self._location)}: {error}") from error


def load(path: Path, model: type[Model]) -> Model:
    """The file as ``model``.

    Raises:
        ConfigurationError: missing or unreadable file, not TOML, or not what ``model`` asks for.
    """
    page = read(path)
    return validate(parse(page), model, page)


def read(path: Path) -> SourceFile:
    """The text of a file that the user named, its line ends those of this system.

    Raises:
        ConfigurationError: missing, unreadable, too large, or not UTF-8.
    """
    try:
        text = content(path, FILE_SIZE_LIMIT).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigurationError(f"{path}: not UTF-8 text (byte {error.start}): is this the right file?") from error
    return SourceFile(path, re.sub("\r\n?", "\n", text))


def parse(page: SourceFile) -> dict[str, Any]:
    """The TOML of ``page``."""
    try:
        return tomllib.loads(page.text)
    except (ValueError, RecursionError) as error:
        hint = "; a key may stand only once in its table" if "overwrite" in str(error) else ""
        raise ConfigurationError(f"{page.path}: not valid TOML: {error}{hint}") from error


SHAPES = {
    "tuple_type": "a list, in [ ]",
    "list_type": "a list, in [ ]",
    "dict_type": "a table",
    "model_type": "a table",
    "string_type": "a text, in quotes",
}
KINDS = {
    "plant": ("a scenario of the simulated plant", "otolith plant"),
    "machine": ("a machine file", "otolith run"),
    "equations": ("a twin", "otolith twin check"),
}
"""The key that only one kind of file has, what the file is, and what it is for."""


def expect(page: SourceFile, data: dict[str, Any], key: str) -> None:
    """Refuse a file of another kind, once and by its name, instead of every key in it."""
    for other, (what, command) in KINDS.items():
        if other != key and other in data and key not in data:
            raise ConfigurationError(f"{page.path}: this is {what}, for '{command}'; {KINDS[key][0]} is needed here")


def validate(data: Any, model: type[Model], page: SourceFile, under: Location = ()) -> Model:
    """``data`` as ``model``; ``under`` is where in the file it stands."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = [(_written(data, fault["loc"]), fault) for fault in error.errors()]
        # A table that fails because of what is in it adds nothing to the fault inside.
        deepest = [(at, fault) for at, fault in faults if not any(_inside(other, at) for other, _ in faults)]
        lines = [f"{page.place([*under, *at])}: {_sentence(dict(fault), at, model)}" for at, fault in deepest]
        raise ConfigurationError("\n".join(dict.fromkeys(lines))) from error


def validated(data: Any, model: type[Model], under: tuple[str, ...]) -> Model:
    """``data`` as ``model``, for who does not know the file in which it stands at ``under``.

    Raises:
        ConfigurationError: with the first fault and the key of it.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        fault = error.errors()[0]
        at = _written(data, fault["loc"])
        raise ConfigurationError(_sentence(dict(fault), at, model), (*under, *map(str, at))) from error


def dotted(location: Location) -> str:
    """``("setpoints", 2, "speed")`` as ``setpoints[2].speed``."""
    return "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in location).lstrip(".") or "the file"


def line_of(text: str, location: Location) -> int | None:
    """The line (from 1) where the value at ``location`` is written, as far as it can be told without a full parser."""
    header: list[int | str] = []
    counts: dict[tuple[str, ...], int] = {}
    best: int | None = None
    depth = 0
    for number, line in enumerate(text.splitlines(), start=1):
        if section := re.match(r"\s*(\[\[?)\s*([^\]]+?)\s*\]\]?\s*(?:#.*)?$", line):
            keys = tuple(part.strip().strip("\"'") for part in section[2].split("."))
            header = list(keys)
            if section[1] == "[[":
                counts[keys] = counts.get(keys, -1) + 1
                header.append(counts[keys])
        elif entry := re.match(r"\s*([\w\-.\"' ()]+?)\s*=", line):
            keys = tuple(part.strip().strip("\"'") for part in re.findall(r"\"[^\"]*\"|'[^']*'|[^.]+", entry[1]))
            here = [*header, *keys]
            if len(here) > depth and list(location[: len(here)]) == here:
                best, depth = number, len(here)
            continue
        else:
            continue
        if header and len(header) > depth and list(location[: len(header)]) == header:
            best, depth = number, len(header)
    return best


def _written(data: Any, location: Location) -> tuple[int | str, ...]:
    """``location`` without the keys that pydantic adds for the members of a union: they stand in no file."""
    kept: list[int | str] = []
    for position, key in enumerate(location):
        inside = data[key] if isinstance(key, int) and isinstance(data, list | tuple) and key < len(data) else None
        if isinstance(data, dict):
            if key not in data and position < len(location) - 1:
                continue
            inside = data.get(key)
        kept.append(key)
        data = inside
    return tuple(kept)


def _inside(inner: tuple[int | str, ...], outer: tuple[int | str, ...]) -> bool:
    return len(inner) > len(outer) and inner[: len(outer)] == outer


def _sentence(fault: dict[str, Any], location: Location, model: type[BaseModel]) -> str:
    if fault["type"] == "extra_forbidden":
        known = _keys_at(model, fault["loc"][:-1])
        return f"unknown key {location[-1]!r}: {nearest(str(location[-1]), known)}"
    if fault["type"] == "missing":
        return "missing: this key must be set"
    if fault["type"] == "value_error":
        return str(fault["ctx"]["error"])
    if fault["type"] in SHAPES:
        return f"{fault['input']!r}: must be {SHAPES[fault['type']]}"
    message = re.sub(r"^Input", "the value", fault["msg"])
    return f"{fault['input']!r}: {message}"


def _keys_at(model: Any, location: Location) -> list[str]:
    """The keys that the table at ``location`` of ``model`` knows."""
    origin, arguments = typing.get_origin(model), typing.get_args(model)
    if origin is typing.Annotated:
        return _keys_at(arguments[0], location)
    if origin in (typing.Union, types.UnionType):
        return sorted({key for part in arguments for key in _keys_at(part, location)})
    if origin in (dict, tuple, list) and location:
        return _keys_at([part for part in arguments if part is not Ellipsis][-1], location[1:])
    known = model.model_fields if isinstance(model, type) and issubclass(model, BaseModel) else {}
    fields = {field.alias or name: field for name, field in known.items()}
    if not location:
        return sorted(fields)
    if location[0] in fields:
        return _keys_at(fields[str(location[0])].annotation, location[1:])
    # The tag of a union's member stands in the location, not in the file.
    return _keys_at(model, location[1:]) if fields else []
