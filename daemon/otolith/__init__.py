"""Otolith: an edge daemon that makes an industrial machine aware of itself.

``from otolith import Twin`` loads the adapted twin of a machine in a notebook: see :class:`otolith.notebook.Twin`.
"""

from importlib import import_module

__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    """Load the API for notebooks when it is asked for: the daemon and the commands do without it."""
    if name == "Twin":
        return import_module("otolith.notebook").Twin
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
