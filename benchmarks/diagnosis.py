"""Simulated faults against what is announced: a confusion table over thirteen situations.

    python -m benchmarks.diagnosis --runs 16

Five situations are those of the paper. Each run has its own noise; the fault begins after ten healthy windows. The most
severe event at the end of the run counts. Any other event is a false one. The exit code is 1 unless 95 % of the runs
are right, with right severity, and at most 0.5 events a simulated day are false.
"""

import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.table import Table

from benchmarks.changes.machines import PUMP, problem_of
from benchmarks.changes.plants import HEALTHY, Change, cut, generator
from benchmarks.changes.plants import simulate as simulate_plant
from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.discovery.motor import Faults, simulate_motor
from benchmarks.discovery.motor import windows as motor_windows
from benchmarks.motor import CONFIG
from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.schema import EventDocument
from otolith.machine import LIBRARY, LoadedMachine, load_machine
from otolith_drivers.plant import faults
from otolith_drivers.plant.scenario import load_scenario, simulate

HEALTHY_WINDOWS, WINDOWS = 10, 40
WEAR_WINDOWS = 170  # of a wear: each changes a parameter by at most 2 %
START = 20.0  # s: end of the healthy windows of the motor
OK = "OK"
DAY = 86400.0  # s
KINDS: dict[str, Any] = {
    "drift": faults.Drift, "step": faults.Step, "unbalance": faults.Unbalance, "gain": faults.Gain,
    "frozen": faults.Frozen,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Situation:
    """A fault, and what must be announced."""

    name: str
    machine: str
    """``motor``, ``hydraulics`` or ``pump``."""
    windows: Callable[[LoadedMachine, int], Iterable[Window]]
    """Of a run, from the machine and the seed."""
    condition: str = OK
    """Part of the condition that is right; :data:`OK` if no event is."""
    severity: str = OK


@dataclass(frozen=True, slots=True)
class Result:
    """One run."""

    situation: str
    announced: str
    severity: str
    is_right: bool
    false_events: int
    seconds: float
    """Simulated."""


def machine_of(kind: str) -> LoadedMachine:
    """Return the machine of a situation; the motor estimates its damping as well."""
    if kind == "hydraulics":
        return load_machine(CONFIG / "hydraulic-actuator.toml", with_driver=False)
    text = (CONFIG / "dc-motor.toml").read_text(encoding="utf-8")
    text = text.replace('D = "0.00143 N*m*s/rad"', 'D = { value = "0.00143 N*m*s/rad", estimate = true }')
    if kind == "pump":
        text = f'[machine]\nname = "pump"\n[twin]\nfile = "{LIBRARY / "pump"}.toml"\n'
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.toml"
        path.write_text(text, encoding="utf-8")
        machine = load_machine(path, with_driver=False)
    return replace(machine, problem=problem_of(PUMP)) if kind == "pump" else machine


def of_scenario(
    name: str, fault: dict[str, Any], machine: LoadedMachine, seed: int, *, count: int = WINDOWS, **changed: Any
) -> Iterator[Window]:
    """Yield ``count`` windows of a scenario with another fault."""
    own = (KINDS[fault["kind"]].model_validate(fault),) if fault else ()
    scenario: Any = load_scenario(CONFIG / "scenarios" / f"{name}.toml")
    scenario = scenario.model_copy(update={"faults": own, "seed": seed, **changed})
    samples, period = simulate(scenario), scenario.sample_period
    names, records = {name: table["signal"] for name, table in machine.file.signals.items()}, machine.records
    for index in range(count):
        rows = [[sample.measured[signal] for signal in names.values()] for sample in islice(samples, records)]
        yield Window.whole(index, index * records * period, period, tuple(names), np.array(rows))


def of_reversing_motor(torque: float, voltage: float, _: LoadedMachine, seed: int) -> list[Window]:
    """Return windows of a motor with dry friction (N·m) and a voltage drop of its brushes (V)."""
    own = Faults(
        torque=lambda *x: -torque * float(np.tanh(x[5] / 0.05)),
        voltage=lambda *x: -voltage * float(np.tanh(x[4] / 0.02)),
        since=START,
    )
    return motor_windows(simulate_motor("reversing", 2.0 * WINDOWS, own, seed))


def of_load_change(machine: LoadedMachine, seed: int) -> list[Window]:
    """Return windows of a motor whose measured load becomes half as large again."""
    before, after = (list(of_scenario("demo", {}, machine, seed, load=load)) for load in (0.006, 0.009))
    return [*before[:HEALTHY_WINDOWS], *after[HEALTHY_WINDOWS:]]


def of_pump(machine: LoadedMachine, seed: int) -> list[Window]:
    """Return windows of a pump whose head is 15 % lower after the healthy windows."""
    random, records = generator(seed, "pump wear", 0), WINDOWS * PUMP.records
    worn = Change(parameters={"h_0": 0.85 * PUMP.parameters["h_0"]})
    rows = simulate_plant(PUMP, [random], records, HEALTHY, worn, HEALTHY_WINDOWS * PUMP.records)
    noise = {output.name: output.noise for output in machine.twin.outputs}
    measured = {name: values[0] + noise.get(name, 0.0) * random.standard_normal(records)
                for name, values in rows.items()}  # fmt: skip
    return cut(PUMP, measured, machine.twin.signals)


def _fault(kind: str, **keys: str | float) -> dict[str, Any]:
    return {"kind": kind, "start": f"{START} s", **keys}


def _motor(name: str, condition: str, severity: str, fault: dict[str, Any], count: int = WINDOWS) -> Situation:
    return Situation(name, "motor", partial(of_scenario, "demo", fault, count=count), condition, severity)


_RESISTANCE, _DAMPING = {"parameter": "R_a"}, {"parameter": "D"}
SITUATIONS = (
    _motor("turns short out", "short circuit between turns", "ACT",
           _fault("drift", **_RESISTANCE, amount="-0.044 ohm", rate="0.01 1/s"), WEAR_WINDOWS),
    _motor("bearing wear", "viscous friction of the bearings is higher", "ACT",
           _fault("drift", **_DAMPING, amount="0.00015 N*m*s/rad", rate="0.01 1/s"), WEAR_WINDOWS),
    _motor("unbalance", "unbalanced shaft", "ACT", _fault("unbalance", acceleration="4.5 rad/s^2", order=1.0)),
    Situation("fluid degradation", "hydraulics",
              partial(of_scenario, "hydraulic-fluid-visible",
                      _fault("drift", **_DAMPING, amount="4.4 N*s/m", rate="0.01 1/s"), count=WEAR_WINDOWS),
              "damping of the hydraulic circuit has changed", "ACT"),
    Situation("leak", "hydraulics",
              partial(of_scenario, "hydraulic-leak", _fault("step", parameter="leak", amount="0.2 1")),
              "leak of the hydraulic circuit", "WATCH"),
    _motor("step of R_a", "short circuit between turns", "ACT", _fault("step", **_RESISTANCE, amount="-0.5 ohm")),
    Situation("dry friction", "motor", partial(of_reversing_motor, 0.006, 0.0), "dry friction on the shaft", "ACT"),
    Situation("brush drop", "motor", partial(of_reversing_motor, 0.0, 0.8), "voltage drop in the armature circuit",
              "WATCH"),
    _motor("misalignment", "shaft misalignment", "ACT", _fault("unbalance", acceleration="4.5 rad/s^2", order=2.0)),
    Situation("pump wear", "pump", of_pump, "pump builds up less head", "ACT"),
    _motor("gain of the current sensor", "sensor is wrong", "ACT",
           _fault("gain", signal="ArmatureCurrent", factor="1.1")),
    _motor("frozen speed sensor", "sensor is wrong", "ACT", _fault("frozen", signal="RotorSpeed", until="1000 s")),
    Situation("load change", "motor", of_load_change),
)  # fmt: skip


def run(name: str, seed: int) -> Result:
    """Return what is announced in one run of a situation."""
    situation = next(item for item in SITUATIONS if item.name == name)
    machine = machine_of(situation.machine)
    state = initial_state("m", "s", machine.problem, machine.plan)
    raised: dict[str, EventDocument] = {}
    seconds = 0.0
    for window in situation.windows(machine, seed):
        state, report = adapt(state, window)
        raised |= {event.id: event for event in report.document.events}
        seconds += window.end - window.start
    open_events = report.document.events
    announced = open_events[0].condition if open_events else OK
    severity = str(open_events[0].state) if open_events else OK
    false = sum(situation.condition not in event.condition for event in raised.values())
    return Result(name, announced, severity, situation.condition in announced, false, seconds)


@click.command(help=__doc__)
@click.option("--runs", default=2, show_default=True, help="Of each situation.")
@click.option("--only", type=click.Choice([item.name for item in SITUATIONS]), help="One situation.")
@with_options
def main(options: Options, runs: int, only: str | None) -> None:
    names = [only] if only else [item.name for item in SITUATIONS]
    jobs = [partial(run, name, options.seed + number) for number in range(runs) for name in names]
    results = in_processes(jobs, options.processes)
    expected = {item.name: item for item in SITUATIONS}
    severe = [result.severity == expected[result.situation].severity for result in results]
    right = [result.is_right for result in results]
    false = sum(result.false_events for result in results) / (sum(result.seconds for result in results) / DAY)
    if options.as_json:
        print(json.dumps([asdict(result) for result in results], indent=2))
    else:
        print_pages(_table(names, results), f"right {np.mean(right):.1%}, right severity {np.mean(severe):.1%}, "
                    f"false events a simulated day {false:.3g}")  # fmt: skip
    sys.exit(not (np.mean(right) >= 0.95 and np.mean(severe) >= 0.95 and false <= 0.5))


def _table(names: Sequence[str], results: Sequence[Result]) -> Table:
    table = Table("situation", "right", "false events", "announced (runs)")
    for name in names:
        own = [result for result in results if result.situation == name]
        announced = Counter(f"{result.severity}: {result.announced}" for result in own)
        texts = "; ".join(f"{text} ({count})" for text, count in announced.most_common())
        right, false = sum(result.is_right for result in own), sum(result.false_events for result in own)
        table.add_row(name, f"{right} of {len(own)}", str(false), texts)
    return table


if __name__ == "__main__":
    main()
