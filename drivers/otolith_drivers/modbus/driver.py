"""The Modbus driver: polls registers on the window's grid and reconnects after every fault.

It can only read (see :mod:`otolith_drivers.modbus.client`), and shares its line with other drivers. The time of a
sample is the middle of its request's round trip.
"""

import logging
import math
import time
from collections import deque
from collections.abc import Sequence

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup
from otolith_drivers.common.reconnection import OwnFaults, PassingFault, Reconnection, ThreadedDriver
from otolith_drivers.modbus.client import (
    BUSY_CODES,
    ConnectionLostError,
    ExceptionReplyError,
    NoReplyError,
)
from otolith_drivers.modbus.options import BIT_TABLES, ModbusOptions, ModbusSource, RegisterSignal, register_signal
from otolith_drivers.modbus.plausibility import OrderMonitor, StalenessMonitor
from otolith_drivers.modbus.schedule import MAX_FAILURES, PollSchedule, Request, RequestSet, plan, summary
from otolith_drivers.modbus.shared_line import LineUser

__all__ = ["ModbusPoller", "Options", "Source", "build"]

log = logging.getLogger(__name__)

Options = ModbusOptions
Source = ModbusSource

BUSY_PAUSES = 10  # of a period: how often a busy device is asked again at most; engineering choice
TRIPS = 100  # round trips of which the longest bounds the error of the times; engineering choice: a second at 100 Hz
MAX_SLEEP = 0.2  # s that a stop between two rounds may go unnoticed; engineering choice


def build(options: ModbusOptions, setup: Setup) -> "ModbusPoller":
    """Return a poller of all signals; raise ConfigurationError for a wrong unit, or a register that does not exist."""
    return ModbusPoller(options, [register_signal(signal, options) for signal in setup.signals], setup.sample_period)


