"""Reading electronic data sheets: what of them the ``canopen`` library can be trusted with.

Sheets are INI files that people edit: sections stand twice, keys are missing, numbers are words. The library refuses a
whole sheet for one such object; here the object is left out.
"""

import io
import logging
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from otolith_drivers.errors import ConfigurationError
from otolith_drivers.files import content

if TYPE_CHECKING:
    from canopen.objectdictionary import ObjectDictionary

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
