"""Changes of single keys of a machine file, which leave all other lines, with their comments, as they are.

What a change makes is parsed and compared with what was meant, so that no layout of a file is misread: where it is not
the same, nothing is written.
"""

import copy
import os
import re
import tempfile
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from otolith.machine import load_machine
from otolith.storage.disk import replace_file
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.grammars.toml_lines import toml_comment, toml_key, toml_value

HEADER = re.compile(r"\s*\[\[?([^\]]*)\]\]?\s*(?:#.*)?")
OWN = "otolith commission: "  # Begin of each remark that is written here, by which it is known later
FORMER = re.compile(rf"(?:^|\s+)# {OWN}.*?(?=\s+#|$)")


@dataclass(frozen=True, slots=True)
class NewLine:
    """The value of a key as it is to stand in a file."""

    value: Any
    remark: str = ""  # Why it is so; it is marked as written here


class Unchangeable(ValueError):  # noqa: N818 - it is told as part of another error
    """A file in which a key cannot be changed by a line."""


def with_keys(text: str, table: str, lines: Mapping[str, NewLine]) -> str:
    """Return the file with keys of a table, which is added at the end if it is missing; as it is without any.

    A key replaces its line, or the one with ``#`` that has its default. What a person wrote behind a replaced value
    stays there, after the remark. A table that is there keeps its keys, and gets those that it lacks. Raises
    Unchangeable.
    """
    if not lines:
        return text
    rows = text.split("\n")
    wanted = copy.deepcopy(tomllib.loads(text))
    inside = wanted.setdefault(table, {})
    if not isinstance(inside, dict):
        raise Unchangeable(f"[{table}] is no table")
    for name, line in lines.items():
        if isinstance(before := inside.get(name), dict) and before:
            new = line.value if isinstance(line.value, dict) else {"value": line.value}
            added = {key: value for key, value in new.items() if key not in before}
            before.update(added)
            if added:
                rows = _with_more(rows, table, name, NewLine(added, line.remark), wanted)
        else:
            inside[name] = line.value
            rows = _with_key(rows, table, name, line)
    return _checked("\n".join(rows), wanted, table)


def with_delay(text: str, signal: str, delay: str, remark: str) -> str:
    """Return the file with the ``delay`` of a signal; raises Unchangeable."""
    wanted = copy.deepcopy(tomllib.loads(text))
    table = wanted.setdefault("signals", {}).setdefault(signal, {})
    if not isinstance(table, dict):
        raise Unchangeable(f"signals.{signal} is no table")
    is_new, before = not table, table.get("delay")
    table["delay"] = delay
    rows = text.split("\n")
    if is_new:
        line = NewLine({"delay": delay}, remark)
        return _checked("\n".join(_with_key(rows, "signals", signal, line)), wanted, signal)
    if before is None:
        return "\n".join(_with_more(rows, "signals", signal, NewLine({"delay": delay}, remark), wanted))
    for number in _inside(rows, "signals") or ():
        if not _is_key(rows[number], signal):
            continue
        changed = re.sub(r"(\bdelay\s*=\s*)(\"[^\"]*\"|'[^']*'|[^,}\s]+)", rf"\g<1>{toml_value(delay)}", rows[number])
        changed = _remarked(changed, remark)
        trial = "\n".join([*rows[:number], changed, *rows[number + 1 :]])
        if _parsed(trial) == wanted:
            return trial
    own = _with_key(rows, f"signals.{signal}", "delay", NewLine(delay, remark))
    return _checked("\n".join(own), wanted, signal)


def write_machine_file(file: Path, text: str) -> None:
    """Replace a machine file at once and whole, with its owner and mode, if the daemon accepts ``text``.

    A link stays; the file that it names is replaced.

    Raises:
        ConfigurationError: the daemon does not accept it.
        ServiceError: the folder cannot be written, or this user cannot keep the owner.
    """
    data, target = text.encode(), file.resolve()
    try:
        handle, name = tempfile.mkstemp(suffix=".toml", prefix=f".{file.stem}-", dir=file.parent)
    except OSError as error:
        raise ServiceError(f"{file.parent}: cannot be written: {error.strerror}") from error
    made = Path(name)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        load_machine(made, for_replay=True)
    except ConfigurationError as error:
        raise ConfigurationError(str(error).replace(str(made), str(file))) from error
    finally:
        made.unlink(missing_ok=True)
    before = target.stat() if target.exists() else None
    mode = 0o644 if before is None else before.st_mode & 0o777
    replace_file(target, data, f".{target.name}.new", mode, before)


