"""A motor of which something was learned: the state after windows of a simulated one, and the windows that follow."""

import math
from functools import cache

from benchmarks.discovery.motor import PERIOD, SIGNALS, Faults, simulate_motor

from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.health.schema import ReportDocument
from otolith.machine import load_machine
from tests.cli.replays import MACHINE

RECORDS = 200
START = 1_700_000_000.0  # Unix s
PROBLEM = load_machine(MACHINE, with_driver=False).problem
NAMES = ("motor", "here")
UNBALANCE = "shaft/periodic/angle(omega)"


def fresh() -> AdaptationState:
    return initial_state(*NAMES, PROBLEM)


def windows(measured: Array, start: float = START) -> list[Window]:
    """Consecutive windows of 2 s from ``start`` (Unix s)."""
    return [
        Window.whole(index, start + 2.0 * index, PERIOD, SIGNALS, measured[index * RECORDS : (index + 1) * RECORDS])
        for index in range(len(measured) // RECORDS)
    ]


def run(state: AdaptationState, cut: list[Window]) -> tuple[AdaptationState, list[ReportDocument]]:
    reports = []
    for window in cut:
        state, report = adapt(state, window)
        reports.append(report.document)
    return state, reports


@cache
def healthy() -> AdaptationState:
    """Nine windows of a healthy motor."""
    return run(fresh(), windows(simulate_motor("sweep", 18.0, Faults(), seed=3)))[0]


@cache
def unbalanced() -> AdaptationState:
    """Twelve windows of a motor that has always been a little out of balance."""
    faults = Faults(torque=lambda _, angle, *__: 0.004 * math.sin(angle))
    return run(fresh(), windows(simulate_motor("sweep", 24.0, faults, seed=5)))[0]


@cache
def noisy() -> AdaptationState:
    """A motor whose current sensor is noisier than stated."""
    measured = simulate_motor("sweep", 24.0, Faults(), seed=7)
    extra = simulate_motor("sweep", 24.0, Faults(), seed=8) - simulate_motor("sweep", 24.0, Faults(), 0, noisy=False)
    measured[:, 2] += 4.0 * extra[:, 2]
    return run(fresh(), windows(measured))[0]
