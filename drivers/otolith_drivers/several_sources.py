"""Several drivers as one: a machine whose signals come from several buses or files."""

import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import astuple, dataclass

from otolith_drivers.base import Counters, Deliver, Driver, Link, Sampling, SourceState, sampling_of
from otolith_drivers.common.reconnection import CLOSE_TIMEOUT, ReconnectBackoff, ThreadedDriver
from otolith_drivers.errors import DeviceError

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class NamedSource:
    """A driver of a machine with several, its name in the machine file, and the signals that it reads."""

    name: str
    driver: Driver
    signals: tuple[str, ...]


class SeveralSources(ThreadedDriver):
    """Implements :class:`otolith_drivers.base.Driver` over other drivers, each of which keeps its own threads.

    All drivers stamp on this computer's monotonic clock, so their samples have one time base.
    """

    def __init__(self, sources: tuple[NamedSource, ...]) -> None:
        super().__init__()
        self._sources = sources
        self._faults: dict[str, str] = {}  # Why a source cannot be opened, by its name; it is tried again

    @property
    def sampling(self) -> Mapping[str, Sampling]:
        """Meaning of the sample times of each signal."""
        return {
            signal: sampling_of(source.driver.sampling, signal) for source in self._sources for signal in source.signals
        }

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`; a source that cannot be opened does not keep the others back.

        Raises:
            DeviceError: no source can be opened.
        """
        for source in self._sources:
            self._try_to_open(source, deliver)
        if len(self._faults) == len(self._sources):
            self.close()
            raise DeviceError("; ".join(f"source {name!r}: {fault}" for name, fault in self._faults.items()))
        if self._faults:
            self._start("open-sources", self._open_the_rest, deliver)

    def _try_to_open(self, source: NamedSource, deliver: Deliver) -> None:
        try:
            source.driver.open(deliver)
        except Exception as error:  # noqa: BLE001 - whatever a driver of another package raises, the others go on
            is_known = isinstance(error, DeviceError)
            self._faults[source.name] = str(error) if is_known else f"{type(error).__name__}: {error}"
        else:
            self._faults.pop(source.name, None)
            if self._stop.is_set():  # it was closed while it opened
                source.driver.close()

    def _open_the_rest(self, deliver: Deliver) -> None:
        backoff, logged = ReconnectBackoff(), dict[str, str]()
        while self._faults:
            for name, fault in self._faults.items():
                if logged.get(name) != fault:
                    log.warning("source %r: %s; tried again until it can be opened", name, fault)
            logged = dict(self._faults)
            if self._stop.wait(backoff.next()):
                return
            for source in self._sources:
                if source.name in self._faults and not self._stop.is_set():
                    self._try_to_open(source, deliver)

    def close(self) -> None:
        """See :meth:`otolith_drivers.base.Driver.close`; all drivers close at the same time."""
        self._stop.set()
        closing = [super().close, *(source.driver.close for source in self._sources)]
        threads = [threading.Thread(target=close, name="close", daemon=True) for close in closing]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def counters(self) -> Counters:
        """Return the sums over all drivers."""
        counters = [astuple(source.driver.counters()) for source in self._sources]
        return Counters(*map(sum, zip(*counters, strict=True)))

    def link(self) -> Link:
        """Return the state of each source, and that of the machine: it is up while any source is.

        A source that is down is a warning. The period is that of the fastest source, if all of them are polled.
        """
        faults = {name: Link(up=False, reason=fault) for name, fault in list(self._faults.items())}
        states = tuple(
            SourceState(
                source.name, source.signals, faults.get(source.name) or source.driver.link(), source.driver.counters()
            )
            for source in self._sources
        )
        up, links = any(state.link.up for state in states), [state.link for state in states]
        warnings = [f"{state.name}: {warning}" for state in states for warning in state.link.warnings]
        down = [f"source {state.name!r} is down: {state.link.reason}" for state in states if not state.link.up]
        periods = [link.period for link in links if link.period is not None]
        return Link(
            up=up,
            reason="" if up else "; ".join(down),
            warnings=tuple([*down, *warnings] if up else warnings),
            plan="; ".join(f"{state.name}: {state.link.plan}" for state in states if state.link.plan),
            period=min(periods) if len(periods) == len(links) else None,
            latency=max((link.latency for link in links), default=0.0),
            sources=states,
        )

    def describe(self) -> list[str]:
        """Return the lines of each driver under its name."""
        lines = [f"{len(self._sources)} sources: {', '.join(source.name for source in self._sources)}"]
        for source in self._sources:
            first, *rest = source.driver.describe()
            lines += [f"source {source.name}: {first}", *rest]
        return lines
