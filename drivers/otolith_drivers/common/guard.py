"""The boundary to a driver, which may be of another package: nothing that it does ends the daemon.

Every call of a driver goes through :class:`GuardedSource`. It runs in a thread of its own, is waited for no longer than
a bound, and may raise anything; only the drivers of this package say at once, in the thread that asks, what they have
counted and how their link is. What a driver returns or delivers is checked before anyone else sees it. What it does
wrong is its *defect*: the link of the source states it, and the last right answer stays in use.
"""

import logging
import operator
import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, replace
from functools import partial
from numbers import Real
from queue import SimpleQueue
from types import FrameType, TracebackType
from typing import Any, Self, TypeVar, cast
from weakref import WeakSet

from otolith_drivers.base import Counters, Deliver, Driver, Link, Sample, Sampling, SourceState, sampling_of
from otolith_drivers.common.reconnection import CLOSE_TIMEOUT, PassingFault, ReconnectBackoff
from otolith_drivers.errors import DeviceError, OtolithError, shown
from otolith_drivers.outside_text import visible

log = logging.getLogger(__name__)

Answer = TypeVar("Answer")

# Thresholds: docs/reference/thresholds-drivers.md has the origin of each.
ANSWER_TIMEOUT = 0.1  # s that the daemon waits for an answer; then it goes on with the last one
STUCK = 5.0  # s that a call may take before this is a defect
OPEN_TIMEOUT = 5.0  # s that the daemon waits for a source to open; then it goes on without it
MAX_TEXT, MAX_LINES = 1000, 50  # characters of a text of a driver; lines of it
MAX_COUNT = 1 << 62  # of anything
PERIODS = (1e-3, 1e6)  # times the sample period that was asked for: what a driver may state as achieved
MAX_LATENCY = 60.0  # s
MAX_AGE, MAX_AHEAD = 600.0, 1e9  # s before and after now at which a sample may lie

DEFECT = "its driver does not work as it should"
PACKAGE = __name__.partition(".")[0]
AT_ONCE = ("counters", "link")  # Methods of the drivers of this package that wait for nothing: two threads less to wake


class _DefectError(Exception):
    """What a driver does wrong, in words."""


class _Caller(threading.Thread):
    """A thread that makes one call after the other; one whose call has not returned makes no further ones."""

    def __init__(self) -> None:
        super().__init__(name="call-driver", daemon=True)
        self._calls: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self.start()

    def run(self) -> None:
        while True:
            self._calls.get()()
            _idle.append(self)

    @classmethod
    def make(cls, call: Callable[[], None]) -> None:
        """Make a call, in a thread that waits for one, or in a new one."""
        try:
            caller = _idle.pop()
        except IndexError:
            caller = cls()
        caller._calls.put(call)


_idle: deque[_Caller] = deque()  # A hall makes hundreds of calls a second


class _Call:
    """Calls one method of a driver, never twice at a time."""

    def __init__(self, title: str) -> None:
        """``title`` names the method in a defect."""
        self._title = title
        self._begun: float | None = None  # s; None if no call is under way
        self._outcome: tuple[Any, Exception | None] | None = None

    def run(self, method: Callable[[], Any], timeout: float) -> Any:
        """Return what ``method``, or the call of it that is under way, returns within ``timeout`` (s).

        Raises:
            TimeoutError: it has not returned yet.
            OtolithError: it raises this.
            _DefectError: it raises anything else, or takes too long.
        """
        if self._begun is None:
            self._begun, self._outcome, returned = time.monotonic(), None, threading.Event()
            _Caller.make(partial(self._run, method, returned))
            returned.wait(timeout)
        if self._outcome is None:
            if (waited := time.monotonic() - self._begun) > STUCK:
                raise _DefectError(f"{self._title} has not returned for {waited:.0f} s")
            raise TimeoutError
        self._begun = None
        answer, error = self._outcome
        if error is not None:
            raise error
        return answer

    def run_here(self, method: Callable[[], Any]) -> Any:
        """Return what ``method`` returns, which waits for nothing; raises as :meth:`run`, but no TimeoutError."""
        try:
            return method()
        except (OtolithError, _DefectError):
            raise
        except Exception as error:
            raise _DefectError(f"{self._title} raises {_named(error)}") from error

    def _run(self, method: Callable[[], Any], returned: threading.Event) -> None:
        try:
            self._outcome = method(), None
        except (OtolithError, _DefectError) as error:
            self._outcome = None, error
        except BaseException as error:  # noqa: BLE001 - a driver may raise anything, also SystemExit
            self._outcome = None, _DefectError(f"{self._title} raises {_named(error)}")
        returned.set()


