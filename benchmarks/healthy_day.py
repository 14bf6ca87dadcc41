"""A simulated healthy day: how often the core reports a step or a component that does not exist.

    python -m benchmarks.healthy_day --hours 24

With changing set-points, and at constant speed. Sensors have noise and 12-bit converters; resistance and damping are
unknown. The exit code is 1 if a parameter steps or a component is discovered; the decisions of all windows are printed.
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

ADC_STEPS = np.array([0.0, 0.0, 20.0 / 4096, 100.0 / 4096])  # A, rad/s


# Warm-up and wear: resistance rises by 7 % and damping by 18 % in the first half hour.
DRIFTS = (
    {"kind": "drift", "parameter": "R_a", "start": "0 s", "amount": "-0.5 ohm", "rate": "-0.0013 1/s"},
    {"kind": "drift", "parameter": "D", "start": "0 s", "amount": "0.0001 N*m*s/rad", "rate": "0.0007 1/s"},
)


def scenarios(*, drifting: bool = False) -> dict[str, Scenario]:
    """Without faults: with the demo's set-points, and at constant speed."""
    faults = tuple(Drift.model_validate(drift) for drift in DRIFTS) if drifting else ()
    demo: Any = load_scenario(CONFIG / "scenarios" / "demo.toml").model_copy(update={"faults": faults})
    first = demo.set_points[0]
    return {"excited": demo, "constant speed": demo.model_copy(update={"set_points": (first,), "repeat_every": None})}


def quantise(values: Array) -> Array:
    """(records, signals) after 12-bit conversion."""
    steps = np.where(ADC_STEPS > 0.0, ADC_STEPS, 1.0)
    return np.where(ADC_STEPS > 0.0, np.rint(values / steps) * steps, values)


def run(scenario: Scenario, hours: float) -> dict[str, Any]:
    """Counts of decisions and statuses, and errors of R_a and D."""
    machine = load_machine(CONFIG / "dc-motor.toml", with_driver=False)
    twin = machine.twin
    free = tuple(twin.parameter(name) for name in ("R_a", "D"))
    known = tuple((parameter.name, parameter.nominal) for parameter in twin.parameters if parameter not in free)
    state = initial_state("motor", "bench", replace(machine.problem, known=known, free=free))
    decisions: Counter[str] = Counter()
    statuses: Counter[str] = Counter()
    errors, normalised_errors, seconds = [], [], []
    for window in windows(scenario, round(hours * 3600.0 / (RECORDS * scenario.sample_period))):
        converted_window = replace(window, values=quantise(window.values))
        start = time.perf_counter()
        state, report = adapt(state, converted_window)
        seconds.append(time.perf_counter() - start)
        document = report.document
        decisions[document.decision.name] += 1
        for parameter in document.parameters.values():
            statuses[parameter.status] += 1
        estimates = [(parameter.value, parameter.sd, parameter.nominal) for parameter in document.parameters.values()]
        if all(value is not None for value, _, _ in estimates):
            errors.append([abs(value / nominal - 1.0) for value, _, nominal in estimates if value is not None])
            normalised_errors.append(
                [(value - nominal) / sd for value, sd, nominal in estimates if value is not None and sd]
            )
    return {
        "hours": hours,
        "windows": sum(decisions.values()),
        "decisions": dict(decisions),
        "statuses": dict(statuses),
        "largest_error": np.max(errors, axis=0).tolist(),
        "median_error": np.median(errors, axis=0).tolist(),
        "intervals_that_hold": np.mean(np.abs(normalised_errors) <= 1.959964, axis=0).tolist(),
        "median_seconds": float(np.median(seconds)),
        "p99_seconds": float(np.quantile(seconds, 0.99)),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument(
        "--drifting", action="store_true", help="parameters drift by warm-up and wear; errors are not printed then"
    )
    parser.add_argument("--only", choices=sorted(scenarios()))
    options = parser.parse_args()
    selected = scenarios(drifting=options.drifting).items()
    results = {name: run(scenario, options.hours) for name, scenario in selected if options.only in (None, name)}
    if options.drifting:
        for result in results.values():
            for key in ("largest_error", "median_error", "intervals_that_hold"):
                del result[key]
    print(json.dumps(results, indent=2))
    return 1 if any({"STEPPED", "DISCOVERED"} & result["decisions"].keys() for result in results.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
