"""A hall of machines in one daemon: what it costs, and whether every report is on time.

    python -m benchmarks.hall --machines 20 --machines 50 --seconds 60

Each machine is a DC motor whose record of 100 Hz is replayed in real time, in windows of 2 s; a share of them has a
winding that loses turns. Of some of them (``--can``) the record is sent by another process, as two frames for each
row, on virtual CAN buses (``--buses``). The daemon is ``otolith run FOLDER`` in the environment of its unit. Measured
are, from the moment at which all workers are ready: processor time and memory (PSS, of all its processes), the latency
of reports (from the end of a window until it is published), the windows that were missed, and by how much the
histories grow. Exponents say how the costs grow with the number of machines.

A computer that is busy with something else delays reports and lets windows be missed. Memory is the same on it, and
while no window is missed also bytes and the processor time for each window.
"""

import contextlib
import csv
import json
import math
import os
import queue
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path

import click
import numpy as np
import psutil
from rich.table import Table

from benchmarks.command_line import print_pages
from benchmarks.hall_buses import driver_table, free_port, sending
from otolith.health.schema import CountersDocument, ReportDocument
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith_drivers.plant.scenario import load_scenario, simulate

ROOT = Path(__file__).parents[1]
CONFIG, UNIT = ROOT / "config", ROOT / "systemd" / "otolith.service"
SIGNALS = {"V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed"}
RATE = 100  # records per second
WINDOW = 2.0  # s
SETTLING = 10.0  # s from the first report of the last machine until it is measured
PATIENCE = 300.0  # s until the first report of the last machine
MACHINE = """[machine]
name = "{name}"
site = "hall"
{driver}
[twin]
name = "dc_motor"
[parameters]
D = {{ value = "0.00143 N*m*s/rad", estimate = true }}
[parameters.R_a]
value = "6.5 ohm"
estimate = true
low = "3 ohm"
high = "12 ohm"
watch = ["-2 %", "+45 %"]
act = ["-5 %", "+65 %"]
[noise]
i = "5 mA"
omega = "0.02 rad/s"
T_load = "0.2 mN*m"
[zenoh]
listen = ["{endpoint}"]
"""

REPLAY = """[driver]
type = "replay"
file = "{record}.csv"
repeat = true
[signals]
V_a = {{}}
T_load = {{}}
i = {{}}
omega = {{}}
"""


@dataclass(frozen=True, slots=True)
class HallFigures:
    """What one hall cost."""

    machines: int
    on_buses: int  # Of them, those whose frames came over a bus
    seconds: float  # Measured
    cores: float  # Processor time of all processes, per second
    cores_of_each: tuple[float, ...]  # First the process that acquires, as for memory
    ms_per_window: float  # Processor time of all processes for each window that was due
    pss_mb: float
    pss_of_each_mb: tuple[float, ...]  # First the process that acquires
    threads: int  # Of the process that acquires
    latency_median_ms: float
    latency_99_ms: float
    latency_max_ms: float
    reports: int
    windows_missed: int
    samples_lost: int
    history_bytes: int  # By which the histories grew


def environment_of_unit() -> dict[str, str]:
    """Return the variables that the unit of a hall sets."""
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    settings = [line.removeprefix("Environment=") for line in lines if line.startswith("Environment=")]
    return dict(pair.split("=", 1) for setting in settings for pair in setting.split())


def write_records(folder: Path, seconds: float) -> None:
    """Write the records of a healthy and of a faulty motor."""
    scenario = load_scenario(CONFIG / "scenarios" / "demo.toml")
    records = {"healthy": scenario.model_copy(update={"faults": ()}), "faulty": scenario}
    for name, each in records.items():
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as stream:
            rows = csv.writer(stream)
            rows.writerow(["t", *SIGNALS])
            for number, tick in enumerate(islice(simulate(each), round(seconds * RATE))):
                rows.writerow(
                    [f"{number / RATE:.2f}", *(f"{tick.measured[signal]:.6g}" for signal in SIGNALS.values())]
                )


@dataclass(frozen=True, slots=True)
class Hall:
    """The files of a hall, and what its buses carry."""

    folder: Path
    port: int
    buses: list[list[Path]]  # The records of the machines on each

    @property
    def on_buses(self) -> int:
        """How many machines are on buses."""
        return sum(map(len, self.buses))


