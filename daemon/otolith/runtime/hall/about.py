"""Which machine a line of the log is about, where one service serves several."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_ABOUT = ContextVar("about", default="")


@contextmanager
def about(machine: str) -> Iterator[None]:
    """Let each line that this thread logs begin with the name of a machine meanwhile, unless it is empty."""
    token = _ABOUT.set(machine)
    try:
        yield
    finally:
        _ABOUT.reset(token)


def name_machines_in_log() -> None:
    """Let all handlers of the log write which machine a line is about."""
    for handler in logging.getLogger().handlers:
        handler.addFilter(_with_machine)


def _with_machine(record: logging.LogRecord) -> bool:
    if (machine := _ABOUT.get()) and not record.msg.startswith(f"{machine}: "):
        record.msg = f"{machine.replace('%', '%%')}: {record.msg}"
    return True
