"""The line of progress: Ctrl-C removes it and ends the command, also where an exception would be dropped."""

import os
import signal
import subprocess
import sys

from tests.waiting import PATIENCE

COMMAND = """
import os, signal, time
signal.signal(signal.SIGINT, signal.SIG_DFL)  # as otolith.__main__ does
from otolith.cli.common import progress_line
with progress_line("working"):
    os.write(1, b"ready\\n")  # Rich redirects print
    while True:
        try:
            time.sleep(60)
        except BaseException:  # as in a callback of the compiler
            pass
"""


def test_ctrl_c_shows_the_cursor_and_ends_the_command() -> None:
    environment = {**os.environ, "TERM": "xterm", "FORCE_COLOR": "1"}  # by which Rich takes the pipe for a terminal
    with subprocess.Popen(
        [sys.executable, "-c", COMMAND], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"ready\n"
            process.send_signal(signal.SIGINT)
            _, shown = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert process.returncode == -signal.SIGINT
    assert shown.count(b"\x1b[?25l") == 1
    assert shown.endswith(b"\r\x1b[2K\x1b[?25h")
