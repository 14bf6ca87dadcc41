"""``otolith watch``: reports of daemons in other processes, as a stream or as a live table in a terminal."""

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rich import box
from rich.console import Console, ConsoleOptions, Group, OverflowMethod, RenderableType, RenderResult
from rich.live import Live
from rich.segment import Segment
from rich.style import Style
from rich.table import Table
from rich.text import Text

from otolith.acquisition.window import Verdict
from otolith.cli.common import drain
from otolith.cli.console import Localised, Terminal
from otolith.cli.machines import last_reports
from otolith.cli.terminal import echo
from otolith.discovery.alternatives import WindowDecision
from otolith.health.limits import Level
from otolith.health.schema import (
    DriverDocument,
    EventDocument,
    FindingDocument,
    FindingKind,
    ParameterDocument,
    ReportDocument,
    Status,
)
from otolith.health.text import (
    PARTS,
    Texts,
    approval_text,
    duration_text,
    event_text,
    explain_command,
    forecast_text,
    headline,
    interval_text,
    note_texts,
    performance_texts,
    probability_text,
    texts_in,
    undecided_advice,
    undecided_text,
    value_cells,
    value_text,
    zone_of,
)
from otolith.health.times import clock_in, in_local_time
from otolith_drivers.grammars.json_lines import checked_line
from otolith_drivers.units import equation_text, quantity_text

if TYPE_CHECKING:
    from otolith.publishing.subscriber import Subscriber
    from otolith.publishing.zenoh_config import Connection

HISTORY = 200  # windows that the curve of a parameter can show
WIDTH_WITH_COMPONENTS = 72  # characters of a terminal whose table of components has columns; engineering choice
WIDTH_WITH_LINES = 60  # characters of a terminal whose tables have lines; a narrower one has no room for them
SILENT_WINDOWS = 3  # lengths of a window without a report until a warning; engineering choice, no test
BORDER = " │ "  # between the columns of a table
BARS = "▁▂▃▄▅▆▇█"
STYLES = {
    Status.ESTIMATED: "green",
    Status.AMBIGUOUS: "magenta",
    Status.HELD: "yellow",
    Status.INVALID: "red",
    Status.UNESTIMATED: "dim",
}
HINT_STYLE = "cyan"
LEVEL_STYLES = {
    Level.OK: "bold green",
    Level.HINT: HINT_STYLE,
    Level.NO_DATA: "bold dim",
    Level.WATCH: "bold yellow",
    Level.ACT: "bold red",
}
VALUE_COLUMNS = ("parameter", "value", "± 95 %", "unit", "change")
RIGHT = {"value", "± 95 %", "change"}
# Engineering choices without a test of their own.
MAX_QUEUED = 100  # reports that wait for a slow terminal; later ones come from the history
PAUSE = 0.2  # s; how late a stop is noticed
PATIENCE = 5.0  # s without a report until the stream prints what it waits for
FIRST_ANSWER = 3.0  # s in which a daemon of this computer answers, before which none is said to be missing


@dataclass(slots=True)
class _Machine:
    """What is shown of one machine."""

    document: ReportDocument
    received: float  # Monotonic s
    histories: dict[str, deque[float]] = field(default_factory=dict)

    def draw(self, state: str, width: int, *, in_short: bool, details: bool) -> list[RenderableType]:
        """Return its lines and tables; ``in_short`` without components, messages and counters.

        With ``details`` as the specialist reads it: also the candidates while it is open which cause holds.
        """
        document, silence = self.document, time.monotonic() - self.received
        texts = texts_of(document)
        times = {"time": clock_in(zone_of(document))(document.window.end), "duration": duration_text(round(silence))}
        is_silent = silence > SILENT_WINDOWS * (document.window.end - document.window.start)
        age = "" if is_silent else f", {texts('age', **times)}"
        head = [title(document, age)] if in_short else []
        parts = Localised(Group(*self._parts(width, age, in_short=in_short, details=details)), texts.decimals)
        if is_silent:
            line = f"{texts.decimals(texts('silent', **times))}: {state}"
            return [*head, Text(line, style="bold red"), _Grey(parts)]
        return [*head, parts]

    def _parts(self, width: int, age: str, *, in_short: bool, details: bool) -> list[RenderableType]:
        document, texts = self.document, texts_of(self.document)
        table = _parameters(document.parameters, self.histories, width, texts)
        if in_short:
            return [*state_lines(document, details=details), table, Text()]
        parts: list[RenderableType] = [
            *state_lines(document, details=details),
            *_title_lines(document, texts, age),
            table,
        ]
        parts += [_components(document, width, texts)] if document.components else []
        parts += _performance(document, texts) if details else []
        return [*parts, *_messages(document, texts, details=details), *_counters(document, texts)]