class GuardedSource:
    """Implements :class:`Driver` over one source of a machine, and lets nothing that its driver does wrong pass."""

    def __init__(
        self, name: str, driver: Driver | None, signals: Sequence[str], period: float | None = None, fault: str = ""
    ) -> None:
        """``name`` is that of the machine file.

        ``period`` is the sample period that was asked for, s; ``fault`` is why there is no ``driver``.
        """
        self.name, self.signals = name, tuple(signals)
        self._driver, self._period = driver, period
        self._is_own = type(driver).__module__.partition(".")[0] == PACKAGE
        self._stop = threading.Event()
        self._fault = fault  # Why it could not be opened; empty if it could, or was not tried
        self._calls = {title: _Call(f"{title}()") for title in ("open", "close", "counters", "link", "describe")}
        self._calls["sampling"] = _Call("sampling")
        self._defects: dict[str, str] = {"build": fault} if fault else {}  # Of the latest call of each method
        self._logged: dict[str, str] = {}  # The last defect of each method that is in the log
        self._refused = PassingFault()  # Samples that were not delivered
        self._ended = ""  # Why a thread of the driver has ended since the last sample
        self._has_delivered = False
        self._counters, self._link = Counters(), cast("Link | None", None)  # The last right answers
        self._sampling: Sampling | Mapping[str, Sampling] = Sampling.CYCLIC

    @classmethod
    def built(cls, name: str, signals: Sequence[str], period: float, build: Callable[[], Driver]) -> Self:
        """Return the source with the driver that ``build`` returns; an error of the configuration is raised."""
        try:
            return cls(name, build(), signals, period)
        except OtolithError:
            raise
        except Exception as error:
            fault = f"{DEFECT}: build() raises {_named(error)}"
            log.exception("source %r: %s", name, fault)
            return cls(name, None, signals, period, fault)

    @property
    def sampling(self) -> Sampling | Mapping[str, Sampling]:
        """Meaning of the sample times."""
        self._sampling = self._ask("sampling", self._checked_sampling, self._sampling)
        return self._sampling

    def open(self, deliver: Deliver, *, patiently: bool = False) -> None:
        """See :meth:`Driver.open`; a defect is tried again in a thread, and ``patiently`` also a DeviceError."""
        if self._driver is None:
            return
        _watch_threads(self)
        if patiently or self._try_to_open(deliver):
            threading.Thread(target=self._open_later, args=(deliver,), name="open-source", daemon=True).start()

    def _try_to_open(self, deliver: Deliver) -> str:
        """Return why the source is not open; empty if it is. Raise DeviceError if the computer lacks something."""
        try:
            self._calls["open"].run(partial(self._open_driver, deliver), OPEN_TIMEOUT)
        except DeviceError as error:
            self._fault = _text(str(error))
            raise
        except TimeoutError:
            self._fault = "open() has not returned yet"
        except (_DefectError, OtolithError) as error:
            self._note("open", str(error))
            self._fault = str(error)
        else:
            self._note("open", "")
            self._fault = ""
        return self._fault

    def _open_driver(self, deliver: Deliver) -> None:
        cast("Driver", self._driver).open(partial(self._take, deliver))
        if self._stop.is_set():  # it was closed while it opened
            self._close_driver()

    def _open_later(self, deliver: Deliver) -> None:
        backoff, logged = ReconnectBackoff(), ""
        while not self._stop.is_set():
            try:
                fault = self._try_to_open(deliver)
            except DeviceError as error:
                fault = str(error)
            if not fault:
                return
            if fault != logged and "open" not in self._defects:
                log.warning("source %r: %s; tried again until it can be opened", self.name, fault)
            logged = fault
            self._stop.wait(backoff.next())

    def close(self) -> None:
        """See :meth:`Driver.close`."""
        self._stop.set()
        self._close_driver()

    def _close_driver(self) -> None:
        self._ask("close", lambda _: None, None, CLOSE_TIMEOUT)

    def counters(self) -> Counters:
        """Return the counts so far, with the samples that were refused here."""
        self._counters = self._ask("counters", _checked_counters, self._counters)
        return replace(self._counters, bad=self._counters.bad + self._refused.count)

    def link(self) -> Link:
        """Return the state of the connection; if there is a defect, with this source among its sources."""
        if self._fault:
            link = Link(up=False, reason=self._fault)
        else:
            up = self._has_delivered
            unknown = Link(up=up, reason="" if up else "its driver states nothing of its connection")
            link = self._ask("link", self._checked_link, self._link or unknown)
            if "link" in self._defects:
                link = unknown
            elif link is not unknown:
                self._link = link
        defects = [*self._defects.values(), *self._refused.warnings(time.monotonic())]
        defects += [self._ended] if self._ended else []
        defects = [defect if defect.startswith(DEFECT) else f"{DEFECT}: {defect}" for defect in defects]
        if not defects and not link.defect:
            return link
        defect = "; ".join([*defects, *filter(None, [link.defect])])
        link = replace(link, defect=defect, warnings=(*defects, *link.warnings))
        return replace(link, sources=(SourceState(self.name, self.signals, link, self.counters()),))

    def describe(self) -> list[str]:
        """Return the lines of the driver."""
        return self._ask("describe", _checked_lines, [f"source {self.name}: {self._fault or 'no description'}"])

    def _ask(
        self, title: str, checked: Callable[[Any], Answer], last: Answer, timeout: float = ANSWER_TIMEOUT
    ) -> Answer:
        """Return the answer of a method or attribute as ``checked`` returns it; ``last`` if there is none in time."""
        if self._driver is None:
            return last

        def asked() -> Answer:
            attribute = getattr(self._driver, title)
            return checked(attribute if title == "sampling" else attribute())

        call = self._calls[title]
        try:
            answer: Answer = call.run_here(asked) if self._is_own and title in AT_ONCE else call.run(asked, timeout)
        except TimeoutError:
            return last
        except (_DefectError, OtolithError) as error:
            self._note(title, str(error))
            return last
        self._note(title, "")
        return answer

    def _note(self, title: str, defect: str) -> None:
        """Note the defect of a method, or that it has none; each is logged once."""
        if not defect:
            self._defects.pop(title, None)
            return
        self._defects[title] = defect
        if title not in self._logged:
            self._logged[title] = defect
            log.error("source %r: %s: %s", self.name, DEFECT, defect)

    def _take(self, deliver: Deliver, samples: Sequence[Sample]) -> None:
        """Deliver what can be used of the samples of the driver; called from its thread."""
        if self._stop.is_set():
            return
        now = time.monotonic()
        if not isinstance(samples, Sequence):
            self._refuse(samples, "no sequence of samples", now)
            return
        low, high = now - MAX_AGE, now + MAX_AHEAD
        good: list[Sample] = []
        for sample in samples:
            try:
                name, moment, value = sample
                if type(moment) is float is type(value) and low <= moment <= high and type(name) is str:
                    good.append(sample)
                else:
                    good.append(_checked_sample(name, moment, value, (low, high)))
            except Exception as error:  # noqa: BLE001 - a driver may deliver anything
                self._refuse(sample, str(error) if isinstance(error, _DefectError) else _named(error), now)
        if good:
            self._has_delivered, self._ended = True, ""
            deliver(good)

    def _refuse(self, sample: object, why: str, now: float) -> None:
        try:
            written = shown(sample)
        except Exception as error:  # noqa: BLE001 - its repr() is of the driver, too
            written = f"a {type(sample).__name__} whose repr() raises {type(error).__name__}"
        self._refused.note(f"it delivers {written}: {_text(why)}", now)
        self._note_refused_once()

    def _note_refused_once(self) -> None:
        if self._refused.count == 1:
            log.error("source %r: %s: %s", self.name, DEFECT, self._refused.text)

    def _checked_link(self, link: Any) -> Link:
        if not isinstance(link, Link) or not isinstance(link.up, bool):
            raise _DefectError(f"link() returns {shown(link)} instead of a Link whose up is true or false")
        asked, period, latency = self._period, link.period, link.latency
        if period is not None:
            low, high = (share * (asked or 1.0) for share in PERIODS)
            if not isinstance(period, Real) or not low <= period <= high:
                raise _DefectError(f"link() states a period of {shown(period)} s, not {low:g} to {high:g} s")
        if not isinstance(latency, Real) or not 0.0 <= latency <= MAX_LATENCY:
            raise _DefectError(f"link() states a latency of {shown(latency)} s, not 0 to {MAX_LATENCY:g} s")
        reason = _checked_text(link.reason) or ("" if link.up else "its driver gives no reason")
        return Link(
            up=link.up,
            reason=reason,
            warnings=tuple(_checked_lines(link.warnings)) if link.warnings else (),
            plan=_checked_text(link.plan),
            period=None if period is None else float(period),
            latency=float(latency),
            defect=_checked_text(link.defect),
        )

    def _checked_sampling(self, sampling: Any) -> Sampling | Mapping[str, Sampling]:
        if isinstance(sampling, Sampling):
            return sampling
        return {signal: Sampling(sampling_of(sampling, signal)) for signal in self.signals}

    def owns(self, frame: FrameType, *, surely: bool) -> bool:
        """Return whether a frame of the stack is of this driver: of a method of it, otherwise of its module."""
        if surely:
            return any(value is self._driver for value in frame.f_locals.values())
        return frame.f_globals.get("__name__") == type(self._driver).__module__

    def note_ended_thread(self, error: BaseException) -> None:
        """Note that ``error`` has ended a thread of the driver."""
        self._ended = f"its thread has ended: {_named(error)}; restart the daemon if no samples come"
        log.error("source %r: %s: %s", self.name, DEFECT, self._ended, exc_info=error)


