"""The plant driver: a simulated machine in this process, without any bus.

The scenario's faults act as on a bus; a fault that needs a real bus is refused.
"""

import logging
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from otolith_drivers.base import Counters, Deliver, Link, Sample, Sampling, Setup, Signal
from otolith_drivers.common.reconnection import ThreadedDriver
from otolith_drivers.config_files import StrictModel
from otolith_drivers.errors import ConfigurationError, nearest
from otolith_drivers.plant.faults import IN_PROCESS
from otolith_drivers.plant.realtime import NodeSummary, ScheduledSample, in_real_time, refuse_unfit
from otolith_drivers.plant.scenario import Scenario, load_scenario
from otolith_drivers.units import factor

log = logging.getLogger(__name__)


class PlantOptions(StrictModel):
    """``[driver]`` with ``type = "plant"``."""

    scenario: Path
    """The scenario file, relative to the machine file."""


class PlantSource(StrictModel):
    """The source of a signal."""

    signal: str
    """Name of the signal in the simulated machine."""


Options, Source = PlantOptions, PlantSource  # for base.DriverType


class PlantSignal(NamedTuple):
    """A wanted signal: its name in the daemon and in the machine, and the conversion between their units."""

    name: str
    signal: str
    scale: float
    offset: float


def build(options: PlantOptions, setup: Setup) -> "PlantDriver":
    """A driver for the machine of the scenario.

    Raises:
        ConfigurationError: a wrong scenario, a fault that needs a real bus, or a signal that the machine lacks.
    """
    path = setup.folder / options.scenario
    scenario = load_scenario(path, ("driver", "scenario"))
    try:
        refuse_unfit(scenario, IN_PROCESS)
    except ConfigurationError as error:
        raise ConfigurationError(f"{path}: {error}", ("driver", "scenario")) from error
    return PlantDriver(scenario, path, [_find(signal, scenario) for signal in setup.signals])


def _find(signal: Signal, scenario: Scenario) -> PlantSignal:
    source: PlantSource = signal.source
    key = ("signals", signal.name)
    if source.signal not in scenario.SIGNALS:
        known = nearest(source.signal, list(scenario.SIGNALS))
        raise ConfigurationError(f"plant {scenario.plant!r} has no signal {source.signal!r}: {known}", key)
    try:
        return PlantSignal(signal.name, source.signal, *factor(scenario.SIGNALS[source.signal], signal.unit))
    except ValueError as error:
        raise ConfigurationError(f"signal {source.signal!r}: {error}", key) from error


class PlantDriver(ThreadedDriver):
    """Implements :class:`otolith_drivers.base.Driver` over a simulated machine, which runs in a thread of its own.

    A sample has the time at which a bus would have carried it, however busy this computer is.
    """

    sampling = Sampling.CYCLIC

    def __init__(self, scenario: Scenario, path: Path, wanted: list[PlantSignal]) -> None:
        super().__init__()
        self._scenario, self._path, self._wanted = scenario, path, wanted
        self._counters = Counters()
        self._link = Link(up=False, reason="not opened yet")

    def open(self, deliver: Deliver) -> None:
        """See :meth:`otolith_drivers.base.Driver.open`."""
        self._link = Link(up=True)
        self._start("plant", self._run, deliver)

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
        return [f"plant {self._scenario.plant!r} of {self._path}, simulated here, a sample each {period}", *signals]

    def _run(self, deliver: Deliver) -> None:
        try:
            summaries = {IN_PROCESS: NodeSummary.of(self._scenario.faults)}
            for _, scheduled in in_real_time(self._scenario, summaries, self._stop.is_set):
                self._take(scheduled, deliver)
        except Exception as error:  # the thread ends: the link names the cause
            self._link = Link(up=False, reason=f"{type(error).__name__}: {error}")
            log.exception("the simulated machine stopped with an error")

    def _take(self, scheduled: ScheduledSample, deliver: Deliver) -> None:
        """Deliver a sample, or count it as lost if a fault withholds it."""
        counters, count, gone = self._counters, len(self._wanted), scheduled.effect.gone
        if gone and self._link.up:
            self._link = Link(up=False, reason="the machine is off its bus, by a fault of the scenario (kind = 'gone')")
        elif not gone and not self._link.up:
            self._link, counters = Link(up=True), replace(counters, reconnects=counters.reconnects + 1)
        if scheduled.effect.withheld is not None:
            self._counters = replace(counters, lost=counters.lost + count)
            return
        self._counters = replace(counters, received=counters.received + count)
        measured = scheduled.sample.measured
        due = scheduled.due
        deliver([Sample(name, due, scale * measured[signal] + offset) for name, signal, scale, offset in self._wanted])
