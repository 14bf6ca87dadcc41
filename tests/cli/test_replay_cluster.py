"""``otolith replay --scheduler``: a batch on two local Dask workers has the reports of a serial replay."""

import os
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmarks.cluster import local_cluster

from otolith_drivers.errors import ServiceError
from tests.cli.commands import otolith
from tests.cli.test_replay_batch import plant, serial, written
from tests.drivers.certificates import certificate
from tests.messages import raises_saying

__all__ = ["plant", "serial"]
PATIENCE = 60.0  # s


def wait_until(done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.mark.full
def test_a_cluster_that_loses_a_worker_and_the_client_has_the_reports_of_a_serial_replay(
    plant: Path, serial: dict[str, str], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "otolith", "replay", str(plant / "hall"), str(plant / "data")]
    command += ["--output", str(tmp_path / "out"), "--scheduler"]
    with local_cluster(tmp_path, 2) as cluster:
        client = subprocess.Popen([*command, cluster.address], stderr=subprocess.PIPE)
        wait_until(lambda: (tmp_path / "out").exists() or client.poll() is not None)
        client.kill()
        client.communicate()
        again = subprocess.Popen([*command, cluster.address], stderr=subprocess.PIPE)
        time.sleep(0.5)
        os.killpg(cluster.workers[0].pid, signal.SIGKILL)
        _, told = again.communicate(timeout=PATIENCE)
    assert again.returncode == 0, told
    assert {name: written(tmp_path / "out", name) for name in serial} == serial


def identity(folder: Path, name: str) -> tuple[Path, Path]:
    """Certificate and key in PEM form, of which the certificate is its own authority."""
    made, key = certificate(folder, name)
    path = folder / f"{name}.crt"
    path.write_text(ssl.DER_cert_to_PEM_cert(made.read_bytes()), encoding="ascii")
    return path, key


@pytest.mark.full
def test_a_cluster_with_tls_computes_for_those_who_have_its_certificates(
    plant: Path, serial: dict[str, str], tmp_path: Path
) -> None:
    own, key = identity(tmp_path, "node")
    foreign, foreign_key = identity(tmp_path, "stranger")
    command = ["replay", plant / "hall", plant / "data", "--output", tmp_path / "out", "--scheduler"]
    with local_cluster(tmp_path, 1, (own, own, key)) as cluster:
        assert cluster.address.startswith("tls://")
        with raises_saying(ServiceError, cluster.address):
            otolith(*command, cluster.address, "--ca", own, "--certificate", foreign, "--key", foreign_key)
        otolith(*command, cluster.address, "--ca", own, "--certificate", own, "--key", key)
    assert {name: written(tmp_path / "out", name) for name in serial} == serial


def test_a_scheduler_that_does_not_answer_is_named(
    plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("otolith.runtime.batch.cluster.CONNECT_TIMEOUT", 0.2)
    with raises_saying(ServiceError, "tcp://127.0.0.1:9"):
        otolith("replay", plant / "hall", plant / "data", "--output", tmp_path, "--scheduler", "tcp://127.0.0.1:9")
