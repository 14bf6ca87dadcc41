"""Writes what was learned, and reads the operator's decisions, in the background."""

import logging
from collections import deque

from otolith.adaptation.state import AdaptationState, OperatorDecisions
from otolith.storage.state_store import StateStore
from otolith.storage.writer_thread import WriterThread
from otolith_drivers.errors import OtolithError

log = logging.getLogger(__name__)

DECISIONS_INTERVAL = 0.5  # s between two checks for decisions; docs/reference/thresholds-storage.md has its origin


class StateWriter(WriterThread):
    """Keeps only the latest value in each direction."""

    def __init__(self, store: StateStore, decisions_time: float) -> None:
        """``decisions_time`` is the :meth:`StateStore.decisions_time` of the decisions that are known already."""
        super().__init__("writer", DECISIONS_INTERVAL, "what was learned is not saved")
        self._store, self._decisions_time = store, decisions_time
        self._to_save: deque[AdaptationState] = deque(maxlen=1)
        self._unsaved: AdaptationState | None = None
        self._new_decisions: deque[OperatorDecisions] = deque(maxlen=1)

    def save(self, state: AdaptationState) -> None:
        """Request that ``state`` replaces what is on disk."""
        self._to_save.append(state)
        self._wakeup.set()

    def new_decisions(self) -> OperatorDecisions | None:
        """Return the operator's decisions if they have changed since the last call, otherwise None."""
        return self._new_decisions.popleft() if self._new_decisions else None

    def write(self) -> None:
        """Save the latest state."""
        if self._to_save:
            self._unsaved = self._to_save.popleft()
        if self._unsaved is not None:
            self._store.save(self._unsaved)
            self._unsaved = None

    def read(self) -> None:
        """Read the decisions if their file has changed."""
        decisions_time = self._store.decisions_time()
        if decisions_time == self._decisions_time:
            return
        self._decisions_time = decisions_time
        try:
            self._new_decisions.append(self._store.decisions())
        except OtolithError as error:
            log.warning("%s", error)
