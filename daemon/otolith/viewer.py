"""``otolith view``: the Rerun viewer on a recording."""

import os
import subprocess
import sysconfig
from pathlib import Path

from otolith.errors import ConfigurationError, ServiceError
from otolith.paths import cache_directory, state_directory

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
