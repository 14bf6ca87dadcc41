"""The main thread of the service: it watches when windows are due, hands them to workers, and supervises the processes.

It serves one machine or a hall of them. A heap has the moment at which each machine is to be asked for its next window,
so the work does not grow with machines that have nothing to do. The main thread never waits for a machine, a worker, a
disk, a command or a subscriber. It waits only for a process that it has killed and, at the end, for writers, recorder
and commands, each up to its flush time.

In a hall no machine ends the service: one that cannot be opened is left out, and what goes wrong while one is served
costs its window only. A machine that is alone ends it with the error. On SIGHUP another thread reads all files again,
closes what is no longer served and opens what is new, one machine after the other.
"""

import contextlib
import heapq
import logging
import math
import os
import signal
import sqlite3
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from types import FrameType

from otolith.machine import LoadedMachine
from otolith.publishing.publisher import Publisher
from otolith.publishing.zenoh_session import protect_files
from otolith.runtime.hall.about import about
from otolith.runtime.hall.background import Background, Then
from otolith.runtime.hall.changes import Changes, changes_of_hall, changes_of_one
from otolith.runtime.hall.files import MachineFiles, Refused, one_line
from otolith.runtime.hall.left_out import LeftOut
from otolith.runtime.hall.machine import MAX_WAIT, Machine
from otolith.runtime.hall.notifier import Notifier
from otolith.runtime.hall.outlet_process import OutletProcess
from otolith.runtime.hall.pool import Pool, Preparation
from otolith.runtime.hall.recorder_process import RecorderProcess
from otolith.runtime.process import SIGNALS, spare_collections, wait_for
from otolith.runtime.service import OUTLET_FLUSH, Service, SharedParts
from otolith.storage.disk import StorageThread
from otolith.storage.state_store import LockedError
from otolith_drivers.errors import OtolithError, ServiceError, counted

log = logging.getLogger(__name__)

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
SWITCH_INTERVAL = 5e-4  # s; Python's thread switch interval, which delays the time stamps of arriving samples
LOOK_INTERVAL = 0.1  # s between two looks at some of the recordings, and whether windows are being finished
LOOKS = 10  # by which a hall has looked at the recordings of all of its machines
MIN_WORKERS = 2  # of a hall: a window that takes long leaves one to the others
STATUS_INTERVAL = 2.0  # s between two lines for systemd about a hall
STORAGE_FLUSH, STORAGE_FLUSH_OF_MACHINE = 1.5, 0.03  # s to finish writing at the end of a hall, and for each machine


