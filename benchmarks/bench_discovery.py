"""What discovery costs: a window that is explained, a full search, a window of a case; all families and inputs."""

import sys
import time
from dataclasses import replace

import numpy as np

from benchmarks.discovery.motor import Faults, J, simulate_motor, windows
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.sequential_test import WindowDecision
from otolith.estimation.problem import Problem
from otolith.machine import find_twin

CALM, SEARCH = 0.015, 0.250  # s: what a window may take at the median


def main() -> int:
    twin = find_twin("dc_motor")
    free = tuple(entry for entry in twin.parameters if entry.name in ("R_a", "D"))
    known = tuple((entry.name, entry.nominal) for entry in twin.parameters if entry not in free)
    problem = Problem(twin, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002))
    begun = initial_state("motor", "bench", problem)
    times: dict[str, list[float]] = {"calm": [], "search": [], "followed": [], "switched off": []}
    for seed in range(8):

        def torque(t: float, *_: float) -> float:
            return 5.0 * J * float(np.sin(10.0 * t))

        state, plain = begun, replace(begun, problem=replace(problem, discover=False))
        for window in windows(simulate_motor("steps", 30.0, Faults(torque=torque, since=20.0), seed)):
            start = time.perf_counter()
            state, report = adapt(state, window)
            seconds = time.perf_counter() - start
            decision = report.document.decision
            if window.index > 2 and decision is WindowDecision.LEARNED and not state.problem.components:
                times["calm"].append(seconds)
            elif decision is WindowDecision.SUSPECTED and state.memory.case is not None:
                times["search" if state.memory.case.windows == 1 else "followed"].append(seconds)
            if window.end <= 20.0:
                start = time.perf_counter()
                plain, _ = adapt(plain, window)
                times["switched off"].append(time.perf_counter() - start)
    medians = {name: float(np.median(values[1:])) for name, values in times.items()}
    for name, value in medians.items():
        ratio = value / medians["switched off"]
        print(f"{name:14} {value * 1e3:8.1f} ms   {ratio:6.1f} x a window with discovery switched off")
    reached = medians["calm"] <= CALM and medians["search"] <= SEARCH
    verdict = "reached" if reached else "MISSED on this computer"
    print(f"targets {CALM * 1e3:.0f} ms and {SEARCH * 1e3:.0f} ms: {verdict}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
