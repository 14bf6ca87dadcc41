"""The Modbus driver: reads registers at the pace of the window's grid, and survives whatever the line does.

It can only read: see :mod:`otolith_drivers.modbus.client`. Times are those of the middle of each request's round trip.
"""

import logging
import math
import random
import threading
import time
from collections.abc import Sequence

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup
from otolith_drivers.modbus.client import Line
from otolith_drivers.modbus.options import Item, Options, Source, item_of
from otolith_drivers.modbus.plausibility import OrderWatch, StalenessMonitor
from otolith_drivers.modbus.protocol import Broken, Refused, Silent
from otolith_drivers.modbus.schedule import PollSchedule, Request, Requests, plan, summary

__all__ = ["ModbusPoller", "Options", "Source", "build"]

log = logging.getLogger(__name__)

BACKOFF_FIRST, BACKOFF_LONGEST = 0.2, 10.0  # s
LONGEST_END = 0.9  # s; only a name that is being looked up takes longer
LONGEST_SLEEP = 0.2  # s; how late a stop can be noticed between rounds


def build(options: Options, setup: Setup) -> "ModbusPoller":
    """A poller of all signals of ``setup``, as often as its sample period asks."""
    return ModbusPoller(options, [item_of(signal, options) for signal in setup.signals], setup.sample_period)


