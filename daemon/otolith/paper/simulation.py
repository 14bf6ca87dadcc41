"""A scenario lived through once: what the sensors said and what was true, to be cut into windows of any length."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Protocol

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.problem import Problem
from otolith.paper.rows import Sensor
from otolith.paths import examples_directory
from otolith.plan import Plan, load_plan
from otolith_drivers.plant.plants import load_scenario, simulate
from otolith_drivers.quantities import factor

CHUNK = 200  # records between two calls that tell of progress


class Lived(Protocol):
    """A row of any kind."""

    @property
    def name(self) -> str:
        """Of the scenario file."""

    @property
    def machine(self) -> str:
        """The machine file."""

    @property
    def parameter(self) -> str:
        """The one that is estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class Life:
    """A simulated machine's signals, and its parameter as it really was."""

    signals: tuple[str, ...]
    """Of the twin."""
    period: float
    """s."""
    values: Array
    """(records, signals)."""
    truth: Array
    """(records + 1,) at each record, and at the end of the last."""

    def windows(self, records: int) -> Iterator[Window]:
        """As the daemon would cut them; what is left over at the end makes none."""
        for index in range(len(self.values) // records):
            first = index * records
            values = self.values[first : first + records]
            yield Window.whole(index, first * self.period, self.period, self.signals, values)

    def with_noise(self, deviations: Mapping[str, float], seed: int) -> "Life":
        """As other sensors would have seen the same life: for signals that no controller acts upon."""
        random = np.random.default_rng(seed)
        values = self.values.copy()
        for name, deviation in deviations.items():
            values[:, self.signals.index(name)] += deviation * random.standard_normal(len(values))
        return replace(self, values=values)


def plan_of(row: Lived) -> Plan:
    """What the row's machine file means.

    Raises:
        OtolithError: it cannot be used.
    """
    return load_plan(examples_directory() / f"{row.machine}.toml", with_driver=False)


def problem_of(row: Lived, plan: Plan, deviations: Mapping[str, float]) -> Problem:
    """The plan's, with the row's parameter sought and all others known, told ``deviations`` of the sensors.

    An input that is measured by an ideal sensor is exact; outputs are weighed as the machine file says.
    """
    problem, twin = plan.problem, plan.twin
    nominal = dict(problem.known) | {entry.name: entry.nominal for entry in problem.free}
    sought = next((entry for entry in problem.free if entry.name == row.parameter), twin.parameter(row.parameter))
    return replace(
        problem,
        known=tuple((name, value) for name, value in nominal.items() if name != row.parameter),
        free=(replace(sought, nominal=nominal[row.parameter]),),
        noise=tuple(deviations.get(entry.name, own) for entry, own in zip(twin.outputs, problem.noise, strict=True)),
        input_noise=tuple(deviations.get(entry.name, 0.0) for entry in twin.inputs),
    )


def live(row: Lived, plan: Plan, seconds: float, sensors: Sequence[Sensor], lived: Callable[[], None]) -> Life:
    """Simulate the row's scenario, with ideal sensors if none are given; ``lived`` is called after every 200 records.

    Raises:
        OtolithError: the scenario file cannot be used.
    """
    scenario = load_scenario(examples_directory() / "scenarios" / f"{row.name}.toml")
    noise = {sensor.plant: sensor.noise for sensor in sensors}
    scenario = scenario.model_copy(update={"noise": scenario.noise.model_copy(update=noise)})
    sources = [str(plan.file.signals[name]["signal"]) for name in plan.twin.signals]
    records = round(seconds / scenario.sample_period)
    values, truth = np.empty((records + 1, len(sources))), np.empty(records + 1)
    for index, tick in enumerate(islice(simulate(scenario), records + 1)):
        values[index] = [tick.measured[source] for source in sources]
        truth[index] = tick.truth[row.parameter]
        if index % CHUNK == CHUNK - 1:
            lived()
    units = scenario.SIGNALS
    for column, (name, source) in enumerate(zip(plan.twin.signals, sources, strict=True)):
        scale, offset = factor(units[source], plan.twin.unit_of(name))
        values[:, column] = scale * values[:, column] + offset
    for sensor in sensors:
        column = plan.twin.signals.index(sensor.signal)
        clipped = np.clip(values[:, column], sensor.low, sensor.high - sensor.quantum)
        values[:, column] = sensor.low + np.rint((clipped - sensor.low) / sensor.quantum) * sensor.quantum
    return Life(plan.twin.signals, scenario.sample_period, values[:records], truth)
