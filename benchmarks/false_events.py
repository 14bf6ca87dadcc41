"""Events of simulated machines at the speed of real wear: what is announced that is not so, per simulated day.

    python -m benchmarks.false_events --hours 24

Healthy motors with changing set-points, at constant speed, with a measured load that changes each hour, and with a
winding that warms up by 40 K; and motors and a hydraulic lift that wear until the last hour, where a trend that is
announced before its limit is right. The exit code is 1 if more than 0.5 events a simulated day are false, or if a wear
is not announced.
"""

import json
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import click
from rich.table import Table

from benchmarks.command_line import Options, in_processes, print_pages, with_options
from benchmarks.diagnosis import DAY, machine_of, of_scenario
from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.health.limits import Level, Limit
from otolith.health.schema import EventDocument
from otolith.health.text import event_text
from otolith.machine import LoadedMachine
from otolith_drivers.plant.dc_motor import SetPoint

HOUR = 3600.0  # s
LENGTH = 2.0  # s: of a window
COPPER = 0.00393  # 1/K: temperature coefficient of the resistance
RISE = 40.0  # K
WARM_UP = 1200.0  # s: a time constant of a small motor
GROWTH = 5.0  # exponent of a wear from its start to its end, as in the paper
AMBIENT = 293.15  # K
MAX_FALSE_PER_DAY = 0.5


@dataclass(frozen=True, slots=True)
class Result:
    """One simulated stretch of time."""

    case: str
    hours: float
    is_announced: bool
    """Whether the wear was, if there is any."""
    false_events: tuple[str, ...]


def wear(parameter: str, change: str, unit: str, hours: float) -> dict[str, Any]:
    """Return a drift that reaches ``change`` at the end."""
    amount = float(change) / math.expm1(GROWTH)
    rate = GROWTH / (hours * HOUR)
    keys = {"kind": "drift", "parameter": parameter, "start": "0 s"}
    return {**keys, "amount": f"{amount} {unit}", "rate": f"{rate} 1/s"}


def motor(fault: dict[str, Any], machine: LoadedMachine, seed: int, hours: float, **changed: Any) -> Iterator[Window]:
    """Yield the windows of the demo's motor."""
    return of_scenario("demo", fault, machine, seed, count=round(hours * HOUR / LENGTH), **changed)


def worn(parameter: str, change: str, unit: str, machine: LoadedMachine, seed: int, hours: float) -> Iterator[Window]:
    """Yield the windows of a motor whose parameter wears."""
    return motor(wear(parameter, change, unit, hours), machine, seed, hours)


def constant_speed(machine: LoadedMachine, seed: int, hours: float) -> Iterator[Window]:
    """Yield the windows of a motor that is always at 10 rad/s."""
    point = SetPoint.model_validate({"at": "1 s", "speed": "10 rad/s"})
    return motor({}, machine, seed, hours, set_points=(point,), repeat_every=None)


def changing_load(machine: LoadedMachine, seed: int, hours: float) -> Iterator[Window]:
    """Yield the windows of a motor whose measured load is each second hour half as large again."""
    both = zip(*(motor({}, machine, seed, hours, load=load) for load in (0.006, 0.009)), strict=True)
    for light, heavy in both:
        yield heavy if light.start // HOUR % 2 else light


def warming(machine: LoadedMachine, seed: int, hours: float, *, measured: bool) -> Iterator[Window]:
    """Yield the windows of a motor whose winding warms up from 20 °C to 60 °C."""
    fault = {
        "kind": "drift", "parameter": "R_a", "start": "0 s",
        "amount": f"{-6.5 * COPPER * RISE} ohm", "rate": f"{-1.0 / WARM_UP} 1/s",
    }  # fmt: skip
    for window in motor(fault, machine, seed, hours):
        rise = -RISE * math.expm1(-0.5 * (window.start + window.end) / WARM_UP)
        yield replace(window, observed={"winding": AMBIENT + rise}) if measured else window


def fluid(machine: LoadedMachine, seed: int, hours: float) -> Iterator[Window]:
    """Yield the windows of a lift whose fluid ages: damping and a half more."""
    count = round(hours * HOUR / (machine.records * 0.01))
    return of_scenario("hydraulic-fluid-visible", wear("D", "60", "N*s/m", hours), machine, seed, count=count)


CASES: dict[str, tuple[str, Callable[[LoadedMachine, int, float], Iterator[Window]], str]] = {
    "changing set-points": ("motor", partial(motor, {}), ""),
    "constant speed": ("motor", constant_speed, ""),
    "changing load": ("motor", changing_load, ""),
    "warming up": ("motor", partial(warming, measured=False), ""),
    "warming up, measured": ("warm motor", partial(warming, measured=True), ""),
    "turns short out": ("motor", partial(worn, "R_a", "-0.6", "ohm"), "short circuit between turns"),
    "bearing wear": ("motor", partial(worn, "D", "0.002", "N*m*s/rad"), "viscous friction of the bearings is higher"),
    "fluid degradation": ("hydraulics", fluid, "damping of the hydraulic circuit has changed"),
}
"""Machine, windows by machine, seed and hours, and what must be announced."""


def machine_for(kind: str) -> LoadedMachine:
    """Return the machine of a case; the temperature of the ``warm motor`` is measured, and its limits are closer."""
    machine = machine_of("motor" if kind == "warm motor" else kind)
    if kind != "warm motor":
        return machine
    plan, own = machine.plan, machine.plan.parameters["R_a"]
    close = Limit(Level.WATCH, 1.05 * own.nominal, is_lower=False)
    own = replace(own, temperature="winding", temperature_coefficient=COPPER, limits=(*own.limits, close))
    return replace(machine, plan=replace(plan, parameters={**plan.parameters, "R_a": own}))


def run(case: str, seed: int, hours: float) -> Result:
    """Return the events of a case that are false."""
    kind, windows, condition = CASES[case]
    machine = machine_for(kind)
    state = initial_state("m", "s", machine.problem, machine.plan)
    raised: dict[str, EventDocument] = {}
    for window in windows(machine, seed, hours):
        state, report = adapt(state, window)
        raised |= {event.id: event for event in report.document.events}
    is_announced = any(condition in event.condition for event in raised.values()) or not condition
    false = [
        event_text(event)
        for event in raised.values()
        if not condition or (condition not in event.condition and event.condition_id != "trend")
    ]
    return Result(case, hours, is_announced, tuple(false))


@click.command(help=__doc__)
@click.option("--hours", default=24.0, show_default=True, help="Of each case.")
@click.option("--only", type=click.Choice(list(CASES)), help="One case.")
@with_options
def main(options: Options, hours: float, only: str | None) -> None:
    jobs = [partial(run, case, options.seed, hours) for case in CASES if only in (None, case)]
    results = in_processes(jobs, options.processes)
    false = sum(len(result.false_events) for result in results) / (sum(result.hours for result in results) * HOUR / DAY)
    if options.as_json:
        print(json.dumps([asdict(result) for result in results], indent=2))
    else:
        table = Table("case", "hours", "announced", "false events")
        for result in results:
            announced = "-" if not CASES[result.case][2] else "yes" if result.is_announced else "no"
            table.add_row(result.case, f"{result.hours:g}", announced, "\n".join(result.false_events) or "none")
        print_pages(table, f"false events a simulated day {false:.3g}")
    sys.exit(not (all(result.is_announced for result in results) and false <= MAX_FALSE_PER_DAY))


if __name__ == "__main__":
    main()
