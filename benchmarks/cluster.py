"""Recordings of many machines, replayed by one process and by a Dask cluster on this computer.

    python -m benchmarks.cluster --machines 8 --minutes 20 --workers 2

Each machine is a DC motor at 100 Hz in windows of 2 s; a share of them has a winding that loses turns. The same files
are replayed twice by ``otolith replay --output``: with ``--jobs 1``, and with ``--scheduler`` on workers of one thread,
of which one is killed on request. Both times include the start of the command and of its processes; workers of the
cluster run already, but have computed nothing. Compared are the bytes of all reports.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import click
from rich.table import Table

from benchmarks.command_line import print_pages
from benchmarks.hall import RATE, write_records

PATIENCE = 60.0  # s for scheduler and workers to start
MACHINE = """[machine]
name = "motor-{number:03d}"
[twin]
name = "dc_motor"
[parameters]
D = {{ value = "0.00143 N*m*s/rad", estimate = true }}
R_a = {{ value = "6.5 ohm", estimate = true, low = "3 ohm", high = "12 ohm" }}
[noise]
i = "5 mA"
omega = "0.02 rad/s"
T_load = "0.2 mN*m"
"""
HEADER = "t,V_a,T_load,i,omega\n"


@dataclass(frozen=True, slots=True)
class LocalCluster:
    """A scheduler and workers on this computer."""

    address: str
    workers: tuple["subprocess.Popen[bytes]", ...]


@dataclass(frozen=True, slots=True)
class ClusterFigures:
    """What the replays took."""

    machines: int
    machine_days: float
    workers: int
    reports: int
    serial_s: float
    cluster_s: float
    speed_up: float
    machine_days_per_hour: float  # On the cluster
    killed: int  # Workers
    is_same: bool  # Whether all reports are the same, bit for bit


@contextlib.contextmanager
def local_cluster(folder: Path, workers: int, tls: tuple[Path, Path, Path] | None = None) -> Iterator[LocalCluster]:
    """Yield a cluster whose workers are ready; each process is in a group of its own.

    ``tls`` are the certificate of the authority, and the certificate and key of all processes.
    """
    from distributed import Client, Security  # noqa: PLC0415 - of the extra

    file, started = folder / "scheduler.json", list[subprocess.Popen[bytes]]()
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    security, options = None, list[str]()
    if tls is not None:
        ca, certificate, key = map(str, tls)
        security = Security(  # type: ignore[no-untyped-call]
            tls_ca_file=ca, tls_client_cert=certificate, tls_client_key=key, require_encryption=True
        )
        options = ["--protocol", "tls", "--tls-ca-file", ca, "--tls-cert", certificate, "--tls-key", key]

    def start(*arguments: str) -> None:
        command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(file), "--no-dashboard", *options]
        with (folder / "dask.log").open("ab") as log:
            started.append(
                subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)  # noqa: S603 - our own command
            )

    try:
        start("scheduler", "--host", "127.0.0.1", "--port", "0")
        deadline = time.monotonic() + PATIENCE
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        for _ in range(workers):
            start("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(folder))
        address = json.loads(file.read_text(encoding="utf-8"))["address"]
        with Client(address, security=security, set_as_default=False) as client:  # type: ignore[no-untyped-call]  # dask leaves it untyped
            client.wait_for_workers(workers, timeout=PATIENCE)
        yield LocalCluster(address, tuple(started[1:]))
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def write_plant(folder: Path, machines: int, minutes: float, files: int, faulty: float) -> None:
    """Write machine files and recordings, ``files`` of each machine."""
    records = folder / "records"
    records.mkdir()
    write_records(records, 60.0 * minutes)
    for number in range(machines):
        name = f"motor-{number:03d}"
        (folder / "hall").mkdir(exist_ok=True)
        (folder / "hall" / f"{name}.toml").write_text(MACHINE.format(number=number), encoding="utf-8")
        (folder / "data" / name).mkdir(parents=True)
        record = records / ("faulty.csv" if number < faulty * machines else "healthy.csv")
        rows = record.read_text(encoding="utf-8").splitlines(keepends=True)[1:]
        size = -(-len(rows) // files)
        for part in range(files):
            text = "".join([HEADER, *rows[part * size : (part + 1) * size]])
            (folder / "data" / name / f"{part:05d}.csv").write_text(text, encoding="utf-8")


def replayed(folder: Path, output: str, *options: str) -> "subprocess.Popen[bytes]":
    """Start the replay of all machines."""
    command = [sys.executable, "-m", "otolith", "replay", "hall", "data", "--output", output, *options]
    environment = {**os.environ, "XDG_STATE_HOME": str(folder / "state")}
    with (folder / f"{output}.log").open("ab") as log:
        return subprocess.Popen(command, cwd=folder, stderr=log, env=environment)  # noqa: S603 - our own command


def finished(process: "subprocess.Popen[bytes]", folder: Path) -> None:
    """Wait for the end of a replay; raise SystemExit if it failed."""
    if process.wait():
        logs = [path.read_text(encoding="utf-8") for path in folder.glob("*.log")]
        raise SystemExit("\n".join(["a replay failed", *logs]))


def reports_in(folder: Path) -> dict[str, bytes]:
    """Return the reports of each machine."""
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.jsonl"))}


def measure(folder: Path, machines: int, minutes: float, workers: int, *, kill: bool) -> ClusterFigures:
    """Replay what :func:`write_plant` has written, by one process and by a cluster."""
    begun = time.monotonic()
    finished(replayed(folder, "serial", "--jobs", "1"), folder)
    serial = time.monotonic() - begun
    with local_cluster(folder, workers) as cluster:
        begun = time.monotonic()
        process = replayed(folder, "cluster", "--scheduler", cluster.address)
        if kill:
            time.sleep(serial / workers / 2)
            os.killpg(cluster.workers[0].pid, signal.SIGKILL)
        finished(process, folder)
        parallel = time.monotonic() - begun
    one, other = reports_in(folder / "serial"), reports_in(folder / "cluster")
    days = machines * minutes / 1440.0
    count = sum(content.count(b"\n") for content in other.values())
    speeds = serial / parallel, days / parallel * 3600.0
    return ClusterFigures(machines, days, workers, count, serial, parallel, *speeds, int(kill), one == other)


@click.command()
@click.option("--machines", default=8, show_default=True, type=click.IntRange(1))
@click.option("--minutes", default=20.0, show_default=True, help="Of recordings of each machine.")
@click.option("--files", default=4, show_default=True, help="Of each machine.")
@click.option("--workers", default=2, show_default=True, type=click.IntRange(1))
@click.option("--faulty", default=0.1, show_default=True, help="Share of the machines with a fault.")
@click.option("--kill", is_flag=True, help="Kill a worker in the middle.")
@click.option("--json", "as_json", is_flag=True, help="Print a JSON document.")
def main(machines: int, minutes: float, files: int, workers: int, faulty: float, kill: bool, as_json: bool) -> None:
    """Replay recordings of many machines by one process, and by a cluster on this computer."""
    with tempfile.TemporaryDirectory(prefix="otolith-cluster-") as name:
        write_plant(Path(name), machines, minutes, files, faulty)
        figures = measure(Path(name), machines, minutes, workers, kill=kill)
    if as_json:
        print(json.dumps(asdict(figures), indent=2))
        return
    table = Table("machine-days", "reports", "one process, s", "cluster, s", "speed-up", "machine-days/h", "the same")
    seconds = f"{figures.serial_s:.1f}", f"{figures.cluster_s:.1f}"
    rates = f"{figures.speed_up:.2f}", f"{figures.machine_days_per_hour:.2f}"
    table.add_row(f"{figures.machine_days:.3f}", str(figures.reports), *seconds, *rates, str(figures.is_same))
    print_pages(table, f"{machines} motors at {RATE} Hz, {workers} workers of one thread, {figures.killed} killed")


if __name__ == "__main__":
    main()
