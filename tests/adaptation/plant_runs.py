"""Runs of the plants of ``benchmarks.changes`` with the noise of sensors: as windows, and as the events they raise."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from benchmarks.changes.plants import HEALTHY, Plant, simulate

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState
from otolith.health.schema import EventDocument
from otolith.twin.definition import Definition


def measured(
    rows: Mapping[str, Array], run: int, random: np.random.Generator, noise: Mapping[str, float], names: Sequence[str]
) -> dict[str, Array]:
    """The signals ``names`` of a run in ``rows``, (runs, records) each, with noise of the given standard deviations."""
    return {
        name: rows[name][run] + noise.get(name, 0.0) * random.standard_normal(rows[name].shape[1]) for name in names
    }


def windows_of_runs(plant: Plant, twin: Definition, randoms: Sequence[np.random.Generator]) -> Iterator[Window]:
    """A window of each of as many healthy runs, with the noise that the twin states."""
    rows = simulate(plant, randoms, plant.records, HEALTHY, HEALTHY, 0)
    noise = {output.name: output.noise for output in twin.outputs}
    for run, random in enumerate(randoms):
        values = np.column_stack(list(measured(rows, run, random, noise, twin.signals).values()))
        yield Window.whole(run, 0.0, plant.period, twin.signals, values)


def events_of(state: AdaptationState, windows: Iterable[Window]) -> list[tuple[EventDocument, ...]]:
    """The open events after each window."""
    events = []
    for window in windows:
        state, report = adapt(state, window)
        events.append(report.document.events)
    return events
