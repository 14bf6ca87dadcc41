"""One machine of the service, with its driver and all that its reports go to.

    driver thread -> rings -> [main thread] samples -> worker process -> [main thread] report -> Zenoh, recorder process

:mod:`otolith.runtime.hall.daemon` is the main thread: it tells a service when a window of its machine is due, and when
one is finished. No service waits for a machine, a disk, a command or a subscriber.
"""

import contextlib
import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from otolith import __version__
from otolith.adaptation.packed_state import PackedState, keys_of
from otolith.adaptation.state import (
    AdaptationState,
    OperatorDecisions,
    apply_decisions,
    with_problem,
)
from otolith.health.events import missed_notes
from otolith.health.labels import Numbers, baseline_event, clock_event, expiry_event
from otolith.health.schema import CountersDocument, DaemonDocument, EventDocument, Language, Report, ReportDocument
from otolith.health.status import driver_document, with_absent_sources
from otolith.health.text import announcements, event_text, summary
from otolith.health.times import moment_text
from otolith.machine import LoadedMachine
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.zenoh_config import Access
from otolith.publishing.zenoh_session import StartDocument
from otolith.runtime.clock import ClockReading, ServiceClock, read_clocks
from otolith.runtime.hall.machine import FinishedWindow, Machine, Task
from otolith.runtime.hall.outlet_process import OutletProcess
from otolith.runtime.hall.pool import Preparation
from otolith.runtime.hall.recorder_process import RecorderProcess
from otolith.runtime.process import EventCommand
from otolith.runtime.recorder_supervisor import RecorderSupervisor
from otolith.storage.disk import StorageThread, WriterThread, phase_of
from otolith.storage.evidence import EvidenceWriter, files_of
from otolith.storage.history import describe_machine
from otolith.storage.history_writer import history_of
from otolith.storage.state_store import LockedError, StateWriter, store_of
from otolith_drivers.base import Sampling
from otolith_drivers.errors import OtolithError, ServiceError
from otolith_drivers.sources import open_patiently

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
RECORDER_FLUSH, WRITER_FLUSH, COMMAND_FLUSH, OUTLET_FLUSH = (
    1.5,
    0.5,
    0.5,
    1.5,
)  # s to finish writing, or running, at the end
LEAVE_FLUSH = 30.0  # s to write what is left of a machine that is served no longer
SAVE_INTERVAL = 60.0  # s between two saves of what was learned
OUTAGE_AFTER = 120.0  # s for which an output fails until it is an event: a network or a clock comes later than a boot
SUMMARY_INTERVAL = 3600.0  # s between two lines in the log about a window; events are logged at once
Key = tuple[str, ...]
_TAKEN_OVER = ("recording", "outlets")  # tables that a running daemon takes over
_WORDING: set[Key] = {("machine", "language"), ("machine", "timezone")}  # what texts of limits and rules depend on


@dataclass(frozen=True, slots=True)
class Reload:
    """What a changed machine file changes in a running daemon; what is not named here needs a restart."""

    machine: LoadedMachine  # The machine to go on with
    limits: bool  # Or rules of the diagnosis
    recording: bool
    access: bool  # Certificates, passwords and readers
    outlets: bool
    needs_restart: tuple[str, ...]  # Keys of the file that were changed and that a running daemon does not take over

    @property
    def text(self) -> str:
        """What has changed, in words."""
        names = {
            "limits or rules": self.limits, "recording": self.recording, "access": self.access, "outlets": self.outlets,
        }  # fmt: skip
        changed = " and ".join(name for name, is_changed in names.items() if is_changed) or "nothing"
        line = f"{self.machine.path}: reloaded, {changed} changed"
        return f"{line}; only a restart takes over {', '.join(self.needs_restart)}" if self.needs_restart else line