def _with_key(rows: list[str], table: str, name: str, line: NewLine) -> list[str]:
    end_of_line = "\r" if rows[0].endswith("\r") else ""  # rows are split at "\n"
    new = _line(name, line) + end_of_line
    places = _inside(rows, table)
    if places is None:
        return [*_without_blank_end(rows), end_of_line, f"[{table}]{end_of_line}", new, ""]
    same = [number for number in places if _is_key(rows[number], name)]
    default = [number for number in places if _is_key(rows[number].lstrip().removeprefix("#"), name)]
    if same:
        number = same[0]
        before = rows[number].rstrip()
        at = _comment_at(before)
        comment = "" if at is None else f"  {before[at:]}"
        return [*rows[:number], _line(name, line, comment) + end_of_line, *rows[number + 1 :]]
    if default:
        return [*rows[: default[0]], new, *rows[default[0] + 1 :]]
    end = _end_of_keys(rows, places)
    return [*rows[:end], new, *rows[end:]]


def _with_more(rows: list[str], table: str, name: str, line: NewLine, wanted: Mapping[str, Any]) -> list[str]:
    """Return the rows with more keys in a table within ``table``; ``wanted`` is the whole file then."""
    keys = ", ".join(f"{toml_key(key)} = {toml_value(value)}" for key, value in line.value.items())
    for number in _inside(rows, table) or ():
        row = rows[number]
        for match in re.finditer(r"\}", row) if _is_key(row, name) else ():
            head, rest = row[: match.start()].rstrip().removesuffix(","), row[match.start() :]
            trial = [*rows[:number], _remarked(f"{head}, {keys} {rest}", line.remark), *rows[number + 1 :]]
            if _parsed("\n".join(trial)) == wanted:
                return trial
    own = rows
    for at, (key, value) in enumerate(line.value.items()):
        own = _with_key(own, f"{table}.{name}", key, NewLine(value, "" if at else line.remark))
    _checked("\n".join(own), wanted, name)
    return own


def _line(name: str, line: NewLine, comment: str = "") -> str:
    return _remarked(f"{toml_key(name)} = {toml_value(line.value)}{comment}", line.remark)


def _remarked(row: str, remark: str) -> str:
    """Return a row with a remark in place of the one that an earlier value got here; what a person wrote follows it."""
    whole = row.rstrip()
    at = _comment_at(whole)
    value, comment = (whole, "") if at is None else (whole[:at].rstrip(), whole[at:])
    one = re.sub(r"\s(?=#)", "_", " ".join(remark.split()))  # A "#" behind a space begins the comment of a person
    parts = [value, *([toml_comment(f"{OWN}{one}")] if one else []), FORMER.sub("", comment).strip()]
    return "  ".join(filter(None, parts)) + row[len(whole) :]


def _comment_at(row: str) -> int | None:
    """Return where the comment of a row begins: the first ``#`` outside of a text."""
    outside = re.match(r"""(?:[^#"']|"(?:[^"\\]|\\.)*"|'[^']*')*""", row)
    at = outside.end() if outside else 0
    return at if row[at : at + 1] == "#" else None


def _without_blank_end(rows: list[str]) -> list[str]:
    kept = list(rows)
    while kept and not kept[-1].strip():
        kept.pop()
    return kept


def _inside(rows: list[str], table: str) -> "range | None":
    """Return the numbers of the lines in a table; None if it has no header."""
    headers = [(number, match[1]) for number, row in enumerate(rows) if (match := HEADER.fullmatch(row))]
    for place, (number, name) in enumerate(headers):
        if re.sub(r"[\s\"']", "", name) == table:
            end = headers[place + 1][0] if place + 1 < len(headers) else len(rows)
            return range(number + 1, end)
    return None


def _end_of_keys(rows: list[str], places: range) -> int:
    """Return the number of the line behind the last key of a table; comments below may be about the next one."""
    keys = [number for number in places if rows[number].strip() and not rows[number].lstrip().startswith("#")]
    if keys:
        return keys[-1] + 1
    return next((number for number in places if not rows[number].strip()), places.stop)


def _is_key(row: str, name: str) -> bool:
    return bool(re.match(rf"\s*(?:{re.escape(toml_key(name))}|\"{re.escape(name)}\")\s*=", row))


def _checked(text: str, wanted: Mapping[str, Any], what: str) -> str:
    if _parsed(text) != wanted:
        raise Unchangeable(f"the lines of {what} have a layout that is not changed by itself")
    return text


def _parsed(text: str) -> dict[str, Any] | None:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None
