"""The service: the only file that knows all parts. Builds, starts, watches and stops them.

    driver thread -> rings -> [this thread] window -> worker process -> [this thread] report -> Zenoh, recorder process

This thread never waits for a machine, a worker, a disk or a subscriber; only for a process that it has killed, and at
the end half a second for the disk.
"""

import contextlib
import logging
import math
import os
import signal
import sys
import time
from datetime import UTC, datetime
from multiprocessing.connection import wait
from pathlib import Path
from types import FrameType

from otolith.acquisition.ring import Rings
from otolith.acquisition.window import Verdict
from otolith.acquisition.windower import Windower
from otolith.adaptation.state import (
    OperatorDecisions,
    apply_decisions,
    component_records,
    initial_state,
    restore_components,
    with_sample_grid,
)
from otolith.health.schema import CountersDocument, DriverDocument, Report
from otolith.health.text import summary
from otolith.machine import LoadedMachine, recording_folder
from otolith.publishing.zenoh_session import Publisher
from otolith.runtime.process import SIGNALS, ChildProcess
from otolith.runtime.state_store import StateStore, WriterThread
from otolith.runtime.systemd import Notifier
from otolith.runtime.worker import COMPILING, Supervisor
from otolith_drivers.errors import OtolithError
from otolith_drivers.user_dirs import writable

log = logging.getLogger(__name__)

RING_WINDOWS = 8  # windows that the rings hold: how long this thread may be held up without losing a sample
RING_RATE = 4  # how much faster than the grid a source may send for that to be true
TICK = 0.1  # s; the longest wait, so how late a stop, a death or an outage can be noticed
SWITCH = 5e-4  # s that a thread of Python may keep the others waiting: what arrives is to be stamped at once
RECORDER_ROOM = 32  # windows
RECORDER_FLUSH, KEEPER_FLUSH = 1.5, 0.5  # s at the end
STALL = 30.0  # s without a finished window (a bad one counts), after which the watchdog is no longer fed; the first
# one may take as much longer as the supervisor gives it, or a slow computer would never compile its twin
OTHER_GRID = 0.01  # difference of two sample periods that matters
FORGET = "'otolith components forget' clears what is no longer so"
KEEP_EVERY = 300.0  # s between two writes of components that are only known better
THRIVES = 60.0  # s after which a recorder counts as healthy


