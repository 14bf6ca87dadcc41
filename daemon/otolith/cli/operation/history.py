"""``otolith history``, ``report`` and ``reproduce``: what was estimated and announced, and its computation again."""

import json
import math
import re
import sys
import time
import webbrowser
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from otolith.cli.common import AS_JSON, FILE, local_time, new_file, progress_line
from otolith.cli.machines import reader_of
from otolith.cli.terminal import echo, echo_csv, echo_json

if TYPE_CHECKING:
    from rich.console import RenderableType

    from otolith.health.schema import EventDocument
    from otolith.health.text import Texts
    from otolith.storage.evidence import Bundle
    from otolith.storage.history import HistoryReader, HistorySample


SPANS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0, "w": 604_800.0}
INTERVALS = ("window", "minute", "hour", "day")
# Engineering choices, see docs/reference/thresholds-cli.md.
LONGEST = {"window": 7200.0, "minute": 2 * 86_400.0, "hour": 60 * 86_400.0}  # s that are shown at a resolution
MAX_EVENTS = 20  # in the table below the values
MIN_CURVE = 8  # characters of a curve
OTHER_COLUMNS = 46  # characters that the table needs beside it, names and units
RANGE_COLUMNS = 24  # characters of its columns min and max
WIDTH_WITH_RANGE = 100  # characters of a terminal that shows them
# What values raise that have the right types, but that no state of the core has.
FORGED = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)


@dataclass(frozen=True, slots=True)
class Since:
    """Where a time begins: at a date, or so long before its end."""

    date: datetime | None = None
    age: float = 0.0  # s

    def before(self, end: float, zone: str | None) -> float:
        """Return the begin, in s as ``end``; a date without a zone is in ``zone``, or in that of this computer."""
        from otolith_drivers.common.time_zones import date_seconds

        return end - self.age if self.date is None else date_seconds(self.date, zone)


def age_or_date(_: click.Context, __: click.Parameter, text: str) -> Since:
    """Return what ``text`` means: an age like ``30d``, or a date and time of the machine's zone."""
    from otolith_drivers.errors import ConfigurationError

    if match := re.fullmatch(r"(\d{1,9}(?:\.\d+)?)\s*([smhdw])", text.strip()):
        return Since(age=float(match[1]) * SPANS[match[2]])
    try:
        since = Since(datetime.fromisoformat(text))
        with suppress(ConfigurationError):  # in the zone of the machine it may be another
            since.before(0.0, None)
    except (ValueError, OverflowError) as error:
        raise click.BadParameter(f"{text!r}: write an age like 12h, 30d or 8w, or a date like 2026-01-31") from error
    return since


@click.command()
@click.argument("machine", metavar="FILE|MACHINE")
@click.option("--since", default="1d", callback=age_or_date, metavar="AGE|DATE", help="Begin here, like 12h, 30d, 8w.")
@click.option("--parameter", "names", multiple=True, metavar="NAME", help="Only this one; may be repeated.")
@click.option("--every", type=click.Choice(INTERVALS), show_default=False,
              help="Values of each window, minute, hour or day.  [default: as --since needs]")  # fmt: skip
