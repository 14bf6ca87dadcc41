"""Random tables in all forms that programs write, with the readings that were written into them.

    python -m tests.drivers.replay.table_cases 1000

reads so many and prints how many are equal, how many are refused, and each that is silently different.
"""

import csv
import io
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from otolith_drivers.base import Setup, Signal
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import format_of
from otolith_drivers.replay.table.options import TableSource

Readings = dict[str, list[tuple[float, float]]]

SEPARATORS = (";", ",", "\t", "|")
DECIMALS = (".", ",")
ENCODINGS = ("utf-8", "utf-8-sig", "utf-16", "cp1252")
ENDS = ("\n", "\r\n", "\r")
ORDERS = ("time first", "time last", "time within", "a time per signal", "a value per row", "blocks")
MISSING = ("none", "blank", "NaN", "cut", "ends early")
EXTRAS = ("none", "title", "units below", "units in the header", "text column", "quotes", "trailing separator")
ZONE = "Europe/Berlin"
BEGIN = datetime(2026, 3, 17, 9, 58, 57)  # noqa: DTZ001 - on the clocks of the plant


@dataclass(frozen=True)
class TimeForm:
    """How a time is written; ``key`` is what the machine file must state of it."""

    name: str
    unit: str | None = None  # In the header
    key: dict[str, object] | None = None
    is_date: bool = False

    def text(self, since: float, decimal: str) -> str:
        """The text of a time, ``since`` s from the begin."""
        moment = BEGIN + timedelta(microseconds=round(1e6 * since))
        utc = moment.replace(tzinfo=ZoneInfo(ZONE)).astimezone(UTC)
        clock = moment.strftime("%H:%M:%S") + f"{decimal}{moment.microsecond // 1000:03d}"
        if self.name in ("s", "ms", "min", "d"):
            scale = {"s": 1.0, "ms": 1e-3, "min": 60.0, "d": 86_400.0}[self.name]
            return f"{since / scale:.12f}".replace(".", decimal)
        return {
            "unix": f"{utc.timestamp():.6f}".replace(".", decimal),
            "spreadsheet": f"{(moment - datetime(1899, 12, 30)) / timedelta(days=1):.12f}".replace(".", decimal),  # noqa: DTZ001
            "iso": moment.isoformat(timespec="milliseconds").replace(".", decimal),
            "iso with zone": utc.isoformat(timespec="milliseconds"),
            "points": f"{moment:%d.%m.%Y} {clock}",
            "slashes, year first": f"{moment:%Y/%m/%d} {clock}",
            "month first": f"{moment:%m/%d/%Y} {clock}",
            "half days": f"{moment:%m/%d/%Y %I:%M:%S}{decimal}{moment.microsecond // 1000:03d} {moment:%p}",
            "time of the day": clock,
        }[self.name]

    def value(self, since: float) -> float:
        """The time that the text means, s."""
        moment = BEGIN + timedelta(microseconds=round(1e6 * since))
        if self.name == "time of the day":
            return (moment - BEGIN.replace(hour=0, minute=0, second=0)).total_seconds()
        if self.name in ("s", "ms", "min", "d"):
            return since
        return moment.replace(tzinfo=ZoneInfo(ZONE)).timestamp()


TIMES = (
    TimeForm("s"),
    TimeForm("ms", "ms"),
    TimeForm("min", "min"),
    TimeForm("d", "d"),
    TimeForm("unix"),
    TimeForm("spreadsheet", "d"),
    TimeForm("iso", is_date=True),
    TimeForm("iso with zone", is_date=True),
    TimeForm("points", is_date=True),
    TimeForm("slashes, year first", is_date=True),
    TimeForm("month first", key={"format": "%m/%d/%Y %H:%M:%S"}, is_date=True),
    TimeForm("half days", key={"format": "%m/%d/%Y %I:%M:%S.%f %p"}, is_date=True),
    TimeForm("time of the day", is_date=True),
)


