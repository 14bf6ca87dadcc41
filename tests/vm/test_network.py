"""Attacks of another user on a service that publishes on the network. Runs in the guest, as root."""

import json
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from subprocess import PIPE

import pytest

from otolith.publishing.zenoh_config import Credentials, reader_settings
from tests.conftest import free_port
from tests.publishing import attacker
from tests.vm.conftest import PATIENCE, ReportListener, counters, run
from tests.vm.service import PROGRAM, STRANGER, Instance, holds_truth, simulated_machine

NAME = "gate"
# Connections whose handshake never ends: a byte of each every half second.
TRICKLE = """
import socket, sys, time
held = [socket.create_connection(("127.0.0.1", int(sys.argv[1])), 60.0) for _ in range(600)]
print("begun", flush=True)
while True:
    for connection in tuple(held):
        try:
            connection.sendall(bytes([1]))
        except OSError:
            held.remove(connection)
    time.sleep(0.5)
"""
# Connections that bring anything but a handshake, one after the other.
FLOOD = """
import random, socket, sys
noise = random.Random(1)
print("begun", flush=True)
while True:
    try:
        with socket.create_connection(("127.0.0.1", int(sys.argv[1])), 5.0) as connection:
            connection.sendall(noise.randbytes(2000))
    except OSError:
        pass
"""


class Gate(Instance):
    """A service with TLS, whose reader is the control room."""

    def __init__(self, folder: Path) -> None:
        super().__init__(NAME)
        self.port = free_port(socket.SOCK_STREAM)
        self.endpoint = f"tls/127.0.0.1:{self.port}"
        keys, own = folder / "keys", folder / "machine" / "keys"
        own.mkdir(parents=True)
        run(PROGRAM, "keys", "init", str(keys))
        run(PROGRAM, "keys", "add", str(keys), NAME, "--host", "127.0.0.1")
        for reader in ("control-room", "visitor"):
            run(PROGRAM, "keys", "add", str(keys), reader)
        for name in ("ca.crt", f"{NAME}.crt", f"{NAME}.key"):
            shutil.copy2(keys / name, own)
        self.keys = keys
        tables = (
            f'[zenoh]\nlisten = ["local", "{self.endpoint}"]\n[zenoh.access]\nreaders = ["control-room"]\n'
            f'[zenoh.tls]\nca = "keys/ca.crt"\ncertificate = "keys/{NAME}.crt"\nkey = "keys/{NAME}.key"\n'
        )
        self.install(simulated_machine(folder / "machine", tables, NAME))

    def credentials(self, reader: str | None) -> Credentials:
        """Those of a reader; without a certificate those that anybody has."""
        own = (None, None) if reader is None else (self.keys / f"{reader}.crt", self.keys / f"{reader}.key")
        return Credentials(self.keys / "ca.crt", *own)

    def listener(self) -> ReportListener:
        """The control room."""
        return ReportListener(self.endpoint, self.failure, self.credentials("control-room"))


@pytest.fixture(scope="module")
def gate(compiled: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gate]:
    made = Gate(tmp_path_factory.mktemp(NAME))
    run("systemctl", "start", made.unit)
    yield made
    run("systemctl", "stop", made.unit)


@contextmanager
def stranger(program: str, port: int) -> Iterator[None]:
    """A program of another user, once it has begun."""
    command = ["nice", sys.executable, "-c", program, str(port)]
    with subprocess.Popen(command, user=int(STRANGER), group=int(STRANGER), extra_groups=(), stdout=PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"begun\n"
        try:
            yield
            assert process.poll() is None
        finally:
            process.kill()


def attacked(endpoint: str, credentials: Credentials | None) -> str:
    """First and last line of what an attacker prints, who may read the files of ``credentials``."""
    settings = {} if credentials is None else reader_settings(credentials, [endpoint])
    given = {"connect": endpoint, "settings": settings}
    command = [sys.executable, attacker.__file__, json.dumps(given)]
    done = subprocess.run(command, capture_output=True, text=True, input="", timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_without_a_certificate_nobody_gets_in(gate: Gate) -> None:
    with closing(gate.listener()) as control_room:
        control_room.wait_for_good(2)
        assert attacked(gate.endpoint, gate.credentials(None)) == "refused\n"
        assert attacked(gate.endpoint.replace("tls/", "tcp/"), None) == "refused\n"
        # Its session opens, but nothing passes in either direction.
        assert attacked(gate.endpoint, gate.credentials("visitor")) == "attacked\n[]\n"
        reader = attacked(gate.endpoint, gate.credentials("control-room"))
        assert attacker.FORGED not in reader.splitlines()[1]
        control_room.wait_for_good(2)  # it would fail at a forged report


def test_only_the_configured_endpoint_listens(gate: Gate) -> None:
    with closing(gate.listener()) as control_room:
        control_room.wait_for_good(1)
    sockets = run("ss", "--no-header", "--numeric", "--processes", "--listening", "--tcp", "--udp", "--raw", "--packet")
    ours = [line.split() for line in sockets.splitlines() if f"pid={gate.shown('MainPID')}," in line]
    assert [(line[0], line[4]) for line in ours] == [("tcp", f"127.0.0.1:{gate.port}")]


def test_slow_handshakes_keep_nobody_out(gate: Gate) -> None:
    with closing(gate.listener()) as control_room:
        control_room.wait_for_good(1)
        with stranger(TRICKLE, gate.port), closing(gate.listener()) as late:
            late.wait_for_good(3)
            control_room.wait_for_good(3)
        check_unharmed(gate, control_room)


def test_a_flood_reaches_neither_readers_nor_the_socket(gate: Gate) -> None:
    """It may keep new readers out of the endpoint that it floods, as docs/security.md says, but only so long."""
    (path,) = Path(f"/run/otolith/{NAME}").glob("*.sock")
    with closing(gate.listener()) as control_room:
        control_room.wait_for_good(1)
        with stranger(FLOOD, gate.port):
            with closing(ReportListener(f"unixsock-stream/{path}", gate.failure)) as local:
                local.wait_for_good(3)
            control_room.wait_for_good(3)
        with closing(gate.listener()) as late:
            late.wait_for_good(1)
        check_unharmed(gate, control_room)


def check_unharmed(gate: Gate, control_room: ReportListener) -> None:
    holds_truth(control_room.reports[-1])
    assert counters(control_room.reports).worker_restarts == 0
    assert gate.shown("NRestarts") == "0"