class Daemon:
    """Serves machines, or one, from :meth:`run` to the signal that stops it."""

    def __init__(self, services: Sequence[Service], hall: "HallSetup | None" = None) -> None:
        """Several ``services`` are a ``hall``, which has the parts that they share; one that is alone has its own."""
        self._services = {service.machine: service for service in services}
        self._hall, self._is_alone = hall, hall is None
        self._pool = Pool(list(self._services), 1 if hall is None else min(len(services), hall.workers))
        self._numbers = count()
        self._due: list[tuple[float, int, Machine]] = []
        self._publishers: list[Publisher] = []
        self._left_out, self._background = LeftOut(), Background()
        self._notifier = Notifier()
        self._preparation: Preparation | None = None  # As it was shown
        self._stop_signal: int | None = None
        self._is_reload_due = self._is_reloading = False
        self._unseen: list[Service] = []  # Those that :meth:`_look` has not looked at yet in this turn
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
                if self._is_reload_due and not self._is_reloading:
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
        for service in self._served:
            with self._alone_or_left_out(service):
                text = service.open(self._publisher_for(service), patiently=not self._is_alone)
        if not self._services:
            raise ServiceError("no machine can be served: the lines above say why")
        for service in self._served:
            service.pass_on()
        self._due = [(0.0, next(self._numbers), machine) for machine in self._services]
        self._pool.start(time.monotonic())
        if self._hall is not None:
            self._left_out.replace(self._hall.refused, {service.names for service in self._served}, time.time())
        spare_collections()
        listening = text if self._is_alone else f"to {counted(len(self._services), 'machine')}"
        self._notifier.send("READY=1", f"STATUS=listening: {listening}", f"MAINPID={os.getpid()}")

    @property
    def _served(self) -> list[Service]:
        """The machines that are not left out."""
        return list(self._services.values())

    @contextlib.contextmanager
    def _alone_or_left_out(self, service: Service) -> Iterator[None]:
        """Leave a machine out that cannot be served; the error of a machine that is alone is raised."""
        try:
            with about("" if self._is_alone else service.title):
                yield
        except Exception as error:
            if self._is_alone:
                raise
            _log_left_out(service, error)
            self._withdraw(service, error)

    def _withdraw(self, service: Service, error: Exception | None = None, *, is_gone: bool = False) -> None:
        """Serve a machine no longer: another daemon may, once another thread has closed what it uses.

        Unless another one does already, it is published then that it is not served because of an ``error``.
        """
        del self._services[service.machine]
        self._due = [row for row in self._due if row[2] is not service.machine]
        heapq.heapify(self._due)
        self._pool.leave_out(service.machine)
        service.leave_outlets(is_gone=is_gone)
        self._background.do(partial(self._close, service, error))

    def _close(self, service: Service, error: Exception | None) -> Then | None:
        """Close what a machine uses, in another thread; return what follows in the main thread."""
        with about(service.title):
            service.end()
        if error is None or isinstance(error, LockedError):
            return None
        refused = Refused(service.path, service.names, one_line(error), service.language)
        return lambda: self._left_out.add(refused, time.time())

    def _publisher_for(self, service: Service) -> Publisher:
        """Return the session that a machine shares with those that have the same endpoints and readers."""
        for publisher in self._publishers:
            if publisher.shares(service.listen, service.access):
                publisher.add(service.published)
                return publisher
        publisher = Publisher([service.published], service.listen, service.access, of_hall=not self._is_alone)
        self._publishers.append(publisher)
        return publisher

    def _stop(self) -> None:
        """Stop every part, even if stopping another one fails; the last callback runs first."""
        services = self._served
        shared = None if self._hall is None else self._hall.parts
        flush = STORAGE_FLUSH + STORAGE_FLUSH_OF_MACHINE * len(services)
        with contextlib.ExitStack() as steps:
            for service in services:
                steps.callback(service.unlock)
            steps.callback(self._notifier.close)
            for publisher in self._publishers:
                steps.callback(publisher.close)
            if shared is not None:
                steps.callback(shared.storage.stop, flush)
            for service in services:
                service.stop_outputs(steps)
            if shared is not None:
                steps.callback(shared.recorder.stop, flush)
                steps.callback(shared.outlets.stop, OUTLET_FLUSH)
            steps.callback(self._pool.kill)
            for service in services:
                steps.callback(service.close_driver)
            for service in services:
                service.save_last()
            steps.callback(self._background.stop, flush)  # it writes what is left of machines that were withdrawn
            self._notifier.send("STOPPING=1")

    def _reload(self) -> None:
        self._is_reload_due, self._is_reloading = False, True
        self._background.do(partial(self._read, self._served))

    def _read(self, served: Sequence[Service]) -> Then:
        """Read the files again, in another thread; return what follows in the main thread."""
        try:
            changes = changes_of_one(served[0]) if self._hall is None else changes_of_hall(served, self._hall.paths)
        except Exception as error:  # noqa: BLE001 - no file ends the service
            _log_error("not reloaded, the daemon goes on as before", error)
            return self._end_reload
        return partial(self._take_over, changes)

    def _take_over(self, changes: Changes) -> None:
        served = [service for service in self._served if service not in changes.ended]
        for service, revision in changes.revised:
            if service not in served:  # it was withdrawn while files were read
                continue
            with self._guarded(service, "not reloaded"):
                service.take_over(revision)
        for service, reason in changes.kept:
            with self._guarded(service, "not reloaded"):
                service.refuse(reason)
        for publisher in self._publishers:
            self._reload_access(publisher, [service for service in served if service.publisher is publisher])
        new = {(machine.file.machine.site, machine.file.machine.name) for machine in changes.new}
        self._left_out.replace(changes.refused, new.union(service.names for service in served), time.time())
        for service in changes.ended:
            if service.machine in self._services:  # it was not left out meanwhile
                with about(service.title):
                    log.info("its file was changed or removed: what it uses is closed")
                service.save_last()
                self._withdraw(service, is_gone=service.names not in new)
        for machine in changes.new:
            self._background.do(partial(self._open, machine))
        self._background.do(lambda: self._end_reload)

    def _open(self, machine: LoadedMachine) -> Then | None:
        """Open a machine, in another thread; return what follows in the main thread."""
        if self._hall is None:
            return None
        service = self._hall.service_of(machine)
        if isinstance(service, Refused):
            refused = service
            return lambda: self._left_out.add(refused, time.time())
        try:
            with about(service.title):
                service.prepare()
                service.open(self._publisher_for(service), patiently=True)
        except Exception as error:  # noqa: BLE001 - no machine ends the hall
            _log_left_out(service, error)
            return self._close(service, error)
        return partial(self._serve, service)

    def _serve(self, service: Service) -> None:
        """Ask a machine that was opened for its windows."""
        now, most = time.monotonic(), 1 if self._hall is None else self._hall.workers
        self._services[service.machine] = service
        service.pass_on()
        heapq.heappush(self._due, (now, next(self._numbers), service.machine))
        self._pool.add(service.machine, now, most)

    def _end_reload(self) -> None:
        self._is_reloading = False
        for publisher in tuple(self._publishers):
            if publisher.is_idle:
                self._publishers.remove(publisher)
                self._background.do(publisher.close)
        spare_collections()
        if not self._is_alone:
            log.info("%d machines are served", len(self._services))

    def _reload_access(self, publisher: Publisher, group: Sequence[Service]) -> None:
        """Let a session take over who may read, if all machines that share it say the same."""
        if not group:
            return
        first = group[0]
        if all(each.access.zenoh == first.access.zenoh for each in group):
            publisher.reload(first.access)
        else:
            names = ", ".join(service.title for service in group)
            log.warning("only a restart takes over who may read, as the files of %s no longer say the same", names)

    def _step(self) -> None:
        """Hand the samples of due windows to workers, publish finished reports, supervise the processes."""
        now = time.monotonic()
        while self._due and self._due[0][0] <= now:
            _, number, machine = heapq.heappop(self._due)
            heapq.heappush(self._due, (self._take_due(machine, now), number, machine))
        due = self._due[0][0] if self._due else now + MAX_WAIT  # all may begin anew at once
        wait_for(self._pool.waitables, min(MAX_WAIT, due - now))
        for machine, finished in self._pool.poll(time.monotonic()):
            if (service := self._services.get(machine)) is None:
                continue
            with self._guarded(service):
                line = service.finish(finished, self._pool.restarts)
                self._show_status(line, time.monotonic())
        self._background.finish()
        now = time.monotonic()
        if (publisher := next((each.publisher for each in self._services.values()), None)) is not None:
            self._left_out.publish(publisher, now, time.time())
        self._show_preparation()
        if now - self._watchdog_at >= LOOK_INTERVAL:
            self._watchdog_at = now
            self._feed_watchdog(now)
        if now - self._recorders_at >= LOOK_INTERVAL or self._is_alone:
            self._recorders_at = now
            self._look(now)
            if not (self._services or self._is_reloading):
                raise ServiceError("no machine is served any more: the lines above say why")

    def _look(self, now: float) -> None:
        """Look at the processes and the lock of some machines, in turn: for all of them it takes milliseconds."""
        for _ in range(math.ceil(len(self._services) / LOOKS)):
            self._unseen = self._unseen or self._served
            service = self._unseen.pop()
            if self._services.get(service.machine) is not service:  # it was withdrawn meanwhile
                continue
            with self._guarded(service):
                service.poll_processes(now)
            if service.locked_out is not None:
                with self._alone_or_left_out(service):
                    raise service.locked_out

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