def reloaded(running: LoadedMachine, new: LoadedMachine) -> Reload:
    """Return ``running`` with what it can take over from ``new``.

    Limits may be percentages of values, so they are taken over only with the parameters they belong to. With them come
    the texts of the rules and the zone of their times, so they also wait for a restart if one of these has changed.
    """
    old, file = running.file, new.file
    changed = list(_differences(old.model_dump(), file.model_dump()))
    recording, outlets = (any(key[0] == name for key in changed) for name in ("recording", "outlets"))
    access = any(_is_access(key) for key in changed)
    limits = [key for key in changed if _is_limit(key)]
    rest = [key for key in changed if key[0] not in _TAKEN_OVER and not (_is_limit(key) or _is_access(key))]
    if new.twin != running.twin and not any(key[0] == "twin" for key in rest):
        rest.append(("twin", "file"))
    own = file.zenoh.access.model_copy(update={"networks": old.zenoh.access.networks})
    tables = {"tls": file.zenoh.tls, "access": own}
    update: dict[str, Any] = {name: getattr(file, name) for name in _TAKEN_OVER} | {
        "zenoh": old.zenoh.model_copy(update=tables)
    }
    if any(key[0] in {"twin", "parameters"} or key in _WORDING for key in rest):
        rest, limits = [*rest, *limits], []
    if limits:
        update |= {"parameters": file.parameters, "components": file.components, "rule": file.rule}
    plan = new.plan if limits else running.plan
    machine = replace(running, file=old.model_copy(update=update), plan=plan, of_service=new.of_service)
    return Reload(machine, bool(limits), recording, access, outlets, tuple(".".join(key) for key in rest))


def _is_limit(key: Key) -> bool:
    return key[0] in {"components", "rule"} or (key[0] == "parameters" and key[-1] in {"watch", "act"})


def _is_access(key: Key) -> bool:
    return key[:2] == ("zenoh", "tls") or (key[:2] == ("zenoh", "access") and key[2:] != ("networks",))


def _differences(old: Any, new: Any, key: Key = ()) -> Iterator[Key]:
    """The keys at which two tables differ; a table that one of them lacks is compared with an empty one."""
    if isinstance(old, Mapping) or isinstance(new, Mapping):
        before, after = (value if isinstance(value, Mapping) else {} for value in (old, new))
        for name in dict.fromkeys((*before, *after)):
            yield from _differences(before.get(name), after.get(name), (*key, str(name)))
    elif old != new:
        yield key


@dataclass(frozen=True, slots=True)
class Revision:
    """A changed machine file, with all else that must be read to take it over."""

    change: Reload
    files: dict[str, str]  # That are kept as evidence
    decisions: OperatorDecisions
    before: OperatorDecisions | None  # Those that the service had taken last when these were read


@dataclass(frozen=True, slots=True)
class SharedParts:
    """What the machines of a hall have in common."""

    recorder: RecorderProcess
    outlets: OutletProcess
    storage: StorageThread


