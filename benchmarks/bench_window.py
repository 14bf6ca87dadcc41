"""What one window costs, and where: printed as times of this run and as ratios that hold elsewhere."""

import sys
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path

import numpy as np

from otolith.acquisition.window import Quality, Verdict, Window
from otolith.adaptation.problem import Objective, Problem
from otolith.adaptation.swarm import search
from otolith.heart import adapt
from otolith.state import begin
from otolith.twins import find_twin
from otolith_drivers.plant.plants import load_scenario, simulate

SCENARIO = Path(__file__).parents[1] / "config" / "scenarios" / "demo.toml"
SIGNALS = {"V_a": "ArmatureVoltage", "T_load": "LoadTorque", "i": "ArmatureCurrent", "omega": "RotorSpeed"}

DC_MOTOR = find_twin("dc_motor")


def median_seconds(work: Callable[[], object], runs: int) -> float:
    work()
    times = []
    for _ in range(runs):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return float(np.median(times))


def main() -> int:
    ticks = list(islice(simulate(load_scenario(SCENARIO)), 1000))[-200:]
    values = np.array([[tick.measured[name] for name in SIGNALS.values()] for tick in ticks])
    quality = Quality(Verdict.GOOD, 0.0, 0.0, 0.0, 0.0)
    window = Window(0, 0.0, 0.01, tuple(SIGNALS), values, np.zeros(values.shape, dtype=np.bool_), quality)
    free = tuple(entry for entry in DC_MOTOR.parameters if entry.name == "R_a")
    known = tuple((entry.name, entry.nominal) for entry in DC_MOTOR.parameters if entry.name != "R_a")
    problem = Problem(DC_MOTOR, known, free, (0.005, 0.02))
    objective = Objective(problem, window, np.array([6.5]))
    start = objective.guess(np.array([6.5]))
    swarm = np.repeat(start[None, :], problem.swarm.size, axis=0)
    generations = search(objective, problem.swarm, start, seed=1).generations
    state = begin("motor", "bench", problem)
    whole = median_seconds(lambda: adapt(state, window), 20)
    kernel = median_seconds(lambda: objective.predict(swarm), 200)
    cost = median_seconds(lambda: objective.cost(swarm), 200)
    print(f"window of 200 records, R_a and initial state: {whole * 1e3:.1f} ms, {generations} generations")
    print(f"  simulating the swarm: {kernel * generations / whole:.1%} of it ({kernel * 1e6:.0f} us a generation)")
    print(f"  the objective around it: {(cost - kernel) * generations / whole:.1%}")
    print(f"  the swarm's own bookkeeping and the rest: {1.0 - cost * generations / whole:.1%}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
