"""``otolith demo``: plant and daemon as processes on a bus, watched from here, and the verdict at the end.

What was injected into the simulated machine of the demonstration, against what was found.
"""

import contextlib
import csv
import json
import os
import queue
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.table import Table

from otolith.acquisition.window import Verdict
from otolith.adaptation.state import initial_state
from otolith.cli.live_table import LiveTable
from otolith.estimation.information import QUANTILE
from otolith.health.schema import ComponentDocument, ReportDocument, Status
from otolith.machine import load_machine
from otolith.publishing.zenoh_session import REPORT, Listener
from otolith.runtime.process import ChildProcess
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.plant.faults import Unbalance
from otolith_drivers.plant.scenario import load_scenario
from otolith_drivers.user_dirs import state_directory, writable

BEGINNING = 2  # windows that need not have found anything yet
CURRENT_FLOWS = 0.1  # A, mean over the window
INNER, AMPLITUDE = 0.01, 0.05  # of what was injected: what order or frequency, and amplitude, must be found within


@dataclass(frozen=True, slots=True)
class Comparison:
    """One parameter in one window: injected (at its end, as reports speak of it) against found."""

    window: int
    end: float
    parameter: str
    injected: float
    found: float | None
    half_width: float | None
    """Of the 95 % interval."""

    @property
    def error(self) -> float:
        """Relative; infinite where nothing was found."""
        return float("inf") if self.found is None else abs(self.found / self.injected - 1.0)


def compare(reports: Sequence[ReportDocument], truth: Mapping[str, Sequence[float]]) -> list[Comparison]:
    """Every parameter of every good window with current flowing; ``truth`` is columns over Unix time ``t`` (s)."""
    times = np.asarray(truth["t"])
    compared = []
    for report in reports:
        inside = (times >= report.window.start) & (times <= report.window.end)
        if report.window.quality.verdict is not Verdict.GOOD or not inside.any():
            continue
        if "i" in truth and np.abs(np.asarray(truth["i"])[inside]).mean() < CURRENT_FLOWS:
            continue
        for name, parameter in report.parameters.items():
            if name not in truth:  # the simulated machine has no such parameter
                continue
            if report.window.index < BEGINNING and parameter.status is Status.UNESTIMATED:
                continue  # the machine may have begun to move as the window ended
            found = parameter.value if parameter.status in (Status.ESTIMATED, Status.HELD) else None
            half = None if found is None or parameter.sd is None else QUANTILE * parameter.sd
            injected = float(np.asarray(truth[name])[inside][-1])
            compared.append(Comparison(report.window.index, report.window.end, name, injected, found, half))
    return compared


@dataclass(frozen=True, slots=True)
class Shaking:
    """An unbalance of the scenario, and the component that was found of it."""

    source: str
    inner: float
    """Order, or frequency in rad/s."""
    amplitude: float
    """N·m."""
    found: ComponentDocument | None

    @property
    def right(self) -> bool:
        """Whether it was found for what it is."""
        if self.found is None:
            return False
        amplitude, inner = list(self.found.values.values())[:2]
        close = (
            abs(inner.value / self.inner - 1.0) <= INNER and abs(amplitude.value / self.amplitude - 1.0) <= AMPLITUDE
        )
        return close and self.found.input == self.source and self.found.family == "periodic"

    def __str__(self) -> str:
        """Injected against found."""
        injected = f"injected {self.amplitude:.4g}·sin({self.inner:.4g}·{self.source} + ...) N*m"
        if self.found is None:
            return f"{injected}; no component was found"
        return f"{injected}; found {self.found.equation} ({self.found.conditions})"


def shaking(fault: Unbalance, inertia: float, reports: Sequence[ReportDocument]) -> Shaking:
    """An unbalance of a shaft with ``inertia`` (kg·m²) against the components of the last report."""
    source, inner = ("t", fault.frequency or 0.0) if fault.order is None else ("angle(omega)", fault.order)

    def distance(entry: ComponentDocument) -> float:
        return abs(list(entry.values.values())[1].value - inner)

    periodic = [entry for entry in (reports[-1].components if reports else ()) if entry.family == "periodic"]
    return Shaking(source, inner, fault.acceleration * inertia, min(periodic, key=distance, default=None))


TOLERANCE = 0.005  # of the injected value: what every window with current must be found within
START_UP, TO_FIND = 10.0, 15.0  # s until plant and daemon listen to each other, and for a component to be adopted
MOST_UNKNOWN = 0.1  # of the windows: that may say that they do not know, as while a case is being decided
STOP_SECONDS = 2.5  # for a process to end by itself
PAUSE = 0.1  # s
ROWS = 15  # of the table at the end