@dataclass(frozen=True)
class TableCase:
    """One form of a table."""

    separator: str
    decimal: str
    encoding: str
    end: str
    time: TimeForm
    order: str
    missing: str
    extra: str
    is_stated: bool  # Whether the machine file says what the table leaves open
    seed: int

    @staticmethod
    def drawn(random: np.random.Generator, seed: int) -> "TableCase":
        """A random one that a program may write: a comma is not both separator and decimal sign."""
        separator = str(random.choice(SEPARATORS))
        decimal = "." if separator == "," else str(random.choice(DECIMALS))
        chosen = [str(random.choice(row)) for row in (ENCODINGS, ENDS, ORDERS, MISSING, EXTRAS)]
        time = TIMES[int(random.integers(len(TIMES)))]
        return TableCase(
            separator,
            decimal,
            chosen[0],
            chosen[1],
            time,
            chosen[2],
            chosen[3],
            chosen[4],
            bool(random.random() < 0.7),
            seed,
        )


@dataclass(frozen=True)
class WrittenTable:
    """A table as it was written."""

    path: Path
    sources: dict[str, dict[str, object]]
    expected: Readings


def write(case: TableCase, folder: Path) -> WrittenTable:
    """Write a table, and what it means."""
    random = np.random.default_rng(case.seed)
    rows = int(random.integers(8, 40))
    since = np.cumsum(random.integers(1, 50, rows)) * 0.001 * float(random.choice([1, 10, 1000]))
    values = {name: random.normal(0.0, 1000.0, rows).round(3) for name in ("u", "n")}
    if case.missing != "none":
        values["n"][random.random(rows) < 0.2] = np.nan
    if case.missing == "ends early":
        values["n"][rows // 2 :] = np.nan
    since, later = since.tolist(), (since + (0.25 if case.order == "a time per signal" else 0.0)).tolist()
    header = f"Time [{case.time.unit}]" if case.time.unit else "Time"
    moments = {"u": since, "n": later}
    cells = [
        [case.time.text(moment, case.decimal), _text(case, u), case.time.text(after, case.decimal), _text(case, n)]
        for moment, u, after, n in zip(since, values["u"].tolist(), later, values["n"].tolist(), strict=True)
    ]
    if case.order == "a time per signal":
        cells = [[*row[:2], *(row[2:] if row[3] else ["", ""])] for row in cells]
    table, name = _arranged(case, header, cells)
    path = folder / "table.csv"
    path.write_bytes(_text_of(case, table).encode(case.encoding, errors="replace"))
    keys: dict[str, object] = {"column": name, **(case.time.key or {})}
    if name != header and case.time.unit:
        keys["unit"] = case.time.unit
    is_open = case.time.key is not None or name != header
    own: dict[str, object] = {"time": keys} if is_open and case.is_stated else {}
    expected = {
        signal: [
            (case.time.value(moment), value)
            for moment, value in zip(moments[signal], values[signal].tolist(), strict=True)
            if np.isfinite(value)
        ]
        for signal in ("u", "n")
    }
    return WrittenTable(path, {"u": dict(own), "n": dict(own)}, expected)


def _text(case: TableCase, value: float) -> str:
    if np.isnan(value):
        return "NaN" if case.missing == "NaN" else ""
    return f"{value:.3f}".replace(".", case.decimal)


def _arranged(case: TableCase, header: str, cells: list[list[str]]) -> tuple[list[list[str]], str]:
    """The lines of the table, and the name of the column of the time."""
    text = ["Notiz", *["gemessen, größer; 5 %"] * len(cells)] if case.extra == "text column" else []
    if case.order == "a value per row":
        rows = [["tag", header, "value"]]
        rows += [[name, row[0], row[place]] for row in cells for place, name in ((1, "u"), (3, "n"))]
        return rows, header
    if case.order == "blocks":
        rows = [["tag", header, "value"]]
        return rows + [[name, row[0], row[place]] for place, name in ((1, "u"), (3, "n")) for row in cells], header
    if case.order == "a time per signal":
        return [["clock", "u", "clock", "n"], *cells], "clock"
    order = {"time first": (0, 1, 3), "time last": (1, 3, 0), "time within": (1, 0, 3)}[case.order]
    rows = [[row[place] for place in order] for row in [[header, "u", "", "n"], *cells]]
    if text:
        rows = [[*row[:1], text[number], *row[1:]] for number, row in enumerate(rows)]
    return rows, header


def _text_of(case: TableCase, table: list[list[str]]) -> str:
    """The text of a file with these lines."""
    rows = [list(row) for row in table]
    if case.missing == "cut":
        rows = [row[:-1] if row[-1] == "" else row for row in rows]
    is_wide = case.order.startswith("time")
    if case.extra == "units below" and is_wide:
        units = {"u": "V", "n": "rpm", "Notiz": "-"}
        rows.insert(1, [units.get(name, case.time.unit or "") for name in rows[0]])
    elif case.extra == "units in the header" and is_wide:
        rows[0] = [{"u": "u [V]", "n": "n (rpm)"}.get(name, name) for name in rows[0]]
    elif case.extra == "trailing separator":
        rows = [[*row, ""] for row in rows]
    elif case.extra == "title":
        rows = [["made by a program"], [], *rows]
    buffer = io.StringIO()
    csv.writer(
        buffer,
        delimiter=case.separator,
        lineterminator=case.end,
        quoting=csv.QUOTE_ALL if case.extra == "quotes" else csv.QUOTE_MINIMAL,
    ).writerows(rows)
    return buffer.getvalue()


def read(written: WrittenTable) -> Readings:
    """What the reader finds; raises ConfigurationError if it refuses."""
    units = {"u": "V", "n": "rpm"}
    kind = format_of(written.path)
    signals = tuple(
        Signal(name, units[name], TableSource.model_validate(source)) for name, source in written.sources.items()
    )
    found: Readings = {name: [] for name in units}
    with kind.open_log(written.path, Setup(signals, written.path.parent, 0.001, timezone=ZONE), None) as reader:
        for rows in reader.chunks():
            for name, values in rows.columns.items():
                there = np.isfinite(values)
                found[name] += zip(rows.times[there].tolist(), values[there].tolist(), strict=True)
        found["bad"] = [(0.0, float(reader.bad))]
    return found


def judged(case: TableCase, folder: Path) -> tuple[str, str]:
    """Whether the readings are those that were written: 'equal', 'refused', 'counted' or 'different'; and why."""
    written = write(case, folder)
    try:
        found = read(written)
    except ConfigurationError as error:
        return "refused", str(error)
    bad = found.pop("bad")[0][1]
    for name, expected in written.expected.items():
        times, values = (np.array([pair[at] for pair in found[name]]) for at in (0, 1))
        true_times, true_values = (np.array([pair[at] for pair in expected]) for at in (0, 1))
        if len(times) != len(true_times):
            if bad:  # not silent: a warning names the first line and the cause
                return "counted", f"{name}: {len(times)} of {len(true_times)} readings, {bad:g} bad"
            return "different", f"{name}: {len(times)} readings of {len(true_times)}"
        if np.abs(times - true_times).max(initial=0.0) > 1e-4 or not np.array_equal(values, true_values):
            return "different", f"{name}: other times or values"
    return "equal", ""


def main(count: int) -> int:
    """Judge so many tables; return how many are silently different."""
    random, counts, causes = np.random.default_rng(1), Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(count):
            case = TableCase.drawn(random, seed)
            kind, why = judged(case, Path(folder))
            counts[kind] += 1
            if kind == "refused":
                causes[why.rpartition("table.csv")[2][:110]] += 1
            elif kind != "equal":
                sys.stdout.write(f"{kind}: {case}: {why}\n")
    sys.stdout.write(f"{dict(counts)}\n")
    for cause, number in causes.most_common(12):
        sys.stdout.write(f"{number:5} {cause}\n")
    return counts["different"]


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
