"""``otolith view``: recordings of one's own daemons and of services, listed, or opened in the Rerun viewer."""

import contextlib
import getpass
import os
import re
import struct
import subprocess
import sysconfig
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO

import click

from otolith.cli.common import DEMOS, SERVICES, local_time
from otolith.cli.machines import is_file, key_of, zone_of_machine
from otolith.cli.operation.history import Since, age_or_date
from otolith.cli.terminal import echo
from otolith.storage.recording_files import MEGABYTE, RecordingFile, recording_file
from otolith_drivers.errors import ConfigurationError, ServiceError, some_names
from otolith_drivers.replay.sample_names import SAMPLES, viewing_file
from otolith_drivers.user_dirs import cache_directory, state_directory

MAGIC = b"RRF2"  # first bytes of Rerun's files
HEADER_BYTES = 12  # before their first message
MESSAGE = struct.Struct("<QQ")  # before each message: its kind and its length in bytes
END = 0  # kind of the message that closes a file; an index for random access follows
COLOUR = re.compile(r"\x1b\[[0-9;]*m")
ADDRESS = re.compile(r"connect at (?P<address>http://[\w.]+:(?P<port>\d+)\S*)")  # in the log of the viewer
QUIET = re.compile(r"^\S+Z +(INFO|DEBUG|TRACE) ")
LIVE_INTERVAL = 0.5  # s between two looks at a recording that is being written
LOOPBACK = ("--bind", "127.0.0.1", "--port", "auto")  # Rerun's default are all interfaces


@click.command()
@click.argument("recordings", metavar="[MACHINE|FILE]...", nargs=-1)
@click.option("--since", callback=lambda *given: given[-1] and age_or_date(*given), metavar="AGE|DATE",
              help="All recordings from here on, like 12h, 30d, 8w.")  # fmt: skip
@click.option("--list", "only_list", is_flag=True, help="Only list the recordings.")
@click.option("--live", is_flag=True, help="Show what is added to it as well.")
@click.option("--web", is_flag=True, help="For a browser on this computer, instead of a window.")
def view(recordings: tuple[str, ...], since: Since | None, only_list: bool, live: bool, web: bool) -> int:
    """Open the newest recording, or FILE, in the Rerun viewer.

    MACHINE is the name of the machine that it is of, with or without its site, its machine file, or an instance of the
    service.

    \b
    Examples:
      otolith view
      otolith view press-3 --since 2h
      otolith view press-3 --list
      otolith view press-3 --live --web
    """
    if live and (since or only_list):
        raise click.UsageError("--live follows the newest recording: give it without --since and --list")
    if len(recordings) > 1:
        if live or since or only_list or not all(name.endswith(".rrd") for name in recordings):
            raise click.UsageError("several are opened only if all are files (.rrd), without other choices")
        return open_viewer([Path(name) for name in recordings], web=web)
    recording = recordings[0] if recordings else None
    if recording and recording.endswith(SAMPLES):
        recording = str(viewing_file(Path(recording)))
    path = Path(recording) if recording and is_file(recording) and not recording.endswith(".toml") else None
    path = Path(recording) if recording and recording.endswith(".rrd") else path
    if path is not None:
        if since or only_list:
            raise click.UsageError("--since and --list choose among the recordings of a machine, not of a file")
        return follow(lambda: path, web=web) if live else open_viewer([path], web=web)
    machine = key_of(recording) if recording and is_file(recording) else recording or ""
    known, zone = Recordings.search(machine), zone_of_machine(recording or "")
    begin = since.before(time.time(), zone) if since else None
    files = [file for file in known.files if begin is None or file.end >= begin]
    if only_list:
        width = max((len(file.key) for file in files), default=0)
        echo(*(_row(file, width, zone) for file in files))
        echo(*(known.unreadable if files else [known.none_text(begin, zone)]), err=True)
        return 0
    if not files:
        raise ConfigurationError(known.none_text(begin, zone))
    if live:
        return follow(lambda: _newest(machine, files[0]), web=web)
    return open_viewer([file.path for file in (files[:1] if since is None else reversed(files))], web=web)