class Demo:
    """One run of the demonstration."""

    def __init__(self, machine: Path, scenario: Path, duration: float, *, as_json: bool) -> None:
        self._machine, self._scenario, self._duration, self._as_json = machine, scenario, duration, as_json
        self._plan = load_machine(machine)
        self._life = load_scenario(scenario)
        stamp = datetime.now().astimezone().strftime("%Y%m%dT%H%M%S")
        self._folder = writable(state_directory() / "demo" / f"{stamp}-{os.getpid()}")
        self._console = Console(stderr=as_json)
        self._reports: list[ReportDocument] = []
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    @property
    def recording(self) -> Path:
        """Where the curves go."""
        return self._folder / "recording.rrd"

    def run(self, stopped: Callable[[], bool]) -> int:
        """0 if every estimate was right, 1 if not; a process that fails gives its own exit code."""
        identity = self._plan.file.machine
        connect = self._plan.file.zenoh.listen
        if not connect:
            raise ConfigurationError(f"{self._machine}: zenoh.listen is empty, so there is nothing to watch")
        key = REPORT.under(identity.site, identity.name)
        say = self._console.print
        say(f"machine {self._machine}, scenario {self._scenario}, {self._duration:.0f} s", soft_wrap=True)
        say(f"frames on {self._plan.driver.describe()[0]}; reports on {connect[0]}, key {key}", soft_wrap=True)
        _refuse_busy(connect)
        self._compile(stopped)
        if stopped():
            return 130
        try:
            self._start("daemon", "run", str(self._machine), "--recording", str(self.recording))
            self._start("plant", "plant", str(self._scenario), "--truth", str(self._folder / "truth.csv"))
            self._watch(connect, key, stopped)
        finally:
            self._end()
        return 130 if stopped() else self._verdict()

    def _compile(self, stopped: Callable[[], bool]) -> None:
        """Before the clocks of plant and daemon start: a daemon whose twin is not compiled yet misses windows."""
        identity, begun = self._plan.file.machine, time.monotonic()
        compiler = ChildProcess("otolith-compiler", "otolith.runtime.worker:main", room=1)
        compiler.start(initial_state(identity.name, identity.site, self._plan.problem))
        compiler.offer(None)  # to end as soon as it could begin
        text = "compiling the twin, which takes a minute or two the first time ..."
        if self._console.is_terminal:
            shown: contextlib.AbstractContextManager[object] = self._console.status(text)
        else:
            self._console.print(text)
            shown = contextlib.nullcontext()
        with shown:
            while compiler.alive and not stopped():
                time.sleep(PAUSE)
        compiler.kill()
        if not stopped():
            self._console.print(f"the twin is compiled, after {time.monotonic() - begun:.0f} s: now the clock runs")

    def _start(self, name: str, *arguments: str) -> None:
        """In a session of its own: Ctrl-C is for this process, which ends the others in order."""
        with (self._folder / f"{name}.log").open("wb") as log:
            self._processes[name] = subprocess.Popen(  # noqa: S603 - our own program
                [sys.executable, "-m", "otolith", *arguments],
                env={**os.environ, "STATE_DIRECTORY": str(self._folder)},  # no component of an earlier run
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def _watch(self, connect: Sequence[str], key: str, stopped: Callable[[], bool]) -> None:
        heard: queue.SimpleQueue[str] = queue.SimpleQueue()
        board = LiveTable(lambda: "waiting for the first window ...")
        live = self._console.is_terminal and not self._as_json
        end = time.monotonic() + self._duration
        shown = Live(board, console=self._console, refresh_per_second=5) if live else contextlib.nullcontext()
        with Listener(connect, key, heard.put), shown:
            while time.monotonic() < end and not stopped():
                self._complain_of_the_dead()
                self._take(heard, board, aloud=not live)
        self._take(heard, board, aloud=not live)

    def _take(self, heard: "queue.SimpleQueue[str]", board: LiveTable, *, aloud: bool) -> None:
        try:
            text = heard.get(timeout=PAUSE)
        except queue.Empty:
            return
        report = board.hear(text)
        if report is not None:
            self._reports.append(report)
            if aloud and not self._as_json:
                values = (f"{name} {entry.value:.5g} {entry.unit}" if entry.value is not None else f"{name} unknown"
                          for name, entry in report.parameters.items())  # fmt: skip
                self._console.print(
                    f"window {report.window.index} {report.window.quality.verdict}: {', '.join(values)}"
                )

    def _complain_of_the_dead(self) -> None:
        for name, process in self._processes.items():
            if process.poll() is not None:
                log = (self._folder / f"{name}.log").read_text(encoding="utf-8", errors="replace").strip()
                raise OtolithError(f"the {name} ended with exit code {process.returncode}: {log.splitlines()[-1]}")

    def _end(self) -> None:
        for process in self._processes.values():
            process.terminate()
        deadline = time.monotonic() + STOP_SECONDS
        for process in self._processes.values():
            try:
                process.wait(max(0.0, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _verdict(self) -> int:
        compared = compare(self._reports, _read_columns(self._folder / "truth.csv"))
        wrong = [row for row in compared if row.found is not None and row.error > TOLERANCE]
        unknown = sum(row.found is None for row in compared)
        begun = [fault for fault in self._unbalances() if fault.start + TO_FIND < self._duration - START_UP]
        shaken = [shaking(fault, self._life.parameters.J, self._reports) for fault in begun]
        known = bool(compared) and unknown <= MOST_UNKNOWN * len(compared)
        right = known and not wrong and all(entry.right for entry in shaken)
        if self._as_json:
            self._print_json(compared, shaken, right=right)
        else:
            self._print_table(compared)
            self._print_sum(compared, wrong, unknown)
            for entry in shaken:
                self._console.print(f"[{'green' if entry.right else 'red'}]{entry}[/]", highlight=False, soft_wrap=True)
        return 0 if right else 1

    def _unbalances(self) -> list[Unbalance]:
        return [fault for fault in self._life.faults if isinstance(fault, Unbalance)]

    def _print_json(self, compared: list[Comparison], shaken: list[Shaking], *, right: bool) -> None:
        rows = [
            {"window": row.window, "parameter": row.parameter, "injected": row.injected, "found": row.found}
            for row in compared
        ]
        components = [{"right": entry.right, "text": str(entry)} for entry in shaken]
        verdict = {
            "components": components,
            "right": right,
            "tolerance": TOLERANCE,
            "unknown": sum(row.found is None for row in compared),
            "windows": rows,
            "recording": str(self.recording),
        }
        sys.stdout.write(json.dumps(verdict) + "\n")

    def _print_table(self, compared: list[Comparison]) -> None:
        units = {entry.name: entry.unit for entry in self._plan.problem.free}
        step = max(1, len(compared) // ROWS)
        every = "" if step == 1 else f" (one row of {step})"
        table = Table(title=f"injected against found, good windows with excitation{every}")
        for column in ("window", "parameter", "injected", "found ± 95 %", "unit", "error"):
            table.add_column(column, justify="left" if column in ("parameter", "unit") else "right")
        shown = [*compared[::step], *(row for row in compared[-1:] if (len(compared) - 1) % step)]
        for row in shown:
            found = "unknown" if row.found is None else f"{row.found:.5g} ± {row.half_width or 0.0:.2g}"
            style = "red" if row.found is not None and row.error > TOLERANCE else None
            error = "" if row.found is None else f"{row.error:.3%}"
            table.add_row(str(row.window), row.parameter, f"{row.injected:.5g}", found, units[row.parameter], error,
                          style=style)  # fmt: skip
        self._console.print(table)
        for name, unit in units.items():
            rows = [row for row in compared if row.parameter == name]
            errors = [row.error for row in rows if row.found is not None]
            if errors:
                before, after = rows[0].injected, rows[-1].injected
                change = f"{name} went from {before:.5g} to {after:.5g} {unit} ({after / before - 1:+.1%})"
                self._console.print(f"{change}; largest error {max(errors):.3%} in {len(errors)} windows")

    def _print_sum(self, compared: list[Comparison], wrong: list[Comparison], unknown: int) -> None:
        say = self._console.print
        if not compared:
            say("[red]no good window with excitation: nothing was shown[/red]")
        elif wrong:
            say(f"[red]{len(wrong)} windows are wrong by more than {TOLERANCE:.1%}[/red]")
        else:
            say(f"[green]every one is within {TOLERANCE:.1%} of what was injected[/green]")
        if unknown:
            style = "yellow" if unknown <= MOST_UNKNOWN * len(compared) else "red"
            say(f"[{style}]{unknown} of {len(compared)} windows said that they do not know[/]")
        say(f"recording: {self.recording}", soft_wrap=True)
        say(f"open it with: {Path(sys.executable).with_name('otolith')} view {self.recording}", soft_wrap=True)


def _refuse_busy(endpoints: Sequence[str]) -> None:
    """A daemon that already publishes there would be taken for the demo's own."""
    for endpoint in endpoints:
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        with contextlib.suppress(OSError, ValueError), socket.create_connection((host, int(port)), timeout=0.5):
            raise ServiceError(f"{endpoint} is in use: a daemon runs there; stop it, or set zenoh.listen")


def _read_columns(path: Path) -> dict[str, list[float]]:
    columns: dict[str, list[float]] = {}
    with path.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if None in row.values() or None in row:  # the last line of a process that was ended
                continue
            for name, value in row.items():
                columns.setdefault(name, []).append(float(value))
    return columns or {"t": []}
