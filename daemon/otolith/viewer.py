"""``otolith view``: the Rerun viewer on a recording."""

import json
import os
import subprocess
import sysconfig
from pathlib import Path

from otolith.errors import ConfigurationError, ServiceError
from otolith.paths import cache_directory, state_directory, writable


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
    program = Path(sysconfig.get_path("scripts")) / "rerun"
    if not program.exists():
        raise ServiceError(f"{program}: the Rerun viewer is not installed beside Otolith; copy {path} to where it is")
    command = [str(program), "--bind", "127.0.0.1", "--port", "auto", str(path)]
    return subprocess.run(command, env=_quiet(), check=False).returncode  # noqa: S603


def _quiet() -> dict[str, str]:
    """An environment in which the viewer sends no analytics: it knows no option for that, only its own file."""
    folder = writable(cache_directory() / "viewer")
    writable(folder / "rerun")
    settings = {"analytics_enabled": False, "analytics_id": "", "metadata": {}}
    (folder / "rerun" / "analytics.json").write_text(json.dumps(settings), encoding="utf-8")
    return {**os.environ, "XDG_CONFIG_HOME": str(folder)}
