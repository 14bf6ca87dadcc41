"""``otolith demo``: plant and daemon as processes on a bus, the live table, and a verdict at the end.

The verdict compares what was injected into the simulated machine with what the daemon estimated.
"""

import contextlib
import csv
import os
import queue
import shlex
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rich.live import Live
from rich.table import Table

from otolith.acquisition.window import Verdict
from otolith.adaptation.state import initial_state
from otolith.cli.common import DEMOS, INTERRUPTED, drain
from otolith.cli.console import Terminal
from otolith.cli.operation.live_table import LEVEL_STYLES, LiveTable, event_style
from otolith.cli.terminal import echo_json
from otolith.estimation.information import QUANTILE
from otolith.health.schema import ComponentDocument, EventDocument, HealthDocument, ReportDocument, Status
from otolith.health.text import (
    LINE,
    announcements,
    awaits_commissioning,
    brief,
    event_text,
    headline,
    undecided_advice,
    undecided_finding,
    undecided_text,
)
from otolith.machine import LoadedMachine, load_machine
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import SOCKET, Connection, listening
from otolith.publishing.zenoh_session import REPORT
from otolith.runtime.process import ChildProcess
from otolith.storage.history import path_in
from otolith.storage.recording_files import STAMP
from otolith_drivers.common.time_zones import local_moment
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.plant.faults import Unbalance
from otolith_drivers.plant.scenario import load_scenario
from otolith_drivers.units import equation_text, quantity_text, scale_of
from otolith_drivers.user_dirs import state_directory, writable

# The verdict. Engineering choices; tests/system/test_main_job.py runs the demo and asserts the same TOLERANCE.
TOLERANCE = 0.005  # of the injected value: largest error of an estimate
MAX_UNKNOWN = 0.1  # share of windows without a value, as while hypotheses compete
FIRST_WINDOWS = 2  # windows that may be without an estimate: the machine has not moved before
MIN_CURRENT = 0.1  # A, mean of a window; with less the armature resistance cannot be estimated
INNER_TOLERANCE = 0.01  # of the injected order or frequency of an unbalance
AMPLITUDE_TOLERANCE = 0.05  # of the injected amplitude of an unbalance
START_UP = 10.0  # s of the demo until plant and daemon are connected
DISCOVERY_TIME = 15.0  # s from the onset of an unbalance until its component must be adopted

STOP_TIMEOUT = 2.5  # s for plant and daemon to end after SIGTERM, then they are killed
PAUSE = 0.1  # s
MAX_ROWS = 15  # of the table of the verdict, roughly


@dataclass(frozen=True, slots=True)
class Comparison:
    """Injected and estimated value of one parameter at the end of one window."""

    window: int
    end: float
    parameter: str
    injected: float
    estimated: float | None  # None where the report has no valid value
    sd: float

    @property
    def error(self) -> float:
        """Relative error of the estimate; infinite without one."""
        return float("inf") if self.estimated is None else abs(self.estimated / self.injected - 1.0)

    @property
    def unknown(self) -> bool:
        """Whether there is no estimate, or one that is too imprecise, as its 95 % interval states."""
        if self.estimated is None:
            return True
        return self.error > TOLERANCE and abs(self.estimated - self.injected) <= QUANTILE * self.sd

    @property
    def wrong(self) -> bool:
        """Whether the estimate is too far from the injected value, and its interval does not contain that."""
        return not self.unknown and self.error > TOLERANCE


def compare(reports: Sequence[ReportDocument], truth: Mapping[str, Sequence[float]]) -> list[Comparison]:
    """Every parameter of every good window with current; ``truth`` has columns over Unix time ``t`` (s)."""
    times = np.asarray(truth["t"])
    compared = []
    for report in reports:
        inside = (times >= report.window.start) & (times <= report.window.end)
        if report.window.quality.verdict is not Verdict.GOOD or not inside.any():
            continue
        if "i" in truth and np.abs(np.asarray(truth["i"])[inside]).mean() < MIN_CURRENT:
            continue
        for name, parameter in report.parameters.items():
            if name not in truth:  # the simulated machine has no such parameter
                continue
            if report.window.index < FIRST_WINDOWS and parameter.status is Status.UNESTIMATED:
                continue
            value = parameter.value if parameter.status in (Status.ESTIMATED, Status.HELD) else None
            injected = float(np.asarray(truth[name])[inside][-1])
            window = report.window
            compared.append(Comparison(window.index, window.end, name, injected, value, parameter.sd or 0.0))
    return compared


