"""A hall to which everything bad happens, one after the other: who publishes on time, and what is lost.

    python -m benchmarks.hall_faults --machines 50 --seconds 30

The hall has DC motors that are well, as that of :mod:`benchmarks.hall`, and for the whole time one whose twin diverges,
one whose bus is dead, and machine files that are hostile. A worker, the recorder and the daemon are killed, and stopped
(SIGSTOP); the disk is full (that needs root, who gives the state a disk of its own). Of each trouble the table has the
machines that were on time, of all that are well: no window missed, no sample lost, each report after the one before it,
and before the next window ended. At last the daemon is killed and started again: nothing that was published may
be missing in the histories, and each machine begins with what it has learned.
"""

import contextlib
import json
import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import click
import numpy as np
import psutil
from rich.table import Table

from benchmarks.command_line import print_pages
from benchmarks.hall import PATIENCE, SETTLING, WINDOW, environment_of_unit, write_hall, write_records
from otolith.health.schema import CountersDocument, ReportDocument
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith.storage.disk import WRITE_RETRY
from otolith.storage.history import SUFFIX, HistoryReader

SITE = "hall"
DISK = 1000  # MB of the state
STOPPED = 3.0  # s for which the daemon is stopped
WRITING = 5.0  # s after the next try to write, in which all that has waited for the disk is written
RECORDED = 90.0  # s of the records, which are repeated
STRICT = "nothing", "a worker killed", "the recorder killed", "a worker stopped", "the recorder stopped", "disk full"
"""Troubles during which every machine that is well must be on time."""
DIVERGES = {"[parameters]": '[parameters]\nJ = "1e-9 kg*m^2"'}  # its speed changes a million times faster than windows
UNITS = {"V_a": "V", "T_load": "N*m", "i": "A", "omega": "rad/s"}
HOSTILE = "x\nExecStartPre=+/bin/sh", "../../../etc/passwd", "\x1b[2J", "'; DROP TABLE report; --", "\u202eevird"
LEARNED = "started with what was learned"


@dataclass(frozen=True, slots=True)
class FaultFigures:
    """What one trouble cost the machines that are well."""

    trouble: str
    machines: int  # That are well
    on_time: int
    reports: int
    windows_missed: int
    samples_lost: int
    latency_median_ms: float
    latency_99_ms: float
    latency_max_ms: float


@dataclass(frozen=True, slots=True)
class RestartFigures:
    """What became of the hall after its daemon was killed."""

    machines: int  # That are well
    learned: int  # Machines that began with what they had learned
    published: int  # Reports before
    kept: int  # Of these, in the histories
    seconds: float  # Until each machine had published again


def write_faulty_hall(folder: Path, well: int, endpoint: str) -> Path:
    """Write the machine files of a hall, of which ``well`` are well, and return their folder."""
    hall = write_hall(folder, well, 0.0, endpoint).folder
    text = (hall / "motor-000.toml").read_text(encoding="utf-8")
    diverging = text.replace('name = "motor-000"', 'name = "diverges"')
    for old, new in DIVERGES.items():
        diverging = diverging.replace(old, new)
    (hall / "diverges.toml").write_text(diverging, encoding="utf-8")
    dead = text.replace('name = "motor-000"', 'name = "dead"')
    driver = dead[dead.index("[driver]") : dead.index("[twin]")]
    registers = "\n".join(
        f'{name} = {{ register = 0, type = "float32", unit = "{unit}" }}' for name, unit in UNITS.items()
    )
    dead = dead.replace(driver, f'[driver]\ntype = "modbus"\nhost = "127.0.0.1"\nport = 9\n[signals]\n{registers}\n')
    (hall / "dead.toml").write_text(dead, encoding="utf-8")
    for number, name in enumerate(HOSTILE):
        file = f"[machine]\nname = {json.dumps(name)}\n[twin]\nname = {json.dumps(name)}\n"
        (hall / f"hostile-{number}.toml").write_text(file, encoding="utf-8")
    return hall