@click.option("--events", "only_events", is_flag=True, help="Only events.")
@click.option("--details", is_flag=True, help="Each change of an event with its evidence, and findings, in sentences.")
@click.option("--csv", "as_csv", is_flag=True, help="Print the values, or the events, as CSV.")
@AS_JSON
@click.option("--parquet", type=FILE, callback=new_file, help="Write the values into this Parquet file.")
def history(
    machine: str,
    since: Since,
    names: tuple[str, ...],
    every: str | None,
    only_events: bool,
    details: bool,
    as_csv: bool,
    as_json: bool,
    parquet: Path | None,
) -> None:
    """Show what was estimated and announced before.

    FILE is the machine file, MACHINE the name in it, with or without its site.
    A daemon may run meanwhile.
    FILE may also be a history, like one that was set aside or copied: *.sqlite.
    Windows are kept for a day, minutes for 14 days, hours for a year, days and
    events for ten years, unless the machine file has other limits.

    \b
    Examples:
      otolith history my-machine.toml
      otolith history press-3 --since 30d --parameter R_a
      otolith history press-3 --since 1w --events
      otolith history press-3 --since 2026-01-31 --every hour --csv > press-3.csv
    """
    if as_csv + as_json + (parquet is not None) > 1:
        raise click.UsageError("give one of --csv, --json and --parquet")
    if only_events and parquet is not None:
        raise click.UsageError("--parquet has values only: give --csv or --json with --events")
    reader = reader_of(machine)
    _check_names(names, reader.names())
    end = end_of(reader)
    begin = since.before(end, reader.language_and_zone()[1])
    events = [] if names and not only_events else reader.events(begin)
    if only_events and as_csv:
        _print_events(events)
        return
    interval = every or interval_since(reader, begin, end)
    samples = [] if only_events else samples_since(reader, interval, begin, names)
    if as_csv:
        _print_samples(samples)
    elif parquet is not None:
        _write_parquet(samples, parquet)
    elif as_json:
        _print_json(reader, interval, begin, samples, events)
    else:
        _print_table(reader, interval, begin, samples, events, details=details, has_findings=only_events or not names)


def _check_names(names: Sequence[str], known: list[str]) -> None:
    from otolith_drivers.errors import ConfigurationError, nearest

    for name in names:
        if name not in known:
            raise ConfigurationError(f"no value of {name!r} in the history: {nearest(name, known)}")


def end_of(reader: "HistoryReader") -> float:
    """Return the present time, in Unix s; of a history that no daemon continues the end of its last window."""
    from otolith.storage.history import history_directory

    last = -math.inf if reader.path.parent == history_directory() else reader.last()
    return reader.labels().unix(last) if math.isfinite(last) else time.time()


def interval_since(reader: "HistoryReader", since: float, end: float) -> str:
    """Return the resolution that shows the time from ``since`` to ``end``, as far as there are values."""
    from otolith.storage.history import DAY, RESOLUTIONS

    firsts = [first for seconds in RESOLUTIONS if (first := reader.first(seconds)) is not None] or [since]
    begin = max(first for first in firsts if first < min(firsts) + DAY)  # coarse intervals begin before their values
    span = end - max(since, begin)
    return next((name for name, longest in LONGEST.items() if span <= longest), "day")


def samples_since(reader: "HistoryReader", interval: str, since: float, names: Sequence[str]) -> "list[HistorySample]":
    """Return the values of each ``interval`` since a time, of the parameters ``names`` or of all."""
    from otolith.storage.history import RESOLUTIONS

    seconds = {name: seconds for seconds, name in RESOLUTIONS.items()}[interval]
    return reader.samples(seconds, since - seconds, names)  # with the interval that contains it


def _utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _print_samples(samples: "Iterable[HistorySample]") -> None:
    from otolith.storage.history import HistorySample

    echo_csv([("parameter", *(column.name for column in fields(HistorySample)[1:]))])
    echo_csv((asdict(sample) | {"time": _utc(sample.time)}).values() for sample in samples)


def _print_events(events: "Iterable[EventDocument]") -> None:
    from otolith.health.text import PARTS, note_texts

    columns = ("change", "part", "state", "condition", "cause", "text", "advice", "id", "reason")
    echo_csv([("time", *columns, "notes")])
    for event in events:
        values = (getattr(event, name) for name in columns)
        echo_csv([[_utc(event.end or event.since), *values, PARTS.join(note_texts(event, _utc))]])


