"""Notifications to systemd: what arrives at its socket."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from otolith.runtime.hall.notifier import Notifier


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver:
        receiver.bind(str(tmp_path / "notify"))
        receiver.settimeout(2.0)
        yield receiver


def notifier_for(manager: socket.socket, **environment: str) -> Notifier:
    return Notifier({"NOTIFY_SOCKET": manager.getsockname(), **environment})


def test_every_notification_arrives_with_one_line_per_assignment(manager: socket.socket) -> None:
    notifier = notifier_for(manager)
    notifier.send("READY=1", "STATUS=listening:\nCAN", f"MAINPID={os.getpid()}")
    notifier.send("STATUS=window 3 good")
    notifier.send("WATCHDOG=1")
    notifier.close()
    received = [manager.recv(4096).decode() for _ in range(3)]
    assert received == [
        f"READY=1\nSTATUS=listening:\\nCAN\nMAINPID={os.getpid()}",
        "STATUS=window 3 good",
        "WATCHDOG=1",
    ]


@pytest.mark.parametrize(
    ("environment", "seconds"),
    [({"WATCHDOG_USEC": "30000000"}, 30.0), ({"WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "1"}, None), ({}, None)],
)
def test_a_watchdog_for_another_process_is_ignored(
    manager: socket.socket, environment: dict[str, str], seconds: float | None
) -> None:
    notifier = notifier_for(manager, **environment)
    assert notifier.watchdog == seconds
    notifier.close()


def test_send_never_blocks_on_a_full_queue(manager: socket.socket) -> None:
    notifier = notifier_for(manager)
    for _ in range(1000):
        notifier.send("STATUS=" + "x" * 1000)
    notifier.close()


def test_without_systemd_nothing_is_sent() -> None:
    notifier = Notifier({})
    notifier.send("READY=1")
    notifier.close()
    assert notifier.watchdog is None
