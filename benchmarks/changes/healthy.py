"""Healthy machines whose residuals have structure: nothing may be adopted, and no verdict may be stated.

Every disturbance is so small that the machine needs no repair: a ripple that one window does not show, converters with
steps of twice the noise, sampling times and loads with errors that add at most half of the noise, and slow wear.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.changes.classes import VERDICTS, text_of
from benchmarks.changes.machines import DC_MOTOR, PUMP, SERVO_AXIS, TWO_MASS, twin_of
from benchmarks.changes.observe import Case, Observed, coverage
from benchmarks.changes.plants import HEALTHY, Change, Plant, Term, generator, simulate
from otolith.acquisition.window import Array

RIPPLE = 8.0  # χ² of a window that the ripple adds: a quarter of what makes a component decisive
JITTER = 0.5  # of the noise: the largest error that wrong times of samples cause
QUANTUM = 2.0  # of the noise: step of a converter
DRIFT = 0.001  # of the parameter, per window
EXAMPLES = 5  # windows that the document lists


@dataclass(frozen=True, slots=True)
class Ageing:
    """Where a machine ripples, wears and is loaded."""

    plant: Plant
    ripple: str
    """Site."""
    rate: float
    """rad/s."""
    wears: str
    """Parameter."""
    load: str = ""
    """Measured input."""
    load_noise: float = 0.0
    """Moves an output by about half of its noise."""


MACHINES = (
    Ageing(DC_MOTOR, "shaft", 25.0, "R_a", "T_load", 2e-4),
    Ageing(PUMP, "pipe", 30.0, "k_v", "u", 4e-3),
    Ageing(SERVO_AXIS, "carriage", 40.0, "F_c"),
    Ageing(TWO_MASS, "load_side", 12.0, "D_l", "T_load", 0.01),
)


def cases(windows: int, names: Sequence[str] = ()) -> list[Case]:
    """Return the cases whose names contain one of ``names``, or all, with so many windows."""
    made = []
    for machine in MACHINES:
        plant = machine.plant
        rate = DRIFT / (plant.records * plant.period)
        plain = Case("noise alone", plant, HEALTHY, healthy=windows, changed=0)
        own = [
            plain,
            replace(plain, name="ripple"),
            replace(plain, name="quantisation", quantum=QUANTUM),
            replace(plain, name="jitter", disturb=jittered),
            replace(plain, name=f"{machine.wears} drifts", before=Change(ramps={machine.wears: rate})),
        ]
        if machine.load:
            disturb = partial(with_load_noise, signal=machine.load, level=machine.load_noise)
            own.append(replace(plain, name="load noise", disturb=disturb))
        named = [replace(case, name=f"{plant.name}: {case.name}") for case in own]
        chosen = [case for case in named if not names or any(name in case.name for name in names)]
        made += [
            replace(case, before=_ripple(machine)) if case.name.endswith("ripple") else case  # takes a simulation
            for case in chosen
        ]
    return made


def _ripple(machine: Ageing) -> Change:
    """Return the ripple whose effect on the outputs of a window has the χ² that is allowed."""
    plant, records, amplitude = machine.plant, 2 * machine.plant.records, 1e-6
    change = Change(terms={machine.ripple: Term("periodic", "t", amplitude, machine.rate)})
    without, rippled = (
        simulate(plant, [generator(1, plant.name, 0)], records, own, own, 0) for own in (HEALTHY, change)
    )
    effects = [(rippled[output.name] - without[output.name]) / output.noise for output in twin_of(plant).outputs]
    chi_square = float(sum((effect**2).sum() for effect in effects)) / (records / plant.records)
    size = amplitude * float(np.sqrt(RIPPLE / chi_square))
    return Change(terms={machine.ripple: Term("periodic", "t", size, machine.rate)})


def jittered(random: np.random.Generator, plant: Plant, rows: dict[str, Array]) -> None:
    """Read the outputs of each record early or late, which the times of the records do not show."""
    outputs = twin_of(plant).outputs
    times = np.arange(len(rows[outputs[0].name]), dtype=float)
    slopes = [float(np.sqrt(np.mean(np.diff(rows[output.name]) ** 2))) / output.noise for output in outputs]
    read = times + JITTER / max(slopes) * random.standard_normal(len(times))
    for output in outputs:
        rows[output.name] = np.interp(read, times, rows[output.name])


def with_load_noise(
    random: np.random.Generator, plant: Plant, rows: dict[str, Array], signal: str, level: float
) -> None:
    """Add white noise to a measured input of the plant."""
    rows[signal] = rows[signal] + level * random.standard_normal(len(rows[signal]))


def summarise(case: Case, runs: Sequence[Sequence[Observed]]) -> dict[str, Any]:
    """Return the figures of a case as a document."""
    windows = [window for run in runs for window in run]
    adopted = sum(_adoptions(run) for run in runs)
    verdicts = [window for window in windows if window.decision in VERDICTS]
    open_windows = [window for window in windows if window.stated]
    return {
        "case": case.name,
        "windows": len(windows),
        "adopted": adopted,
        "verdicts": len(verdicts),
        "open": len(open_windows),
        "decisions": dict(Counter(window.decision.name for window in windows)),
        "cost": float(np.mean([window.cost for window in windows if window.cost is not None])),
        "held": {
            name: coverage([window.parameters[name] for window in windows]).held for name in windows[0].parameters
        },
        "examples": [text_of(window) for window in (verdicts or open_windows)[:EXAMPLES]],
        "met": adopted == 0 and not verdicts,
    }


def _adoptions(run: Sequence[Observed]) -> int:
    """Return how many components were adopted."""
    keys = [frozenset(item.text for item in window.components) for window in run]
    return sum(len(after - before) for before, after in zip([frozenset[str](), *keys], keys, strict=False))
