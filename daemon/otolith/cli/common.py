"""What the commands share: arguments, options of readers, the signal to stop, logging, progress, and folders."""

import functools
import logging
import os
import queue
import re
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import click

from otolith.cli.terminal import JournalFormatter, LogFormatter, echo
from otolith_drivers.errors import ServiceError

SERVICES = Path("/var/lib/otolith")  # state directories of the services: systemd/otolith@.service, otolith.service
INSTALLED = Path("/etc/otolith")  # machine files of the instances of otolith@.service
HALL = "hall"  # folder of the machine files of otolith.service in INSTALLED, and of their state in SERVICES
DEMOS = "demo"  # folder in the state directory with one for each demo, whose names sort by time
INTERRUPTED = 128 + signal.SIGINT  # exit code of a command that Ctrl-C ended, as a shell reports it
STEP_TIMEOUT, BREAK_INTERVAL = 2.0, 0.5  # s until a step is broken off after a signal; until that is tried again
PAUSE = 0.05  # s between two looks for a signal
FILE = click.Path(path_type=Path, dir_okay=False)
DATA_FILES = click.argument("data", type=FILE, nargs=-1, required=True)
ANY_DATA_FILES = click.argument("data", type=FILE, nargs=-1)


def _machine_file(_: click.Context, __: click.Parameter, given: str) -> Path:
    from otolith.cli.machines import file_of

    return file_of(given)


def _machine_paths(_: click.Context, __: click.Parameter, given: tuple[str, ...]) -> tuple[Path, ...]:
    from otolith.cli.machines import file_of

    return tuple(Path(text) if Path(text).is_dir() else file_of(text) for text in given)


MACHINE_FILE = click.argument("file", metavar="FILE|MACHINE", callback=_machine_file)


def _machine_or_folder(_: click.Context, __: click.Parameter, given: str) -> Path:
    return _machine_paths(_, __, (given,))[0]


MACHINE_OR_FOLDER = click.argument("path", metavar="FILE|MACHINE|DIRECTORY", callback=_machine_or_folder)
MACHINES = click.argument("paths", metavar="PATH...", nargs=-1, required=True, callback=_machine_paths)
AS_JSON = click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")


def use_state_of_service(machine: Path | str) -> bool:
    """Use the state of the service with this machine file or of this name, if it is one; return whether it is used.

    A ``STATE_DIRECTORY`` that is set is kept. Raises ServiceError if this user may not.
    """
    name = service_of(machine) if isinstance(machine, Path) else machine
    folder = SERVICES / (name or "")
    if not name or "STATE_DIRECTORY" in os.environ or not folder.is_dir():
        return False
    if not os.access(folder, os.W_OK):
        raise ServiceError(f"{folder}: state of a service, which root and its own user may read: try it with sudo")
    os.environ["STATE_DIRECTORY"] = str(folder)
    return True


def service_of(machine: Path) -> str:
    """Return the name of the service with this machine file, as its folder of state has it; empty if it is none."""
    folder = machine.absolute().parent
    return machine.stem if folder == INSTALLED else HALL if folder == INSTALLED / HALL else ""


def restart_command(machine: Path) -> str:
    """Return how the daemon of a machine file is started again."""
    if name := service_of(machine):
        return f"systemctl restart otolith{'' if name == HALL else f'@{name}'}"
    return f"stop the daemon, then 'otolith run {machine}'"


def new_file(_: click.Context, __: click.Parameter, path: Path | None) -> Path | None:
    """Return the file of an option; raise BadParameter if it exists, or its folder does not."""
    if path is not None and path.exists():
        raise click.BadParameter(f"{str(path)!r} exists: choose another name, or delete it first")
    if path is not None and not path.parent.is_dir():
        raise click.BadParameter(f"{str(path)!r}: there is no folder {str(path.parent)!r}: make it first")
    return path


class _OverdueError(BaseException):
    """The step that a signal asked to end has not ended; like KeyboardInterrupt, no other exception."""


class StopSignal:
    """Remembers the signal that asks this command to end."""

    def __init__(self) -> None:
        self._number: int | None = None
        self._is_ending = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP, and that stays so
                signal.signal(number, self._receive)

    def release(self) -> None:
        """From now on a signal ends the command at once: one that waits for a person looks at no flag."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) == self._receive:
                signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)

    def received(self) -> bool:
        """Whether a signal has come."""
        return self._number is not None

    def wait(self, seconds: float) -> None:
        """Return after ``seconds``, or soon after a signal."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0 and not self.received():
            time.sleep(min(left, PAUSE))

    def code(self, clean: int | None = None) -> int:
        """Exit code: 0 without a signal and for the signal ``clean``, else 128 plus the number of the signal."""
        return 0 if self._number is None or self._number == clean else 128 + self._number

    @contextmanager
    def ending(self) -> Iterator[None]:
        """In this block, a step that goes on ``STEP_TIMEOUT`` after a signal is broken off, and the block ends."""
        signal.signal(signal.SIGALRM, self._break_off)
        self._is_ending = True
        try:
            if self._number is not None:
                self._give_time()
            yield
        except _OverdueError:
            pass
        finally:
            self._is_ending = False
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _give_time(self) -> None:
        # Again and again: some libraries drop an exception that is raised in a call back from their native code.
        signal.setitimer(signal.ITIMER_REAL, STEP_TIMEOUT, BREAK_INTERVAL)

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self._is_ending and self._number is None:
            self._give_time()
        self._number = number

    def _break_off(self, _: int, __: FrameType | None) -> None:
        if self._is_ending:
            raise _OverdueError


