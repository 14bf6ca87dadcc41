"""Where files are: the private folders of :mod:`otolith_drivers.private`, and the examples that travel with Otolith."""

from pathlib import Path

from otolith_drivers.private import cache_directory, complain_unless_writable, state_directory, writable

__all__ = ["cache_directory", "complain_unless_writable", "examples_directory", "state_directory", "writable"]


def examples_directory() -> Path:
    """The machine files to copy from: inside an installed package, or beside the sources of a checkout."""
    installed = Path(__file__).parent / "config"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "config"