def _log_left_out(service: Service, error: Exception) -> None:
    with about(service.title):
        _log_error("not served", error)


def _log_error(what: str, error: Exception) -> None:
    is_known = isinstance(error, OtolithError | OSError | sqlite3.Error)
    log.error("%s: %s", what, one_line(error), exc_info=None if is_known else error)


@dataclass(frozen=True, slots=True)
class HallSetup:
    """What several machines have in common."""

    paths: tuple[Path, ...]  # Their files, and directories of files
    listen: tuple[str, ...] | None  # In place of the endpoints of the files
    workers: int  # Processes that compute, at most
    parts: SharedParts
    refused: tuple[Refused, ...] = ()  # At the start

    def service_of(self, machine: LoadedMachine) -> Service | Refused:
        """Return the service of a machine, or why there is none."""
        identity = machine.file.machine
        try:
            return Service(machine, self.listen, shared=self.parts)
        except (OtolithError, OSError) as error:
            log.error("%s: not served: %s", machine.path, error)  # noqa: TRY400 - a fault of a machine needs no traceback
            return Refused(machine.path, (identity.site, identity.name), one_line(error), identity.language)


def hall_of(paths: Sequence[Path], files: MachineFiles, listen: tuple[str, ...] | None, workers: int | None) -> Daemon:
    """Return the hall of several machines; without a number, there are as many ``workers`` as processors, but two.

    Raises:
        ServiceError: no machine can be served.
    """
    parts = SharedParts(RecorderProcess(), OutletProcess(), StorageThread())
    most = max(MIN_WORKERS, os.cpu_count() or 1) if workers is None else workers
    hall = HallSetup(tuple(paths), listen, most, parts, files.refused)
    services = [hall.service_of(machine) for machine in files.machines.values()]
    usable = [service for service in services if isinstance(service, Service)]
    if not usable:
        raise ServiceError("no machine can be served: the lines above say why")
    refused = (*files.refused, *(service for service in services if isinstance(service, Refused)))
    return Daemon(usable, replace(hall, refused=refused))
