"""Runs outlets, each in a thread of its own, so that none delays another one, the pages, or what is collected."""

import logging
import threading
import time
from collections import deque
from dataclasses import replace

from otolith.health.limits import Level
from otolith.health.text import event_in, report_in
from otolith.site.cards import card_of
from otolith.site.known import KnownMachine
from otolith.site.outlets.base import Known, MachineView, Notice, Outlet, OutletError, OutletSetup, OutletStatus
from otolith.site.outlets.notices import Notices, RateLimit, Silences

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
TICK = 1.0  # s between two looks for what has changed
FIRST_PAUSE, MAX_PAUSE = 1.0, 60.0  # s until an outlet that failed is tried again; doubled each time
MAX_PENDING = 500  # notices that wait for an outlet that fails; the oldest are dropped
CLOSING = 5.0  # s that an outlet may take to end


class OutletRunner:
    """The thread of an outlet."""

    def __init__(self, name: str, outlet: Outlet, known: Known, setup: OutletSetup, per_hour: int) -> None:
        """``per_hour`` bounds its notices, 0 for none; their texts are in language and zone of ``setup``."""
        self.status = OutletStatus(name)
        self._outlet, self._known, self._setup = outlet, known, setup
        self._notices, self._silences = Notices(time.monotonic()), Silences()
        self._limit, self._tells = RateLimit(per_hour), per_hour > 0
        self._pending: deque[Notice] = deque()
        self._dropped = 0
        self._shown: dict[str, tuple[object, ...]] = {}  # Revision of each machine that was passed on
        self._left: deque[str] = deque()  # Machines that must be taken back, even if another process passed them on
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"outlet-{name}", daemon=True)

    @property
    def is_running(self) -> bool:
        """Whether it has begun and not ended."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def leave(self, key: str) -> None:
        """Take back what the other side has of a machine, by its site and name, which is known no longer."""
        self._left.append(key)

    def end(self) -> None:
        """Begin to end it, once what was left is taken back."""
        self._stopping.set()

    def stop(self) -> None:
        """End it, within :data:`CLOSING`."""
        self.end()
        self._thread.join(CLOSING)

    def _run(self) -> None:
        pause = TICK  # s
        while not self._stopping.wait(pause):
            longer = min(2.0 * pause, MAX_PAUSE) if pause > TICK else 2.0 * FIRST_PAUSE
            pause = TICK if self._try() else longer
        if self._left:
            self._try()
        self._outlet.close()

    def _try(self) -> bool:
        """Pass on what has changed, and note whether that works; return False if it does not."""
        try:
            is_tried = self._pass_on()
        except OutletError as error:
            self._fail(str(error))
            return False
        except Exception:  # what machines publish ends no outlet
            log.exception("%s: a fault of its own", self.status.name)
            self._fail("a fault of its own, see the log")
            return False
        if is_tried and not self.status.is_up:
            log.info("%s: works", self.status.name)
        if is_tried:
            self.status.is_tried, self.status.is_up, self.status.reason = True, True, ""
        return True

    def _fail(self, reason: str) -> None:
        if self.status.is_up or reason != self.status.reason:
            log.warning("%s: %s", self.status.name, reason)
        self.status.is_tried, self.status.is_up, self.status.reason = True, False, reason
        self.status.failures += 1
        self._shown = dict.fromkeys(self._shown, ())  # all are shown again, and those that are gone are known

    def _pass_on(self) -> bool:
        """Pass on what has changed; return whether the other side was reached."""
        now, language = time.monotonic(), self._setup.language
        with self._known.lock:
            machines = list(self._known.knowledge)
            new = list[Notice]()
            if self._tells:
                new += self._notices.take(machines, now)
                new += self._silences.take(machines, now, time.time(), language)
                new = [self._reworded(notice) for notice in new]
            changed = [view for machine in machines if (view := self._view(machine, now)) is not None]
        self._pending.extend(self._limit.passes(new, now))
        while len(self._pending) > MAX_PENDING:
            self._pending.popleft()
            self._dropped += 1
        self.status.lost, refused = self._dropped + self._limit.withheld, 0
        waiting = len(self._pending)
        while self._left:
            self._shown.setdefault(self._left.popleft(), ())
        known = {f"{machine.site}/{machine.name}" for machine in machines}
        gone = [key for key in self._shown if key not in known]
        try:
            is_tried = self._outlet.send(changed, gone, self._pending)
        except OutletError as error:
            refused = error.refused
            raise
        finally:
            self._dropped += refused
            self.status.lost += refused
            self.status.sent += waiting - len(self._pending) - refused
        for key in gone:
            del self._shown[key]
        self._shown |= {view.key: view.revision for view in changed}
        return is_tried

    def _reworded(self, notice: Notice) -> Notice:
        """Return a notice in language and zone of the site."""
        event, setup = notice.event, self._setup
        return replace(notice, event=event_in(event, setup.language, setup.zone))

    def _view(self, machine: KnownMachine, now: float) -> MachineView | None:
        """Return a machine, None if it was passed on as it is."""
        state, is_silent = machine.state(now), machine.is_silent(now)
        revision = (machine.revision, state, is_silent)
        if self._shown.get(f"{machine.site}/{machine.name}") == revision:
            return None
        report, setup = machine.report, self._setup
        language = setup.language or (report.health.language if report and report.health else "en")
        card = card_of(machine, now, language, setup.zone)
        report = None if is_silent or report is None else report_in(report, setup.language, setup.zone)
        health = report.health if report is not None else None
        since = None if state is Level.NO_DATA or health is None else health.since
        return MachineView(
            machine.site, machine.name, state, card.word, since, card.what, card.advice, report, revision
        )