@dataclass(frozen=True, slots=True)
class Recordings:
    """The recordings that this user can read, the newest first."""

    machine: str
    places: tuple[Path, ...]
    files: tuple[RecordingFile, ...]
    unreadable: tuple[str, ...]  # Folders that this user must not read, and the way out, a line each

    @classmethod
    def search(cls, machine: str) -> "Recordings":
        """Return the recordings of ``machine``, or of all machines if it is empty."""
        own = state_directory()
        services = sorted(SERVICES.iterdir()) if os.access(SERVICES, os.R_OK | os.X_OK) else []
        files: dict[Path, RecordingFile] = {}
        unreadable = [unreadable_text(SERVICES)] if SERVICES.is_dir() and not services else []
        for place in (own, *(folder for folder in services if folder.is_dir())):
            closed = next((folder for folder in (place, place / "recordings") if _is_closed(folder)), None)
            if closed is not None:
                unreadable.append(unreadable_text(closed))
                continue
            of_place = {file.path.resolve(): file for path in place.rglob("*.rrd") for file in _described(path)}
            is_instance = machine == place.name and place != own
            files |= {path: file for path, file in of_place.items() if is_instance or _is_of(file, machine)}
        newest_first = sorted(files.values(), key=lambda file: file.end, reverse=True)
        if machine:  # a demo is shown if there is no machine of that name
            machines = [file for file in newest_first if not file.path.is_relative_to(own / DEMOS)]
            newest_first = machines or newest_first
        return cls(machine, (own, SERVICES), tuple(newest_first), tuple(unreadable))

    def none_text(self, since: float | None, zone: str | None) -> str:
        """Return why there is nothing to open, and what to do."""
        of = f" of {self.machine}" if self.machine else ""
        span = f" since {local_time(since, zone)}" if since else ""
        where = " and ".join(map(str, self.places))
        others = sorted({file.key for file in Recordings.search("").files if file.key}) if self.machine else []
        known = f"there are recordings of {some_names(others)}"
        remedy = known if others else "'otolith run' makes one, or 'otolith replay --recording FILE.rrd'"
        return "; ".join([f"{where}: no recording{of}{span}", *(self.unreadable or (remedy,))])


def _described(path: Path) -> Iterator[RecordingFile]:
    """Yield what is known of a recording; one of another name has no machine."""
    try:
        status = path.stat()
    except OSError:  # deleted meanwhile
        return
    other = RecordingFile(path, "", status.st_mtime, status.st_mtime, status.st_size, is_marked=False)
    yield recording_file(path) or other


def _is_of(file: RecordingFile, machine: str) -> bool:
    return not machine or machine in (file.key, file.key.partition(".")[2])


def _is_closed(path: Path) -> bool:
    return path.exists() and not os.access(path, os.R_OK | os.X_OK if path.is_dir() else os.R_OK)


def unreadable_text(path: Path) -> str:
    """Return that this user must not read ``path``, and which group may."""
    try:
        group = path.group()
    except (OSError, KeyError):
        group = "otolith"
    try:
        user = getpass.getuser()
    except (OSError, KeyError):  # without a name
        user = "USER"
    join = f"'sudo usermod -aG {group} {user}', and log in again"
    return f"{path}: not readable for this user: join group {group}: {join}"


def _row(file: RecordingFile, width: int, zone: str | None) -> str:
    """Return the line of a list: end, length, size, machine, mark, path; the name has begin and machine, or neither."""
    minutes = f"{max(0.0, file.end - file.begin) / 60.0:.0f}" if file.key else "-"
    mark = "event" if file.is_marked else ""
    size = f"{file.size / MEGABYTE:8.1f} MB"
    return f"{local_time(file.end, zone)}  {minutes:>5} min  {size}  {file.key or '-':<{width}}  {mark:<5}  {file.path}"


def open_viewer(paths: Sequence[Path], *, web: bool = False) -> int:
    """Show recordings of which each may still be written; returns the exit code of the viewer.

    Raises:
        ConfigurationError: there is no such recording.
        ServiceError: there is no display, or the viewer is not installed.
    """
    for path in paths:
        _check(path)
    command, environment = _viewer(paths[0], web=web)
    with tempfile.TemporaryDirectory(prefix="otolith-view-") as folder:
        whole = list(_whole(Path(command[0]), paths, Path(folder)))
        with _started([*command, *map(str, whole)], environment, web=web) as viewer:
            try:
                return max(0, viewer.wait())
            except KeyboardInterrupt:
                viewer.terminate()
                return 0


def follow(newest: Callable[[], Path], *, web: bool = False) -> int:
    """Show the ``newest`` recording and what is added to it, then the one that follows it, and so on.

    Returns the exit code of the viewer, and raises as :func:`open_viewer`.
    """
    _check(newest())
    command, environment = _viewer(newest(), web=web)
    with _started([*command, "-"], environment, web=web, stdin=subprocess.PIPE) as viewer:
        assert viewer.stdin is not None  # noqa: S101 - for mypy
        try:
            while viewer.poll() is None:
                with contextlib.suppress(FileNotFoundError), newest().open("rb") as file:  # an event renames it
                    _send(file, viewer, newest)
                time.sleep(LIVE_INTERVAL)
        except (BrokenPipeError, KeyboardInterrupt):  # the viewer was closed, or is to be
            viewer.terminate()
        finally:
            with contextlib.suppress(BrokenPipeError):
                viewer.stdin.close()
        return max(0, viewer.wait())


