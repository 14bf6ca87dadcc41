"""``otolith watch``: the live table, or the stream of reports, of daemons in other processes."""

import queue
import sys
import threading
import time
from collections.abc import Callable

from rich.console import Console
from rich.live import Live

from otolith.cli.common import drain
from otolith.cli.operation.live_table import LiveTable
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection

# Engineering choices without a test of their own.
MAX_QUEUED = 100  # reports that wait for a slow terminal; later ones come from the history
PAUSE = 0.2  # s; how late a stop is noticed
PATIENCE = 5.0  # s without a report until the stream prints what it waits for


def watch_reports(
    connection: Connection, machine: str, *, as_json: bool, after: int | None, stopped: Callable[[], bool]
) -> None:
    """Show reports until ``stopped``; wait for a daemon that is not there yet.

    As JSON each report is printed once and in order, beginning after the sequence number ``after``.
    """
    texts: queue.Queue[str] = queue.Queue(MAX_QUEUED)
    ended = threading.Event()

    def receive(text: str) -> None:
        while not (stopped() or ended.is_set()):  # meanwhile the history keeps the reports for a slow reader
            try:
                texts.put(text, timeout=PAUSE)
            except queue.Full:
                continue
            return

    with Subscriber(connection, receive, machine, after=after) as subscriber:
        try:
            if as_json:
                _stream(texts, subscriber.state, stopped)
                return
            table = LiveTable(subscriber.state)
            with Live(table, console=Console(), refresh_per_second=5):
                while not stopped():
                    for text in drain(texts, PAUSE):
                        table.add(text)
        finally:
            ended.set()


def _stream(texts: "queue.Queue[str]", state: Callable[[], str], stopped: Callable[[], bool]) -> None:
    """Print reports as lines; print the state to standard error when it changes while no report comes."""
    latest, printed = time.monotonic(), ""
    while not stopped():
        lines = drain(texts, PAUSE)
        sys.stdout.writelines(f"{line}\n" for line in lines)
        sys.stdout.flush()
        if lines:
            latest = time.monotonic()
        elif time.monotonic() - latest > PATIENCE and state() != printed:
            printed = state()
            sys.stderr.write(f"{printed}\n")
