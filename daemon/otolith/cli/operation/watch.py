"""``otolith watch``: the live table, or the stream of reports, of daemons in other processes.

``otolith view``: the Rerun viewer on a recording.
"""

import os
import queue
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import click
from rich.console import Console
from rich.live import Live

from otolith.cli.common import drain
from otolith.cli.operation.daemons import Daemons
from otolith.cli.operation.live_table import LiveTable
from otolith.publishing.zenoh_config import Credentials
from otolith.publishing.zenoh_session import REPORT
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.user_dirs import cache_directory, state_directory

# Engineering choices without a test of their own.
MAX_QUEUED = 100  # reports kept for a slow terminal; the oldest are dropped
PAUSE = 0.2  # s; how late a stop is noticed
PATIENCE = 5.0  # s without a report until the stream prints what it waits for
MAGIC = b"RRF2"  # first bytes of Rerun's files


def watch_reports(
    connect: Sequence[str], credentials: Credentials, machine: str, *, as_json: bool, stopped: Callable[[], bool]
) -> None:
    """Show reports until ``stopped``; wait for a daemon that is not there yet."""
    key = REPORT.under("*", machine)
    texts: queue.Queue[str] = queue.Queue(MAX_QUEUED)

    def receive(text: str) -> None:
        if texts.full():
            texts.get_nowait()
        texts.put_nowait(text)

    with Daemons(connect, key, receive, credentials) as daemons:
        if as_json:
            _stream(texts, daemons, stopped)
            return
        table = LiveTable(daemons.state)
        with Live(table, console=Console(), refresh_per_second=5):
            while not stopped():
                daemons.refresh()
                for text in drain(texts, PAUSE):
                    table.add(text)


def _stream(texts: "queue.Queue[str]", daemons: Daemons, stopped: Callable[[], bool]) -> None:
    """Print reports as lines; print the state to standard error when it changes while no report comes."""
    latest, printed = time.monotonic(), ""
    while not stopped():
        daemons.refresh()
        lines = drain(texts, PAUSE)
        sys.stdout.writelines(f"{line}\n" for line in lines)
        sys.stdout.flush()
        if lines:
            latest = time.monotonic()
        elif time.monotonic() - latest > PATIENCE and daemons.state() != printed:
            printed = daemons.state()
            sys.stderr.write(f"{printed}\n")


def _recordings() -> list[Path]:
    """All recordings in the state directory, the newest first."""
    return sorted(state_directory().rglob("*.rrd"), key=lambda path: path.stat().st_mtime, reverse=True)


def list_recordings() -> None:
    """Print the paths of all recordings in the state directory, the newest first."""
    paths = _recordings()
    for path in paths:
        click.echo(path)
    if not paths:
        click.echo(f"no recordings under {state_directory()}", err=True)


def open_viewer(path: Path | None) -> int:
    """Show ``path``, or the newest recording; returns the exit code of the viewer.

    Raises:
        ConfigurationError: there is no such recording.
        ServiceError: there is no display, or the viewer is not installed.
    """
    if path is None:
        path = next(iter(_recordings()), None)
    if path is None:
        raise ConfigurationError(
            f"{state_directory()}: no recording; 'otolith run' makes one, or 'otolith replay --recording FILE.rrd'"
        )
    if not path.is_file():
        raise ConfigurationError(f"{path}: no such file; 'otolith view --list' lists the recordings")
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ConfigurationError(f"{path}: not a Rerun recording")
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ServiceError(f"no display here: copy {path} to a computer with one, and open it with 'rerun' there")
    program = Path(sysconfig.get_path("scripts")) / "rerun"
    if not program.exists():
        raise ServiceError(f"{program}: the Rerun viewer is not installed; copy {path} to a computer that has it")
    # Only 'rerun analytics disable' switches its analytics off, by a file; a folder of ours keeps the user's settings.
    environment = {**os.environ, "XDG_CONFIG_HOME": str(cache_directory("viewer"))}
    subprocess.run([program, "analytics", "disable"], env=environment, capture_output=True, check=False)  # noqa: S603
    command = [str(program), "--bind", "127.0.0.1", "--port", "auto", str(path)]
    return subprocess.run(command, env=environment, check=False).returncode  # noqa: S603
