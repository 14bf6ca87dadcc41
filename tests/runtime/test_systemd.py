"""sd_notify: what systemd would read from its socket."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from otolith.runtime.systemd import Notifier


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(2.0)
        yield listening


def notifier(manager: socket.socket, **more: str) -> Notifier:
    return Notifier({"NOTIFY_SOCKET": manager.getsockname(), **more})


def test_readiness_status_watchdog_and_stop(manager: socket.socket) -> None:
    said = notifier(manager)
    said.ready("listening:\nCAN")
    said.status("window 3 good")
    said.progress()
    said.stopping()
    said.close()
    got = [manager.recv(4096).decode() for _ in range(4)]
    assert got == [
        f"READY=1\nSTATUS=listening: CAN\nMAINPID={os.getpid()}",
        "STATUS=window 3 good",
        "WATCHDOG=1",
        "STOPPING=1",
    ]


@pytest.mark.parametrize(
    ("environment", "seconds"),
    [({"WATCHDOG_USEC": "30000000"}, 30.0), ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"}, None), ({}, None)],
)
def test_the_watchdog_is_the_one_meant_for_us(
    manager: socket.socket, environment: dict[str, str], seconds: float | None
) -> None:
    said = notifier(manager, **environment)
    assert said.watchdog == seconds
    said.close()


def test_a_manager_that_does_not_read_blocks_nobody(manager: socket.socket) -> None:
    said = notifier(manager)
    for _ in range(1000):
        said.status("x" * 1000)
    said.close()


def test_without_systemd_it_is_silent() -> None:
    said = Notifier({})
    said.ready("")
    said.close()
    assert said.watchdog is None