def _write_parquet(samples: "Sequence[HistorySample]", path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [asdict(sample) for sample in samples]
    fields = [pa.field("parameter", pa.string()), pa.field("unit", pa.string())]
    fields += [pa.field("time", pa.timestamp("us", tz="UTC")), pa.field("count", pa.int64())]
    fields += [pa.field(name, pa.float64()) for name in ("min", "mean", "max", "last", "low", "high")]
    schema = pa.schema([*fields, pa.field("status", pa.string())])
    for row in rows:
        row["parameter"] = row.pop("name")
        row["time"] = datetime.fromtimestamp(row["time"], UTC)
    try:
        pq.write_table(pa.Table.from_pylist(rows, schema=schema), path)
    except OSError as error:
        error.filename = str(path)  # pyarrow gives none
        raise


def _print_json(
    reader: "HistoryReader",
    interval: str,
    since: float,
    samples: "Iterable[HistorySample]",
    events: "Iterable[EventDocument]",
) -> None:
    content = {
        "machine": reader.machine,
        "site": reader.site,
        "since": since,
        "every": interval,
        "values": [asdict(sample) for sample in samples],
        "events": [event.model_dump(mode="json", exclude_none=True) for event in events],
        "evidence": {number: str(path) for number, path in _bundles(reader, since).items()},
        "findings": reader.findings(since),
        "counters": reader.counters(since),
    }
    echo_json(content)


def _print_table(
    reader: "HistoryReader",
    interval: str,
    since: float,
    samples: "Sequence[HistorySample]",
    events: "Sequence[EventDocument]",
    *,
    details: bool,
    has_findings: bool,
) -> None:
    from otolith.cli.console import Localised, Terminal
    from otolith.cli.operation.event_table import event_table, print_changes, print_findings
    from otolith.health.text import texts_in
    from otolith.health.times import moment_text

    console, (language, zone) = Terminal(highlight=True), reader.language_and_zone()
    say = texts_in(language or "en")
    first = min((sample.time for sample in samples), default=since)
    values = say("values_per", interval=say.translated(interval)) if samples else ""
    begin = moment_text(max(first, since), zone)
    console.print(say("history_of", machine=reader.machine, site=reader.site, time=begin, values=values))
    if samples:
        titles = _titles({sample.name for sample in samples}, reader.description().get("places", {}), say)
        varying = _of_operation(reader)
        console.print(Localised(_table(samples, titles, varying, console.width, say), say.decimals))
    findings = reader.findings(since) if has_findings else []
    if details:
        print_changes(console, events, _bundles(reader, since), say)
        print_findings(console, findings, say, zone)
    else:
        newest = MAX_EVENTS if samples else None
        if events:
            console.print(Localised(event_table(events, console.width, say, newest), say.decimals))
        earlier = len({event.id for event in events}) - (newest or math.inf)
        if earlier > 0:
            console.print(say("earlier_events", count=int(earlier)))
        if findings:
            console.print(say("findings_counted", count=len(findings)))
    if not samples and not events:
        echo("no values or events since then; a daemon writes values once a minute", err=True)


def _bundles(reader: "HistoryReader", since: float) -> "dict[int | None, Path]":
    """Return the evidence of each change of an event since a time, by its sequence number, where there is some."""
    from otolith.storage.evidence import bundles_of, stamp_of

    bundles = bundles_of(reader.site, reader.machine)
    stamps = {number: stamp_of(end) for number, end in reader.event_ends(since).items()}
    return {number: bundles[stamp] for number, stamp in stamps.items() if stamp in bundles}


def _titles(names: "Collection[str]", places: "Mapping[str, str]", texts: "Texts") -> dict[str, str]:
    """Return the titles of rows: parameters and figures by their names, components by place and family.

    One that another row has too is the name in the history.
    """
    from otolith.storage.history import PERFORMANCE

    titles = {name: name.removeprefix(PERFORMANCE) for name in names}
    for name in names:
        place, _, rest = name.partition("/")
        if rest and place in places:
            titles[name] = f"{texts.translated(places[place])}, {texts.translated(rest.partition('/')[0])}"
    counts = Counter(titles.values())
    return {name: title if counts[title] == 1 else name for name, title in titles.items()}


def _of_operation(reader: "HistoryReader") -> set[str]:
    """Return the names of figures of performance that are means over a window: another load changes them, too."""
    from otolith.storage.history import PERFORMANCE
    from otolith_drivers.errors import ConfigurationError

    with suppress(ConfigurationError, ValueError):  # a report that the disk has damaged hinders no table
        figures = next((report.performance for report in reader.latest(1)), None) or {}
        return {f"{PERFORMANCE}{name}" for name, figure in figures.items() if figure.over == "window"}
    return set()


def _table(
    samples: "Sequence[HistorySample]", titles: "Mapping[str, str]", varying: "Collection[str]", width: int,
    texts: "Texts",
) -> "RenderableType":  # fmt: skip
    """A row for each parameter: last value and interval, change and range of the means, and their curve.

    Those that are ``varying`` with the operation have no change.
    """
    from otolith.cli.operation.live_table import parameter_table, sparkline
    from otolith_drivers.units import scale_of

    has_range = width >= WIDTH_WITH_RANGE
    words = max(map(len, titles.values())) + max(len(sample.unit) for sample in samples)
    length = max(width - OTHER_COLUMNS - RANGE_COLUMNS * has_range - words, MIN_CURVE)
    table = parameter_table(*(("min", "max") if has_range else ()), "history", width=width, texts=texts)
    first, last = samples[0].time, samples[-1].time
    series: dict[tuple[str, str], list[HistorySample]] = {}
    for sample in samples:
        series.setdefault((sample.name, sample.unit), []).append(sample)
    for (name, unit), row in series.items():
        bins: dict[int, list[float]] = {}
        for sample in row:
            bins.setdefault(int((sample.time - first) / max(last - first, 1.0) * (length - 1)), []).append(sample.mean)
        curve = sparkline(tuple(sum(values) / len(values) for _, values in sorted(bins.items())))
        end, begin = row[-1], row[0].mean
        reach = None if end.low is None or end.high is None else 0.5 * (end.high - end.low)
        change = f"{row[-1].mean / begin - 1.0:+.2%}" if begin and name not in varying else ""
        low, high = min(sample.min for sample in row), max(sample.max for sample in row)
        scale = scale_of(end.last, unit, reach)
        limits = (scale.number(low), scale.number(high)) if has_range else ()
        table.add_row(titles[name], *scale.numbers(end.last, reach), scale.unit, change, *limits, curve)
    return table


@click.command()
@click.argument("machine", metavar="FILE|MACHINE")
@click.option("--since", default="7d", callback=age_or_date, metavar="AGE|DATE", help="Begin here, like 12h, 30d, 8w.")
@click.option("--output", type=click.Path(path_type=Path, dir_okay=False, allow_dash=True), callback=new_file,
              metavar="FILE", help="Write this new file; '-' prints.  [default: MACHINE-TIME.html]")  # fmt: skip
@click.option("--open", "opens", is_flag=True, help="Open it in the browser of this computer.")
def report(machine: str, since: Since, output: Path | None, opens: bool) -> None:
    """Write what was estimated and announced as one HTML page.

    FILE is the machine file, MACHINE the name in it, with or without its site.
    A daemon may run meanwhile.
    The page needs no other file and no network: it can be mailed and printed.

    \b
    Examples:
      otolith report press-3 --open
      otolith report my-machine.toml --since 30d
      otolith report press-3 --since 2026-01-31 --output press-3.html
      otolith report press-3 --since 1d --output - > /srv/www/press-3.html
    """
    if opens and output == Path("-"):
        raise click.UsageError("--open needs a file: give another --output than '-'")
    from otolith_drivers.common.time_zones import local_moment

    reader, now = reader_of(machine), time.time()
    end = end_of(reader)
    zone = reader.language_and_zone()[1]
    begin = since.before(end, zone)
    if begin >= now:
        raise click.BadParameter("lies in the future", param_hint="'--since'")
    content = page_of(reader, begin, end)
    if output == Path("-"):
        sys.stdout.buffer.write(content)
        return
    path = output or Path(f"{reader.machine}-{local_moment(now, zone):%FT%H%M%S}.html")
    write_page(path, content)
    echo(path)
    if opens and not webbrowser.open(path.absolute().as_uri()):
        echo("no browser is known here: open the file where there is one, or set BROWSER", err=True)


def page_of(reader: "HistoryReader", since: float, end: float) -> bytes:
    """Return the page about the time from ``since`` to ``end``.

    Raises:
        ConfigurationError: the history cannot be read.
    """
    from otolith.publishing.html_report import html_report
    from otolith_drivers.errors import ConfigurationError

    interval = interval_since(reader, since, end)
    try:
        page = html_report(reader, samples_since(reader, interval, since, ()), interval, since, end)
    except FORGED as error:
        raise ConfigurationError(f"{reader.path}: cannot be read: {type(error).__name__}: {error}") from error
    return page.encode()


def write_page(path: Path, content: bytes) -> None:
    """Write a new file, whole or not at all; raise OSError with its name."""
    with path.open("xb") as file:
        try:
            file.write(content)
            file.flush()
        except OSError as error:
            path.unlink()
            error.filename = str(path)
            raise


@click.command()
@click.argument("bundle", type=FILE)
@click.option("--json", "as_json", is_flag=True, help="Print each report as a line of JSON.")
def reproduce(bundle: Path, as_json: bool) -> int:
    """Compute the reports around an event again, from its evidence.

    BUNDLE is a file in the folder 'evidence' of the daemon's state directory. It
    has the last windows up to the one that raised, changed or cleared the event,
    and the state before them. Each report must be the same to the last bit;
    otherwise the first difference is shown, and the exit code is 1.

    \b
    Examples:
      otolith reproduce hall.press-3-000007-20260131T101112.zip
      otolith reproduce hall.press-3-000007-20260131T101112.zip --json
    """
    from otolith.health.text import event_text
    from otolith.storage.evidence import read_bundle, versions
    from otolith_drivers.errors import counted

    def tell(line: str) -> None:
        echo(line, err=as_json)

    read = read_bundle(bundle)
    state, count, last = read.state, len(read.windows), read.windows[-1].window

    def when(time: float) -> str:
        return local_time(time + last.ahead, state.plan.timezone)

    span = read.windows[0].window.start, last.end
    tell(f"{state.machine} at {state.site}, {counted(count, 'window')} from {' to '.join(map(when, span))}")
    for event in read.events:
        tell(f"{'' if event.end else f'{event.change}: '}{event_text(event, when, details=True)}")
    tell(f"seed {state.problem.seed}, " + ", ".join(f"{name} {number}" for name, number in read.versions.items()))
    with progress_line("reproducing") as show:
        difference = _first_difference(read, show, echo if as_json else lambda _: None)
    others = [f"{name} {here}" for name, here in versions().items() if read.versions.get(name) != here]
    if others:
        tell(f"other versions here, on which the last bits may depend: {', '.join(others)}")
    tell(f"not the same: {difference}" if difference else f"the same to the last bit: {counted(count, 'report')}")
    return 1 if difference else 0


def _first_difference(bundle: "Bundle", show: Callable[[str], None], put: Callable[[str], None]) -> str:
    """Compute the reports of a bundle, ``put`` each, and return where the first one differs; empty if none does."""
    from otolith import kernel_cache
    from otolith.adaptation.adapt import adapt

    state = bundle.state
    with kernel_cache.observed(lambda step: show(f"compiling {step.kernel}")):
        for item in bundle.windows:
            show(place := f"window {item.window.index}")
            try:
                state, report = adapt(item.state or state, item.window)
                put(text := report.document.to_json())
                if text != item.report:
                    return f"{place}: {_difference(json.loads(item.report), json.loads(text))}"
            except FORGED as error:
                return f"{place}: {type(error).__name__}: {error}"
    return ""


def _difference(kept: Any, computed: Any, place: str = "report") -> str:
    """Return the place of the first difference of two documents, and its values."""
    if isinstance(kept, list) and isinstance(computed, list):
        kept, computed = dict(enumerate(kept)), dict(enumerate(computed))
    if isinstance(kept, dict) and isinstance(computed, dict):
        for key in (*kept, *computed):
            first, second = kept.get(key), computed.get(key)
            if json.dumps(first) != json.dumps(second):  # 0.0 and -0.0 are equal, but not the same
                return _difference(first, second, f"{place}.{key}")
    return f"{place}: {json.dumps(kept):.100} in the bundle, {json.dumps(computed):.100} computed"