def _checked_sample(name: Any, moment: Any, value: Any, bounds: tuple[float, float]) -> Sample:
    if not (isinstance(name, str) and isinstance(moment, Real) and isinstance(value, Real)):
        raise _DefectError("no sample: it has a name, a time and a value")
    if not bounds[0] <= float(moment) <= bounds[1]:
        raise _DefectError(f"its time is not within {MAX_AGE:g} s of time.monotonic()")
    return Sample(name, float(moment), float(value))


def _checked_counters(counters: Any) -> Counters:
    if not isinstance(counters, Counters):
        raise _DefectError(f"counters() returns {shown(counters)} instead of Counters")
    try:
        numbers = [operator.index(number) for number in astuple(counters)]
    except TypeError:
        numbers = [-1]
    if not all(0 <= number <= MAX_COUNT for number in numbers):
        raise _DefectError(f"counters() returns {shown(counters)}, which are no counts from 0")
    return Counters(*numbers)


def _checked_lines(lines: Any) -> list[str]:
    if isinstance(lines, str) or not isinstance(lines, Sequence) or not lines:
        raise _DefectError(f"it returns {shown(lines)} instead of lines of text")
    more = [f"and {len(lines) - MAX_LINES} lines more"] if len(lines) > MAX_LINES else []
    return [*map(_checked_text, lines[:MAX_LINES]), *more]


