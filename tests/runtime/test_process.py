"""Child processes: a process that cannot be started, or dies, is restarted with growing pauses."""

import os
import signal
import struct
import threading
import time
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import pytest

from otolith.runtime.process import FIRST_RESTART_PAUSE, MAX_RESTART_PAUSE, ChildProcess
from tests.messages import assert_each_says
from tests.waiting import PATIENCE, wait_for, within


def test_a_failed_spawn_counts_as_a_death(monkeypatch: pytest.MonkeyPatch) -> None:
    def out_of_descriptors(*_: object) -> None:
        raise OSError(24, "Too many open files")

    child = ChildProcess("child", "time:sleep", room=1)
    monkeypatch.setattr(ChildProcess, "_spawn", out_of_descriptors)
    child.start()
    assert not child.alive
    assert child.replies() == []
    assert child.may_restart(100.0)
    child.start()
    assert not child.may_restart(100.0)
    assert child.may_restart(100.0 + FIRST_RESTART_PAUSE)
    child.stop(0.1)
    assert child.starts == 2


def test_restart_pauses_double_until_the_backoff_is_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ChildProcess, "_spawn", lambda *_: None)
    child, pauses = ChildProcess("child", "time:sleep", room=1), []
    for _ in range(9):
        now = 0.0
        while not child.may_restart(now):
            now += 0.25
        pauses.append(now)
        child.start()
    assert pauses[:4] == [0.0, 0.5, 1.0, 2.0]
    assert pauses[-1] == MAX_RESTART_PAUSE
    child.reset_backoff()
    assert child.may_restart(0.0)


def echo(connection: Any) -> None:
    """Main function of a child: return each message, and whether SIGTERM is blocked."""
    while (message := connection.recv()) is not None:
        connection.send((message, signal.SIGTERM in signal.pthread_sigmask(signal.SIG_BLOCK, [])))


def test_a_child_gets_messages_but_no_group_signals() -> None:
    child = ChildProcess("echo", "tests.runtime.test_process:echo", room=2)
    child.start()
    assert child.offer("a")
    replies: list[object] = []

    def has_replied() -> bool:
        replies.extend(child.replies())
        return bool(replies)

    wait_for(has_replied)
    assert replies == [("a", True)]
    child.stop(PATIENCE)
    assert not child.alive


