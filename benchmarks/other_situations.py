"""Further faults on all built-in twins: what is announced, for a person to judge.

    python -m benchmarks.other_situations --runs 1

Other machines than those of :mod:`benchmarks.diagnosis`, other sizes of a change, sensors, two faults at once, a fault
that ends, and faults that were there before the first window. A run is right if the most severe event at its end names
the condition, and, if the fault has ended, no event is open.
"""

import json
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.table import Table

from benchmarks.changes.machines import LIBRARY_PLANTS, problem_of
from benchmarks.changes.plants import HEALTHY, Change, Term, cut, generator, simulate
from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.diagnosis import HEALTHY_WINDOWS, OK, START, WINDOWS, machine_of, of_scenario
from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.machine import LIBRARY, LoadedMachine, load_machine
from otolith_drivers.plant import faults

CLASS = "one of several causes, which the data do not distinguish"
"""A moved parameter gives the same signals as an error of an input's sensor, or as another parameter."""


@dataclass(frozen=True, slots=True)
class Situation:
    """A fault, and what must be announced."""

    name: str
    machine: Callable[[], LoadedMachine]
    windows: Callable[[LoadedMachine, int], Iterable[Window]]
    condition: str
    """Part of the text of the condition, or of one of them where the data do not distinguish several."""
    severity: str


@dataclass(frozen=True, slots=True)
class Result:
    """One run."""

    situation: str
    is_right: bool
    story: tuple[str, ...]
    """Each announcement, and how many windows after the first it came."""


def machine_with(twin: str) -> LoadedMachine:
    """Return a machine of a twin as it is in the library, whose values are its own, with the noise of the plant."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "machine.toml"
        path.write_text(f'[machine]\nname = "m"\n[twin]\nfile = "{LIBRARY / twin}.toml"\n', encoding="utf-8")
        machine = load_machine(path, with_driver=False)
    return replace(machine, problem=problem_of(LIBRARY_PLANTS[twin]))


def of_plant(
    twin: str, change: Change, machine: LoadedMachine, seed: int, *, at: int = HEALTHY_WINDOWS
) -> list[Window]:
    """Return the windows of a plant that changes after ``at`` windows."""
    plant = LIBRARY_PLANTS[twin]
    random, records = generator(seed, "other", 0), WINDOWS * plant.records
    rows = simulate(plant, [random], records, HEALTHY, change, at * plant.records)
    noise = {output.name: output.noise for output in machine.twin.outputs}
    measured = {name: values[0] + noise.get(name, 0.0) * random.standard_normal(records)
                for name, values in rows.items()}  # fmt: skip
    return cut(plant, measured, machine.twin.signals)


def of_motor(own: tuple[Any, ...], machine: LoadedMachine, seed: int, count: int = WINDOWS) -> Iterable[Window]:
    """Return the windows of the demo's motor with several faults."""
    return of_scenario("demo", {}, machine, seed, count=count, faults=own)


def noisier(factor: float, machine: LoadedMachine, seed: int) -> Iterable[Window]:
    """Yield the windows of a motor whose speed sensor becomes ``factor`` times as noisy."""
    random = np.random.default_rng(seed + 1000)
    column = machine.twin.signals.index("omega")
    level = np.sqrt(factor**2 - 1.0) * next(item.noise for item in machine.twin.outputs if item.name == "omega")
    for window in of_scenario("demo", {}, machine, seed):
        values = window.values.copy()
        values[:, column] += level * random.standard_normal(len(values))
        yield replace(window, values=values) if window.index >= HEALTHY_WINDOWS else window


def _at(start: float = START, **keys: Any) -> dict[str, Any]:
    return {"start": f"{start} s", **keys}


def _step(parameter: str, amount: str, start: float = START) -> faults.Step:
    return faults.Step.model_validate(_at(start, kind="step", parameter=parameter, amount=amount))


def _unbalance(size: float, start: float = START, order: float = 1.0) -> faults.Unbalance:
    keys = _at(start, kind="unbalance", acceleration=f"{size} rad/s^2", order=order)
    return faults.Unbalance.model_validate(keys)


def _motor(name: str, condition: str, severity: str, *own: Any) -> Situation:
    return Situation(f"motor: {name}", partial(machine_of, "motor"), partial(of_motor, own), condition, severity)


def _plant(twin: str, name: str, condition: str, severity: str, change: Change, at: int = HEALTHY_WINDOWS) -> Situation:
    windows = partial(of_plant, twin, change, at=at)
    return Situation(f"{twin}: {name}", partial(machine_with, twin), windows, condition, severity)


def _gain(signal: str, factor: float, until: float = 1e9) -> faults.Gain:
    return faults.Gain.model_validate(_at(kind="gain", signal=signal, factor=str(factor), until=f"{until} s"))


def _offset(signal: str, amount: str, until: float = 1e9) -> faults.Offset:
    return faults.Offset.model_validate(_at(kind="offset", signal=signal, amount=amount, until=f"{until} s"))


def _changed(twin: str, name: str, factor: float) -> Change:
    return Change(parameters={name: factor * LIBRARY_PLANTS[twin].parameters[name]})


