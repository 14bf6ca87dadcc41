"""``otolith watch``: the live table, or the stream of reports, of daemons in other processes."""

import queue
import sys
import time
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.live import Live

from otolith.console import Board
from otolith.outlets.zenoh_session import Listener
from otolith.topics import REPORT

ROOM = 100  # reports between the network and a slow terminal
PAUSE = 0.2  # s
PATIENCE = 5.0  # s without a report, after which the stream says what it waits for


def watch_reports(connect: Sequence[str], machine: str, *, as_json: bool, stopped: Callable[[], bool]) -> None:
    """Until ``stopped``; a daemon that is not there yet is waited for."""
    key = REPORT.under("*", machine)
    heard: queue.Queue[str] = queue.Queue(ROOM)

    def hear(text: str) -> None:
        if heard.full():
            heard.get_nowait()
        heard.put_nowait(text)

    with Listener(connect, key, hear) as listener:

        def state() -> str:
            nobody = "no daemon reached yet, --connect asks elsewhere"
            found = f"connected, waiting for {key}" if listener.connected else nobody
            return f"{found} ({', '.join(connect)})"

        if as_json:
            _stream(heard, state, stopped)
            return
        board = Board(state)
        with Live(board, console=Console(), refresh_per_second=5):
            while not stopped():
                for text in _drain(heard):
                    board.hear(text)


def _stream(heard: "queue.Queue[str]", state: Callable[[], str], stopped: Callable[[], bool]) -> None:
    """Reports as lines; what is waited for is said on standard error, once per change."""
    begun, said = time.monotonic(), ""
    while not stopped():
        lines = _drain(heard)
        for text in lines:
            sys.stdout.write(text + "\n")
        sys.stdout.flush()
        if not lines and time.monotonic() - begun > PATIENCE and state() != said:
            said = state()
            sys.stderr.write(f"{said}\n")
        begun = time.monotonic() if lines else begun


def _drain(heard: "queue.Queue[str]") -> list[str]:
    """What has come, after waiting a moment for the first."""
    found = []
    try:
        found.append(heard.get(timeout=PAUSE))
        while True:
            found.append(heard.get_nowait())
    except queue.Empty:
        return found