def log_to_stderr(*, verbose: bool) -> None:
    """Log to standard error; under systemd with the priority prefix that journald reads."""
    handler = logging.StreamHandler(sys.stderr)
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(JournalFormatter("%(name)s: %(message)s"))
    else:
        handler.setFormatter(LogFormatter("%(asctime)s %(levelname)-7s %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    for name in ("otolith", "otolith_drivers"):
        logging.getLogger(name).setLevel(logging.DEBUG if verbose else logging.INFO)


@contextmanager
def progress_line(first: str, *, enabled: bool = True) -> Iterator[Callable[[str], None]]:
    """A function that shows a text on a line of standard error, if that is a terminal and ``enabled``."""
    from rich.text import Text

    from otolith.cli.console import Terminal

    console = Terminal(stderr=True)
    console.quiet = not (enabled and console.is_terminal)
    if not console.quiet and signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, _end_with_cursor)
    with console.status(Text(first)) as status:
        yield lambda text: status.update(Text(text))


def _end_with_cursor(number: int, _: FrameType | None) -> None:
    """Remove the line of progress, show the cursor, and end by the signal; the compiler would drop an exception."""
    os.write(sys.stderr.fileno(), b"\r\x1b[2K\x1b[?25h")
    signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)


def drain(texts: "queue.Queue[str]", timeout: float) -> list[str]:
    """All texts in the queue; waits up to ``timeout`` s for the first."""
    drained = []
    try:
        drained.append(texts.get(timeout=timeout))
        while True:
            drained.append(texts.get_nowait())
    except queue.Empty:
        return drained


def echo_warnings(data: Path, lines: Iterable[str]) -> None:
    """Print what a replay of ``data`` warns of, to standard error."""
    echo(*(f"{data}: {line}" for line in lines), err=True)


def local_time(seconds: float, zone: str | None) -> str:
    """Unix ``seconds`` as date and time in the zone of a machine, with its name; without one in that of this computer.

    Every command tells times by it.
    """
    from otolith.health.times import moment_text

    return moment_text(seconds, zone)


def shipped_directory(name: str) -> Path:
    """The folder ``config`` or ``systemd``: in an installed package, or beside the sources of a checkout."""
    installed = Path(__file__).parents[1] / name
    return installed if installed.is_dir() else Path(__file__).parents[3] / name


def endpoints(_: click.Context, option: click.Parameter, written: tuple[str, ...]) -> tuple[str, ...]:
    """Return what ``--connect`` or ``--listen`` gives; raise BadParameter for a text that is no endpoint."""
    for endpoint in written:
        is_local = option.name == "listen" and endpoint == "local"
        if not (is_local or re.fullmatch(r"[a-z-]+/\S+", endpoint)):
            raise click.BadParameter(f"{endpoint!r} is no endpoint: write it like tcp/127.0.0.1:7447")
    return written


def reader_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a reader; the command receives ``connect`` and ``credentials``."""

    @functools.wraps(command)
    def wrapped(
        ca: Path | None, certificate: Path | None, key: Path | None, login: Path | None, **options: Any
    ) -> object:
        from otolith.publishing.zenoh_config import Credentials

        return command(credentials=Credentials(ca, certificate, key, login), **options)

    for option in (
        click.option("--login", type=FILE, envvar="OTOLITH_LOGIN", help="File with a line name:password."),
        click.option("--key", type=FILE, envvar="OTOLITH_KEY", help="Private key of the certificate."),
        click.option("--certificate", type=FILE, envvar="OTOLITH_CERTIFICATE", help="Own certificate."),
        click.option("--ca", type=FILE, envvar="OTOLITH_CA", help="Certificate of the site's CA, for tls/ endpoints."),
        click.option("--connect", multiple=True, callback=endpoints, metavar="ENDPOINT", envvar="OTOLITH_CONNECT",
                     help="Where daemons publish; may be repeated.  [default: their sockets on this computer]"),
    ):  # fmt: skip
        wrapped = option(wrapped)
    return wrapped
