"""The one process of a service that passes reports on to other systems: started with the first machine that wants it.

It is restarted when it has died, hangs, or has become too large. The main thread only queues reports for it.
"""

import logging
import time
from collections.abc import Mapping

from otolith.health.schema import ReportDocument
from otolith.machine import LoadedMachine
from otolith.outlet_tables import MachineOutlets
from otolith.runtime.effort import Effort
from otolith.runtime.process import ChildProcess

log = logging.getLogger(__name__)

MAIN = "otolith.site.outlets.process:main"  # Which only the process imports

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
OUTLET_ROOM = 32  # messages of a machine that wait for the process
OUTLET_TIMEOUT = 60.0  # s of effort without an answer, while messages wait, after which it hangs
OUTLET_HEALTHY_AGE = 60.0  # s after which its restart pause is reset
OUTLET_MEMORY = 500e6  # bytes above which it is killed
LOOK_PAUSE = 0.1  # s between two looks at it
MEMORY_PAUSE = 5.0  # s between two looks at its memory
MIN_DEATHS = 4  # in a row, from which it is out of order and not restarted by chance


class OutletProcess:
    """Times are monotonic, s."""

    def __init__(self, main: str = MAIN) -> None:
        self.child = ChildProcess("otolith-outlets", main, OUTLET_ROOM)
        self.dropped = 0  # Reports that no outlet has received
        self._machines: dict[str, MachineOutlets] = {}
        self._unserved: dict[str, MachineOutlets] = {}  # Those of which outlets tell that nobody serves them
        self._before: dict[str, MachineOutlets] = {}  # Tables that a process may not have left yet
        self._changes: dict[str, MachineOutlets | bool] = {}  # That wait for room
        self._is_ending = False
        self._reasons: Mapping[str, str] = {}
        self._unanswered = 0
        self._effort = Effort()
        self._looked_at = self._weighed_at = 0.0

    def serve(self, machine: LoadedMachine) -> None:
        """Pass on a machine from now on, by the tables of its file, or by those that it has now."""
        identity = machine.file.machine
        own = MachineOutlets(identity.site, identity.name, machine.path_of("outlets"), machine.file.outlets)
        if not own.table.names:
            self.leave(own.key, is_gone=True)
            return
        former = self._unserved.pop(own.key, None) or self._machines.get(own.key)
        if former is not None and former != own:
            self._before.setdefault(own.key, former)
        self._machines[own.key] = own
        self.child.widen(OUTLET_ROOM * len(self._machines))
        self._change(own.key, own)

    def leave(self, key: str, *, is_gone: bool) -> None:
        """Pass on a machine no longer; ``is_gone`` if its file or its tables were removed."""
        if (own := self._machines.pop(key, None) or self._unserved.pop(key, None)) is None:
            return
        if is_gone:
            self._before.setdefault(key, own)
        else:
            self._unserved[key] = own
        self._change(key, is_gone)

    def offer(self, document: ReportDocument, text: str = "") -> None:
        """Give it a report, without waiting; ``text`` is its JSON, if it was made already."""
        key = f"{document.site}/{document.machine}"
        if key in self._machines and not self._send(key, (self.dropped, (text or document.to_json()).encode())):
            self.dropped += 1

    def outage(self, key: str) -> str:
        """Return why reports of a machine are not passed on; empty if they are, or should not be."""
        if key not in self._machines:
            return ""
        if self.child.deaths >= MIN_DEATHS:
            return f"the process of outlets has ended {self.child.deaths} times"
        return self._reasons.get(key, "")

    def poll(self, now: float) -> None:
        """Read answers, kill it if it hangs or is too large, and start it if it does not run."""
        if not (self._serves or self._before or self.child.alive) or now - self._looked_at < LOOK_PAUSE:
            return
        self._looked_at = now
        self._read(now)
        if self.child.alive:
            self._send_changes()
            self._end_without_machines()
            self._supervise(now)
            return
        if self._is_ending and self.child.has_finished:
            self._before.clear()
        self.dropped += self._unanswered
        self._unanswered, self._reasons, self._is_ending = 0, {}, False
        self._changes.clear()  # it begins with the machines as they are
        if (self._serves or self._before) and self.child.may_restart(now):
            self.child.start(self._first_messages())

    @property
    def _serves(self) -> bool:
        """Whether a machine has a table."""
        return bool(self._machines or self._unserved)

    def _first_messages(self) -> tuple[tuple[str, MachineOutlets | bool], ...]:
        """Return what a process begins with: it leaves the tables that one before it may not have left."""
        served = [(key, own) for part in (self._before, self._unserved, self._machines) for key, own in part.items()]
        left = [(key, True) for key in self._before if key not in self._machines and key not in self._unserved]
        return (*served, *left, *((key, False) for key in self._unserved))

    def stop(self, seconds: float) -> None:
        """Let it tell for up to ``seconds`` that the daemon ends."""
        self.child.stop(seconds)

    def _change(self, key: str, content: MachineOutlets | bool) -> None:
        """Send what has changed of a machine, as soon as there is room."""
        self._changes[key] = content
        self._send_changes()

    def _send_changes(self) -> None:
        for key in tuple(self._changes):
            if not self._send(key, self._changes[key]):
                return
            del self._changes[key]

    def _end_without_machines(self) -> None:
        """Let it end once no machine has a table."""
        if not (self._serves or self._changes or self._is_ending) and self.child.offer(None):
            self._is_ending = True
            self.child.reset_backoff()

    def _send(self, key: str, content: object) -> bool:
        if not (self.child.alive and self.child.offer((key, content))):
            return False
        if not self._unanswered:
            self._effort.begin(time.monotonic(), self.child.processor_time)
        self._unanswered += 1
        return True

    def _read(self, now: float) -> None:
        for answer in self.child.replies():
            self._unanswered = max(0, self._unanswered - 1)
            self._effort.begin(now, self.child.processor_time)
            if not (self._unanswered or self._changes):
                self._before.clear()
            reasons, lines = answer
            if reasons is not None:
                self._reasons = reasons
            for name, level, text, trace in lines:
                logger = logging.getLogger(name)
                if logger.isEnabledFor(level):
                    record = logger.makeRecord(name, level, "", 0, "%s", (text,), None)
                    record.exc_text = trace or None
                    logger.handle(record)

    def _supervise(self, now: float) -> None:
        if self.child.age > OUTLET_HEALTHY_AGE:
            self.child.reset_backoff()
        reason = ""
        if self._unanswered and self._effort.seconds(now, self.child.processor_time) > OUTLET_TIMEOUT:
            reason = f"has not answered in {OUTLET_TIMEOUT:g} s of processor time and waiting"
        elif now - self._weighed_at >= MEMORY_PAUSE:
            self._weighed_at = now
            if (memory := self.child.memory) > OUTLET_MEMORY:
                reason = f"has {memory / 1e6:.0f} MB of memory, over {OUTLET_MEMORY / 1e6:.0f} MB"
        if reason:
            log.warning("the process of outlets %s, and is killed", reason)
            self.child.kill()
