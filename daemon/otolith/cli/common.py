"""What commands have in common as processes: how they are asked to end, and where they log."""

import logging
import os
import signal
import sys
from pathlib import Path
from types import FrameType


class NobodyReads(Exception):  # noqa: N818 - the reader of our output has seen enough, which is no error
    """Not an OSError, as click would make exit code 1 of a broken pipe."""


class StopSignal:
    """Remembers the signal that asks this command to end."""

    def __init__(self) -> None:
        self.number: int | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup leaves SIGHUP
                signal.signal(number, self._take)

    def code(self, clean: int | None = None) -> int:
        """The exit code, as a shell counts signals; 0 for the signal that is the ordinary way to end."""
        return 0 if self.number is None or self.number == clean else 128 + self.number

    def _take(self, number: int, _: FrameType | None) -> None:
        self.number = number


def log_to_stderr(*, verbose: bool) -> None:
    """To standard error; under systemd with the priority that journald understands."""
    handler = logging.StreamHandler(sys.stderr)
    if "JOURNAL_STREAM" in os.environ:
        handler.setFormatter(_Journal("%(name)s: %(message)s"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s", "%H:%M:%S"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.getLogger("otolith").setLevel(logging.DEBUG if verbose else logging.INFO)
    logging.getLogger("otolith_drivers").setLevel(logging.DEBUG if verbose else logging.INFO)


class _Journal(logging.Formatter):
    PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (logging.NOTSET, 7))

    def format(self, record: logging.LogRecord) -> str:
        priority = next(number for level, number in self.PRIORITIES if record.levelno >= level)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


def examples_directory() -> Path:
    """The machine files to copy from: inside an installed package, or beside the sources of a checkout."""
    installed = Path(__file__).parents[1] / "config"
    return installed if installed.is_dir() else Path(__file__).parents[3] / "config"
