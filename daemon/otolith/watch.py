"""``otolith watch``: the live table, or the stream of reports, of daemons in other processes."""

import queue
import sys
from collections.abc import Callable

from rich.console import Console
from rich.live import Live

from otolith.console import Board
from otolith.outlets.zenoh_session import Listener
from otolith.topics import REPORT

ROOM = 100  # reports between the network and a slow terminal
PAUSE = 0.2  # s


def watch_reports(connect: str, machine: str, *, as_json: bool, stopped: Callable[[], bool]) -> None:
    """Until ``stopped``; a daemon that is not there yet is waited for."""
    key = REPORT.under("*", machine)
    heard: queue.Queue[str] = queue.Queue(ROOM)

    def hear(text: str) -> None:
        if heard.full():
            heard.get_nowait()
        heard.put_nowait(text)

    board = Board(f"reports on {connect}, key {key}")
    with Listener([connect], key, hear):
        if as_json:
            while not stopped():
                for text in _drain(heard):
                    sys.stdout.write(text + "\n")
                sys.stdout.flush()
            return
        with Live(board, console=Console(), refresh_per_second=5):
            while not stopped():
                for text in _drain(heard):
                    board.hear(text)


def _drain(heard: "queue.Queue[str]") -> list[str]:
    """What has come, after waiting a moment for the first."""
    found = []
    try:
        found.append(heard.get(timeout=PAUSE))
        while True:
            found.append(heard.get_nowait())
    except queue.Empty:
        return found
