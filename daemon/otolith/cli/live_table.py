"""What people see in a terminal: the live table of a machine, fed by its reports."""

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import datetime

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from otolith.acquisition.window import Verdict
from otolith.estimation.information import QUANTILE
from otolith.health.schema import DriverDocument, ParameterDocument, ReportDocument, Status

HISTORY = 200  # windows that the curve can show
WITHOUT_HISTORY = 72  # columns of the table beside the curve
SILENT_WINDOWS = 3  # lengths of a window without a report, after which the table says so
BARS = "▁▂▃▄▅▆▇█"
STYLES = {Status.ESTIMATED: "green", Status.HELD: "yellow", Status.INVALID: "red", Status.UNESTIMATED: "dim"}


class LiveTable:
    """Takes reports from any thread, and draws; ``state`` says in words what is waited for."""

    def __init__(self, state: Callable[[], str]) -> None:
        self._state = state
        self._heard_at = 0.0
        self._lock = threading.Lock()
        self._latest: ReportDocument | None = None
        self._histories: dict[str, deque[float]] = {}
        self._unreadable = 0

    def hear(self, text: str) -> ReportDocument | None:
        """Take a published report; None, and counted, if it is not one that this version can read."""
        try:
            document = ReportDocument.from_json(text)
        except ValueError:
            with self._lock:
                self._unreadable += 1
            return None
        with self._lock:
            self._latest = document
            self._heard_at = time.monotonic()
            for name, parameter in document.parameters.items():
                if parameter.value is not None:
                    self._histories.setdefault(name, deque(maxlen=HISTORY)).append(parameter.value)
        return document

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The table as it is now."""
        del console
        yield self._drawn(options.max_width)

    def _drawn(self, width: int) -> RenderableType:
        with self._lock:
            document, unreadable = self._latest, self._unreadable
            silence = time.monotonic() - self._heard_at
            histories = {name: tuple(values) for name, values in self._histories.items()}
        if document is None:
            return Text(self._state(), style="dim")
        parts: list[RenderableType] = [*_heading(document), _parameters(document, histories, width)]
        if document.components:
            parts.append(_components(document))
        parts += _words(document)
        length = document.window.end - document.window.start
        if silence > SILENT_WINDOWS * length:
            parts.insert(0, Text(f"no report for {silence:.0f} s: {self._state()}", style="bold red"))
        if unreadable:
            parts.append(Text(f"{unreadable} reports could not be read: another version publishes here", style="red"))
        return Group(*parts)


def _heading(document: ReportDocument) -> list[Text]:
    window, quality = document.window, document.window.quality
    text = Text.assemble((document.machine, "bold"), f" at {document.site}, twin {document.twin} ({document.model})")
    line = Text(f"window {window.index} ")
    line.append(quality.verdict, style="green" if quality.verdict is Verdict.GOOD else "red")
    line.append(f", {window.records} records, {quality.missing:.1%} missing, jitter {quality.jitter_s * 1e3:.1f} ms")
    if document.fit is not None:
        line.append(f", {document.cost.seconds * 1e3:.0f} ms")
    return [text, line]


def _parameters(document: ReportDocument, histories: Mapping[str, tuple[float, ...]], width: int) -> Table:
    table = Table(expand=False)
    for column in ("parameter", "value", "± 95 %", "unit", "change", "status", "history"):
        table.add_column(column, justify="right" if column in ("value", "± 95 %", "change") else "left", no_wrap=True)
    room = max(8, width - WITHOUT_HISTORY)
    for name, parameter in document.parameters.items():
        status = Text(parameter.status, style=STYLES[parameter.status])
        table.add_row(name, *value_cells(parameter), status, sparkline(histories.get(name, ())[-room:]))
    return table


def _components(document: ReportDocument) -> Table:
    table = Table(expand=False)
    for column in ("component", "equation", "amplitude ± 95 %", "since", "status"):
        table.add_column(column, overflow="fold")  # an equation that is cut off is none
    for entry in document.components:
        amplitude = entry.values["amplitude"]
        text = f"{amplitude.value:.4g} ± {QUANTILE * amplitude.sd:.2g} {amplitude.unit}"
        moment = datetime.fromtimestamp(entry.onset).astimezone().strftime("%F %T")
        table.add_row(entry.meaning, entry.equation, text, moment, f"{entry.status}, {entry.approval}")
    return table


def value_cells(parameter: ParameterDocument) -> tuple[str, str, str, str]:
    """Value, half of its interval, unit and change against nominal, as a table shows them."""
    if parameter.value is None or parameter.sd is None:
        return "unknown", "", parameter.unit, ""
    change = f"{parameter.value / parameter.nominal - 1:+.2%}" if parameter.nominal else ""
    return (
        f"{parameter.value:.5g}",
        f"{QUANTILE * parameter.sd:.2g}",
        parameter.unit,
        change.replace("-0.00%", "0.00%").replace("+0.00%", "0.00%"),
    )


def _words(document: ReportDocument) -> list[Text]:
    lines = [Text(f"bad window: {reason}", style="red") for reason in document.window.quality.reasons]
    for name, parameter in document.parameters.items():
        if parameter.reason and not document.window.quality.reasons:
            lines.append(Text(f"{name}: {parameter.reason}", style="yellow"))
        if parameter.advice:
            lines.append(Text(f"{name}: {parameter.advice}", style="cyan"))
    for finding in document.findings:
        lines.append(Text(f"{finding.severity}: {finding.text}", style="bold red"))
        if finding.advice:
            lines.append(Text(f"  {finding.advice}", style="cyan"))
    if document.fit is not None:
        errors = ", ".join(f"{name} {value:.3g}" for name, value in document.fit.rmse_estimated.items())
        explained = "explained up to the noise" if document.fit.explained else "more than noise is left"
        lines.append(Text(f"residual (RMSE): {errors}: {explained}"))
    if document.driver is not None:
        lines += _of_driver(document.driver)
    if document.counters is not None:
        counters = document.counters
        lines += [
            Text(f"samples: {counters.received}, lost {counters.lost}, bad {counters.bad}", style="dim"),
            Text(
                f"windows: {counters.windows}, bad {counters.windows_bad}, missed {counters.windows_missed}; "
                f"worker restarts {counters.worker_restarts}, bus reconnects {counters.reconnects}",
                style="dim",
            ),
        ]
    return lines


def _of_driver(driver: DriverDocument) -> list[Text]:
    lines = [Text(f"driver: {complaint}", style="yellow") for complaint in driver.warnings]
    if not driver.up:
        return [*lines, Text(f"driver: {driver.reason}", style="bold red")]
    return [*lines, Text(f"driver: {driver.plan}", style="dim")] if driver.plan else lines


def sparkline(values: tuple[float, ...]) -> str:
    """A curve of one line; flat where the values hardly differ."""
    if not values:
        return ""
    low, high = min(values), max(values)
    if high - low <= 1e-6 * max(abs(high), abs(low)):
        return BARS[3] * len(values)
    return "".join(BARS[min(int((value - low) / (high - low) * len(BARS)), len(BARS) - 1)] for value in values)
