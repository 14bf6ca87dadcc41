"""The driver of the simulated machine in this very process: something to try things with, without any bus.

The scenario's faults happen as they do on a bus; those that a bus alone can have are refused.
"""

import logging
import threading
from dataclasses import dataclass, replace
from pathlib import Path

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup, Signal
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.plant.faults import IN_PROCESS
from otolith_drivers.plant.realtime import Summary, Turn, in_real_time, refuse_unfit
from otolith_drivers.plant.scenario import Scenario, load_scenario
from otolith_drivers.units import factor

__all__ = ["Options", "PlantDriver", "Source", "build"]

log = logging.getLogger(__name__)


class Options(StrictModel):
    """``[driver]`` with ``type = "plant"``."""

    scenario: Path
    """What happens to the machine; relative to the machine file."""


class Source(StrictModel):
    """Which of its signals."""

    signal: str


@dataclass(frozen=True, slots=True)
class _Wanted:
    """A signal as the daemon wants it."""

    name: str
    signal: str
    scale: float
    offset: float


def build(options: Options, setup: Setup) -> "PlantDriver":
    """The machine of the scenario.

    Raises:
        ConfigurationError: the scenario is wrong or has a fault of a bus, or the machine has no such signal.
    """
    path = setup.folder / options.scenario
    scenario = load_scenario(path)
    try:
        refuse_unfit(scenario, IN_PROCESS)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}", ("driver", "scenario")) from error
    return PlantDriver(scenario, path, [_find(signal, scenario) for signal in setup.signals])


def _find(signal: Signal, scenario: Scenario) -> _Wanted:
    source: Source = signal.source
    key = ("signals", signal.name)
    if source.signal not in scenario.SIGNALS:
        known = nearest(source.signal, list(scenario.SIGNALS))
        raise ConfigurationError(f"plant {scenario.plant!r} has no signal {source.signal!r}: {known}", key)
    try:
        scale, offset = factor(scenario.SIGNALS[source.signal], signal.unit)
    except ValueError as error:
        raise ConfigurationError(f"signal {source.signal!r}: {error}", key) from error
    return _Wanted(signal.name, source.signal, scale, offset)


class PlantDriver:
    """Implements :class:`otolith_drivers.base.Driver` over a simulated machine, which lives in a thread of its own.

    A sample bears the time at which a bus would have brought it, however busy this computer is.
    """

    sampling = Sampling.CYCLIC

    def __init__(self, scenario: Scenario, path: Path, wanted: list[_Wanted]) -> None:
        self._scenario, self._path, self._wanted = scenario, path, wanted
        self._counters = Counters()
        self._link = Link(up=False, reason="not opened yet")
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        self._link = Link(up=True)
        self._thread = threading.Thread(target=self._live, args=(deliver,), name="plant", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """See :meth:`otolith_drivers.base.Driver.close`."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1.0)

    def counters(self) -> Counters:
        """See :meth:`otolith_drivers.base.Driver.counters`."""
        return self._counters

    def link(self) -> Link:
        """See :meth:`otolith_drivers.base.Driver.link`."""
        return self._link

    def describe(self) -> list[str]:
        """See :meth:`otolith_drivers.base.Driver.describe`."""
        units = self._scenario.SIGNALS
        signals = [f"{wanted.name} from {wanted.signal} [{units[wanted.signal]}]" for wanted in self._wanted]
        period = f"{1e3 * self._scenario.sample_period:g} ms"
        return [f"plant {self._scenario.plant!r} of {self._path}, simulated here, a tick each {period}", *signals]

    def _live(self, deliver: Deliver) -> None:
        try:
            for turn in in_real_time(self._scenario, Summary.of(self._scenario.faults), self._stop.is_set):
                self._take(turn, deliver)
        except Exception as error:
            self._link = Link(up=False, reason=f"{type(error).__name__}: {error}")
            log.exception("the simulated machine has ended")

    def _take(self, turn: Turn, deliver: Deliver) -> None:
        """Hand a tick on as it comes, or count what its bus withholds."""
        counters, count = self._counters, len(self._wanted)
        if self._link.up is turn.effect.gone:
            back = Link(up=True), replace(counters, reconnects=counters.reconnects + 1)
            silent = Link(up=False, reason="the scenario has the machine gone"), counters
            self._link, counters = silent if turn.effect.gone else back
        if turn.effect.withheld is not None:
            self._counters = replace(counters, lost=counters.lost + count)
            return
        self._counters = replace(counters, received=counters.received + count)
        measured = turn.tick.measured
        deliver(
            [Sample(each.name, turn.due, each.scale * measured[each.signal] + each.offset) for each in self._wanted]
        )
