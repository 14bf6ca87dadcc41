"""Several sources of a machine as one driver, for a machine whose signals come from several buses or files."""

import threading
import time
from collections.abc import Mapping
from dataclasses import astuple

from otolith_drivers.base import Counters, Deliver, Driver, Link, Sampling, SourceState, sampling_of
from otolith_drivers.common.guard import GuardedSource
from otolith_drivers.common.reconnection import CLOSE_TIMEOUT
from otolith_drivers.errors import DeviceError


class SeveralSources:
    """Implements :class:`otolith_drivers.base.Driver` over other drivers, each of which keeps its own threads.

    All drivers stamp on this computer's monotonic clock, so their samples have one time base.
    """

    def __init__(self, sources: tuple[GuardedSource, ...]) -> None:
        self._sources = sources

    @property
    def sampling(self) -> Mapping[str, Sampling]:
        """Meaning of the sample times of each signal."""
        kinds = [(source, source.sampling) for source in self._sources]
        return {signal: sampling_of(kind, signal) for source, kind in kinds for signal in source.signals}

    def open(self, deliver: Deliver, *, patiently: bool = False) -> None:
        """See :meth:`Driver.open`; a source that cannot be opened does not keep the others back, and is tried again.

        Raises:
            DeviceError: no source can be opened, and it was not to be done ``patiently``.
        """
        faults = dict[str, str]()
        for source in self._sources:
            try:
                source.open(deliver)
            except DeviceError as error:
                faults[source.name] = str(error)
        if len(faults) == len(self._sources) and not patiently:
            self.close()
            raise DeviceError("; ".join(f"source {name!r}: {fault}" for name, fault in faults.items()))
        for source in self._sources:
            if source.name in faults:
                source.open(deliver, patiently=True)

    def close(self) -> None:
        """See :meth:`Driver.close`; all drivers close at the same time."""
        threads = [threading.Thread(target=source.close, name="close", daemon=True) for source in self._sources]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def counters(self) -> Counters:
        """Return the sums over all drivers."""
        counters = [astuple(source.counters()) for source in self._sources]
        return Counters(*map(sum, zip(*counters, strict=True)))

    def link(self) -> Link:
        """Return the state of each source, and that of the machine: it is up while any source is.

        A source that is down is a warning. The period is that of the fastest source, if all of them are polled.
        """
        states = tuple(
            SourceState(source.name, source.signals, source.link(), source.counters()) for source in self._sources
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
            first, *rest = source.describe()
            lines += [f"source {source.name}: {first}", *rest]
        return lines


def open_patiently(driver: Driver, deliver: Deliver) -> None:
    """Open a driver; if the computer lacks what it needs, it is tried again until it is closed."""
    if isinstance(driver, GuardedSource | SeveralSources):
        driver.open(deliver, patiently=True)
    else:
        driver.open(deliver)