class Service:
    """One machine, its driver and its outputs; :mod:`otolith.runtime.hall.daemon` starts, asks and stops them."""

    def __init__(
        self,
        machine: LoadedMachine,
        listen: tuple[str, ...] | None = None,
        recording: Path | None = None,
        clocks: Callable[[], ClockReading] = read_clocks,
        shared: SharedParts | None = None,
    ) -> None:
        """``listen`` and ``recording`` replace the endpoints and the recording file that the machine file gives.

        ``clocks`` reads the clocks of the computer. A machine of a hall has what is ``shared`` instead of parts of its
        own, and no line in the log for each of its windows.
        """
        file = machine.file
        self._loaded, self.machine, self._shared = machine, Machine.of(machine), shared
        self.listen = file.zenoh.listen if listen is None else listen
        self._store = store_of(machine)
        self._writer = StateWriter(self._store, self._store.operator.time())
        self._history = history_of(file)
        self._evidence = EvidenceWriter(machine)
        self._read_clocks, self._clock = clocks, ServiceClock(read=clocks)
        self._noted: tuple[EventDocument, ...] = ()  # events that the next report has
        self._failing: dict[str, float] = {}  # outputs, and since when they fail, monotonic s
        self._notes: tuple[str, ...] = ()
        self._refused = ""  # Why a changed file was not taken over
        self._decisions: OperatorDecisions | None = None  # The last ones that were changed while it runs
        self._waiting: tuple[str, ...] = ()  # Parameters whose baselines were found with other values
        self._saved: tuple[str, ...] = ()
        self._saved_at = -math.inf
        self._unsaved: PackedState | None = None  # the last state that no window contradicts
        self._described = b""  # Plan that the history has
        self._recorder = RecorderSupervisor(machine, recording, None if shared is None else shared.recorder)
        self._outlets = OutletProcess() if shared is None else shared.outlets
        self._command = EventCommand(file.machine.on_event, file.machine.name, file.machine.site)
        self.publisher: Publisher | None = None
        self._started_at = 0.0
        self._summarised_at = -math.inf
        self._logged: ReportDocument | None = None  # The last report with a line in the log
        for writer in (self._writer, self._history, self._evidence):
            if shared is not None and writer is not None:
                writer.share(shared.storage)

    @property
    def path(self) -> Path:
        """Its machine file."""
        return self._loaded.path

    @property
    def names(self) -> tuple[str, str]:
        """Its site and its name."""
        return self._loaded.file.machine.site, self._loaded.file.machine.name

    @property
    def language(self) -> Language:
        """The language of its texts."""
        return self._loaded.file.machine.language

    @property
    def title(self) -> str:
        """Site and name of the machine, with a point between."""
        return ".".join(self.names)

    @property
    def access(self) -> Access:
        """Who may read its reports."""
        return Access(self._loaded.file.zenoh, self._loaded.path_of("zenoh"))

    @property
    def published(self) -> Published:
        """What its publisher must know of it."""
        identity = self._loaded.file.machine
        return Published(identity.site, identity.name, self._history, self._store.operator)

    @property
    def locked_out(self) -> LockedError | None:
        """Another process has taken the state of this machine, which its writer notices."""
        return self._writer.locked_out

    def prepare(self) -> None:
        """Continue what the daemon before has learned.

        Raises:
            LockedError: another daemon runs for the machine.
        """
        try:
            self._store.lock_or_later()
        except LockedError:
            raise
        except ServiceError as error:  # what is learned may be lost, but the machine is monitored
            self._writer.fail(error)
        self._start_clock()
        self.machine.state = self._restored(self.machine.state)
        self._start_history()

    def open(self, publisher: Publisher, *, patiently: bool = False) -> str:
        """Listen to the machine, and return where, in words.

        Raises:
            DeviceError: the machine's bus cannot be opened; ``patiently`` it is tried again instead.
            ServiceError: a file that the caller named cannot be recorded.
        """
        self.publisher = publisher
        driver = self._loaded.driver
        if patiently:
            open_patiently(driver, self.machine.rings.deliver)
        else:
            driver.open(self.machine.rings.deliver)
        self._writer.start()
        self._evidence.start()
        if self._recorder.is_enabled:
            self._recorder.start(time.monotonic())
        self._started_at = time.monotonic()
        self.machine.begin(self._started_at)
        name, twin = self._loaded.file.machine.name, self._loaded.twin.title
        log.info("machine %s, %s: reports on %s", name, twin, publisher.endpoints)
        return str(driver.describe()[0])

    def stop_outputs(self, steps: contextlib.ExitStack) -> None:
        """Add to ``steps`` how every output is stopped, even if stopping another one fails; the last runs first."""
        if self._history is not None:
            steps.callback(self._history.stop, WRITER_FLUSH)
        steps.callback(self._command.stop, COMMAND_FLUSH)
        steps.callback(self._writer.stop, WRITER_FLUSH)
        steps.callback(self._evidence.stop, WRITER_FLUSH)
        if self._shared is None:
            steps.callback(self._recorder.stop, RECORDER_FLUSH)
            steps.callback(self._outlets.stop, OUTLET_FLUSH)

    def end(self) -> None:
        """End a machine of a hall, in another thread than the main one; then another daemon may serve it."""
        writers = [writer for writer in (self._writer, self._history, self._evidence) if writer is not None]
        with contextlib.ExitStack() as steps:
            steps.callback(self.unlock)
            steps.callback(self._await, writers)
            self.stop_outputs(steps)
            steps.callback(self._recorder.finish)
            steps.callback(self.close_driver)
            if self.publisher is not None:
                steps.callback(self.publisher.remove, *self.names)

    def _await(self, writers: Sequence[WriterThread]) -> None:
        deadline = time.monotonic() + LEAVE_FLUSH
        if not all(writer.wait(max(0.0, deadline - time.monotonic())) for writer in writers):
            log.warning("writing took over %g s: check the disk", LEAVE_FLUSH)

    def pass_on(self) -> None:
        """Let other systems know of it from now on."""
        self._outlets.serve(self._loaded)

    def leave_outlets(self, *, is_gone: bool) -> None:
        """Let other systems know that it is served no longer; ``is_gone`` if its file was changed or removed."""
        self._outlets.leave("/".join(self.names), is_gone=is_gone)

    def close_driver(self) -> None:
        """Listen no longer."""
        self._loaded.driver.close()

    def save_last(self) -> None:
        """Request that what was learned is saved."""
        self._save(math.inf)

    def unlock(self) -> None:
        """Let another daemon serve the machine."""
        self._store.unlock()

    def _start_clock(self) -> None:
        """Continue the service time of the daemon before, as its state or its history have it."""
        (saved, last), labels = self._store.saved_clock(), None
        if self._history is not None:
            with contextlib.suppress(OtolithError):  # an unreadable history must not prevent monitoring
                last, labels = max(last, self._history.reader.last()), self._history.reader.labels()
        self._clock = ServiceClock(saved, last, labels, self._read_clocks)
        self._store.clock = self._clock.saved

    def _restored(self, state: AdaptationState) -> AdaptationState:
        """Return ``state`` with what was saved and decided; an unreadable file must not prevent monitoring."""
        state, note = self._store.restore(state)
        polled = {name for name, plan in self.machine.windower.plans.items() if plan.sampling is Sampling.POLLED}
        changing = tuple(name for name in state.problem.changing if name not in polled)  # without those declared since
        state = with_problem(state, replace(state.problem, changing=changing))
        notes = [note] if note else []
        try:
            state = self._decided(state, self._store.decisions())
        except OtolithError as error:
            notes.append(f"started without the operator's decisions: {error}")
        for text in notes:
            log.warning("%s", text)
        self._notes, self._saved = tuple(notes), keys_of(state)
        if math.isfinite(end := state.posterior.belief.end):
            log.info(
                "started with what was learned up to %s",
                moment_text(self._clock.labels.unix(end), self._loaded.plan.timezone),
            )
        if state.adopted:
            remedy = "'otolith components forget' removes those that no longer exist"
            names = ", ".join(known.component.key for known in state.adopted)
            log.info("started with saved components: %s; %s", names, remedy)
        return state

    def _decided(self, state: AdaptationState, decisions: OperatorDecisions) -> AdaptationState:
        for event in missed_notes(state.health, decisions.notes):
            log.warning("event %s is over: what a person did with it is not kept; a comment can be given again", event)
        self._note_waiting(decisions.waiting(state.problem))
        return apply_decisions(state, decisions.in_service_time(self._clock.labels, self._clock.now()))

    def _note_waiting(self, names: tuple[str, ...]) -> None:
        """Say once which baselines were found with other values than this daemon has, and what to do."""
        before, self._waiting = self._waiting, names
        if not set(names) - set(before):
            return
        key = "baseline_waits" if self._started_at else "baseline_is_of_other_values"
        language, file = self._loaded.file.machine.language, str(self._loaded.path)
        text = self._loaded.plan.texts(key, names=", ".join(names), file=file)
        log.warning("%s", text)
        self._noted = (*self._noted, baseline_event(self._clock.now(), text, self.machine.windows, language))

    def _start_history(self) -> None:
        self.machine.numbers = Numbers(time.time())
        if self._history is not None:
            self.machine.numbers, note = self._history.open(max(self._clock.now(), time.time()))
            self._notes += (note,) if note else ()
            state, reason = self.machine.state, "its state was not saved before the daemon ended"
            health = state.health.agreeing(self._history.last_changes(), reason)
            self.machine.state = replace(state, health=health)
            self._history.start()

    def revision(self, new: LoadedMachine) -> Revision:
        """Return what its file changes; raise OtolithError or OSError if something else cannot be read.

        Another thread may call it.
        """
        before, change = self._decisions, reloaded(self._loaded, new)
        files = self._evidence.files if change.needs_restart else files_of(change.machine)
        return Revision(change, files, self._store.decisions(), before)

    def refuse(self, reason: str) -> None:
        """Go on as before although the file is wrong, and let the reports say so."""
        self._refused = f"not reloaded, the daemon goes on as before: {reason}"
        log.warning("%s", self._refused)

    def take_over(self, revision: Revision) -> None:
        """Take over limits, rules, recording and access."""
        change, decisions = revision.change, revision.decisions
        if self._decisions is not None and self._decisions is not revision.before:
            decisions = self._decisions  # They were changed after those of the revision were read
        self._refused, self._loaded, self._evidence.files = "", change.machine, revision.files
        log.log(logging.WARNING if change.needs_restart else logging.INFO, "%s", change.text)
        if change.limits:
            # The decisions contain the baselines to which limits in percent refer.
            self.machine.revise(lambda state: self._decided(replace(state, plan=change.machine.plan), decisions))
        if change.recording:
            self._recorder.reload(self._loaded, time.monotonic())
        self._outlets.serve(self._loaded)  # also as it was: its files, or what it lacked, may have changed

    def show_preparation(self, shown: Preparation, *, is_done: bool) -> None:
        """Tell readers how many kernels the workers have: until they are ready there is no report."""
        if self.publisher is None:
            return
        identity, done = self._loaded.file.machine, shown.total if is_done else shown.done
        self.publisher.publish_start(
            StartDocument(site=identity.site, machine=identity.name, done=done, total=shown.total, text=shown.text)
        )

    def take(self, now: float) -> Task:
        """Return the window of the machine that is due."""
        self._follow_wall_clock()
        link = self._loaded.driver.link()
        raw = self.machine.take(link, self._clock.offset, self._clock.ahead)
        window, period = self._loaded.problem.window, self._loaded.file.window.sample_period
        self.machine.adopt_period(link.period, window, period)
        decisions = self._writer.new_decisions()
        if decisions is not None:
            self._decisions = decisions
            self.machine.revise(lambda state: self._decided(state, decisions))
        return Task(raw, link, self._outages(now))

    def finish(self, finished: FinishedWindow, restarts: int) -> str:
        """Save, keep and publish a window; return its line. ``restarts`` is how often workers were started again."""
        self._evidence.add(finished.before, finished.window, finished.report, finished.after, finished.text)
        line = self._publish(finished.report, finished.seconds, restarts)
        self._save(time.monotonic())
        return line

    def poll_processes(self, now: float) -> None:
        """Read what recorder and outlets answer, and start them again if they must be."""
        self._outlets.poll(now)
        if self._recorder.is_enabled:
            self._recorder.poll(now)

    def _outages(self, now: float) -> dict[str, str]:
        """Return the outputs that have failed for ``OUTAGE_AFTER``, and why; the machine is monitored without them."""
        reasons = {
            "state": self._writer.outage,
            "history": "" if self._history is None else self._history.outage,
            "evidence": self._evidence.outage,
            "recording": self._recorder.outage,
            "on_event": self._command.outage,
            "outlets": self._outlets.outage("/".join(self.names)),
            **({} if self.publisher is None else self.publisher.outages(datetime.now(UTC))),
        }
        self._failing = {name: self._failing.get(name, now) for name, reason in reasons.items() if reason}
        return {name: reasons[name] for name, since in self._failing.items() if now - since >= OUTAGE_AFTER}

    def _follow_wall_clock(self) -> None:
        """Let the labels follow the wall clock. If it was set, save them, and note it in the next report."""
        by = self._clock.update()
        self._store.clock = self._clock.saved
        if by is not None:
            self._saved_at = -math.inf
            event = clock_event(self._clock.now(), by, self.machine.windows, self._loaded.file.machine.language)
            self._noted = (*self._noted, event)

    def _publish(self, report: Report, seconds: float, restarts: int = 0) -> str:
        document, noted = report.document, self._noted
        self._noted, warning = (), "" if self.publisher is None else self.publisher.warning(datetime.now(UTC))
        latency = max(0.0, self._clock.now() - document.window.end)
        cost = document.cost.model_copy(update={"seconds": seconds, "latency_s": latency})
        driver = driver_document(self._loaded.driver.link())
        parameters = with_absent_sources(document.parameters, document.window.absent)
        update = {"cost": cost, "counters": self._counters(restarts), "driver": driver, "parameters": parameters}
        update["events"] = (*noted, *document.events)
        certificate = None if self.publisher is None else self.publisher.certificate
        update["daemon"] = DaemonDocument(version=__version__, certificate=certificate)
        update["notes"] = (*self._notes, *filter(None, [self._refused, warning]))
        document = self.machine.numbers.number(document.model_copy(update=update))
        text = document.to_json()
        if self._history is not None:
            self._describe()
            self._history.labels = self._clock.labels
            self._history.add(document, text)
        labelled = self._clock.labels.of_report(document)
        document, text = labelled, text if labelled is document else labelled.to_json()
        if self.publisher is not None:
            self.publisher.publish(document, text)
        self._outlets.offer(document, text)
        if self._recorder.is_enabled:
            self._recorder.offer(Report(document, report.traces), time.monotonic())
        return self._log(document, time.monotonic())

    def _describe(self) -> None:
        """Write the machine into the history as it is monitored: with baselines and limits that were changed."""
        packed, machine = self.machine.packed, self._loaded
        if self._history is not None and packed.plan != self._described:
            plan, known = packed.unpack_plan(), dict(machine.problem.known)
            self._history.description = describe_machine(machine.twin, plan, None, machine.path, known)
            self._described = packed.plan

    def _counters(self, restarts: int) -> CountersDocument:
        rings, driver = self.machine.rings.counters(), self._loaded.driver.counters()
        return CountersDocument(
            received=rings.received,
            bad=driver.bad,
            lost=driver.lost + rings.overwritten,
            reconnects=driver.reconnects,
            windows=self.machine.windows,
            windows_bad=self.machine.bad,
            windows_missed=self.machine.missed,
            worker_restarts=restarts,
            recordings_dropped=self._recorder.dropped,
            recorder_restarts=self._recorder.restarts,
            history_dropped=0 if self._history is None else self._history.dropped,
            evidence_dropped=self._evidence.dropped,
            commands_failed=self._command.failed,
        )

    def _log(self, document: ReportDocument, now: float) -> str:
        """Log the events that the window changed, and run the command for those that are not silent.

        A window is logged once per hour, in a terminal each of a machine that is alone. Returns its line if the machine
        is alone.
        """
        for event in announcements(document):
            level = logging.ERROR if event.is_urgent else logging.WARNING
            log.log(logging.INFO if event.is_silent else level, "%s", event_text(event, details=True))
            if not event.is_silent:
                self._command.run(event)
        is_due, is_alone = now - self._summarised_at >= SUMMARY_INTERVAL, self._shared is None
        before, self._logged = self._logged, document
        self._summarised_at = now if is_due else self._summarised_at
        if is_due and self.publisher is not None:
            self._warn_of_expiry(self.publisher, datetime.now(UTC))
        line = summary(document) if is_due or is_alone else ""
        level = logging.INFO if is_due or (is_alone and sys.stderr.isatty()) else logging.DEBUG
        if log.isEnabledFor(level):
            log.log(level, "%s", line if is_due else summary(document, before))
        return line

    def _warn_of_expiry(self, publisher: Publisher, now: datetime) -> None:
        """Log that the certificate of an endpoint expires soon, and note it in the next report."""
        publisher.warn_of_expiry(now)
        if (notice := publisher.expiry_notice(now)) is not None and notice.end is not None:
            name, language = str(notice.certificate), self._loaded.file.machine.language
            event = expiry_event(self._clock.now(), name, notice.end.timestamp(), self.machine.windows, language)
            self._noted = (*self._noted, event)

    def _save(self, now: float) -> None:
        """Request a save if components or open events have changed, or the last save is ``SAVE_INTERVAL`` ago.

        A state that windows contradict is not saved: it might not be restored as what it was. The one before it is.
        """
        if self.machine.finished and self.machine.packed.is_valid:
            self._unsaved = self.machine.packed
        if self._unsaved is None:
            return
        keys = self._unsaved.keys
        if keys != self._saved or now - self._saved_at >= SAVE_INTERVAL:
            self._writer.save(self._unsaved)
            is_first, self._saved, self._saved_at, self._unsaved = math.isinf(self._saved_at), keys, now, None
            if is_first and self._shared is not None:
                self._saved_at -= phase_of(self.title) * SAVE_INTERVAL