@contextlib.contextmanager
def own_disk(folder: Path) -> Iterator[bool]:
    """Give a folder a disk of its own, which can be filled; whether that was possible."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK}M,mode=700", "tmpfs", str(folder)]
    is_own = os.geteuid() == 0 and not subprocess.run(mount, check=False, capture_output=True).returncode  # noqa: S603 - our own command
    try:
        yield is_own
    finally:
        if is_own:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)  # noqa: S603, S607 - as above


class FaultyHall:
    """A daemon, what it publishes, and what happens to it."""

    def __init__(self, folder: Path, well: int) -> None:
        self.state, self.log = folder / "state", folder / "daemon.log"
        self._endpoint = f"unixsock-stream/{folder}/reports.sock"
        self._machines = write_faulty_hall(folder, well, self._endpoint)
        self.well = [f"motor-{number:03d}" for number in range(well)]
        self.reports: defaultdict[str, list[ReportDocument]] = defaultdict(list)
        self._received: queue.SimpleQueue[str] = queue.SimpleQueue()
        (folder / "run").mkdir(mode=0o700)
        own = {"XDG_STATE_HOME": str(self.state), "XDG_RUNTIME_DIR": str(folder / "run")}
        self._environment = {**os.environ, **environment_of_unit(), **own}

    @contextlib.contextmanager
    def running(self) -> Iterator["subprocess.Popen[bytes]"]:
        """Run the daemon until each machine that is well has published, and to the end of the context."""
        command = [sys.executable, "-m", "otolith", "run", str(self._machines)]
        self.reports.clear()
        with self.log.open("wb") as log:
            daemon = subprocess.Popen(command, stdout=log, stderr=log, env=self._environment)  # noqa: S603 - our own
        try:
            with Subscriber(Connection((self._endpoint,)), self._received.put):
                deadline = time.monotonic() + PATIENCE
                while not all(self.reports[name] for name in self.well):
                    if daemon.poll() is not None or time.monotonic() > deadline:
                        raise SystemExit(
                            f"not all machines have reports:\n{self.log.read_text(encoding='utf-8')[-3000:]}"
                        )
                    time.sleep(0.1)
                    self.read()
                yield daemon
        finally:
            with contextlib.suppress(ProcessLookupError):
                daemon.send_signal(signal.SIGTERM)
            daemon.wait(timeout=60)
            self.read()

    def read(self) -> None:
        """Take what was published."""
        while not self._received.empty():
            document = ReportDocument.from_json(self._received.get())
            self.reports[document.machine].append(document)

    def children(self, daemon: "subprocess.Popen[bytes]") -> tuple[psutil.Process, psutil.Process]:
        """The oldest worker, and the recorder, once it has recordings open: it may have been started just now."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            children = psutil.Process(daemon.pid).children()
            spawned = [child for child in children if "spawn_main" in " ".join(child.cmdline())]
            recorders = [child for child in spawned if any(file.path.endswith(".rrd") for file in child.open_files())]
            workers = sorted((child for child in spawned if child not in recorders), key=lambda own: own.create_time())
            if recorders and workers:
                return workers[0], recorders[0]
            time.sleep(0.1)
        raise SystemExit(f"no recorder or no worker in {PATIENCE:g} s")

    def during(self, trouble: str, act: Callable[[], None], seconds: float) -> FaultFigures:
        """Let something happen, and return what it cost the machines that are well."""
        self.read()
        before = {name: len(self.reports[name]) for name in self.well}
        act()
        time.sleep(seconds)
        self.read()
        print(trouble, file=sys.stderr)
        return judged(trouble, [self.reports[name][before[name] - 1 :] for name in self.well], seconds)


def judged(trouble: str, reports: Sequence[Sequence[ReportDocument]], seconds: float) -> FaultFigures:
    """Return what something cost machines, of each of which ``reports`` has the last report before it and all since."""
    latencies, on_time, missed, lost = list[float](), 0, 0, 0
    for first, *since in reports:
        own = [1e3 * latency for document in since if (latency := document.cost.latency_s) is not None]
        pairs = list(pairwise((first, *since)))
        windows = sum(_rise(one, other, lambda row: row.windows_missed) for one, other in pairs)
        samples = sum(_rise(one, other, lambda row: row.lost) for one, other in pairs)
        follows = all(other.previous == one.sequence for one, other in pairs)
        enough = len(since) >= int(seconds / WINDOW) - 1
        on_time += bool(
            enough and follows and not windows and not samples and max(own, default=math.inf) <= 1e3 * WINDOW
        )
        missed, lost = missed + windows, lost + samples
        latencies += own
    values = np.array(latencies or [np.nan])
    return FaultFigures(
        trouble, len(reports), on_time, len(latencies), missed, lost,
        float(np.median(values)), float(np.quantile(values, 0.99)), float(values.max()),
    )  # fmt: skip


def _rise(before: ReportDocument, after: ReportDocument, of: Callable[[CountersDocument], int]) -> int:
    return of(after.counters) - of(before.counters) if before.counters and after.counters else 0


