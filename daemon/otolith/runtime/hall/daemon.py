"""The main thread of the service: it watches when windows are due, hands them to workers, and supervises the processes.

It serves one machine or a hall of them. A heap has the moment at which each machine is to be asked for its next window,
so the work does not grow with machines that have nothing to do. The main thread never waits for a machine, a worker, a
disk, a command or a subscriber. It waits only for a process that it has killed and, at the end, for writers, recorder
and commands, each up to its flush time.

In a hall no machine ends the service: one that cannot be opened is left out, and what goes wrong while one is served
costs its window only. A machine that is alone ends it with the error.
"""

import contextlib
import heapq
import logging
import os
import signal
import sqlite3
import sys
import time
from collections.abc import Iterator, Sequence
from multiprocessing.connection import wait
from types import FrameType

from otolith.machine import LoadedMachine
from otolith.machine_file import ZenohTable
from otolith.publishing.publisher import Publisher
from otolith.publishing.zenoh_session import protect_files
from otolith.runtime.hall.about import about
from otolith.runtime.hall.machine import MAX_WAIT, Machine
from otolith.runtime.hall.notifier import Notifier
from otolith.runtime.hall.pool import Pool, Preparation
from otolith.runtime.hall.recorder_process import RecorderProcess
from otolith.runtime.process import SIGNALS
from otolith.runtime.service import Service, SharedParts
from otolith.storage.disk import StorageThread
from otolith_drivers.errors import OtolithError, ServiceError, counted

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
SWITCH_INTERVAL = 5e-4  # s; Python's thread switch interval, which delays the time stamps of arriving samples
RECORDER_INTERVAL = 0.1  # s between two looks at the recorder
WATCHDOG_INTERVAL = 0.1  # s between two looks whether windows are being finished
STATUS_INTERVAL = 2.0  # s between two lines for systemd about a hall
STORAGE_FLUSH, STORAGE_FLUSH_OF_MACHINE = 1.5, 0.03  # s to finish writing at the end of a hall, and for each machine