@dataclass(frozen=True, slots=True)
class UnbalanceComparison:
    """An unbalance of the scenario, and the component that the daemon adopted for it."""

    source: str
    inner: float  # Order, or frequency in rad/s
    amplitude: float  # N·m
    component: ComponentDocument | None

    @property
    def right(self) -> bool:
        """Whether source, family, order and amplitude of the component are those of the unbalance."""
        if self.component is None:
            return False
        amplitude, inner = list(self.component.values.values())[:2]
        return (
            abs(inner.value / self.inner - 1.0) <= INNER_TOLERANCE
            and abs(amplitude.value / self.amplitude - 1.0) <= AMPLITUDE_TOLERANCE
            and self.component.input == self.source
            and self.component.family == "periodic"
        )

    def __str__(self) -> str:
        """Injected and discovered equation."""
        injected = equation_text(f"injected {self.amplitude:.4g}·sin({self.inner:.4g}·{self.source} + ...) N*m")
        if self.component is None:
            return f"{injected}; no component was found"
        return f"{injected}; found {equation_text(self.component.equation)}"


def compare_unbalance(fault: Unbalance, inertia: float, components: Sequence[ComponentDocument]) -> UnbalanceComparison:
    """An unbalance of a shaft with ``inertia`` (kg·m²) and the periodic component nearest to its order."""
    source, inner = ("t", fault.frequency or 0.0) if fault.order is None else ("angle(omega)", fault.order)

    def distance(component: ComponentDocument) -> float:
        return abs(list(component.values.values())[1].value - inner)

    periodic = [component for component in components if component.family == "periodic"]
    return UnbalanceComparison(source, inner, fault.acceleration * inertia, min(periodic, key=distance, default=None))


def transports_of(machine: LoadedMachine) -> list[str]:
    """Return how the plant must send what ``machine`` receives; raise ConfigurationError if no plant can."""
    transports = []
    for driver in machine.file.drivers:
        kind, is_tcp = driver.get("type"), driver.get("framing", "tcp") == "tcp"
        if kind == "can":
            transports.append("can")
        elif kind == "modbus" and ("serial" in driver or is_tcp):
            transports.append("modbus-rtu" if "serial" in driver else "modbus-tcp")
        else:
            text = f'the demo simulates a machine on a CAN bus or on Modbus, but [driver] has type = "{kind}"'
            raise ConfigurationError(f"{machine.path}: {text}")
    return transports


