"""The state of a connection that fails and returns, whichever driver has it."""

import errno
import logging
import re
import socket
import ssl

import pytest

from otolith_drivers.common.reconnection import (
    BACKOFF_FIRST,
    BACKOFF_MAX,
    LASTING,
    LINE_PERIOD,
    LINES,
    Reconnection,
    cause_of,
)
from tests.messages import assert_each_says


def test_a_pause_grows_until_the_connection_lasts() -> None:
    """A broker may accept a client and close its connection at once, for ever."""
    now = 0.0
    connection = Reconnection("line", logging.getLogger("test"), lambda: now)
    pauses = []
    for _ in range(10):
        pauses.append(connection.backoff.next())
        connection.come_up("answers")
        connection.go_down("the connection was closed")
    for number, pause in enumerate(pauses):
        longest = min(BACKOFF_FIRST * 2.0**number, BACKOFF_MAX)
        assert 0.5 * longest <= pause <= longest
    connection.come_up("answers")
    now += LASTING
    connection.go_down("the connection was closed")
    assert connection.backoff.next() <= BACKOFF_FIRST


def test_each_change_is_logged_once_and_each_return_counted(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    connection = Reconnection("line", logging.getLogger("test"))
    assert (connection.up, connection.reason) == (False, "not opened yet")
    for _ in range(2):
        connection.come_up("answers")
        connection.come_up("answers")
        assert (connection.up, connection.reason) == (True, "")
        for _ in range(3):
            connection.stay_down("waiting")  # between two attempts
            connection.go_down("no answer")
        assert (connection.up, connection.reason) == (False, "no answer")
    assert connection.count == 1
    assert_each_says(caplog.messages, *[("line", "answers"), ("line", "no answer", "again")] * 2)


def test_a_connection_that_fails_once_a_minute_for_a_day_has_few_lines_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    now = 0.0
    connection = Reconnection("line", logging.getLogger("test"), lambda: now)
    for _ in range(1440):
        connection.come_up("answers")
        now += 55.0
        for reason in ("the connection was closed", "Connection refused"):
            now += 2.5
            connection.go_down(reason)
    assert connection.count == 1439
    assert len(caplog.messages) <= LINES + 86400 / LINE_PERIOD
    left_out = [int(found[1]) for line in caplog.messages if (found := re.search(r"\((\d+) lines", line))]
    assert 0.95 * 3 * 1440 < len(caplog.messages) + sum(left_out) <= 3 * 1440 + len(left_out)
    caplog.clear()
    for _ in range(int(LINE_PERIOD)):  # it stays down: the log says so in the end
        now += 1.5
        connection.go_down("no answer")
    assert_each_says(caplog.messages, ("line", "no answer", "lines"))


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (OSError(errno.ECONNREFUSED, "Connect call failed ('127.0.0.1', 4840)"), "Connection refused"),
        (socket.gaierror(socket.EAI_NONAME, "Name or service not known"), "Name or service not known"),
        (ConnectionError("the connection was closed"), "the connection was closed"),
        (
            ssl.SSLError(1, "[SSL: WRONG_VERSION_NUMBER] wrong version number"),
            "TLS fails: [SSL: WRONG_VERSION_NUMBER] wrong version number",
        ),
        (ValueError(), "ValueError"),
    ],
)
def test_a_cause_is_the_text_of_the_system_without_prefixes(error: Exception, cause: str) -> None:
    assert cause_of(error) == cause