@dataclass(frozen=True, slots=True)
class _Grey:
    """What was last known: it may be wrong by now."""

    shown: RenderableType

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        segments = Segment.remove_color(console.render(self.shown, options))
        return Segment.apply_style(segments, post_style=Style(dim=True, bold=False))


class LiveTable:
    """Takes reports from any thread, and draws itself; ``state`` returns what is waited for, in words."""

    def __init__(
        self, state: Callable[[], str], *, details: bool = False, starting: Callable[[], Iterable[str]] = tuple
    ) -> None:
        """``starting`` returns how far each daemon is that has not reported yet."""
        self._state, self._details, self._starting = state, details, starting
        self._lock = threading.Lock()
        self._machines: dict[tuple[str, str], _Machine] = {}
        self._unreadable = 0

    def add(self, text: str) -> ReportDocument | None:
        """Take a published report; None, and counted, if this version cannot read it."""
        try:
            document = ReportDocument.from_json(text)
        except (ValueError, RecursionError):
            with self._lock:
                self._unreadable += 1
            return None
        with self._lock:
            now = time.monotonic()
            machine = self._machines.setdefault((document.site, document.machine), _Machine(document, now))
            machine.document, machine.received = document, now
            for name, parameter in document.parameters.items():
                if parameter.value is not None:
                    machine.histories.setdefault(name, deque(maxlen=HISTORY)).append(parameter.value)
        return document

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table as it is now."""
        del console
        yield self._draw(options.max_width)

    def _draw(self, width: int) -> RenderableType:
        state = self._state()
        with self._lock:
            in_short = len(self._machines) > 1
            shown = [self._machines[key] for key in sorted(self._machines)]
            parts = [
                part
                for machine in shown
                for part in machine.draw(state, width, in_short=in_short, details=self._details)
            ]
            unreadable = self._unreadable
        if parts:
            parts += [Text(text, style="yellow") for text in self._starting()]
        if in_short:
            parts.append(Text("'otolith watch MACHINE' shows more of one machine", style="dim"))
        if unreadable:
            parts.append(Text(f"{unreadable} reports cannot be read: another version publishes here", style="red"))
        return Group(*parts) if parts else Text(state, style="dim")


def texts_of(document: ReportDocument) -> Texts:
    """The texts in the language of a report."""
    return texts_in("en" if document.health is None else document.health.language)


def title(document: ReportDocument, rest: str = "") -> Text:
    """The machine of a report, its site, twin and model."""
    text = f" ({document.site}): {document.twin} ({document.model}){rest}"
    return Text.assemble((document.machine, "bold"), text)


def event_style(event: EventDocument) -> str:
    """The style of the text of an event: that of its state until it is cleared."""
    return LEVEL_STYLES[event.state if event.end is None else Level.OK]


def state_lines(document: ReportDocument, *, details: bool = False) -> list[Text]:
    """State of the machine, then its parts, then of each event that is not cleared: what, how sure, and what to do.

    With ``details`` also the hints, and what to write into the machine file.
    """
    if (health := document.health) is None:
        return []
    texts, parts = texts_of(document), Text()
    say = texts.translated
    for name, part in health.parts.items():
        parts.append(f"{texts.part(name)} ").append(say(part.state), style=LEVEL_STYLES[part.state]).append("  ")
    current, when = document.open_events, clock_in(zone_of(document))
    is_in_headline = len(current) == 1  # several events have a line each instead
    own_lines = () if is_in_headline else current
    lines = [Text(headline(health, events=own_lines), style=LEVEL_STYLES[health.state]), parts]
    for event in current:
        if not is_in_headline or event.state is not health.state:
            what, since = f"{say(event.state)}: {texts.part(event.part)}: {event.condition}", when(event.since)
            lines.append(Text(f"{what} {texts('since', time=since)}", style=event_style(event)))
        sure = f" ({probability})" if (probability := probability_text(event)) else ""
        lines.append(Text(f"{in_local_time(event.text, zone_of(document))}{sure}"))
        lines += [Text(note, style="magenta") for note in note_texts(event, when)]
        lines += [Text(f"{texts('what_to_do')}: {event.advice}", style="bold")] if event.advice else []
        lines += [Text(command, style="dim")] if (command := explain_command(event)) else []
        specialist = (event.formulas, event.setting) if details else ()
        lines += [Text(text, style=HINT_STYLE) for text in specialist if text]
    if undecided := undecided_text(document):
        advice = undecided_advice(document)
        lines.append(Text(undecided, style="bold magenta"))
        lines += [Text(f"{texts('what_to_do')}: {advice}", style="bold")] if advice else []
    hints = document.hints if details else ()
    return [*lines, *(Text(event_text(event, details=True), style=HINT_STYLE) for event in hints)]


def parameter_table(*columns: str, width: int, texts: Texts | None = None) -> Table:
    """A table of parameters: the columns of :func:`value_cells`, then ``columns``; status counts are numbers.

    In a narrow terminal words are folded first, as a truncated number would be a wrong one.
    """
    table = _table(width)
    for column in (*VALUE_COLUMNS, *columns):
        right, whole = column in RIGHT or column in set(Status), column in (*RIGHT, "history")
        overflow: OverflowMethod = "ellipsis" if whole else "fold"
        title = texts.translated(column) if texts else column
        table.add_column(title, justify="right" if right else "left", no_wrap=whole, overflow=overflow)
    return table


def _table(width: int) -> Table:
    has_lines = width >= WIDTH_WITH_LINES
    return Table(box=box.HEAVY_HEAD if has_lines else None, pad_edge=has_lines, collapse_padding=not has_lines)


def _title_lines(document: ReportDocument, texts: Texts, age: str) -> list[Text]:
    window, quality = document.window, document.window.quality
    line = Text(f"{texts('window')} {window.index} ")
    line.append(texts.translated(quality.verdict), style="green" if quality.verdict is Verdict.GOOD else "red")
    line.append(f", {texts('sampling', records=window.records, jitter=f'{quality.jitter_s * 1e3:.1f}')}")
    if document.fit is not None and document.cost.seconds is not None:
        line.append(f", {texts('computed', milliseconds=f'{document.cost.seconds * 1e3:.0f}')}")
    return [title(document, age), line]


def _parameters(
    parameters: Mapping[str, ParameterDocument], histories: Mapping[str, deque[float]], width: int, texts: Texts
) -> RenderableType:
    """A table of parameters; in a narrow terminal lines, as its columns would split words and numbers."""
    say = texts.translated
    rows = [(name, *map(say, value_cells(row)), say(row.status)) for name, row in parameters.items()]
    titles = map(say, (*VALUE_COLUMNS, "status"))
    longest = [max(map(len, column)) for column in zip(titles, *rows, strict=True)]
    length = width - sum(longest) - len(BORDER) * (len(longest) + 1) - 1
    if length < -len(BORDER):
        return Group(*(_parameter_line(name, row, say) for name, row in parameters.items()))
    curve = ("history",) if length >= len(say("history")) else ()
    table = parameter_table("status", *curve, width=width, texts=texts)
    for (*cells, word), (name, parameter) in zip(rows, parameters.items(), strict=True):
        curves = [sparkline(tuple(histories.get(name, ()))[-length:], _scale(parameter)) for _ in curve]
        table.add_row(*cells, Text(word, style=STYLES[parameter.status]), *curves)
    return table


def _parameter_line(name: str, parameter: ParameterDocument, say: Callable[[str], str]) -> Text:
    change = value_cells(parameter)[-1]
    text = f" {say(value_text(parameter))}{f' ({change})' if change else ''} "
    return Text.assemble((name, "bold"), text, (say(parameter.status), STYLES[parameter.status]))


def _components(document: ReportDocument, width: int, texts: Texts) -> RenderableType:
    table, say, lines, when = _table(width), texts.translated, [], clock_in(zone_of(document))
    for column in ("component", "equation", "amplitude", "since", "status"):
        table.add_column(say(column), overflow="fold")  # a truncated equation would be a wrong one
    for component in document.components:
        amplitude = component.values["amplitude"]
        text = interval_text(amplitude.value, amplitude.sd, amplitude.unit)
        status = f"{say(component.status)}, {approval_text(component, texts)}"
        cells = say(component.meaning), equation_text(component.equation), text, when(component.onset), status
        table.add_row(*cells)
        lines.append(Text("{}: {}: {}, {}, {}".format(*cells)))
    return Group(*lines) if width < WIDTH_WITH_COMPONENTS else table


def _performance(document: ReportDocument, texts: Texts) -> list[Text]:
    """What the machine costs or yields now, against the healthy machine and at a limit."""
    rows, zone = (document.performance or {}).values(), zone_of(document)
    return [Text(f"{texts.translated(row.meaning)}: {PARTS.join(performance_texts(row, texts, zone))}") for row in rows]


def _messages(document: ReportDocument, texts: Texts, *, details: bool) -> list[Text]:
    """Reasons, advice, and how well the twin explains the window.

    While it is open which cause holds, or the machine file has to be corrected, reasons and advice are details.
    """
    bad = document.window.quality.reasons
    zone = zone_of(document)
    lines = [Text(f"{texts('bad_window')}: {in_local_time(reason, zone)}", style="red") for reason in bad]
    for name, parameter in document.parameters.items():
        if details and (expected := forecast_text(parameter, document.window.end, texts.language)):
            lines.append(Text(f"{name}: {expected} (80 %)", style="bold yellow"))
    candidates = [finding for finding in document.findings if finding.kind is FindingKind.OPEN]
    if (candidates or document.explanations or document.hints) and not details:
        return lines
    for key, style in (("reason", "yellow"), ("advice", "cyan"))[bool(bad) :]:
        names: dict[str, list[str]] = {}
        for name, parameter in document.parameters.items():
            names.setdefault(getattr(parameter, key) or "", []).append(name)
        told = [(_without(text, candidates), own) for text, own in names.items()]
        shown = ((", ".join(own), in_local_time(text, zone)) for text, own in told if text)
        lines += [Text(f"{own}: {text}", style=style) for own, text in shown]
    for finding in candidates:
        lines.append(Text(f"{texts('open_test')}: {in_local_time(finding.text, zone)}", style="magenta"))
        lines += [Text(f"  {text}", style="cyan") for text in (finding.advice, finding.setting) if text]
    if document.fit is not None:
        fit, units = document.fit, document.fit.units
        rows = (fit.rmse_completed or fit.rmse_estimated).items()  # of the twin as it is: with its components
        errors = ", ".join(f"{name} {quantity_text(value, units.get(name, '1'), digits=3)}" for name, value in rows)
        is_explained = fit.explained and document.decision is not WindowDecision.REFUSED
        explained = texts("explained" if is_explained else "unexplained", cost=f"{fit.cost:.2g}")
        lines.append(Text(f"{texts('residual', errors=errors)}: {explained}"))
    return lines


def _without(text: str, findings: Iterable[FindingDocument]) -> str:
    """Return a reason without the findings that have lines of their own."""
    for finding in findings:
        text = text.replace(finding.text, "")
    return PARTS.join(part for part in text.split(PARTS) if part)


def _counters(document: ReportDocument, texts: Texts) -> list[Text]:
    lines = _driver(document.driver, texts("source")) if document.driver is not None else []
    if (counters := document.counters) is not None:
        samples = texts("samples_counted", received=counters.received, lost=counters.lost, bad=counters.bad)
        restarts = {"restarts": counters.worker_restarts, "reconnects": counters.reconnects}
        bad, missed = counters.windows_bad, counters.windows_missed
        windows = texts("windows_counted", windows=counters.windows, bad=bad, missed=missed, **restarts)
        lines += [Text(samples, style="dim"), Text(windows, style="dim")]
    return lines


def _driver(driver: DriverDocument, word: str) -> list[Text]:
    lines = [Text(f"{word}: {warning}", style="yellow") for warning in driver.warnings]
    if not driver.up:
        return [*lines, Text(f"{word}: {driver.reason}", style="bold red")]
    return [*lines, Text(f"{word}: {driver.plan}", style="dim")] if driver.plan else lines


def _scale(parameter: ParameterDocument) -> tuple[float, float] | None:
    """The ends of the curve: the healthy value is in its middle, and a value at its limit at its edge."""
    if parameter.limit is None:
        return None
    healthy = parameter.nominal if parameter.baseline is None else parameter.baseline
    return healthy - abs(parameter.limit - healthy), healthy + abs(parameter.limit - healthy)


def sparkline(values: tuple[float, ...], scale: tuple[float, float] | None = None) -> str:
    """A curve of one line, between its extremes or on a ``scale``; flat where they differ by less than a millionth."""
    if not values:
        return ""
    low, high = scale or (min(values), max(values))
    if high - low <= 1e-6 * max(abs(high), abs(low)):
        return BARS[3] * len(values)
    heights = (int((value - low) / (high - low) * len(BARS)) for value in values)
    return "".join(BARS[min(max(height, 0), len(BARS) - 1)] for height in heights)


def watch_reports(
    connection: "Connection",
    machine: str,
    *,
    as_json: bool,
    details: bool,
    after: int | None,
    stopped: Callable[[], bool],
) -> None:
    """Show reports until ``stopped``; wait for a daemon that is not there yet.

    ``details`` are for the specialist. As JSON each report is printed once and in order, beginning after the sequence
    number ``after``.
    """
    from otolith.publishing.subscriber import Subscriber

    texts: queue.Queue[str] = queue.Queue(MAX_QUEUED)
    ended = threading.Event()

    def receive(text: str) -> None:
        while not (stopped() or ended.is_set()):  # meanwhile the history keeps the reports for a slow reader
            try:
                texts.put(text, timeout=PAUSE)
            except queue.Full:
                continue
            return

    with Subscriber(connection, receive, machine, after=after) as subscriber:
        try:
            known = () if connection.endpoints else tuple(last_reports(machine))  # of the daemons of this computer

            begun = time.monotonic()

            def state() -> str:
                is_alone = not (subscriber.connected or subscriber.order.keys)
                return waiting_text(time.monotonic() - begun, known) if is_alone and known else subscriber.state()

            if as_json:
                _stream(texts, subscriber, state, stopped)
                return
            table = LiveTable(state, details=details, starting=lambda: subscriber.starting)
            with Live(table, console=Terminal(), refresh_per_second=5):
                while not stopped():
                    for text in drain(texts, PAUSE):
                        table.add(text)
        finally:
            ended.set()


def waiting_text(seconds: float, known: Iterable[str]) -> str:
    """Return what is waited for since ``seconds`` while no daemon answers, after the lines ``known``."""
    if seconds < FIRST_ANSWER:
        return "looking for daemons of this computer ..."
    return PARTS.join(["no daemon runs", *known])


def _stream(
    texts: "queue.Queue[str]", subscriber: "Subscriber", state: Callable[[], str], stopped: Callable[[], bool]
) -> None:
    """Print reports as lines; print to standard error what is missing, and the state while no report comes."""
    latest, printed, missed = time.monotonic(), "", 0
    refused = named = 0
    while not stopped():
        lines = drain(texts, PAUSE)
        refused += _print_objects(lines)
        if refused != named:
            named = refused
            echo(f"{named} messages are not shown: they are no JSON objects, so they are of another program", err=True)
        if subscriber.order.missed != missed:
            missed, (last, end) = subscriber.order.missed, subscriber.order.gap
            remedy = "the daemon no longer has them, see [history] resend_hours"
            echo(f"reports after number {last} up to {end} are missing: {remedy}; gaps: {missed}", err=True)
        if lines:
            latest = time.monotonic()
        elif time.monotonic() - latest > PATIENCE and state() != printed:
            printed = state()
            echo(printed, err=True)


def _print_objects(texts: Iterable[str]) -> int:
    """Print each text that is a JSON object as one line; return how many are not, as anybody may publish anything."""
    refused = 0
    for text in texts:
        try:
            echo(checked_line(text))
        except ValueError:
            refused += 1
    return refused