class Service:
    """One machine, from :meth:`run` to the signal that stops it."""

    def __init__(
        self, plan: LoadedMachine, listen: tuple[str, ...] | None = None, recording: Path | None = None
    ) -> None:
        machine = plan.file.machine
        self._plan = plan
        self._listen = plan.file.zenoh.listen if listen is None else listen
        self._rings = Rings(plan.twin.signals, RING_RATE * RING_WINDOWS * plan.problem.window.longest)
        period, sampling = plan.file.window.sample_period, plan.driver.sampling
        self._windower = Windower(plan.twin.signals, plan.records, period, plan.limits, sampling)
        longest = plan.problem.window.longest * period
        keeper = StateStore(machine.site, machine.name, plan.twin, signal_fingerprint=plan.signal_fingerprint)
        self._housekeeper = WriterThread(keeper, keeper.stamp())
        state = initial_state(machine.name, machine.site, plan.problem)
        decisions = OperatorDecisions()
        try:
            state, decisions = restore_components(state, keeper.components()), keeper.decisions()
        except OtolithError as error:  # a file that cannot be read is no reason not to watch the machine
            log.warning("begun without components: %s", error)
        self._kept, self._kept_at = tuple(entry.component.key for entry in state.adopted), 0.0
        if self._kept:
            log.info("begun with what was found earlier: %s; %s", ", ".join(map(str, self._kept)), FORGET)
        self._supervisor = Supervisor(apply_decisions(state, decisions), longest)
        self._recorder = ChildProcess("otolith-recorder", "otolith.publishing.recorder:main", RECORDER_ROOM)
        self._recording = recording if plan.file.recording.enabled else None
        self._publisher: Publisher | None = None
        self._notifier = Notifier()
        self._stop_signal: int | None = None
        self._windows = self._windows_bad = self._recordings_dropped = self._settled = 0
        self._started = self._progress = self._fed = 0.0

    def run(self) -> int:
        """Serve until SIGTERM, SIGHUP or SIGINT; the signal's number.

        Raises:
            DeviceError: the machine's bus cannot be opened.
            ServiceError: a port or folder of this computer cannot be had.
        """
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # as nohup leaves SIGHUP
                signal.signal(number, self._on_signal)
        try:
            self._start()
            while self._stop_signal is None:
                self._turn()
        finally:
            self._stop()
        return self._stop_signal or 0

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self._stop_signal = number

    def _start(self) -> None:
        sys.setswitchinterval(SWITCH)
        machine, driver = self._plan.file.machine, self._plan.driver
        self._publisher = Publisher(machine.site, machine.name, self._listen, self._plan.file.zenoh.connect)
        driver.open(self._rings.deliver)
        self._housekeeper.start()
        self._supervisor.start()
        self._start_recorder()
        self._started = self._progress = time.monotonic()
        self._notifier.ready(f"listening: {driver.describe()[0]}")
        log.info("machine %s, %s: reports on %s", machine.name, self._plan.twin.title, ", ".join(self._listen))

    def _stop(self) -> None:
        """Everything that was begun, whatever becomes of the rest."""
        with contextlib.ExitStack() as steps:
            steps.callback(self._notifier.close)
            if self._publisher is not None:
                steps.callback(self._publisher.close)
            steps.callback(self._housekeeper.stop, KEEPER_FLUSH)
            steps.callback(self._recorder.stop, RECORDER_FLUSH)
            steps.callback(self._supervisor.stop)
            steps.callback(self._plan.driver.close)
            self._keep(math.inf)
            self._notifier.stopping()

    def _start_recorder(self) -> None:
        plan = self._plan
        if not plan.file.recording.enabled:
            return
        if self._recording is None or self._recorder.starts:  # a second file never overwrites the first
            folder = recording_folder(plan)
            stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
            self._recording = folder / f"{plan.file.machine.name}-{stamp}-{os.getpid()}.rrd"
        writable(self._recording.parent)
        title = f"{plan.file.machine.name} at {plan.file.machine.site}"
        self._recorder.start(self._recording, title, plan.twin, plan.problem.free)
        log.info("recording to %s", self._recording)

    def _turn(self) -> None:
        """One pass: cut what is due, hand it on, publish what came back, watch over everybody."""
        now = time.monotonic()
        begun = self._windower.begin(self._rings, now, now - self._started)
        while begun and self._windower.due(self._rings, now):
            self._cut(now)
        pause = min(TICK, max(0.005, self._windower.next_end - now))
        wait(self._supervisor.waitables, timeout=pause)
        for report, seconds in self._supervisor.poll(time.monotonic()):
            self._publish(report, seconds)
            self._windower.records = self._supervisor.records
            self._keep(time.monotonic())
        self._watch(time.monotonic())

    def _keep(self, now: float) -> None:
        """Have components written down that are new, gone, or known better than a while ago."""
        state = self._supervisor.state
        found = tuple(entry.component.key for entry in state.adopted)
        if found != self._kept or (found and now - self._kept_at >= KEEP_EVERY):
            self._housekeeper.keep(component_records(state))
            self._kept, self._kept_at = found, now

    def _listen_to_specialist(self) -> None:
        """What has been said about components since it was last looked at."""
        decisions = self._housekeeper.new_decisions()
        if decisions is not None:
            self._supervisor.revise(lambda state: apply_decisions(state, decisions))

    def _regrid(self) -> None:
        """Where the machine gives less than was asked, windows are made of what it gives."""
        period, now = self._plan.driver.link().period, self._windower.sample_period
        if period is None or abs(period / now - 1.0) < OTHER_GRID:
            return
        plan = self._plan
        ratio = period / plan.file.window.sample_period
        self._supervisor.revise(lambda state: with_sample_grid(state, plan.problem.window, ratio))
        self._windower.regrid(self._supervisor.records, period)
        found = f"the machine gives a sample every {period * 1e3:.4g} ms, not every {now * 1e3:.4g} ms"
        size = f"{self._windower.records} records in {self._windower.length:.4g} s"
        log.warning("%s: windows have %s from now on", found, size)

    def _cut(self, now: float) -> None:
        window = self._windower.cut(self._rings, time.time() - time.monotonic())
        self._regrid()
        self._listen_to_specialist()
        self._windows += 1
        self._windows_bad += window.quality.verdict is Verdict.BAD
        self._supervisor.submit(window, now)

    def _publish(self, report: Report, seconds: float) -> None:
        document = report.document
        latency = max(0.0, time.time() - document.window.end)
        cost = document.cost.model_copy(update={"seconds": seconds, "latency_s": latency})
        link = self._plan.driver.link()
        driver = DriverDocument(up=link.up, reason=link.reason, warnings=link.warnings, plan=link.plan)
        document = document.model_copy(update={"cost": cost, "counters": self._counters(), "driver": driver})
        if self._publisher is not None:
            self._publisher.publish(document)
        if self._plan.file.recording.enabled:
            recorded = self._recorder.alive and self._recorder.offer(Report(document, report.traces))
            self._recordings_dropped += not recorded
        line = summary(document)
        self._notifier.status(line)
        log.info("%s", line)

    def _counters(self) -> CountersDocument:
        driver, rings, supervisor = self._plan.driver.counters(), self._rings.counters(), self._supervisor
        return CountersDocument(
            received=rings.received,
            bad=driver.bad,
            lost=driver.lost + rings.overwritten,
            reconnects=driver.reconnects,
            windows=self._windows,
            windows_bad=self._windows_bad,
            windows_missed=supervisor.missed,
            worker_restarts=supervisor.restarts,
            recordings_dropped=self._recordings_dropped,
        )

    def _watch(self, now: float) -> None:
        """Feed the watchdog by progress, not by mere life; bring a dead recorder back with a file of its own."""
        if self._supervisor.finished != self._settled:
            self._settled, self._progress = self._supervisor.finished, now
        patience = STALL + 3 * self._windower.length + (0.0 if self._supervisor.finished else COMPILING)
        stalled = now - self._progress > patience
        if self._notifier.watchdog and not stalled and now - self._fed > self._notifier.watchdog / 4:
            self._fed = now
            self._notifier.progress()
        if not self._plan.file.recording.enabled:
            return
        if self._recorder.alive and self._recorder.age > THRIVES:
            self._recorder.has_thrived()
        if self._recorder.may_start_again(now):
            try:
                self._start_recorder()
            except OtolithError as error:  # recordings are not what the machine is watched for
                log.warning("no recording: %s", error)
                self._recorder.postpone()
