"""``otolith replay --scheduler``: a batch on two local Dask workers has the reports of a serial replay."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from otolith_drivers.errors import ServiceError
from tests.cli.commands import otolith
from tests.cli.test_replay_batch import plant, serial, written
from tests.messages import raises_saying

__all__ = ["plant", "serial"]
PATIENCE = 60.0  # s
Cluster = tuple[str, list["subprocess.Popen[bytes]"]]


def wait_until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    """A scheduler on this computer with two workers, in process groups of their own."""
    file, environment = tmp_path / "scheduler.json", {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    started = list[subprocess.Popen[bytes]]()

    def start(*arguments: str) -> None:
        command = [sys.executable, "-m", "dask", *arguments, "--scheduler-file", str(file), "--no-dashboard"]
        with (tmp_path / "dask.log").open("ab") as log:
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
        started.append(process)

    start("scheduler", "--host", "127.0.0.1", "--port", "0")
    try:
        wait_until(file.exists)
        for _ in range(2):
            start("worker", "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
        yield json.loads(file.read_text(encoding="utf-8"))["address"], started
    finally:
        for process in started:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def with_two_workers(address: str) -> None:
    code = f"from distributed import Client; Client({address!r}).wait_for_workers(2, timeout={PATIENCE})"
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


@pytest.mark.full
def test_a_cluster_that_loses_a_worker_and_the_client_has_the_reports_of_a_serial_replay(
    cluster: Cluster, plant: Path, serial: dict[str, str], tmp_path: Path
) -> None:
    address, (_, worker, _) = cluster
    with_two_workers(address)
    command = [sys.executable, "-m", "otolith", "replay", str(plant / "hall"), str(plant / "data")]
    command += ["--output", str(tmp_path / "out"), "--scheduler", address]
    client = subprocess.Popen(command, stderr=subprocess.PIPE)
    wait_until(lambda: (tmp_path / "out").exists() or client.poll() is not None)
    client.kill()
    client.communicate()
    again = subprocess.Popen(command, stderr=subprocess.PIPE)
    time.sleep(0.5)
    os.killpg(worker.pid, signal.SIGKILL)
    _, told = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, told
    assert {name: written(tmp_path / "out", name) for name in serial} == serial


def test_a_scheduler_that_does_not_answer_is_named(
    plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("otolith.runtime.batch.cluster.CONNECT_TIMEOUT", 0.2)
    with raises_saying(ServiceError, "tcp://127.0.0.1:9"):
        otolith("replay", plant / "hall", plant / "data", "--output", tmp_path, "--scheduler", "tcp://127.0.0.1:9")
