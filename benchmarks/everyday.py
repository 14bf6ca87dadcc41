"""Everyday situations of a motor: what is announced, against what has happened.

    python -m benchmarks.everyday --runs 1

The plant has equations of its own, not those of a twin: a winding with a temperature, a bridge that can be disabled, a
supply that sags, loads without a sensor. A row is healthy, or has a fault and what must be said of it. Right is a
healthy run without an event, or an event that names the fault; honest is a class of causes, or that nothing explains
it; everything else is wrong, also a wrong cause beside the right one. False events are all of healthy runs, and those
before a fault began. The exit code is 1 if a run is wrong.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from time import perf_counter

import click
import numpy as np
from rich.table import Table

from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.diagnosis import DAY, machine_of
from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.schema import EventChange, Status

OfTime = Callable[[float], float]

PERIOD, STEPS, RECORDS = 0.01, 10, 200  # s; of the integration per row; rows of a window
RESISTANCE, INDUCTANCE, INERTIA, CONSTANT, DAMPING = 6.5, 0.673, 0.001171, 0.038, 0.00143  # SI
NOISE = {"V_a": 0.0, "T_load": 0.0002, "i": 0.005, "omega": 0.02}  # In the unit of each signal
COPPER = 0.00393  # 1/K
LOAD = 0.006  # N·m: of the machine, measured
GAIN, INTEGRAL = 0.5, 0.4  # V·s/rad and V/rad: of the controller of the speed
RANGE = 24.0  # V
HONEST = frozenset({"class", "unexplained"})  # Ids of conditions that name no cause
ONSET = 40.0  # s


@dataclass(frozen=True, slots=True)
class Machine:
    """What the plant does at each time, SI."""

    resistance: OfTime = lambda _: RESISTANCE
    damping: OfTime = lambda _: DAMPING
    load: OfTime = lambda _: LOAD
    hidden_load: OfTime = lambda _: 0.0  # Without a sensor
    per_angle: Callable[[float], float] = lambda _: 0.0  # Torque at an angle
    supply: OfTime = lambda _: 1.0  # Voltage over that of the command
    enabled: Callable[[float], bool] = lambda _: True
    current_zero: OfTime = lambda _: 0.0
    current_gain: OfTime = lambda _: 1.0
    speed: OfTime = lambda time: (10.0, 20.0, 15.0, 5.0)[int(time // 7.0) % 4]  # Set-point


@dataclass(frozen=True, slots=True)
class Situation:
    """A row of the benchmark."""

    name: str
    machine: Machine
    right: tuple[str, ...] = ()
    """Ids of the conditions that name the fault; none of a healthy machine."""
    onset: float = ONSET
    seconds: float = 120.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run."""

    situation: str
    verdict: str
    seconds: float
    false_events: int
    covered: int
    intervals: int
    longest: float
    """Computing time of the slowest window, s."""
    story: tuple[str, ...] = field(default=())


def _after(before: float, later: float, onset: float = ONSET, until: float = 1e9) -> OfTime:
    return lambda time: later if onset <= time < until else before


