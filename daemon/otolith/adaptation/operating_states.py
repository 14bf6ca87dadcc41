"""Stretches of a window in which the drive is switched off: its command is then not the voltage at the machine.

While a bridge is open, no current flows whatever the command says, and a brake or gear may hold the load. The equations
of the twin do not hold there, so that such a stretch is evidence of nothing. It is recognised by a command of zero
volts, in whose equation the current is zero within its noise, in a window that contradicts the twin.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Mask, Window, runs_of
from otolith.estimation.evidence import SIGNIFICANT_DEVIATE
from otolith.estimation.problem import Problem
from otolith.twin.definition import Definition
from otolith.twin.expressions import names_in, parse
from otolith_drivers.units import are_of_one_quantity

MIN_OFF = 5  # records without a command from which on a drive is off
SWITCHING = 3  # records within which the current of an open bridge ends
OFF_SHARE = 0.95  # of the records of a stretch whose current is zero within its noise
MIN_ON_SHARE = 0.25  # of the records of a window: less between two stretches is not estimated from


@dataclass(frozen=True, slots=True)
class RunningPart:
    """What of a window the equations of the twin hold in."""

    window: Window | None  # Without stretches in which the drive is off; None if too little is left
    note: str


def running_part(problem: Problem, window: Window) -> RunningPart | None:
    """Return the longest part of ``window`` in which the drive is on; None if it is so all the time."""
    off = off_records(problem, window)
    if not off.any():
        return None
    runs = [(start, end) for start, end in runs_of(~off) if end - start >= MIN_ON_SHARE * window.records]
    seconds = float(window.grid.steps[off].sum())
    note = f"the drive was switched off for {seconds:.3g} s, in which no equation of the twin holds"
    if not runs:
        return RunningPart(None, note)
    start, end = max(runs, key=lambda run: run[1] - run[0])
    return RunningPart(window.until(end).since(start), note)


def off_records(problem: Problem, window: Window) -> Mask:
    """Return where the drive is off (records,)."""
    off, inputs = np.zeros(window.records, dtype=np.bool_), problem.base_model.inputs
    levels = dict(zip((row.name for row in inputs), problem.input_noise or (0.0,) * len(inputs), strict=True))
    for current, commands in _driven_currents(problem.base_model):
        index = [output.name for output in problem.base_model.outputs].index(current)
        reach = SIGNIFICANT_DEVIATE * problem.noise[index] + (problem.steps[index] if problem.steps else 0.0)
        is_zero = (np.abs(window.readings(current)) <= reach) | window.missing_in(current)
        without = np.all(
            [np.abs(window.column(name)) <= SIGNIFICANT_DEVIATE * levels[name] for name in commands], axis=0
        )
        for start, end in runs_of(without):
            begin = _end_of_current(is_zero[start:end])
            if end - start - begin >= MIN_OFF:
                off[start if begin <= SWITCHING else start + begin : end] = True
    return off


def _end_of_current(is_zero: Mask) -> int:
    """Return after how many records of a stretch without a command the current stays zero."""
    left = np.cumsum(is_zero[::-1])[::-1] / np.arange(len(is_zero), 0, -1)
    ended = np.flatnonzero(is_zero & (left >= OFF_SHARE))
    return int(ended[0]) if len(ended) else len(is_zero)


@lru_cache(maxsize=64)
def _driven_currents(twin: Definition) -> tuple[tuple[str, list[str]], ...]:
    """Return each measured current that is a state, with the commands in volts of its equation."""
    equations = dict(twin.equations)
    volts = [row.name for row in twin.inputs if are_of_one_quantity(row.unit, "V")]
    driven = ((output, names_in(parse(equations.get(f"der({output.name})", "0")))) for output in twin.outputs)
    rows = ((output, [name for name in volts if name in names]) for output, names in driven)
    return tuple((output.name, names) for output, names in rows if names and are_of_one_quantity(output.unit, "A"))