class ModbusPoller(ThreadedDriver):
    """Implements :class:`otolith_drivers.base.Driver` over pymodbus, with its own thread."""

    sampling = Sampling.POLLED

    def __init__(self, options: ModbusOptions, signals: Sequence[RegisterSignal], period: float) -> None:
        super().__init__()
        self._options = options
        self._signals = signals
        self._client = LineUser(options)
        hidden = {signal.decimals.place: signal.decimals for signal in signals if signal.decimals is not None}
        self._requests = RequestSet(plan([*signals, *hidden.values()], options.max_gap, options.max_registers))
        self._decimals: dict[tuple[int, str, int], float] = {}  # latest ones, by the place of their register
        self._trips: deque[float] = deque(maxlen=TRIPS)  # latest round-trip times in s
        self._answers = self._closings = 0  # since the connection was opened; connections in a row with one answer
        self._schedule = PollSchedule(period)
        self._order = OrderMonitor(signals)
        self._unjudged: dict[str, list[Sample]] = {}  # By signal, until the first judgement of the byte order
        self._staleness = StalenessMonitor()
        self._unusable = {signal.name: PassingFault() for signal in signals}  # Values that are no reading
        self._own_faults = OwnFaults(log)
        self._received = self._bad = self._lost = 0
        self._rate_logged = False
        self._connection = Reconnection(options.title(), log)

    def open(self, deliver: Deliver) -> None:
        self._connection.stay_down("not connected yet")
        self._start("modbus-poll", self._run, deliver)

    def close(self) -> None:
        self._stop.set()
        self._client.abort()
        super().close()

    def counters(self) -> Counters:
        return Counters(self._received, self._bad, self._lost, self._connection.count)

    def link(self) -> Link:
        schedule, requests, (up, reason) = self._schedule, self._requests.requests, self._connection.state
        now = time.monotonic()
        warnings = [*self._requests.warnings(now), *self._order.warnings()]
        warnings += [line for name, fault in self._unusable.items() for line in fault.warnings(now, name)]
        warnings += self._staleness.warnings(requests, schedule.period)
        period = schedule.period if schedule.known or schedule.period > schedule.requested else None
        plan_text = f"{summary(requests)}, {schedule.describe()}"
        if trips := list(self._trips):
            plan_text += f", times right within {500.0 * max(trips):.2g} ms"
        if self._closings >= MAX_FAILURES:
            plan_text += ", reconnected for each request, as the device closes the connection after each answer"
        return Link(up, reason, tuple(warnings), plan_text, period, defect=self._own_faults.defect(now))

    def describe(self) -> list[str]:
        requests, period = self._requests.requests, self._schedule.requested
        codes = "1 to 4" if any(signal.table in BIT_TABLES for signal in self._signals) else "3 and 4"
        title = f"{self._options.title()}, read only (function codes {codes})"
        lines = [f"{title}: {summary(requests)}, {1.0 / period:g} Hz asked"]
        least = sum(self._options.least_time(request.count) for request in requests)
        if least > period:
            lines.append(f"the line is too slow for that: at most {1.0 / least:.3g} Hz can be achieved")
        return lines + [f"{signal.name} [{signal.target_unit}] from {signal.describe()}" for signal in self._signals]

    def _run(self, deliver: Deliver) -> None:
        self._schedule.start(time.monotonic())
        connected = False
        while not self._stop.is_set():
            try:
                if not connected:
                    self._client.connect()
                    self._answers = 0
                    self._lost += self._schedule.pass_over(time.monotonic()) * len(self._signals)
                    connected = True
                    self._connection.backoff.reset()  # although a device may break each round before it is complete
                self._wait()
                if not self._stop.is_set():
                    connected = self._round(deliver)
            except Exception as error:  # noqa: BLE001 - nothing that a device answers may end the thread
                if self._stop.is_set():  # the connection was closed by the driver
                    break
                if not isinstance(error, ConnectionLostError):
                    self._own_faults.note(error, f"a round of requests to {self._options.title()}", time.monotonic())
                self._go_down(str(error) or type(error).__name__)
                connected = False
                self._stop.wait(self._connection.backoff.next())
                self._lost += self._schedule.pass_over(time.monotonic()) * len(self._signals)
        self._client.close()

    def _wait(self) -> None:
        while not self._stop.is_set() and (left := self._schedule.due - time.monotonic()) > 0.0:
            self._stop.wait(min(left, MAX_SLEEP))

    def _round(self, deliver: Deliver) -> bool:
        """Send the requests that are due; return whether the connection may be used for the next round as it is."""
        begun = time.monotonic()
        self._lost += self._schedule.begin(begun) * len(self._signals)
        usable, answered, repeated = True, 0, True
        waiting = deque(self._requests.due(begun))
        busy: list[Request] = []
        while waiting and usable and not self._stop.is_set():
            request = waiting.popleft()
            try:
                repeated &= self._read(request, deliver)
                answered += request.samples
            except ExceptionReplyError as error:
                busy += self._refused(request, error)
            except NoReplyError as error:
                self._requests.unanswered(request, str(error), time.monotonic())
                usable = False
            except ConnectionLostError:
                self._end_reading(answered, deliver)
                raise
            if busy and not waiting:
                self._stop.wait(self._schedule.period / BUSY_PAUSES)
                waiting, busy = deque(busy), []
        self._end_reading(answered, deliver)
        if answered:
            self._connection.come_up("answers")
        if answered == len(self._signals):
            self._end_complete_round(time.monotonic() - begun, repeated=repeated)
        if not usable and self._requests.all_silent:
            self._go_down("no device answers")
        return usable

    def _refused(self, request: Request, error: ExceptionReplyError) -> list[Request]:
        """Return the request if the device is busy and can be asked again before the next round; else note it."""
        log.debug("%s: %s", request.describe(), error)
        if not self._connection.up:
            self._connection.stay_down(f"requests are refused: {error}")
        now, schedule = time.monotonic(), self._schedule
        if error.code in BUSY_CODES and now + 2.0 * schedule.period / BUSY_PAUSES < schedule.due:
            return [request]
        self._requests.refused(request, error, now)
        return []

    def _request(self, request: Request) -> tuple[list[int], float]:
        """Return registers and middle (s) of the round trip; reopen a closed line once; raises as ``read``."""
        try:
            with self._client.turn():
                sent = time.monotonic()
                registers = self._client.read(request.device, request.table, request.address, request.count)
                received = time.monotonic()
        except ExceptionReplyError:
            self._answers += 1
            raise
        except ConnectionLostError:
            if not self._answers or self._stop.is_set():
                raise
            self._reopen()
            return self._request(request)  # not a third time, as the new connection has no answer yet
        self._answers += 1
        if self._answers > 1:
            self._closings = 0
        self._trips.append(received - sent)
        return registers, 0.5 * (sent + received)

    def _reopen(self) -> None:
        """Open the connection that the device closed."""
        self._closings += self._answers == 1
        if self._closings == MAX_FAILURES:
            log.warning("%s: closes the connection after each answer", self._options.title())
        self._client.close()
        self._client.connect()
        self._answers = 0
        self._connection.count += 1

    def _read(self, request: Request, deliver: Deliver) -> bool:
        """Read one request and deliver its samples; return whether all registers repeat the previous values."""
        registers, moment = self._request(request)
        self._requests.answered(request)
        repeated, stale = self._staleness.take(request, registers)
        if stale:
            self._bad += request.samples
            return repeated
        samples = []
        for signal in sorted(request.signals, key=lambda signal: signal.is_sampled):  # decimals first
            part = registers[signal.address - request.address : signal.end - request.address]
            if not signal.is_sampled:
                self._decimals[signal.place] = signal.value(part)
                continue
            self._order.take(signal, part)
            decimals = 0.0 if signal.decimals is None else self._decimals.get(signal.decimals.place, math.nan)
            value = signal.value(part, decimals)
            if math.isnan(value):
                self._unusable[signal.name].note(signal.why_no_value(part, decimals), moment)
            samples.append(Sample(signal.name, moment, value))
        for sample in samples:
            if self._order.is_unjudged(sample.signal):
                self._unjudged.setdefault(sample.signal, []).append(sample)
        self._deliver([sample for sample in samples if sample.signal not in self._unjudged], deliver)
        return repeated

    def _end_reading(self, answered: int, deliver: Deliver) -> None:
        """Count the lost samples, judge the byte order, and deliver the samples that waited for it."""
        self._lost += len(self._signals) - answered
        self._order.end_round()
        for name in [name for name in self._unjudged if not self._order.is_unjudged(name)]:
            self._deliver(self._unjudged.pop(name), deliver)

    def _deliver(self, samples: Sequence[Sample], deliver: Deliver) -> None:
        if self._stop.is_set():  # nothing is delivered after close
            return
        accepted = [sample for sample in samples if sample.signal not in self._order.withheld]
        good = sum(math.isfinite(sample.value) for sample in accepted)
        self._received += good
        self._bad += len(samples) - good
        if accepted:
            deliver(accepted)

    def _end_complete_round(self, duration: float, *, repeated: bool) -> None:
        """End a round in which all devices answered, and log a change of the period or the first known rate."""
        if self._schedule.end(duration, repeated=repeated):
            level = logging.WARNING if self._schedule.is_slow else logging.INFO
            log.log(level, "%s: %s", self._options.title(), self._schedule.describe_period())
        if self._schedule.known and not self._rate_logged and self._schedule.achieved is not None:
            self._rate_logged = True
            rate = self._schedule.describe()
            log.info("%s: %s, %s", self._options.title(), summary(self._requests.requests), rate)

    def _go_down(self, reason: str) -> None:
        self._client.close()
        self._connection.go_down(reason)