def test_a_write_that_a_busy_computer_delays_reaches_no_later_child(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread that sends is stopped just before it writes to a child, until that is dead and the next one runs."""
    begun, proceeds, ended = threading.Event(), threading.Event(), threading.Event()

    def write(descriptor: int, data: bytes) -> int:
        if begun.is_set():
            return os.write(descriptor, data)
        begun.set()
        assert proceeds.wait(PATIENCE)
        try:
            return os.write(descriptor, data)
        finally:
            ended.set()

    child = ChildProcess("echo", "tests.runtime.test_process:echo", room=2)
    child.start()
    monkeypatch.setattr("multiprocessing.connection.Connection._send.__defaults__", (write,))
    child.offer("to the first")
    assert begun.wait(PATIENCE)
    child.kill()
    child.start()
    proceeds.set()
    assert ended.wait(PATIENCE)
    child.offer("to the second")
    replies: list[object] = []

    def has_replied() -> bool:
        replies.extend(child.replies())
        return bool(replies)

    try:
        wait_for(has_replied)
    finally:
        child.kill()
    assert replies == [("to the second", True)]


@pytest.mark.timed
def test_offer_never_waits_for_a_child_that_does_not_read() -> None:
    child = ChildProcess("stuck", "tests.runtime.test_process:sleep", room=2)
    child.start()
    begun = time.monotonic()
    accepted = [child.offer(bytes(1 << 20)) for _ in range(20)]
    assert time.monotonic() - begun < within(0.5)
    assert not all(accepted)
    child.kill()


def sleep(connection: Any) -> None:
    """Main function of a child that never reads."""
    del connection
    time.sleep(60.0)


def test_a_death_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """A full disk delays the restart, not the message."""
    child = ChildProcess("echo", "tests.runtime.test_process:echo", room=2)
    child.start()
    assert child._process is not None
    os.kill(child._process.pid, signal.SIGKILL)
    wait_for(lambda: not child.alive)
    for _ in range(3):
        child.may_restart(0.0)
        child.count_failed_start()
    child.stop(0.0)
    assert_each_says(caplog.messages, ("echo", "-9", "started again"))


def fail(connection: Any) -> None:
    """Main function of a child that finds its folder gone."""
    del connection
    Path("/nowhere/folder").stat()


def test_a_file_that_is_gone_gives_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    child = ChildProcess("recorder", "tests.runtime.test_process:fail", room=2)
    child.start()
    wait_for(lambda: not child.alive)
    child.stop(PATIENCE)
    assert_each_says(capfd.readouterr().err.splitlines(), ("recorder", "No such file", "'/nowhere/folder'"))


def freeze_within_a_message(connection: Any) -> None:
    """Main function of a child that sends a message, and stops in the middle of the next one."""
    connection.send("whole")
    os.write(connection.fileno(), struct.pack("!i", 1 << 20) + b"half")
    time.sleep(60.0)


@pytest.mark.timed
def test_a_child_that_freezes_within_a_message_delays_nobody() -> None:
    child = ChildProcess("frozen", "tests.runtime.test_process:freeze_within_a_message", room=1)
    child.start()
    replies: list[object] = []

    def has_replied() -> bool:
        wait(child.waitables, timeout=0.1)
        replies.extend(child.replies())
        return bool(replies)

    wait_for(has_replied)
    begun = time.monotonic()
    for _ in range(3):
        assert child.replies() == []
    assert time.monotonic() - begun < within(0.5)
    assert replies == ["whole"]
    child.kill()
    assert not child.alive


def answer_and_end(connection: Any) -> None:
    """Main function of a child that ends with its answer."""
    connection.send(bytes(1 << 20))


def test_what_a_child_sent_before_its_end_is_received() -> None:
    child = ChildProcess("last words", "tests.runtime.test_process:answer_and_end", room=1)
    child.start()
    sizes: list[int] = []
    while child.alive:
        wait(child.waitables, timeout=0.1)
        sizes += map(len, child.replies())
    assert sizes == [1 << 20]
    child.stop(0.0)


def confuse(connection: Any) -> None:
    """Main function of a child that sends what is no message."""
    os.write(connection.fileno(), struct.pack("!i", 4) + b"what")
    time.sleep(60.0)


def test_what_is_no_message_ends_nobody(caplog: pytest.LogCaptureFixture) -> None:
    child = ChildProcess("confused", "tests.runtime.test_process:confuse", room=1)
    child.start()
    wait_for(lambda: child._inbox is not None and not child._inbox.is_open)
    assert child.replies() == []
    assert_each_says(caplog.messages, ("confused", "cannot be read"))
    assert wait(child.waitables, timeout=0.05) == []  # nobody waits in vain for it
    child.kill()


def test_a_child_that_freezes_before_it_reads_its_arguments_delays_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state of a machine may be larger than what a pipe takes before somebody reads it."""
    resource_tracker.ensure_running()
    frozen = tmp_path / "frozen"
    frozen.write_text("#!/bin/sh\nexec sleep 20\n", encoding="ascii")
    frozen.chmod(0o700)
    monkeypatch.setattr("multiprocessing.spawn.get_executable", lambda: os.fsencode(frozen))
    child = ChildProcess("frozen", "tests.runtime.test_process:answer_and_end", room=1)
    starting = threading.Thread(target=child.start, args=(bytes(1 << 20),), daemon=True)
    starting.start()
    starting.join(within(5.0))
    assert not starting.is_alive()
    assert child.alive
    child.kill()
    assert not child.alive


def answer_size(connection: Any, content: bytes) -> None:
    """Main function of a child that answers the size of its argument."""
    connection.send(len(content))


def test_a_child_gets_arguments_of_any_size() -> None:
    child = ChildProcess("large", "tests.runtime.test_process:answer_size", room=1)
    child.start(bytes(1 << 22))
    replies: list[object] = []

    def has_replied() -> bool:
        replies.extend(child.replies())
        return bool(replies)

    wait_for(has_replied)
    assert replies == [1 << 22]
    child.kill()
