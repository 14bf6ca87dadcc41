"""Time of discovery: an explained window, a full search, a window of a sequential test; all families and inputs.

Processor time is measured. The targets hold on a computer that runs nothing else. With ``--quick``, fewer runs.
"""

import sys
import time
from dataclasses import replace

import numpy as np

from benchmarks.discovery.motor import PERIOD, Faults, J, simulate_motor, windows
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state, with_problem
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

EXPLAINED, SEARCH = 0.004, 0.080  # s: targets for the median of a window of 200 records
LENGTHS = (50, 200, 500, 1000, 2000, 5000)  # records
HEALTHY_WINDOWS = 12


def median_times(problem: Problem, records: int) -> tuple[float, float]:
    """Median seconds of healthy windows of that many records, with discovery and without."""
    measured = simulate_motor("steps", HEALTHY_WINDOWS * records * PERIOD, Faults(), 1)
    state = initial_state("motor", "bench", problem)
    states = [state, with_problem(state, replace(problem, discover=False))]
    times: tuple[list[float], list[float]] = ([], [])
    for window in windows(measured, records):
        for index, row in enumerate(times):
            start = time.process_time()
            states[index], _ = adapt(states[index], window)
            row.append(time.process_time() - start)
    first, second = (float(np.median(row[HEALTHY_WINDOWS // 2 :])) for row in times)
    return first, second


def main(*, quick: bool) -> int:
    twin = find_twin("dc_motor")
    free = tuple(parameter for parameter in twin.parameters if parameter.name in ("R_a", "D"))
    known = tuple((parameter.name, parameter.nominal) for parameter in twin.parameters if parameter not in free)
    problem = Problem(twin, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))
    initial = initial_state("motor", "bench", problem)
    times: dict[str, list[float]] = {"explained": [], "search": [], "tested": [], "discovery off": []}
    for seed in range(2 if quick else 8):

        def torque(t: float, *_: float) -> float:
            return 5.0 * J * float(np.sin(10.0 * t))

        state, without_discovery = initial, with_problem(initial, replace(problem, discover=False))
        for window in windows(simulate_motor("steps", 30.0, Faults(torque=torque, since=20.0), seed)):
            start = time.process_time()
            state, report = adapt(state, window)
            seconds = time.process_time() - start
            decision = report.document.decision
            if window.index > 2 and decision is WindowDecision.LEARNED and not state.problem.components:
                times["explained"].append(seconds)
            elif decision is WindowDecision.SUSPECTED and state.test is not None:
                times["search" if state.test.counts.tested == 1 else "tested"].append(seconds)
            if window.end <= 20.0:
                start = time.process_time()
                without_discovery, _ = adapt(without_discovery, window)
                times["discovery off"].append(time.process_time() - start)
    medians = {name: float(np.median(values[1:])) for name, values in times.items()}
    for name, value in medians.items():
        ratio = value / medians["discovery off"]
        print(f"{name:14} {value * 1e3:8.1f} ms   {ratio:6.1f} x a window with discovery switched off")
    for records in LENGTHS[:2] if quick else LENGTHS:
        whole, rest = median_times(problem, records)
        print(
            f"healthy, {records:4d} records {whole * 1e3:8.1f} ms   {whole / rest:6.1f} x with discovery switched off"
        )
    reached = medians["explained"] <= EXPLAINED and medians["search"] <= SEARCH
    verdict = "reached" if reached else "MISSED on this computer"
    print(f"targets {EXPLAINED * 1e3:.0f} ms and {SEARCH * 1e3:.0f} ms: {verdict}")
    return 0


if __name__ == "__main__":
    sys.exit(main(quick="--quick" in sys.argv))