@contextlib.contextmanager
def _started(
    command: Sequence[str], environment: dict[str, str], *, web: bool, stdin: int | None = None
) -> "Iterator[subprocess.Popen[bytes]]":
    """Start the viewer; with ``web`` one line says what to open, in place of its log."""
    log = subprocess.PIPE if web else None
    with subprocess.Popen(  # noqa: S603 - our viewer
        command, env=environment, stdin=stdin, stdout=log, stderr=log and subprocess.STDOUT
    ) as viewer:
        if viewer.stdout is not None:
            reader = threading.Thread(target=_say_address, args=(viewer.stdout,), daemon=True)
            reader.start()
        yield viewer
        if viewer.stdout is not None:
            reader.join(LIVE_INTERVAL)


def _say_address(log: IO[bytes]) -> None:
    """Print the address that the viewer logs, and how another computer reaches it; of the rest only what is wrong."""
    for line in log:
        text = COLOUR.sub("", line.decode(errors="replace")).rstrip()
        if match := ADDRESS.search(text):
            ports = [match["port"], *re.findall(r"localhost%3A(\d+)", match["address"])]
            tunnel = " ".join(f"-L {port}:127.0.0.1:{port}" for port in ports)
            echo(f"open {match['address']} here, or elsewhere after 'ssh {tunnel} HOST'; Ctrl-C ends it")
        elif not QUIET.search(text):
            echo(text, err=True)


def _send(file: BinaryIO, viewer: "subprocess.Popen[bytes]", newest: Callable[[], Path]) -> None:
    """Give a recording to the viewer as it grows, until there is a newer one or the viewer is closed."""
    assert viewer.stdin is not None  # noqa: S101 - for mypy
    is_last, is_begun = False, False
    while not is_last and viewer.poll() is None:
        is_last = not os.path.samestat(os.fstat(file.fileno()), newest().stat())
        if not is_begun and os.fstat(file.fileno()).st_size >= HEADER_BYTES:
            is_begun = bool(viewer.stdin.write(file.read(HEADER_BYTES)))
        if is_begun:
            viewer.stdin.writelines(whole_messages(file))
        viewer.stdin.flush()
        time.sleep(0.0 if is_last else LIVE_INTERVAL)


def whole_messages(file: BinaryIO) -> Iterator[bytes]:
    """Yield the messages that are complete, from the position of the file on, but not the one that closes it.

    The viewer waits for the rest of a torn message, and takes the header of the next file for it.
    """
    place, size = file.tell(), os.fstat(file.fileno()).st_size
    while place + MESSAGE.size <= size:
        head = file.read(MESSAGE.size)
        kind, length = MESSAGE.unpack(head)
        if kind == END or place + MESSAGE.size + length > size:
            break
        yield head + file.read(length)
        place = file.tell()
    file.seek(place)


def _newest(machine: str, first: RecordingFile) -> Path:
    """Return the newest recording of the machine of ``first``."""
    files = (file for file in Recordings.search(machine).files if file.key == first.key)
    return next(files, first).path


def _viewer(path: Path, *, web: bool) -> tuple[list[str], dict[str, str]]:
    """Return command and environment of the viewer; raise ServiceError without a display or viewer."""
    if not web and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        remedy = "'otolith view --web' serves it to a browser, through a tunnel like 'ssh -L'"
        raise ServiceError(f"no display here: {remedy}; or copy {path} to a computer with one")
    program = Path(sysconfig.get_path("scripts")) / "rerun"
    # Only 'rerun analytics disable' switches its analytics off, by a file; a folder of ours keeps the user's settings.
    environment = {**os.environ, "XDG_CONFIG_HOME": str(cache_directory("viewer"))}
    command = [str(program), "analytics", "disable"]
    # The program may be there without the viewer that it starts: docs/service.md shows how to do without.
    if not program.exists() or subprocess.run(command, env=environment, capture_output=True, check=False).returncode:  # noqa: S603 - our viewer
        raise ServiceError(f"{program}: the Rerun viewer is not installed; copy {path} to a computer that has it")
    return [str(program), *LOOPBACK, *(("--serve-web", "--web-viewer-port", "0") if web else ())], environment


def _check(path: Path) -> None:
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise ConfigurationError(f"{path}: not a Rerun recording")
    except PermissionError as error:
        raise ConfigurationError(unreadable_text(path)) from error
    except OSError as error:
        raise ConfigurationError(f"{path}: no such file; 'otolith view --list' lists the recordings") from error


def _whole(program: Path, paths: Sequence[Path], folder: Path) -> Iterator[Path]:
    """Yield each path, or of a file that was not finished what is whole of it: the viewer refuses a torn one."""
    done = subprocess.run(  # noqa: S603 - our viewer
        [program, "rrd", "verify", *paths], capture_output=True, text=True, check=False
    )
    for number, path in enumerate(paths):
        if done.returncode == 0 or f'"{path}"' not in done.stderr:
            yield path
            continue
        copy = folder / f"{number}-{path.name}"
        command = [str(program), "rrd", "optimize", "--continue-on-error", str(path), "-o", str(copy)]
        subprocess.run(command, capture_output=True, check=False)  # noqa: S603 - our viewer
        yield copy if copy.exists() else path