class ModbusPoller:
    """Implements :class:`otolith_drivers.base.Driver` over pymodbus, with a thread of its own."""

    sampling = Sampling.POLLED

    def __init__(self, options: Options, items: Sequence[Item], period: float) -> None:
        self._options = options
        self._items = items
        self._line = Line(options)
        self._requests = Requests(plan(items, options.max_gap, options.max_registers))
        self._pace = PollSchedule(period)
        self._watch = OrderWatch(items)
        self._held_back: dict[str, list[Sample]] = {}
        self._freshness = StalenessMonitor()
        self._received = self._bad = self._lost = self._reconnects = 0
        self._told = False
        self._up, self._was_up, self._reason = False, False, "not opened yet"
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        self._reason = "not connected yet"
        self._thread = threading.Thread(target=self._run, args=(deliver,), name="modbus-poll", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """See :meth:`otolith_drivers.base.Driver.close`."""
        self._stop.set()
        self._line.abort()
        if self._thread is not None:
            self._thread.join(timeout=LONGEST_END)

    def counters(self) -> Counters:
        """See :meth:`otolith_drivers.base.Driver.counters`."""
        return Counters(self._received, self._bad, self._lost, self._reconnects)

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        warnings = [*self._requests.warnings(time.monotonic()), *self._watch.warnings()]
        warnings += self._freshness.warnings(self._requests.requests, self._pace.period)
        described = f"{summary(self._requests.requests)}, {self._pace.describe()}"
        period = self._pace.period if self._pace.known or self._pace.period > self._pace.asked else None
        return Link(self._up, self._reason, tuple(warnings), described, period)

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        requests = self._requests.requests
        hertz = 1.0 / self._pace.asked
        lines = [
            f"{self._options.title()}, read only (function codes 3 and 4): {summary(requests)}, {hertz:g} Hz asked"
        ]
        least = sum(self._options.least_time(request.count) for request in requests)
        if least > self._pace.asked:
            lines.append(f"the line is too slow for that: at most {1.0 / least:.3g} Hz can be achieved")
        return lines + [f"{item.name} [{item.target_unit}] from {item.describe()}" for item in self._items]

    def _run(self, deliver: Deliver) -> None:
        self._pace.start(time.monotonic())
        connected, pause = False, BACKOFF_FIRST
        while not self._stop.is_set():
            try:
                if not connected:
                    self._line.connect()
                    self._lose(self._pace.pass_over(time.monotonic()) * len(self._items))
                    connected, pause = True, BACKOFF_FIRST
                self._wait()
                if not self._stop.is_set():
                    connected = self._round(deliver)
            except Exception as error:
                if self._stop.is_set():  # by ourselves
                    break
                if not isinstance(error, Broken):
                    log.exception("%s", self._options.title())
                self._go_down(str(error) or type(error).__name__)
                connected = False
                self._stop.wait(pause * random.uniform(0.5, 1.0))  # noqa: S311 - jitter, not a secret
                pause = min(2.0 * pause, BACKOFF_LONGEST)
                self._lose(self._pace.pass_over(time.monotonic()) * len(self._items))
        self._line.close()

    def _wait(self) -> None:
        while not self._stop.is_set() and (left := self._pace.due - time.monotonic()) > 0.0:
            self._stop.wait(min(left, LONGEST_SLEEP))

    def _round(self, deliver: Deliver) -> bool:
        """Read what is due; whether the line may be used for the next round as it is."""
        begun = time.monotonic()
        self._lose(self._pace.begin(begun) * len(self._items))
        due = self._requests.due(begun)
        usable, answered, repeated = True, 0, True
        for request in due:
            try:
                repeated &= self._read(request, deliver)
                answered += len(request.items)
            except Refused as error:
                log.debug("%s: %s", request.describe(), error)
                self._requests.refused(request, error, time.monotonic())
            except Silent as error:
                self._requests.silent(request, str(error), time.monotonic())
                usable = False
                break
            except Broken:
                self._lose(len(self._items) - answered)
                self._settle(deliver)
                raise
            if self._options.pause:
                self._stop.wait(self._options.pause)
        self._lose(len(self._items) - answered)
        self._settle(deliver)
        if answered:
            self._come_up()
        if answered == len(self._items) and self._pace.end(time.monotonic() - begun, repeated=repeated):
            log.warning("%s: %s", self._options.title(), self._pace.describe())
        if self._pace.known and not self._told and self._pace.achieved is not None:
            self._told = True
            log.info("%s: %s, %s", self._options.title(), summary(self._requests.requests), self._pace.describe())
        return usable or self._drained()

    def _read(self, request: Request, deliver: Deliver) -> bool:
        """Read one request and hand on what is in it; whether it says the same as before."""
        asked = time.monotonic()
        registers = self._line.read(request.device, request.table, request.address, request.count)
        moment = 0.5 * (asked + time.monotonic())
        self._requests.answered(request)
        repeated, stale = self._freshness.take(request, registers)
        if stale:
            self._bad += len(request.items)
            return repeated
        samples = []
        for item in request.items:
            part = registers[item.address - request.address : item.end - request.address]
            self._watch.take(item, part)
            samples.append(Sample(item.name, moment, item.value(part)))
        for sample in samples:
            if self._watch.unjudged(sample.signal):
                self._held_back.setdefault(sample.signal, []).append(sample)
        self._hand_on([sample for sample in samples if sample.signal not in self._held_back], deliver)
        return repeated

    def _settle(self, deliver: Deliver) -> None:
        """Judge the order of bytes, and hand on what waited for it."""
        self._watch.end_round()
        for name in [name for name in self._held_back if not self._watch.unjudged(name)]:
            self._hand_on(self._held_back.pop(name), deliver)

    def _hand_on(self, samples: Sequence[Sample], deliver: Deliver) -> None:
        if self._stop.is_set():  # nobody waits for them any more
            return
        kept = [sample for sample in samples if sample.signal not in self._watch.withheld]
        good = sum(math.isfinite(sample.value) for sample in kept)
        self._received += good
        self._bad += len(samples) - good
        if kept:
            deliver(kept)

    def _drained(self) -> bool:
        """After a question without an answer, an answer without a question may come: the line is opened anew."""
        self._line.drain()
        if self._requests.all_silent:
            self._go_down("no device answers")
        return False

    def _come_up(self) -> None:
        if not self._up:
            self._up, self._reason = True, ""
            self._reconnects += self._was_up
            self._was_up = True
            log.info("%s: answers", self._options.title())

    def _go_down(self, reason: str) -> None:
        self._line.close()
        if reason != self._reason:
            log.warning("%s: %s; tried again for ever", self._options.title(), reason)
        self._up, self._reason = False, reason

    def _lose(self, samples: int) -> None:
        self._lost += samples
