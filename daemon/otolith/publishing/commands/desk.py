"""Takes the commands about one machine: who may send them, to whom, and each once; writes what they decide.

What it writes is what ``otolith event`` and ``otolith components`` write: a running daemon obeys with its next window.
"""

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

from otolith.adaptation.state import OperatorDecisions
from otolith.discovery.decision import Approval
from otolith.health.notes import Deed, OperatorNote
from otolith.health.schema import ComponentDocument, EventDocument, ReportDocument
from otolith.publishing.certificates import authorities
from otolith.publishing.commands.documents import CommandAnswerDocument, CommandDocument, CommandKind
from otolith.publishing.commands.signatures import CommandRefusedError, verified
from otolith.storage.decisions import Decide, DecisionsFile, unchanged
from otolith_drivers.errors import OtolithError
from otolith_drivers.outside_text import SURROGATE

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_COMMAND_AGE = 60.0  # s by which the time of a command may differ from that of the daemon
MAX_COMMANDS = 20  # that are carried out in ...
COMMAND_SPAN = 60.0  # ... s
MAX_IDS = 1000  # of commands that are remembered
MAX_SENDER = 32  # characters of the name in a certificate that a note has
REFUSAL_PAUSE = 60.0  # s between two lines in the log about refused commands, and about those that failed
DONE = {CommandKind.APPROVE: "approved as healthy", CommandKind.REJECT: "rejected"}


class CommandDesk:
    """Of one machine; it is asked in one thread at a time."""

    def __init__(
        self, site: str, machine: str, file: DecisionsFile,
        wall: Callable[[], float] = time.time, clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """``file`` has the decisions about the machine; ``wall`` returns Unix time, ``clock`` one that only elapses."""
        self._site, self._machine, self._file, self._wall, self._clock = site, machine, file, wall, clock
        self._lock = threading.Lock()  # the threads of two sessions may ask
        self._known: dict[str, float] = {}  # Time of each command that was carried out, by its id
        self._begun = clock()  # Commands before then are refused, whatever the wall clock said then
        self._forgotten = -math.inf  # Unix time; commands of then or before are refused: their ids may be forgotten
        self._done: deque[float] = deque(maxlen=MAX_COMMANDS)
        self._told: dict[type[Exception], float] = {}  # When the log had the latest line, by what became of a command

    def take(self, content: bytes, ca: Path, senders: Collection[str], latest: str | None) -> str:
        """Carry out a signed command, and return the answer as JSON.

        ``senders`` may send commands, by the names in their certificates, which the authority in ``ca`` must have
        issued. ``latest`` is the latest report of the machine.

        Raises:
            CommandRefusedError: it is not carried out; the message has the reason.
        """
        with self._lock:
            try:
                return self._taken(content, ca, senders, latest)
            except OtolithError as error:
                self._tell(OtolithError, f"a command is not carried out: {error}")
                raise CommandRefusedError("the daemon cannot write it: its log has the reason") from error
            except CommandRefusedError as error:
                self._tell(CommandRefusedError, f"a command is refused: {error}")
                raise

    def _tell(self, kind: type[Exception], text: str) -> None:
        """Log why a command was not obeyed: any reader can send what is refused, and must not fill the log."""
        if (now := self._clock()) - self._told.get(kind, -math.inf) >= REFUSAL_PAUSE:
            self._told[kind] = now
            log.warning("%s", text)

    def _taken(self, content: bytes, ca: Path, senders: Collection[str], latest: str | None) -> str:
        elapsed = self._clock() - self._begun  # before the wall clock is read, so that the start is never too early
        now = self._wall()
        command, sender = verified(content, authorities(ca, ()), datetime.fromtimestamp(now, UTC))
        if sender not in senders:
            raise CommandRefusedError(f"{sender!r} may not send commands: [zenoh.access] commands has who may")
        if (command.site, command.machine) != (self._site, self._machine):
            raise CommandRefusedError("it is for another machine")
        if command.id in self._known:
            return CommandAnswerDocument(id=command.id, is_new=False).json_line()
        self._check_time(command, now, now - elapsed)
        if len(self._done) == MAX_COMMANDS and self._clock() - self._done[0] < COMMAND_SPAN:
            raise CommandRefusedError(f"more than {MAX_COMMANDS} commands in {COMMAND_SPAN:.0f} s: try it again later")
        by = SURROGATE.sub("\ufffd", f"{command.by} ({sender[:MAX_SENDER]})")
        self._carry_out(command, by, latest)
        self._done.append(self._clock())
        self._remember(command)
        log.info("command of %s: %s %s", by, command.kind, command.event)
        return CommandAnswerDocument(id=command.id, is_new=True).json_line()

    def _check_time(self, command: CommandDocument, now: float, begin: float) -> None:
        """Refuse a command whose id may have been forgotten, and one that is older than a person waits.

        ``begin`` is when this desk began, by the wall clock as it is ``now``: it may have been set since.
        """
        if abs(age := now - command.at) > MAX_COMMAND_AGE:
            when = f"{age:.0f} s ago" if age > 0.0 else f"{-age:.0f} s in the future"
            remedy = "give it again, and check the clocks of both computers"
            raise CommandRefusedError(f"it was given {when}, which is more than {MAX_COMMAND_AGE:.0f} s: {remedy}")
        if command.at <= max(self._forgotten, begin):
            raise CommandRefusedError("it was given before the daemon started: give it again")

    def _remember(self, command: CommandDocument) -> None:
        self._known[command.id] = command.at
        while len(self._known) > MAX_IDS:
            self._forgotten = max(self._forgotten, self._known.pop(next(iter(self._known))))

    def _carry_out(self, command: CommandDocument, by: str, latest: str | None) -> None:
        """Write what a command decides, with a note on its event."""
        report = None if latest is None else ReportDocument.from_json(latest)
        events = {} if report is None else {each.id: each for each in report.events if each.end is None}
        if report is None or command.event not in events:
            raise CommandRefusedError(f"no event {command.event!r} is open: look at the page again")
        deed, text = Deed.ACKNOWLEDGE, ""
        decided: Decide = unchanged
        if command.kind is not CommandKind.ACKNOWLEDGE:
            component = component_of(report, events[command.event])
            if component is None:
                raise CommandRefusedError(f"event {command.event!r} is not about one component without a decision")
            deed, text = Deed.COMMENT, f"{DONE[command.kind]}: {component.id}"
            decided = _decision(command.kind, component.id)
        note = OperatorNote(id=command.id, deed=deed, event=command.event, by=by, at=self._wall(), text=text)
        learned = self._file.learned()
        self._file.note(lambda _: note, () if learned is None else learned.health.taken, decided)


def component_of(report: ReportDocument, event: EventDocument) -> ComponentDocument | None:
    """Return the component that an event is about, and that nobody has decided about; None if it is not one."""
    key = event.id.rpartition("@")[0]
    found = [each for each in report.components
             if f"component/{each.site}/{each.family}" == key and each.approval is Approval.OPEN]  # fmt: skip
    return found[0] if len(found) == 1 else None


def _decision(kind: CommandKind, component: str) -> Decide:
    def decided(decisions: OperatorDecisions) -> OperatorDecisions:
        if component in decisions.approved | decisions.rejected:  # and the daemon has not reported that yet
            raise CommandRefusedError(f"somebody has decided about {component!r} already: look at the page again")
        if kind is CommandKind.APPROVE:
            return replace(decisions, approved=decisions.approved | {component})
        return replace(decisions, rejected=decisions.rejected | {component})

    return decided