def _checked_text(text: Any) -> str:
    if not isinstance(text, str):
        raise _DefectError(f"it returns {shown(text)} instead of a text")
    return _text(text)


def _text(text: str) -> str:
    """Return ``text`` as one line, cut to what a report can carry."""
    line = visible(text, MAX_TEXT)
    return line if len(text) <= MAX_TEXT else f"{line} ({len(text)} characters)"


def _named(error: BaseException) -> str:
    """Return type and text of an error, which may be of another package and have no text."""
    try:
        text = _text(str(error))
    except Exception:  # noqa: BLE001
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


_watched: "WeakSet[GuardedSource]" = WeakSet()


def _watch_threads(source: GuardedSource) -> None:
    """From now on, an exception that ends a thread of the driver is noted by ``source``."""
    _watched.add(source)
    before = threading.excepthook
    if getattr(before, "gives_to_sources", False):
        return

    def on_ended_thread(ended: threading.ExceptHookArgs) -> None:
        owner = _owner(ended.exc_traceback)
        if owner is None or ended.exc_value is None:
            before(ended)
        else:
            owner.note_ended_thread(ended.exc_value)

    on_ended_thread.gives_to_sources = True  # type: ignore[attr-defined]
    threading.excepthook = on_ended_thread


def _owner(trace: TracebackType | None) -> GuardedSource | None:
    """Return the source in whose driver an exception was raised; two of the same module differ by their methods."""
    frames = [frame for frame, _ in traceback.walk_tb(trace)]
    for surely in (True, False):
        for source in list(_watched):
            if any(source.owns(frame, surely=surely) for frame in frames):
                return source
    return None