class Demo:
    """One run of the demonstration."""

    def __init__(self, machine: Path, scenario: Path, duration: float, *, as_json: bool) -> None:
        self._machine, self._scenario = load_machine(machine), load_scenario(scenario)
        self._transports = transports_of(self._machine)
        self._scenario_file, self._duration, self._as_json = scenario, duration, as_json
        stamp, names = datetime.now(UTC).strftime(STAMP), self._machine.file.machine
        self._folder = writable(state_directory() / DEMOS / f"{stamp}-{os.getpid()}")
        self._recording = self._folder / f"{names.site}.{names.name}-{stamp}-{os.getpid()}.rrd"
        self._history = path_in(self._folder / "history", names.site, names.name)
        self._console = Terminal(stderr=as_json)
        self._reports: list[ReportDocument] = []
        self._undecided: float | str | None = (
            None  # What was printed last: begin of what is open in Unix s, or the text
        )
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def run(self, stopped: Callable[[], bool]) -> int:
        """0 if every estimate was right, 1 if not, 130 if stopped.

        Raises:
            OtolithError: the endpoint is in use, or plant or daemon ended.
        """
        names = self._machine.file.machine
        endpoints = listening(self._machine.file.zenoh.listen, f"{names.site}.{names.name}")
        if not endpoints:
            raise ConfigurationError(f"{self._machine.path}: zenoh.listen is empty, so there is nothing to watch")
        key = REPORT.under(names.site, names.name)
        machine, scenario = str(self._machine.path), str(self._scenario_file)
        self._print(f"machine {machine}, scenario {scenario}, {self._duration:.0f} s")
        self._print(f"signals on {self._machine.driver.describe()[0]}; reports on {endpoints[0]}, key {key}")
        _refuse_busy(endpoints)
        self._compile(stopped)
        if stopped():
            return INTERRUPTED
        try:
            self._start("daemon", "run", machine, "--recording", str(self._recording))
            truth = str(self._folder / "truth.csv")
            buses = [argument for transport in self._transports for argument in ("--as", transport)]
            self._start("plant", "plant", scenario, *buses, "--truth", truth)
            self._watch(endpoints, stopped)
        finally:
            self._end()
        return INTERRUPTED if stopped() else self._verdict()

    def _print(self, text: str, style: str = "") -> None:
        self._console.print(text, style=style, highlight=not style, soft_wrap=True)

    def _compile(self, stopped: Callable[[], bool]) -> None:
        """Compile the twin before plant and daemon start: a daemon without a compiled twin misses windows."""
        names, begun = self._machine.file.machine, time.monotonic()
        compiler = ChildProcess("otolith-compiler", "otolith.runtime.worker:main", room=1)
        compiler.start(initial_state(names.name, names.site, self._machine.problem))
        compiler.offer(None)  # ask it to end as soon as it is ready
        self._print("compiling the twin, which takes longer the first time ...")
        with self._console.status("compiling"):
            while compiler.alive and not stopped():
                compiler.replies()
                time.sleep(PAUSE)
        compiler.kill()
        if not stopped():
            self._print(f"the twin is compiled, after {time.monotonic() - begun:.0f} s; the demo starts")

    def _start(self, name: str, *arguments: str) -> None:
        """Start in a session of its own: only this process gets Ctrl-C, and ends the others in order."""
        with (self._folder / f"{name}.log").open("wb") as log:
            self._processes[name] = subprocess.Popen(  # noqa: S603 - our own program
                [sys.executable, "-m", "otolith", *arguments],
                env={**os.environ, "STATE_DIRECTORY": str(self._folder)},  # no component of an earlier run
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def _watch(self, endpoints: Sequence[str], stopped: Callable[[], bool]) -> None:
        """Collect the reports of ``duration`` seconds, and show them."""
        texts: queue.Queue[str] = queue.Queue()
        table = LiveTable(lambda: "waiting for the first window ...")
        live = self._console.is_terminal and not self._as_json
        end = time.monotonic() + self._duration
        shown = Live(table, console=self._console, refresh_per_second=5) if live else contextlib.nullcontext()
        with Subscriber(Connection(tuple(endpoints)), texts.put, self._machine.file.machine.name), shown:
            while time.monotonic() < end and not stopped():
                self._refuse_ended()
                self._add(map(table.add, drain(texts, PAUSE)), echo=not live and not self._as_json)
        self._add(map(table.add, drain(texts, PAUSE)), echo=not live and not self._as_json)

    def _add(self, reports: Iterable[ReportDocument | None], *, echo: bool) -> None:
        for report in filter(None, reports):
            self._reports.append(report)
            if echo:
                self._print_events(announcements(report))
                self._print_plain(report)

    def _time_of_day(self, seconds: float) -> str:
        return f"{local_moment(seconds, self._machine.plan.timezone):%T}"

    def _print_plain(self, report: ReportDocument) -> None:
        """Print a report in a line, and in another one what is new while its cause is not yet known: once."""
        self._print(brief(report, self._time_of_day))
        undecided, finding = undecided_text(report, self._time_of_day), undecided_finding(report)
        key = undecided if finding is None or awaits_commissioning(report) else finding.since
        if undecided and key != self._undecided:
            self._print_wrapped(undecided)
            if awaits_commissioning(report):
                self._print_wrapped(undecided_advice(report))
            self._undecided = key

    def _print_wrapped(self, text: str, style: str = "") -> None:
        for line in textwrap.wrap(text, LINE, subsequent_indent="  ", break_on_hyphens=False):
            self._print(line, style)

    def _refuse_ended(self) -> None:
        for name, process in self._processes.items():
            if process.poll() is not None:
                log = (self._folder / f"{name}.log").read_text(encoding="utf-8", errors="replace")
                last_line = log.strip().rpartition("\n")[2]
                raise OtolithError(f"the {name} ended with exit code {process.returncode}: {last_line}")

    def _end(self) -> None:
        for process in self._processes.values():
            process.terminate()
        deadline = time.monotonic() + STOP_TIMEOUT
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _verdict(self) -> int:
        rows = compare(self._reports, _read_columns(self._folder / "truth.csv"))
        unknown, wrong = sum(row.unknown for row in rows), sum(row.wrong for row in rows)
        unbalances = self._unbalances()
        known = bool(rows) and unknown <= MAX_UNKNOWN * len(rows)
        right = known and not wrong and all(unbalance.right for unbalance in unbalances)
        if self._as_json:
            self._print_json(rows, unbalances, right=right)
            return 0 if right else 1
        self._console.print(self._table(rows))
        self._print_changes(rows)
        if not rows:
            self._print("no window determines a parameter: nothing was compared", "red")
        elif wrong:
            self._print(f"{wrong} estimates are wrong by more than {TOLERANCE:.1%}", "red")
        else:
            which = "every other estimate" if unknown else "every estimate"
            self._print(f"{which} is within {TOLERANCE:.1%} of what was injected", "green")
        if unknown:
            text = f"{unknown} of {len(rows)} estimates are missing or not that precise"
            self._print(f"{text}: the computer may be too busy to receive all samples", "yellow" if known else "red")
        for unbalance in unbalances:
            self._print_wrapped(str(unbalance), "green" if unbalance.right else "red")
        events = {event.id: event for report in self._reports for event in report.events}  # each as it was last
        self._print_events(sorted(events.values(), key=lambda event: event.start))
        if (health := self._health) is not None:
            state = headline(health, events=events.values())
            self._print_wrapped(f"state of the machine: {state}", LEVEL_STYLES[health.state])
        for line in self._closing_lines():
            self._print(line)
        return 0 if right else 1

    def _closing_lines(self) -> Iterator[str]:
        """Yield the commands that show what the demo has left, as they can be pasted into a shell."""
        program = Path(sys.executable).with_name("otolith")
        yield f"recording: {shlex.join(map(str, (program, 'view', self._recording)))}"
        if self._history.exists():  # unless the machine file disables it
            yield f"report page: {shlex.join(map(str, (program, 'report', self._history)))}"

    def _print_events(self, events: Iterable[EventDocument]) -> None:
        for event in events:
            self._print_wrapped(event_text(event), event_style(event))

    @property
    def _health(self) -> HealthDocument | None:
        """State of the machine at the end."""
        return self._reports[-1].health if self._reports else None

    def _unbalances(self) -> list[UnbalanceComparison]:
        """Those that began early enough to be discovered, against the components of the last report."""
        components = self._reports[-1].components if self._reports else ()
        return [
            compare_unbalance(fault, self._scenario.parameters.J, components)
            for fault in self._scenario.faults
            if isinstance(fault, Unbalance) and fault.start + DISCOVERY_TIME < self._duration - START_UP
        ]

    def _print_json(self, rows: list[Comparison], unbalances: list[UnbalanceComparison], *, right: bool) -> None:
        verdict = {
            "state": self._health and self._health.model_dump(),
            "events": [event.model_dump() for report in self._reports for event in announcements(report)],
            "components": [{"right": unbalance.right, "text": str(unbalance)} for unbalance in unbalances],
            "right": right,
            "tolerance": TOLERANCE,
            "unknown": sum(row.unknown for row in rows),
            "windows": [
                {"window": row.window, "parameter": row.parameter, "injected": row.injected, "estimated": row.estimated}
                for row in rows
            ],
            "recording": str(self._recording),
        }
        echo_json(verdict)

    def _table(self, rows: list[Comparison]) -> Table:
        step = max(1, len(rows) // MAX_ROWS)
        every = "" if step == 1 else f", one window of {step}"
        table = Table(title=f"injected and estimated{every}")
        for column in ("window", "parameter", "injected", "estimated ± 95 %", "unit", "error"):
            table.add_column(column, justify="left" if column in ("parameter", "unit") else "right")
        units = {parameter.name: parameter.unit for parameter in self._machine.problem.free}
        last = [] if (len(rows) - 1) % step == 0 else rows[-1:]
        for row in [*rows[::step], *last]:
            text, error, style, scale = "unknown", "", None, scale_of(row.injected, units[row.parameter])
            if row.estimated is not None:
                text, error = " ± ".join(scale.numbers(row.estimated, QUANTILE * row.sd)), f"{row.error:.3%}"
                style = "red" if row.wrong else None
            injected = scale.number(row.injected)
            table.add_row(str(row.window), row.parameter, injected, text, scale.unit, error, style=style)
        return table

    def _print_changes(self, rows: list[Comparison]) -> None:
        """How each parameter changed, and its largest error."""
        for parameter in self._machine.problem.free:
            own = [row for row in rows if row.parameter == parameter.name]
            errors = [row.error for row in own if row.estimated is not None]
            if errors:
                before, after = own[0].injected, own[-1].injected
                values = " to ".join(quantity_text(value, parameter.unit) for value in (before, after))
                change = f"from {values} ({after / before - 1:+.1%})"
                error = f"largest error {max(errors):.3%} in {len(errors)} windows"
                self._print(f"{parameter.name} went {change}; {error}")


def _refuse_busy(endpoints: Sequence[str]) -> None:
    """Raise ServiceError if another daemon publishes at an endpoint: its reports would be taken for the demo's."""
    for endpoint in endpoints:
        is_file = endpoint.startswith(SOCKET)
        host, _, port = endpoint.partition("/")[2].rpartition(":")
        with (
            contextlib.suppress(OSError, ValueError),
            socket.socket(socket.AF_UNIX if is_file else socket.AF_INET) as s,
        ):
            s.settimeout(0.5)
            s.connect(endpoint.removeprefix(SOCKET) if is_file else (host, int(port)))
            raise ServiceError(f"{endpoint} is in use: a daemon runs there; stop it, or set zenoh.listen")


def _read_columns(path: Path) -> dict[str, list[float]]:
    """The columns of a CSV file; an incomplete last line, of a process that was ended, is left out."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = [row for row in csv.DictReader(file) if None not in row and None not in row.values()]
    return {name: [float(row[name]) for row in rows] for name in (rows[0] if rows else ("t",))}
