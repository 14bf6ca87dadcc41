"""A day of healthy running, simulated and adapted to: how often something is found that is not there.

    python -m benchmarks.healthy_day --hours 24

Twice: with set-points that change, and at constant speed. Sensors have noise and 12-bit converters; resistance and
damping are unknown. What must not happen is a step of a parameter or a component; windows held back are told as well.
"""

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.motor import CONFIG, RECORDS, windows
from otolith.acquisition.window import Array
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.machine import load_machine
from otolith_drivers.plant.faults import Drift
from otolith_drivers.plant.scenario import Scenario, load_scenario

QUANTA = np.array([0.0, 0.0, 20.0 / 4096, 100.0 / 4096])  # A, rad/s


# Warming up and wearing: resistance rises by 7 % and damping by 18 % in the first half hour.
DRIFTS = (
    {"kind": "drift", "parameter": "R_a", "start": "0 s", "amount": "-0.5 ohm", "rate": "-0.0013 1/s"},
    {"kind": "drift", "parameter": "D", "start": "0 s", "amount": "0.0001 N*m*s/rad", "rate": "0.0007 1/s"},
)


def scenarios(*, drifting: bool = False) -> dict[str, Scenario]:
    """Without a fault: with the demo's set-points, and at one speed."""
    faults = tuple(Drift.model_validate(entry) for entry in DRIFTS) if drifting else ()
    demo: Any = load_scenario(CONFIG / "scenarios" / "demo.toml").model_copy(update={"faults": faults})
    first = demo.set_points[0]
    return {"excited": demo, "constant speed": demo.model_copy(update={"set_points": (first,), "repeat_every": None})}


def converted(values: Array) -> Array:
    """(records, signals) as converters of 12 bit show them."""
    steps = np.where(QUANTA > 0.0, QUANTA, 1.0)
    return np.where(QUANTA > 0.0, np.rint(values / steps) * steps, values)


def run(scenario: Scenario, hours: float) -> dict[str, Any]:
    """Lessons, statuses, and how far R_a and D strayed from the truth."""
    plan = load_machine(CONFIG / "dc-motor.toml", with_driver=False)
    twin = plan.twin
    free = tuple(twin.parameter(name) for name in ("R_a", "D"))
    known = tuple((entry.name, entry.nominal) for entry in twin.parameters if entry not in free)
    state = initial_state("motor", "bench", replace(plan.problem, known=known, free=free))
    decisions: Counter[str] = Counter()
    statuses: Counter[str] = Counter()
    errors, pulls, seconds = [], [], []
    for window in windows(scenario, round(hours * 3600.0 / (RECORDS * scenario.sample_period))):
        seen = replace(window, values=converted(window.values))
        begun = time.perf_counter()
        state, report = adapt(state, seen)
        seconds.append(time.perf_counter() - begun)
        document = report.document
        decisions[document.decision.name] += 1
        for entry in document.parameters.values():
            statuses[entry.status] += 1
        found = [(entry.value, entry.sd, entry.nominal) for entry in document.parameters.values()]
        if all(value is not None for value, _, _ in found):
            errors.append([abs(value / nominal - 1.0) for value, _, nominal in found if value is not None])
            pulls.append([(value - nominal) / sd for value, sd, nominal in found if value is not None and sd])
    return {
        "hours": hours,
        "windows": sum(decisions.values()),
        "lessons": dict(decisions),
        "statuses": dict(statuses),
        "largest_error": np.max(errors, axis=0).tolist(),
        "median_error": np.median(errors, axis=0).tolist(),
        "intervals_that_hold": np.mean(np.abs(pulls) <= 1.959964, axis=0).tolist(),
        "median_seconds": float(np.median(seconds)),
        "p99_seconds": float(np.quantile(seconds, 0.99)),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--drifting", action="store_true", help="parameters warm up and wear; errors are not told then")
    parser.add_argument("--only", choices=sorted(scenarios()))
    options = parser.parse_args()
    lives = scenarios(drifting=options.drifting).items()
    found = {name: run(each, options.hours) for name, each in lives if options.only in (None, name)}
    if options.drifting:
        for each in found.values():
            for key in ("largest_error", "median_error", "intervals_that_hold"):
                del each[key]
    print(json.dumps(found, indent=2))
    return 1 if any({"STEPPED", "DISCOVERED"} & each["lessons"].keys() for each in found.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