def run_troubles(hall: FaultyHall, seconds: float, *, has_disk: bool) -> list[FaultFigures]:
    """Let everything happen that does not end the daemon, then kill it."""
    with hall.running() as daemon:
        time.sleep(SETTLING)

        def child(which: int, what: signal.Signals) -> Callable[[], None]:
            return lambda: os.kill(hall.children(daemon)[which].pid, what)

        rows = [
            hall.during("nothing", lambda: None, seconds),
            hall.during("a worker killed", child(0, signal.SIGKILL), seconds),
            hall.during("the recorder killed", child(1, signal.SIGKILL), seconds),
            hall.during("a worker stopped", child(0, signal.SIGSTOP), 2 * seconds),
            hall.during("the recorder stopped", child(1, signal.SIGSTOP), 3 * seconds),
        ]
        if has_disk:
            rows.append(hall.during("disk full", lambda: fill(hall.state), seconds))
            (hall.state / "ballast").unlink()
            rows.append(hall.during("disk has room again", lambda: None, max(seconds, WRITE_RETRY + WRITING)))

        def stop_all() -> None:
            daemon.send_signal(signal.SIGSTOP)
            time.sleep(STOPPED)
            daemon.send_signal(signal.SIGCONT)

        rows.append(hall.during(f"the daemon stopped for {STOPPED:g} s", stop_all, seconds))
        hall.read()
        daemon.kill()
    return rows


def fill(disk: Path) -> None:
    """Fill a disk."""
    with contextlib.suppress(OSError), (disk / "ballast").open("wb", buffering=0) as ballast:  # ENOSPC
        while True:
            ballast.write(bytes(1 << 16))


def restarted(hall: FaultyHall) -> RestartFigures:
    """Start the daemon that was killed again, and return what became of what it had learned and published."""
    published = {name: {document.sequence for document in hall.reports[name]} for name in hall.well}
    begun = time.monotonic()
    with hall.running():
        elapsed = time.monotonic() - begun
        text = hall.log.read_text(encoding="utf-8")
    learned = [name for name in hall.well if f"{SITE}.{name}: {LEARNED}" in text]
    kept = 0
    for name, numbers in published.items():
        path = hall.state / "otolith" / "history" / f"{SITE}.{name}{SUFFIX}"
        messages = HistoryReader(path).messages("report", 100_000)
        kept += len(numbers & {ReportDocument.from_json(message).sequence for message in messages})
    return RestartFigures(len(hall.well), len(learned), sum(map(len, published.values())), kept, elapsed)


def broken_promises(rows: Sequence[FaultFigures], restart: RestartFigures) -> list[str]:
    """Return what was promised and not kept, a line each."""
    late = [f"{row.trouble}: {row.machines - row.on_time} machines were late" for row in rows
            if row.trouble in STRICT and row.on_time < row.machines]  # fmt: skip
    lost = [f"{row.trouble}: {row.samples_lost} samples lost" for row in rows if row.samples_lost]
    forgotten, missing = restart.machines - restart.learned, restart.published - restart.kept
    late += [f"after the kill: {forgotten} machines had forgotten what they had learned"] if forgotten else []
    return late + lost + ([f"after the kill: {missing} reports are in no history"] if missing else [])


@click.command()
@click.option("--machines", type=click.IntRange(2), default=50, show_default=True, help="One of them diverges.")
@click.option("--seconds", default=30.0, show_default=True, help="Measured for each trouble, at least.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON document.")
def main(machines: int, seconds: float, as_json: bool) -> None:
    """Let everything bad happen to a hall; the exit code is 1 if a promise was not kept."""
    with tempfile.TemporaryDirectory(prefix="otolith-hall-faults-") as name:
        folder = Path(name)
        write_records(folder, RECORDED)
        hall = FaultyHall(folder, machines - 1)
        with own_disk(hall.state) as has_disk:
            if not has_disk:
                print("only root can give the state a disk of its own: none is filled", file=sys.stderr)
            rows = run_troubles(hall, seconds, has_disk=has_disk)
            restart = restarted(hall)
    broken = broken_promises(rows, restart)
    if as_json:
        print(json.dumps({"troubles": [asdict(row) for row in rows], "restart": asdict(restart), "broken": broken}))
        sys.exit(bool(broken))
    table = Table("trouble", "on time", "reports", "missed", "lost samples", "latency 50 / 99 / 100 %, ms")
    for row in rows:
        latency = f"{row.latency_median_ms:.0f} / {row.latency_99_ms:.0f} / {row.latency_max_ms:.0f}"
        table.add_row(row.trouble, f"{row.on_time} of {row.machines}", *map(str, (row.reports, row.windows_missed)),
                      str(row.samples_lost), latency)  # fmt: skip
    again = f"killed and started again: {restart.learned} of {restart.machines} with what was learned"
    again += (
        f", {restart.kept} of {restart.published} reports in the histories, all published in {restart.seconds:.0f} s"
    )
    print_pages(table, again, *broken)
    sys.exit(bool(broken))


if __name__ == "__main__":
    main()
