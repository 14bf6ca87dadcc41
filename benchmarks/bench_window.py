"""Time of one window, cold and warm, and of its parts: in seconds here, and as ratios that hold elsewhere.

With ``--quick``, fewer runs.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.motor import CONFIG, windows
from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.global_search import search_window
from otolith.estimation.information import initial_prior
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import SwarmSearch, estimate
from otolith.machine import find_twin, load_machine
from otolith.twin.kernel import Excitation, kernel_of
from otolith_drivers.plant.scenario import load_scenario

AXIS_PERIOD = 1e-3  # s
AXIS_RECORDS = (1000, 2000, 4000)
AXIS_WINDOWS = 20
AXIS_STEP = 3.0  # N: added to the force of the last window


def median_seconds(function: Callable[[], object], runs: int) -> float:
    function()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def with_free(problem: Problem, names: tuple[str, ...]) -> Problem:
    """``problem`` with these parameters free, all others known."""
    twin = problem.twin
    known = tuple((parameter.name, parameter.nominal) for parameter in twin.parameters if parameter.name not in names)
    return replace(
        problem, known=known, free=tuple(parameter for parameter in twin.parameters if parameter.name in names)
    )


def axis_seconds(records: int) -> tuple[float, float]:
    """Times of ``adapt`` for windows of a simulated servo axis: the median of healthy ones, and one with a full search.

    Times of the processor.
    """
    twin, random = find_twin("servo_axis"), np.random.default_rng(1)
    time_of_record = AXIS_PERIOD * np.arange(AXIS_WINDOWS * records)
    slow, fast = (np.sin(2.0 * np.pi * frequency * time_of_record) for frequency in (0.7, 2.3))
    force = (60.0 * slow + 30.0 * fast)[:, None]
    nominal = np.array([[parameter.nominal for parameter in twin.parameters]])
    stepped = force + AXIS_STEP * (time_of_record >= AXIS_PERIOD * (AXIS_WINDOWS - 1) * records)[:, None]
    excitation = Excitation.uniform(stepped, AXIS_PERIOD, substeps=4)
    position = kernel_of(twin).simulate(nominal, np.zeros((1, len(twin.states))), excitation)[0]
    values = np.hstack([force, position + twin.outputs[0].noise * random.standard_normal(position.shape)])
    names = tuple(parameter.name for parameter in twin.parameters if parameter.name != "v_s")
    problem = with_free(Problem(twin, (), twin.parameters, (twin.outputs[0].noise,)), names)
    state, times, search = initial_state("axis", "bench", problem), [], 0.0
    for index in range(AXIS_WINDOWS):
        part = values[index * records : (index + 1) * records]
        window = Window.whole(index, index * records * AXIS_PERIOD, AXIS_PERIOD, ("F", "x"), part)
        start = time.process_time()
        state, report = adapt(state, window)
        seconds = time.process_time() - start
        if report.document.cost.searched:
            search = seconds
        else:
            times.append(seconds)
    return float(np.median(times[AXIS_WINDOWS // 2 :])), search


def main(*, quick: bool) -> int:
    problem = load_machine(CONFIG / "dc-motor.toml").problem
    record = list(windows(load_scenario(CONFIG / "scenarios" / "demo.toml"), 12))
    for names in (("R_a",), ("R_a", "D"), ("R_a", "D", "J")):
        free = with_free(problem, names)
        start = np.array([parameter.nominal for parameter in free.free])
        prior = initial_prior(free)
        cold = median_seconds(partial(estimate, free, record[-1], prior, start, SwarmSearch.FROM_BOUNDS), 5)
        warm = median_seconds(partial(estimate, free, record[-1], prior, start, SwarmSearch.IF_UNEXPLAINED), 50)
        objective = Objective(free, record[-1], start)
        guess = objective.guess(start)
        kernel = median_seconds(partial(objective.linearise, guess), 200)
        generations = search_window(free, record[-1], start, np.random.default_rng(1)).generations
        print(f"200 records, unknown: {', '.join(names)}, and the initial state")
        print(f"  warm {warm * 1e3:8.2f} ms   one linearisation is {kernel / warm:.1%} of it")
        print(f"  cold {cold * 1e3:8.2f} ms   {cold / warm:.0f} x warm, {generations} generations of the search")
    state = initial_state("motor", "bench", problem)
    for window in record:
        state, _ = adapt(state, window)
    whole = median_seconds(lambda: adapt(state, record[-1]), 50)
    print(f"the whole core, warm: {whole * 1e3:.2f} ms a window")
    print("servo axis at 1 kHz, a healthy window, and one in which a force appears")
    times = {records: axis_seconds(records) for records in (AXIS_RECORDS[:1] if quick else AXIS_RECORDS)}
    shortest = times[AXIS_RECORDS[0]][0] / AXIS_RECORDS[0]
    for records, (healthy, search) in times.items():
        print(
            f"  {records:5d} records {healthy * 1e3:7.1f} ms, a record {healthy / records / shortest:.2f} x that of the"
        )
        print(f"        shortest window; with a search {search / healthy:.0f} x that")
    return 0


if __name__ == "__main__":
    sys.exit(main(quick="--quick" in sys.argv))
