"""``otolith replay``: recorded data through the code of the daemon, and a summary of the reports."""

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from rich.console import Console, ConsoleOptions, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from otolith.acquisition.quality import ReasonCounts
from otolith.adaptation.state import AdaptationState
from otolith.cli.common import echo_warnings, progress_line
from otolith.cli.console import Localised, Terminal
from otolith.cli.operation.live_table import LEVEL_STYLES, STYLES, event_style, parameter_table, texts_of, title
from otolith.cli.terminal import echo
from otolith.discovery.alternatives import WindowDecision
from otolith.health.schema import EventDocument, FindingKind, ReportDocument, Status
from otolith.health.text import PARTS, Texts, component_text, event_text, headline, undecided_text, value_cells, zone_of
from otolith.health.times import clock_in, in_local_time
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.preview import computing_time_text, preview_recording, short_lines
from otolith.runtime.replay import RealTimePacer, Replay, open_recordings, replay_recorder
from otolith.storage.state_store import COMPONENTS, store_of
from otolith_drivers.errors import ConfigurationError, OtolithError, counted
from otolith_drivers.user_dirs import writable

PLAIN_WIDTH = 110  # columns of a summary that goes into a file
PREVIEWED_ROWS = 50_000  # of which a replay prints a preview


class ReplaySummary:
    """Counts reports, keeps the last one, and draws itself."""

    def __init__(self) -> None:
        self._first: ReportDocument | None = None
        self._last: ReportDocument | None = None
        self._fitted = self._explained = 0
        self._decisions: Counter[WindowDecision] = Counter()
        self._statuses: Counter[tuple[str, Status]] = Counter()
        self._seconds: list[float] = []
        self._reasons = ReasonCounts()
        self._events: dict[str, EventDocument] = {}

    def add(self, document: ReportDocument) -> None:
        """Count one report."""
        self._first = self._first or document
        self._last = document
        self._decisions[document.decision] += 1
        if document.cost.seconds is not None:
            self._seconds.append(document.cost.seconds)
        if document.fit is not None:
            self._fitted += 1
            self._explained += document.fit.explained
        self._statuses.update((name, parameter.status) for name, parameter in document.parameters.items())
        self._events |= {event.id: event for event in document.events}
        self._reasons.add(document.window.index, document.window.quality.reasons)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Parameters, components and findings of the last report, and the counts, in the language of the machine."""
        del console
        if self._first is None or self._last is None:
            yield Text("no window")
            return
        decimals = texts_of(self._last).decimals
        for part in self._parts(self._first, self._last, options.max_width):
            yield Localised(part, decimals)

    def _parts(self, first: ReportDocument, last: ReportDocument, width: int) -> Iterator[RenderableType]:
        zone, texts = zone_of(last), texts_of(last)
        when, say = clock_in(zone), texts.translated
        if last.health is not None:
            yield Text(headline(last.health, events=self._events.values()), style=LEVEL_STYLES[last.health.state])
        if undecided := undecided_text(last):
            yield Text(undecided, style="bold magenta")
        yield title(last, f", {say(f'from {when(first.window.start)} to {when(last.window.end)}')}")
        yield self._parameters(last, width, texts)
        for reason in dict.fromkeys(parameter.reason for parameter in last.parameters.values() if parameter.reason):
            names = ", ".join(name for name, parameter in last.parameters.items() if parameter.reason == reason)
            yield Text(f"{names}, {say('last window')}: {in_local_time(say(reason), zone)}", style="yellow")
        for component in last.components:
            since = texts("since", time=when(component.onset))
            yield Text(f"{component_text(component, texts)}, {since}", style="bold red")
        for event in self._events.values():
            yield Text(event_text(event, details=True), style=event_style(event))
        for finding in last.findings:
            if finding.kind is FindingKind.OPEN:
                text = PARTS.join(filter(None, (finding.text, finding.advice, finding.setting)))
                yield Text(f"{texts('open_test')}: {in_local_time(text, zone)}", style="magenta")
        yield from self._counts(last, texts)

    def _parameters(self, last: ReportDocument, width: int, texts: Texts) -> Table:
        say = texts.translated
        seen = [kind for kind in Status if any(self._statuses[name, kind] for name in last.parameters)]
        table = parameter_table("last window", *seen, width=width, texts=texts)
        for name, parameter in last.parameters.items():
            status = Text(say(parameter.status), style=STYLES[parameter.status])
            counts = (str(self._statuses[name, kind]) for kind in seen)
            table.add_row(name, *map(say, value_cells(parameter)), status, *counts)
        return table

    def _counts(self, last: ReportDocument, texts: Texts) -> Iterator[Text]:
        windows, bad, say = self._decisions.total(), self._decisions[WindowDecision.BAD], texts.translated
        explained = f"the twin explains {self._explained} of {self._fitted} up to the noise"
        yield Text(say(f"{counted(windows, 'window')}: {windows - bad} good, {bad} bad; {explained}"))
        if self._seconds:
            length = last.window.end - last.window.start
            yield Text(say(computing_time_text(median(self._seconds), max(self._seconds), length)))
        for decision, count in self._decisions.items():
            if decision not in (WindowDecision.LEARNED, WindowDecision.BAD):
                yield Text(say(f"  {count} good, but: {decision.in_words}"), style="yellow")
        for count, example in self._reasons.most_frequent():
            yield Text(say(f"  {count} bad like: {in_local_time(example, zone_of(last))}"), style="red")


def replay(
    file: Path,
    data: Sequence[Path],
    recording: Path | None,
    *,
    as_json: bool,
    stopped: Callable[[], bool],
    real_time: bool = False,
    timing: bool = False,
    page: Path | None = None,
    folder: Path | None = None,
    state: Path | None = None,
    ending: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> None:
    """Print the daemon's reports on ``data`` for the machine in ``file``: as JSON Lines, or as a summary.

    Each file of ``data`` is a recording of its own. With ``timing`` reports have computing times, which differ from run
    to run. The history of the reports is kept in ``folder``, and drawn as the new HTML file ``page``. The operator's
    decisions are those in the state directory ``state``, or of this user without one, and are named. ``ending`` breaks
    off, in its block, what takes too long after a signal.

    Raises:
        OtolithError: a file that cannot be used, or that cannot be written.
        OSError: the page cannot be written.
    """
    machine = load_machine(file, with_driver=False)
    machine.try_fmu()
    summary = ReplaySummary()
    with open_recordings(machine, data) as recorded:
        if recorded.ignored:
            echo(f"{recorded.path}: columns not used: {', '.join(recorded.ignored)}", err=True)
        if not as_json:
            with ending():
                _echo_preview(machine, data[0], stopped)
        wait = RealTimePacer(stopped).wait if real_time else None
        run = Replay(machine, recorded, stopped, wait, timing=timing)
        run.state = with_decisions(machine, run.state, state)
        with (
            replay_recorder(recording, machine.recorded(recorded.sampling)) as record,
            _history(machine, run, data, page, folder) as keep,
            progress_line("reading", enabled=not as_json) as show,
        ):
            reports = run.reports()
            while not stopped():
                report = None
                with ending():  # a window may take long
                    report = next(reports, None)
                if report is None:
                    break
                summary.add(report.document)
                record(report)
                keep(report.document)
                show(f"window {report.document.window.index}, {run.progress:.0%} of the data")
                if as_json:
                    echo(report.document.to_json())
    if as_json:
        echo_warnings(data[0], (in_local_time(line, machine.plan.timezone) for line in run.warnings()))
        return
    console = Terminal(width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    console.print(summary)
    for line in (run.summary(), *run.warnings()):
        console.print(in_local_time(line, machine.plan.timezone), soft_wrap=True)


@contextmanager
def _history(
    machine: LoadedMachine, run: Replay, data: Sequence[Path], page: Path | None, folder: Path | None
) -> Iterator[Callable[[ReportDocument], None]]:
    """Yield what keeps a report for ``page`` and in ``folder``, and draw the page at the end; nothing without both."""
    if page is None and folder is None:
        yield lambda _: None
        return
    from otolith.cli.operation.history import page_of, write_page
    from otolith.storage.history import describe_machine
    from otolith.storage.log_history import log_history

    names = machine.file.machine
    if page is not None:
        writable(page.absolute().parent)
    with (
        TemporaryDirectory(prefix="otolith-replay-") as temporary,
        log_history(folder or Path(temporary), names.site, names.name) as history,
    ):
        yield history.add
        log = {"files": [path.name for path in data], "warnings": run.warnings()}
        history.describe(describe_machine(machine.twin, run.state.plan, log, given=dict(machine.problem.known)))
        if page is not None and history.span is not None:
            write_page(page, page_of(history.reader, *history.span))


def with_decisions(machine: LoadedMachine, state: AdaptationState, directory: Path | None) -> AdaptationState:
    """Return the initial state with the components that the operator approved, and without those rejected.

    They change the reports, so standard error tells which file they are from.
    """
    if directory is not None and not (directory / COMPONENTS).is_dir():
        raise ConfigurationError(f"{directory}: no state directory: it has no folder {COMPONENTS!r}")
    store = store_of(machine, directory)
    chosen = {"approved": sorted(record.adopted.component.key for record in store.approved()),
              "rejected": sorted(store.decisions().rejected)}  # fmt: skip
    if told := "; ".join(f"{name}: {', '.join(keys)}" for name, keys in chosen.items() if keys):
        echo(f"{store.decisions_path}: the replay uses these decisions: {told}", err=True)
    return store.decided(state)


def _echo_preview(machine: LoadedMachine, data: Path, stopped: Callable[[], bool]) -> None:
    """Print to standard error what the first rows of ``data`` offer."""
    with suppress(OtolithError):  # the replay itself raises what is wrong with the file
        preview = preview_recording(machine, [data], stopped, max_rows=PREVIEWED_ROWS)
        for line in short_lines(preview, machine.plan.timezone):
            echo(line, err=True)