def write_hall(folder: Path, machines: int, faulty: float, endpoint: str, can: float = 0.0, buses: int = 4) -> Hall:
    """Write the machine files of a hall, of which the share ``can`` is on so many buses."""
    hall = Hall(folder / f"hall-{machines}", free_port(), [[] for _ in range(buses)])
    hall.folder.mkdir()
    for name in ("healthy", "faulty"):
        (hall.folder / f"{name}.csv").symlink_to(folder / f"{name}.csv")
    for number in range(machines):
        record = "faulty" if number < faulty * machines else "healthy"
        driver = REPLAY.format(record=record)
        if machines - number <= round(can * machines):  # the last ones
            bus = number % buses
            driver = driver_table(bus, hall.port, len(hall.buses[bus]))
            hall.buses[bus].append(folder / f"{record}.csv")
        text = MACHINE.format(name=f"motor-{number:03d}", driver=driver, endpoint=endpoint)
        (hall.folder / f"motor-{number:03d}.toml").write_text(text, encoding="utf-8")
    return hall


def pss(process: psutil.Process) -> float:
    """Return the memory of a process in MB, with its share of what is shared."""
    lines = Path(f"/proc/{process.pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def measure(hall: Hall, machines: int, seconds: float, folder: Path, endpoint: str) -> HallFigures:
    """Run a daemon for the machines of a hall, and return what it cost."""
    paths = [next(hall.folder.glob("*.toml"))] if machines == 1 else [hall.folder]
    state = folder / f"state-{machines}"
    environment = {
        **os.environ,
        **environment_of_unit(),
        "XDG_STATE_HOME": str(state),
        "XDG_RUNTIME_DIR": str(folder / "run"),
    }
    (folder / "run").mkdir(mode=0o700, exist_ok=True)
    received: queue.SimpleQueue[str] = queue.SimpleQueue()
    command = [sys.executable, "-m", "otolith", "run", *map(str, paths)]
    with sending(hall.port, RATE, hall.buses), (folder / f"daemon-{machines}.log").open("wb") as log:
        daemon = subprocess.Popen(command, stdout=log, stderr=log, env=environment)  # noqa: S603 - our own command
        try:
            with Subscriber(Connection((endpoint,)), received.put):
                known = _wait_for_all(received, machines, daemon)
                time.sleep(SETTLING)
                known |= {document.machine: document for document in _taken(received)}
                return _measured(daemon, received, known, (seconds, hall.on_buses), state)
        finally:
            daemon.send_signal(signal.SIGTERM)
            daemon.wait(timeout=60)


def _taken(received: "queue.SimpleQueue[str]") -> list[ReportDocument]:
    """Return the reports that were received until now."""
    return [ReportDocument.from_json(received.get()) for _ in range(received.qsize())]


def _wait_for_all(
    received: "queue.SimpleQueue[str]", machines: int, daemon: "subprocess.Popen[bytes]"
) -> dict[str, ReportDocument]:
    """Wait until each machine has a report, and return the last one of each."""
    deadline, seen = time.monotonic() + PATIENCE, dict[str, ReportDocument]()
    while len(seen) < machines:
        if daemon.poll() is not None or time.monotonic() > deadline:
            raise SystemExit(f"only {len(seen)} of {machines} machines have reports")
        with contextlib.suppress(queue.Empty):
            document = ReportDocument.from_json(received.get(timeout=1.0))
            seen[document.machine] = document
    return seen


def _measured(
    daemon: "subprocess.Popen[bytes]",
    received: "queue.SimpleQueue[str]",
    known: Mapping[str, ReportDocument],
    run: tuple[float, int],
    state: Path,
) -> HallFigures:
    """Measure; ``known`` has the last report of each machine before, ``run`` the time in s and machines on buses."""
    seconds, on_buses = run
    root = psutil.Process(daemon.pid)
    tree = [root, *root.children(recursive=True)]
    spent, begun = [sum(each.cpu_times()[:2]) for each in tree], time.monotonic()
    bytes_before = _history_bytes(state)
    time.sleep(seconds)
    elapsed = time.monotonic() - begun
    cores = tuple((sum(each.cpu_times()[:2]) - one) / elapsed for each, one in zip(tree, spent, strict=True))
    memory = [pss(each) for each in tree]
    documents = _taken(received)
    latencies = np.array([document.cost.latency_s for document in documents], dtype=np.float64) * 1e3
    last = {document.machine: document.counters for document in documents}
    pairs = [(known[name].counters, counters) for name, counters in last.items()]

    def rise(of: Callable[[CountersDocument], int]) -> int:
        return sum(of(after) - of(before) for before, after in pairs if before is not None and after is not None)

    return HallFigures(
        machines=len(known),
        on_buses=on_buses,
        seconds=elapsed,
        cores=sum(cores),
        cores_of_each=cores,
        ms_per_window=sum(cores) * 1e3 * WINDOW / len(known),
        pss_mb=sum(memory),
        pss_of_each_mb=tuple(memory),
        threads=root.num_threads(),
        latency_median_ms=float(np.median(latencies)),
        latency_99_ms=float(np.quantile(latencies, 0.99)),
        latency_max_ms=float(latencies.max()),
        reports=len(documents),
        windows_missed=rise(lambda counters: counters.windows_missed),
        samples_lost=rise(lambda counters: counters.lost),
        history_bytes=_history_bytes(state) - bytes_before,
    )


def _history_bytes(state: Path) -> int:
    """Return the size of all histories, with what is not yet in their tables."""
    return sum(path.stat().st_size for path in state.rglob("*.sqlite*") if not path.name.endswith("-shm"))


def exponents(figures: Sequence[HallFigures]) -> dict[str, float]:
    """Return how processor time and memory grow with the number of machines: 1 is in proportion to it."""
    machines = np.log([each.machines for each in figures])
    return {
        name: float(np.polyfit(machines, np.log([getattr(each, name) for each in figures]), 1)[0])
        for name in ("cores", "pss_mb", "history_bytes")
        if len(figures) > 1
    }


@click.command()
@click.option("--machines", multiple=True, type=click.IntRange(1), default=(1, 20, 50), show_default=True)
@click.option("--seconds", default=60.0, show_default=True, help="Measured for each hall.")
@click.option("--faulty", default=0.1, show_default=True, help="Share of the machines with a fault.")
@click.option("--can", default=0.0, show_default=True, help="Share of the machines that are on CAN buses.")
@click.option("--buses", default=4, show_default=True, type=click.IntRange(1, 200), help="CAN buses.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON document.")
def main(machines: tuple[int, ...], seconds: float, faulty: float, can: float, buses: int, as_json: bool) -> None:
    """Measure halls of machines."""
    figures = []
    with tempfile.TemporaryDirectory(prefix="otolith-hall-") as name:
        folder = Path(name)
        write_records(folder, 90.0)
        for count in machines:
            endpoint = f"unixsock-stream/{folder}/reports-{count}.sock"
            hall = write_hall(folder, count, faulty, endpoint, can, buses)
            figures.append(measure(hall, count, seconds, folder, endpoint))
            print(asdict(figures[-1]), file=sys.stderr)
    if as_json:
        print(json.dumps({"halls": [asdict(each) for each in figures], "exponents": exponents(figures)}, indent=2))
        return
    titles = (
        "machines",
        "on CAN",
        "cores",
        "ms per window",
        "PSS, MB",
        "latency 50 / 99 / 100 %, ms",
        "reports",
        "missed",
    )
    table = Table(*titles, "lost samples", "history, kB")
    for each in figures:
        latency = f"{each.latency_median_ms:.0f} / {each.latency_99_ms:.0f} / {each.latency_max_ms:.0f}"
        row = (
            each.machines,
            each.on_buses,
            f"{each.cores:.2f}",
            f"{each.ms_per_window:.1f}",
            f"{each.pss_mb:.0f}",
            latency,
            each.reports,
            each.windows_missed,
            each.samples_lost,
            f"{each.history_bytes / 1e3:.0f}",
        )
        table.add_row(*map(str, row))
    grown = ", ".join(f"{name} {value:.2f}" for name, value in exponents(figures).items())
    print_pages(table, f"exponents of machines: {grown or math.nan}")


if __name__ == "__main__":
    main()
