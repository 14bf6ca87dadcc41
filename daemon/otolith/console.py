"""What people see in a terminal: the live table of a machine, fed by its reports."""

import threading
from collections import deque
from collections.abc import Mapping

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from otolith.acquisition.window import Verdict
from otolith.health.report import ParameterDocument, ReportDocument, Status
from otolith.health.status import QUANTILE

HISTORY = 60  # windows that the curve shows
BARS = "▁▂▃▄▅▆▇█"
STYLES = {Status.ESTIMATED: "green", Status.HELD: "yellow", Status.INVALID: "red", Status.UNESTIMATED: "dim"}


class Board:
    """Takes reports from any thread, and draws."""

    def __init__(self, waiting_for: str) -> None:
        self._waiting_for = waiting_for
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
            for name, parameter in document.parameters.items():
                if parameter.value is not None:
                    self._histories.setdefault(name, deque(maxlen=HISTORY)).append(parameter.value)
        return document

    def __rich__(self) -> RenderableType:
        """The table as it is now."""
        with self._lock:
            document, unreadable = self._latest, self._unreadable
            histories = {name: tuple(values) for name, values in self._histories.items()}
        if document is None:
            return Text(f"waiting for {self._waiting_for} ...", style="dim")
        parts: list[RenderableType] = [_heading(document), _parameters(document, histories), *_words(document)]
        if unreadable:
            parts.append(Text(f"{unreadable} reports could not be read: another version publishes here", style="red"))
        return Group(*parts)


def _heading(document: ReportDocument) -> Text:
    window, quality = document.window, document.window.quality
    text = Text.assemble(
        (f"{document.machine}", "bold"), f" at {document.site}, twin {document.twin} ({document.model})"
    )
    text.append(f"   window {window.index} ")
    text.append(quality.verdict, style="green" if quality.verdict is Verdict.GOOD else "red")
    text.append(f", {window.records} records, {quality.missing:.1%} missing, jitter {quality.jitter_s * 1e3:.1f} ms")
    text.append(f", adapted in {document.cost.seconds * 1e3:.0f} ms")
    return text


def _parameters(document: ReportDocument, histories: Mapping[str, tuple[float, ...]]) -> Table:
    table = Table(expand=False)
    for column in ("parameter", "value", "± 95 %", "unit", "change", "status", f"last {HISTORY} windows"):
        table.add_column(column, justify="right" if column in ("value", "± 95 %", "change") else "left", no_wrap=True)
    for name, parameter in document.parameters.items():
        table.add_row(name, *_values(parameter), Text(parameter.status, style=STYLES[parameter.status]),
                      sparkline(histories.get(name, ())))  # fmt: skip
    return table


def _values(parameter: ParameterDocument) -> tuple[str, str, str, str]:
    if parameter.value is None or parameter.sd is None:
        return "unknown", "", parameter.unit, ""
    change = f"{parameter.value / parameter.nominal - 1:+.2%}" if parameter.nominal else ""
    return f"{parameter.value:.5g}", f"{QUANTILE * parameter.sd:.2g}", parameter.unit, change


def _words(document: ReportDocument) -> list[Text]:
    lines = [Text(f"window: {reason}", style="red") for reason in document.window.quality.reasons]
    for name, parameter in document.parameters.items():
        if parameter.reason and not document.window.quality.reasons:
            lines.append(Text(f"{name}: {parameter.reason}", style="yellow"))
    if document.fit is not None:
        errors = ", ".join(f"{name} {value:.3g}" for name, value in document.fit.rmse_estimated.items())
        explained = "explained up to the noise" if document.fit.explained else "more than noise is left"
        lines.append(Text(f"residual (RMSE): {errors}: {explained}"))
    if document.counters is not None:
        counters = document.counters
        lost = (
            f"{counters.received} samples, {counters.lost} lost, {counters.bad} bad, {counters.reconnects} reconnects; "
        )
        lost += f"{counters.windows} windows, {counters.windows_bad} bad, {counters.windows_missed} missed, "
        lines.append(Text(f"{lost}{counters.worker_restarts} worker restarts", style="dim"))
    return lines


def sparkline(values: tuple[float, ...]) -> str:
    """A curve of one line; flat where the values hardly differ."""
    if not values:
        return ""
    low, high = min(values), max(values)
    if high - low <= 1e-6 * max(abs(high), abs(low)):
        return BARS[3] * len(values)
    return "".join(BARS[min(int((value - low) / (high - low) * len(BARS)), len(BARS) - 1)] for value in values)