SITUATIONS = (
    Situation("healthy: changing set-points", Machine()),
    Situation("healthy: constant speed", Machine(speed=lambda _: 12.0)),
    Situation("healthy: cold morning",
              Machine(resistance=lambda time: RESISTANCE * (1.0 - 30.0 * COPPER * float(np.exp(-time / 300.0))))),
    Situation("healthy: drive disabled, coasting", Machine(enabled=lambda time: time % 40.0 < 28.0)),
    Situation("healthy: another product each minute",
              Machine(load=lambda time: LOAD * (1.0 + 0.5 * (time // 60.0 % 2)))),
    Situation("healthy: sags of the supply", Machine(supply=lambda time: 0.9 if time % 30.0 > 29.5 else 1.0)),
    Situation("healthy: stops at a closed bridge and restarts",
              Machine(speed=lambda time: 0.0 if time % 30.0 > 20.0 else 12.0)),
    Situation("healthy: ripple of the supply", Machine(supply=lambda time: 1.0 + 0.02 * float(np.sin(314.0 * time)))),
    Situation("healthy: a product each 7 s", Machine(load=lambda time: LOAD * (1.0, 1.5, 0.7)[int(time // 7.0) % 3])),
    Situation("turns short out", Machine(resistance=_after(RESISTANCE, 0.91 * RESISTANCE)),
              ("winding-turns", "winding-turns-step")),
    Situation("friction of the bearings x 2.5", Machine(damping=_after(DAMPING, 2.5 * DAMPING)),
              ("friction-step", "viscous-friction")),
    Situation("a load without a sensor", Machine(hidden_load=_after(0.0, 0.004)), ("constant-torque",)),
    Situation("a load without a sensor that rises", Machine(hidden_load=lambda time: 5e-5 * max(time - ONSET, 0.0)),
              ("constant-torque",)),
    Situation("zero of the current drifts by 50 mA/min",
              Machine(current_zero=lambda time: 0.05 / 60.0 * max(time - ONSET, 0.0)), ("sensor",)),
    Situation("current reads 10 % more", Machine(current_gain=_after(1.0, 1.1)), ("sensor",)),
    Situation("current reads 10 % more, later turns short out",
              Machine(current_gain=_after(1.0, 1.1), resistance=_after(RESISTANCE, 0.91 * RESISTANCE, 80.0)),
              ("sensor", "winding-turns", "winding-turns-step"), seconds=160.0),
    Situation("unbalance", Machine(per_angle=lambda angle: 0.0045 * float(np.sin(angle))), ("unbalance",), onset=0.0),
    Situation("knock of a bearing", Machine(per_angle=lambda angle: 0.003 * float(np.sin(0.273 * angle))),
              ("less-than-once-per-turn",), onset=0.0),
    Situation("turns short out, then repaired", Machine(resistance=_after(RESISTANCE, 0.91 * RESISTANCE, until=80.0)),
              ("winding-turns", "winding-turns-step"), seconds=160.0),
)  # fmt: skip


def simulate(machine: Machine, seconds: float, seed: int) -> tuple[tuple[str, ...], Array]:
    """Return names and rows (records, signals) of what is measured."""
    random, rows = np.random.default_rng(seed), []
    current = speed = angle = integral = 0.0
    for row in range(round(seconds / PERIOD)):
        time = row * PERIOD
        is_on = machine.enabled(time)
        error = machine.speed(time) - speed
        integral = float(np.clip(integral + INTEGRAL * error * PERIOD, -RANGE, RANGE)) if is_on else 0.0
        command = float(np.clip(CONSTANT * speed + GAIN * error + integral, -RANGE, RANGE)) if is_on else 0.0
        measured = machine.current_gain(time) * current + machine.current_zero(time)
        rows.append((command, machine.load(time), measured, speed))
        for step in range(STEPS):
            now, length = time + step * PERIOD / STEPS, PERIOD / STEPS
            voltage = machine.supply(now) * command - machine.resistance(now) * current - CONSTANT * speed
            current = current + length * voltage / INDUCTANCE if is_on else 0.0  # the open bridge ends the current
            torque = CONSTANT * current - machine.load(now) - machine.hidden_load(now) + machine.per_angle(angle)
            speed += length * (torque - machine.damping(now) * speed) / INERTIA
            speed = max(speed, 0.0)  # a worm gear holds the load
            angle += length * speed
    values = np.array(rows)
    return tuple(NOISE), values + np.array(list(NOISE.values())) * random.standard_normal(values.shape)


def run(name: str, seed: int) -> Outcome:
    """Return what is announced in one run of a situation."""
    return run_of(next(item for item in SITUATIONS if item.name == name), seed)


def run_of(situation: Situation, seed: int) -> Outcome:
    """Return what is announced in one run of a situation."""
    machine = machine_of("motor")
    state = initial_state("m", "s", machine.problem, machine.plan)
    signals, values = simulate(situation.machine, situation.seconds, seed)
    named, story = set[str](), list[str]()
    false, covered, intervals, longest = 0, 0, 0, 0.0
    for index in range(len(values) // RECORDS):
        window = Window.whole(
            index, index * RECORDS * PERIOD, PERIOD, signals, values[index * RECORDS : (index + 1) * RECORDS]
        )
        began = perf_counter()
        state, report = adapt(state, window)
        longest = max(longest, perf_counter() - began)
        truths = {"R_a": situation.machine.resistance(window.end), "D": situation.machine.damping(window.end)}
        for own, truth in truths.items():
            item = report.document.parameters[own]
            if item.status is Status.ESTIMATED and item.low is not None and item.high is not None:
                intervals += 1
                covered += item.low <= truth <= item.high
        for event in report.document.events:
            if event.change is None:
                continue
            story.append(f"{window.end:.0f} s: {event.change} {event.state} {event.condition}: {event.text}")
            if event.change is EventChange.RAISED and not event.is_hint:
                false += not situation.right or window.end <= situation.onset
        named |= {rule for event in report.document.open_events for rule in event.condition_id.split()}
    judged = verdict(situation, named)
    return Outcome(situation.name, judged, situation.seconds, false, covered, intervals, longest, tuple(story))


def verdict(situation: Situation, named: set[str]) -> str:
    """Return whether what was named at any time is right, honest or wrong; a healthy run must name nothing.

    A wrong cause is wrong also where the right one is named before or after it, and so is a fault that is missed.
    """
    right = set(situation.right)
    if named - right - HONEST:
        return "wrong"
    if named & right or not (named or right):
        return "right"
    return "honest" if named else "wrong"


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
        table = Table("situation", "right", "honest", "wrong", "false events", "coverage", "slowest window")
        for name in names:
            own = [result for result in results if result.situation == name]
            counts = [str(sum(item.verdict == kind for item in own)) for kind in ("right", "honest", "wrong")]
            table.add_row(name, *counts, *_numbers(own))
        healthy = [item for item in results if item.situation.startswith("healthy")]
        days = sum(item.seconds for item in healthy) / DAY
        rate = f"{sum(item.false_events for item in healthy) / days:.3g} false events a day" if days else ""
        print_pages(table, f"healthy: {rate}")
    sys.exit(any(result.verdict == "wrong" for result in results))


def _numbers(own: list[Outcome]) -> tuple[str, str, str]:
    covered, intervals = sum(item.covered for item in own), sum(item.intervals for item in own)
    share = f"{covered / intervals:.0%} of {intervals}" if intervals else ""
    return str(sum(item.false_events for item in own)), share, f"{max(item.longest for item in own):.2g} s"


if __name__ == "__main__":
    main()