class Daemon:
    """Serves machines, or one, from :meth:`run` to the signal that stops it."""

    def __init__(self, services: Sequence[Service], workers: int = 1, shared: SharedParts | None = None) -> None:
        """Several ``services`` have the parts that are ``shared``; one that is alone has its own."""
        self._services = {service.machine: service for service in services}
        self._shared, self._is_alone = shared, shared is None
        self._pool = Pool(list(self._services), workers)
        self._due: list[tuple[float, int, Machine]] = []
        self._publishers: list[Publisher] = []
        self._notifier = Notifier()
        self._preparation: Preparation | None = None  # As it was shown
        self._stop_signal: int | None = None
        self._is_reload_due = False
        self._fed_at = self._watchdog_at = self._recorders_at = self._status_at = 0.0

    def run(self) -> int:
        """Serve until SIGTERM or SIGINT, or in a terminal SIGHUP, and return the number of that signal.

        Raises:
            DeviceError: the bus of a machine that is alone cannot be opened.
            ConfigurationError: a file for the encryption of reports is wrong.
            ServiceError: another daemon runs for the machine, or a file that the caller named cannot be recorded.
        """
        for number in SIGNALS:
            if signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
                signal.signal(number, self._on_signal)
        try:
            self._start()
            while self._stop_signal is None:
                self._step()
                if self._is_reload_due:
                    self._reload()
        finally:
            self._stop()
        return self._stop_signal or 0

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGHUP and not os.isatty(0):  # in a terminal it means that the terminal is closed
            self._is_reload_due = True
        else:
            self._stop_signal = number

    def _start(self) -> None:
        sys.setswitchinterval(SWITCH_INTERVAL)
        protect_files()
        for service in self._served:
            with self._alone_or_left_out(service):
                service.prepare()
        for group in _groups(self._served):
            with self._alone_or_left_out(*group):
                published = [service.published for service in group]
                publisher = Publisher(published, group[0].listen, group[0].access)
                self._publishers.append(publisher)
                for service in group:
                    with self._alone_or_left_out(service):
                        text = service.open(publisher, patiently=not self._is_alone)
        if not self._services:
            raise ServiceError("no machine can be served: the lines above say why")
        self._due = [(0.0, number, machine) for number, machine in enumerate(self._services)]
        self._pool.start(time.monotonic())
        listening = text if self._is_alone else f"to {counted(len(self._services), 'machine')}"
        self._notifier.send("READY=1", f"STATUS=listening: {listening}", f"MAINPID={os.getpid()}")

    @property
    def _served(self) -> list[Service]:
        """The machines that are not left out."""
        return list(self._services.values())

    @contextlib.contextmanager
    def _alone_or_left_out(self, *services: Service) -> Iterator[None]:
        """Leave machines out that cannot be served; the error of a machine that is alone is raised."""
        try:
            with about(services[0].title if len(services) == 1 and not self._is_alone else ""):
                yield
        except Exception as error:
            if self._is_alone:
                raise
            for service in services:
                self._leave_out(service, error)

    def _leave_out(self, service: Service, error: Exception) -> None:
        """Serve a machine no longer: another daemon may, and nothing of it is written any more."""
        with about(service.title):
            is_known = isinstance(error, OtolithError | OSError | sqlite3.Error)
            log.error("not served: %s", error, exc_info=None if is_known else error)
            del self._services[service.machine]
            self._due = [row for row in self._due if row[2] is not service.machine]
            heapq.heapify(self._due)
            self._pool.leave_out(service.machine)
            with contextlib.ExitStack() as steps:
                steps.callback(service.unlock)
                service.stop_outputs(steps)
                steps.callback(service.close_driver)

    def _stop(self) -> None:
        """Stop every part, even if stopping another one fails; the last callback runs first."""
        services, count = self._served, len(self._services)
        with contextlib.ExitStack() as steps:
            for service in services:
                steps.callback(service.unlock)
            steps.callback(self._notifier.close)
            for publisher in self._publishers:
                steps.callback(publisher.close)
            if self._shared is not None:
                steps.callback(self._shared.storage.stop, STORAGE_FLUSH + STORAGE_FLUSH_OF_MACHINE * count)
            for service in services:
                service.stop_outputs(steps)
            if self._shared is not None:
                steps.callback(self._shared.recorder.stop, STORAGE_FLUSH + STORAGE_FLUSH_OF_MACHINE * count)
            steps.callback(self._pool.kill)
            for service in services:
                steps.callback(service.close_driver)
            for service in services:
                service.save_last()
            self._notifier.send("STOPPING=1")

    def _reload(self) -> None:
        self._is_reload_due = False
        for service in self._served:
            with self._guarded(service, "not reloaded"):
                service.reload()
        for publisher in self._publishers:
            self._reload_access(publisher, [service for service in self._served if service.publisher is publisher])

    def _reload_access(self, publisher: Publisher, group: Sequence[Service]) -> None:
        """Let a session take over who may read, if all machines that share it say the same."""
        if len(_groups(group)) == 1:
            publisher.reload(group[0].access)
        elif group:
            names = ", ".join(service.title for service in group)
            log.warning("only a restart takes over who may read, as the files of %s no longer say the same", names)

    def _step(self) -> None:
        """Hand the samples of due windows to workers, publish finished reports, supervise the processes."""
        now = time.monotonic()
        while self._due[0][0] <= now:
            _, number, machine = heapq.heappop(self._due)
            heapq.heappush(self._due, (self._take_due(machine, now), number, machine))
        wait(self._pool.waitables, timeout=min(MAX_WAIT, self._due[0][0] - now))
        for machine, finished in self._pool.poll(time.monotonic()):
            if (service := self._services.get(machine)) is None:
                continue
            with self._guarded(service):
                line = service.finish(finished, self._pool.restarts)
                self._show_status(line, time.monotonic())
        now = time.monotonic()
        self._show_preparation()
        if now - self._watchdog_at >= WATCHDOG_INTERVAL:
            self._watchdog_at = now
            self._feed_watchdog(now)
        if now - self._recorders_at >= RECORDER_INTERVAL or self._is_alone:
            self._recorders_at = now
            for service in self._served:
                with self._guarded(service):
                    service.poll_recorder(now)
                if service.locked_out is not None:
                    with self._alone_or_left_out(service):
                        raise service.locked_out
            if not self._services:
                raise ServiceError("no machine is served any more: the lines above say why")

    def _take_due(self, machine: Machine, now: float) -> float:
        """Submit the windows of a machine that are due; return when to ask it again."""
        service = self._services[machine]
        due = now + MAX_WAIT
        with self._guarded(service):
            while (due := machine.due_at(now)) <= now:
                self._pool.submit(machine, service.take(now), now)
        return due if due > now else now + MAX_WAIT

    @contextlib.contextmanager
    def _guarded(self, service: Service, what: str = "this window is not served") -> Iterator[None]:
        """In a hall, log what goes wrong with a machine instead of ending the service."""
        if self._is_alone:
            yield
            return
        with about(service.title):
            try:
                yield
            except Exception:
                log.exception("%s", what)

    def _show_preparation(self) -> None:
        """Tell readers and systemd how many kernels a worker has that is not ready: until then there is no report."""
        if (now := self._pool.preparation) == self._preparation:
            return
        before, self._preparation = self._preparation, now
        if (shown := now or before) is None:
            return
        self._notifier.send(f"STATUS={shown.text if now else 'the first window is computed'}")
        for service in self._served:
            service.show_preparation(shown, is_done=now is None)

    def _show_status(self, line: str, now: float) -> None:
        """Tell systemd the last line about a machine that is alone, or how the windows of a hall are."""
        if self._is_alone:
            self._notifier.send(f"STATUS={line}")
        elif now - self._status_at >= STATUS_INTERVAL:
            self._status_at = now
            finished = sum(machine.finished for machine in self._services)
            missed = sum(machine.missed for machine in self._services)
            machines = counted(len(self._services), "machine")
            self._notifier.send(f"STATUS={machines}: {finished} windows finished, {missed} missed")

    def _feed_watchdog(self, now: float) -> None:
        """Feed systemd's watchdog as long as windows, good or bad, are being finished, or kernels compiled."""
        stalled = self._pool.is_stalled(now)
        if self._notifier.watchdog and not stalled and now - self._fed_at > self._notifier.watchdog / 4:
            self._fed_at = now
            self._notifier.send("WATCHDOG=1")


def _groups(services: Sequence[Service]) -> list[list[Service]]:
    """Return the services that share a session: those with the same endpoints, readers and certificates."""
    groups: dict[tuple[object, ...], list[Service]] = {}
    for service in services:
        access = service.access
        table: ZenohTable = access.zenoh
        key = (service.listen, table.model_dump_json(), str(access.path.parent.absolute()))
        groups.setdefault(key, []).append(service)
    return list(groups.values())


def hall_of(machines: Sequence[LoadedMachine], listen: tuple[str, ...] | None, workers: int | None) -> Daemon:
    """Return the hall of several machines; without a number, there are as many ``workers`` as processors."""
    shared = SharedParts(RecorderProcess(len(machines)), StorageThread())
    services = []
    for machine in machines:
        try:
            services.append(Service(machine, listen, shared=shared))
        except (OtolithError, OSError) as error:
            log.error("%s: not served: %s", machine.path, error)  # noqa: TRY400 - a fault of a machine needs no traceback
    if not services:
        raise ServiceError("no machine can be served: the lines above say why")
    count = min(len(services), os.cpu_count() or 1) if workers is None else workers
    return Daemon(services, count, shared)
