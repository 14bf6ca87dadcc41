"""A daemon that can neither save, record nor listen estimates the machine, and says what it lacks."""

import os
import queue
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from otolith.health.observations import DAEMON
from otolith.health.schema import ReportDocument, Status
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from tests.conftest import EXAMPLES, free_port
from tests.waiting import PATIENCE


@pytest.mark.parametrize("until_it_is_an_event", [False, pytest.param(True, marks=pytest.mark.full)])
def test_a_daemon_without_a_state_directory_estimates_and_says_so(tmp_path: Path, until_it_is_an_event: bool) -> None:
    """A file in the place of the directory stands for a read-only disk, which does not stop root."""
    (tmp_path / "state").write_text("")
    free, busy = (f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(2))
    port = int(busy.rpartition(":")[2])
    command = [sys.executable, "-m", "otolith", "run", str(EXAMPLES / "dc-motor-in-process.toml")]
    command += ["--listen", busy, "--listen", free, "--listen", "local"]
    environment = {**os.environ, "XDG_STATE_HOME": str(tmp_path / "state"), "XDG_RUNTIME_DIR": ""}
    received: queue.SimpleQueue[str] = queue.SimpleQueue()
    with socket.create_server(("127.0.0.1", port)), Subscriber(Connection((free,)), received.put):
        daemon = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)
        outages, is_estimated, deadline = set[str](), False, time.monotonic() + 6 * PATIENCE
        try:
            while not is_estimated or (until_it_is_an_event and len(outages) < 3):
                assert time.monotonic() < deadline, outages
                assert daemon.poll() is None
                try:
                    report = ReportDocument.from_json(received.get(timeout=1.0))
                except queue.Empty:
                    continue
                is_estimated |= report.parameters["R_a"].status is Status.ESTIMATED
                outages |= {event.text.partition(":")[0] for event in report.events if event.part == DAEMON}
            daemon.send_signal(signal.SIGTERM)
            assert daemon.wait(timeout=PATIENCE) == 0
        finally:
            daemon.kill()
            _, log = daemon.communicate()
    expected = (
        {"recording", "reports on local", f"reports on {busy.partition(':')[0]}"} if until_it_is_an_event else set()
    )
    assert expected <= outages
    assert all(f"no {what}" in log.decode() for what in (f"reports on {busy}", "reports on local", "recording"))
    assert (tmp_path / "state").read_text() == ""