SITUATIONS = (
    _plant("servo_axis", "dry friction + 75 %", "friction", "WATCH", _changed("servo_axis", "F_c", 1.75)),
    _plant("servo_axis", "viscous friction x 2.3", "friction", "ACT", _changed("servo_axis", "F_v", 2.3)),
    _plant("servo_axis", "constant force 30 N", CLASS, "WATCH",
           Change(terms={"carriage": Term("constant", "", 30.0)})),
    _plant("two_mass", "stiffness - 35 %", "shaft or coupling is softer", "ACT", _changed("two_mass", "k_s", 0.65)),
    _plant("two_mass", "load friction x 3", "friction has risen", "ACT", _changed("two_mass", "D_l", 3.0)),
    _plant("two_mass", "sensor of load speed 5 % off", "sensor is wrong", "WATCH", Change(gains={"omega_l": 1.05})),
    _plant("pump", "pipe x 2", CLASS, "WATCH", _changed("pump", "k_v", 2.0)),
    _plant("pump", "friction x 3", CLASS, "WATCH", _changed("pump", "T_c", 3.0)),
    _plant("pump", "flow sensor + 3", "sensor is wrong", "ACT", Change(offsets={"Q": 3.0})),
    _plant("pmsm", "magnets - 25 %", "magnetic field of the motor", "ACT", _changed("pmsm", "psi", 0.75)),
    _plant("hydraulic_actuator", "pump flow - 15 %", "pump delivers less", "ACT",
           _changed("hydraulic_actuator", "q_pump", 0.85)),
    _motor("R_a + 54 %", "contact in the winding circuit has opened", "WATCH", _step("R_a", "3.5 ohm")),
    _motor("R_a - 4 %", "short circuit between turns", "WATCH", _step("R_a", "-0.26 ohm")),
    _motor("R_a - 2 %", CLASS, "WATCH", _step("R_a", "-0.13 ohm")),
    _motor("K_e - 20 %", CLASS, "WATCH", _step("K_e", "-0.0076 V*s/rad")),
    _motor("J + 30 %", CLASS, "WATCH", _step("J", "0.00035 kg*m^2")),
    _motor("small unbalance", "unbalanced shaft", "WATCH", _unbalance(1.5)),
    _motor("offset of the current sensor", "sensor is wrong", "ACT", _offset("ArmatureCurrent", "0.15 A")),
    _motor("offset of the speed sensor", "sensor is wrong", "ACT", _offset("RotorSpeed", "1 rad/s")),
    _motor("gain that heals", OK, OK, _gain("ArmatureCurrent", 1.1, 50.0)),
    _motor("winding and unbalance at once", "short circuit", "ACT", _step("R_a", "-0.6 ohm"), _unbalance(4.5)),
    _motor("winding, later unbalance", "short circuit", "ACT", _step("R_a", "-0.6 ohm"), _unbalance(4.5, 40.0)),
    _motor("winding, later current sensor", "short circuit", "ACT", _step("R_a", "-0.6 ohm"),
           faults.Gain.model_validate(_at(40.0, kind="gain", signal="ArmatureCurrent", factor="1.1"))),
    _motor("winding from the first window", "colder than at commissioning", "HINT", _step("R_a", "-0.6 ohm", 0.0)),
    _motor("unbalance from the first window", "unbalanced shaft", "ACT", _unbalance(4.5, 0.0)),
    Situation("motor: speed sensor 5 x noisier", partial(machine_of, "motor"), partial(noisier, 5.0),
              "sensor is noisier", "WATCH"),
)  # fmt: skip


def run(name: str, seed: int) -> Result:
    """Return what is announced in one run of a situation."""
    situation = next(item for item in SITUATIONS if item.name == name)
    machine = situation.machine()
    state, story = initial_state("m", "s", machine.problem, machine.plan), []
    for number, window in enumerate(situation.windows(machine, seed)):
        state, report = adapt(state, window)
        story += [f"{number} {event.change} {event.state} {event.part}: {event.condition}: {event.text}"
                  for event in report.document.events if event.change]  # fmt: skip
    current = [event for event in report.document.events if event.end is None]
    condition, severity = (current[0].condition, str(current[0].state)) if current else (OK, OK)
    is_right = situation.condition in condition and severity == situation.severity
    return Result(name, is_right, (*story, f"at the end: {severity} {condition}"))


@click.command(help=__doc__)
@click.option("--runs", default=1, show_default=True, help="Of each situation.")
@click.option("--only", default="", help="Situations whose name contains this.")
@with_options
def main(options: Options, runs: int, only: str) -> None:
    names = [item.name for item in SITUATIONS if only in item.name]
    jobs = [partial(run, name, options.seed + number) for name in names for number in range(runs)]
    results = in_processes(jobs, options.processes)
    if options.as_json:
        print(json.dumps([asdict(result) for result in results], indent=2))
    else:
        table = Table("situation", "right", "window, and what was announced")
        for result in results:
            table.add_row(result.situation, "yes" if result.is_right else "no", "\n".join(result.story))
        right = sum(result.is_right for result in results)
        print_pages(table, f"right {right} of {len(results)}")
    sys.exit(not all(result.is_right for result in results))


if __name__ == "__main__":
    main()
