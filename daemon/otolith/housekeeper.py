"""The thread that waits for the disk, so that no other does: it keeps components, and hears the specialist."""

import logging
import threading
import time
from collections import deque

from otolith.errors import OtolithError
from otolith.keeping import Keeper
from otolith.specialist import Decisions, Kept

log = logging.getLogger(__name__)

EVERY = 0.5  # s between two looks at the specialist's file
AGAIN = 30.0  # s after which what the disk did not take is tried once more


class Housekeeper:
    """Of one machine. Others exchange values with it and never wait; a newer value takes the place of an older one."""

    def __init__(self, keeper: Keeper, stamp: float) -> None:
        """``stamp`` is of the specialist's word that is known already."""
        self._keeper, self._stamp = keeper, stamp
        self._to_keep: deque[tuple[Kept, ...]] = deque(maxlen=1)
        self._heard: deque[Decisions] = deque(maxlen=1)
        self._wake, self._ends = threading.Event(), threading.Event()
        self._unsaved: tuple[Kept, ...] | None = None
        self._try_at, self._complaint = 0.0, ""
        self._thread = threading.Thread(target=self._run, name="housekeeper", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def keep(self, components: tuple[Kept, ...]) -> None:
        """Have ``components`` written in place of those that are on disk."""
        self._to_keep.append(components)
        self._wake.set()

    def heard(self) -> Decisions | None:
        """What the specialist has said since this was last asked; None for nothing."""
        return self._heard.popleft() if self._heard else None

    def stop(self, seconds: float) -> None:
        """Have what is to be kept written for up to ``seconds``, and end the thread."""
        self._ends.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(seconds)
            if self._thread.is_alive():
                log.warning("components may not be kept: the disk has not answered in %.1f s", seconds)

    def _run(self) -> None:
        while True:
            self._wake.wait(EVERY)
            self._wake.clear()
            ends = self._ends.is_set()
            if self._to_keep:
                self._unsaved, self._try_at = self._to_keep.popleft(), 0.0
            if self._unsaved is not None and (ends or time.monotonic() >= self._try_at):
                self._write(self._unsaved)
            if ends:
                return
            self._listen()

    def _write(self, components: tuple[Kept, ...]) -> None:
        try:
            self._keeper.keep(components)
        except OtolithError as error:  # a full disk must not end the watching
            if str(error) != self._complaint:  # once, however often it is tried
                log.warning("components are not kept: %s", error)
            self._complaint, self._try_at = str(error), time.monotonic() + AGAIN
        else:
            self._complaint, self._unsaved = "", None

    def _listen(self) -> None:
        stamp = self._keeper.stamp()
        if stamp == self._stamp:
            return
        self._stamp = stamp
        try:
            self._heard.append(self._keeper.decisions())
        except OtolithError as error:
            log.warning("%s", error)
