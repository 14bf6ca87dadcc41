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

from rich.console import Console
from rich.live import Live

from otolith.cli.live_table import LiveTable
from otolith.publishing.zenoh_session import REPORT, Listener
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.user_dirs import cache_directory, state_directory

MAGIC = b"RRF2"  # of Rerun's files


def recordings() -> list[Path]:
    """All recordings in the state directory, the newest first."""
    found = state_directory().rglob("*.rrd")
    return sorted(found, key=lambda path: path.stat().st_mtime, reverse=True)


def open_viewer(path: Path | None) -> int:
    """Show ``path``, or the newest recording; the viewer's exit code.

    Raises:
        ConfigurationError: there is no such recording.
        ServiceError: the viewer is not installed.
    """
    if path is None:
        path = next(iter(recordings()), None)
    if path is None or not path.is_file():
        raise ConfigurationError(
            f"{path or state_directory()}: no recording; 'otolith view --list' shows what there is"
        )
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ConfigurationError(f"{path}: this is no recording")
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ServiceError(f"no display here: copy {path} to a computer with one, and open it with 'rerun' there")
    program = Path(sysconfig.get_path("scripts")) / "rerun"
    if not program.exists():
        raise ServiceError(f"{program}: the Rerun viewer is not installed beside Otolith; copy {path} to where it is")
    command = [str(program), "--bind", "127.0.0.1", "--port", "auto", str(path)]
    return subprocess.run(command, env=_quiet(), check=False).returncode  # noqa: S603


def _quiet() -> dict[str, str]:
    """An environment in which the viewer sends no analytics.

    It knows no option for that, only a file that ``rerun analytics disable`` writes; a folder of ours keeps
    the user's settings as they are.
    """
    environment = {**os.environ, "XDG_CONFIG_HOME": str(cache_directory("viewer"))}
    program = str(Path(sysconfig.get_path("scripts")) / "rerun")
    subprocess.run([program, "analytics", "disable"], env=environment, capture_output=True, check=False)  # noqa: S603
    return environment


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
        board = LiveTable(state)
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
