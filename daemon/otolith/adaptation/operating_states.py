"""Stretches of a window in which the equations of the twin do not hold.

A twin or a machine file states outside of which ranges of its signals that is so. A drive that is switched off need not
be stated. While a bridge is open, no current flows whatever the command says, and a brake or gear may hold the load. It
is recognised by a command of zero volts, in whose equation the current is zero within its noise, in a window that
contradicts the twin. Such a stretch is evidence of nothing.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from otolith.acquisition.window import Mask, Window, runs_of
from otolith.estimation.evidence import SIGNIFICANT_DEVIATE
from otolith.estimation.problem import MIN_RUN, Problem, out_of_operation, runs_outside
from otolith.twin.definition import Definition
from otolith.twin.expressions import names_in, parse
from otolith_drivers.units import are_of_one_quantity, unit_text

SWITCHING = 3  # records within which the current of an open bridge ends
OFF_SHARE = 0.95  # of the records of a stretch whose current is zero within its noise
MIN_ON_SHARE = 0.25  # of the records of a window: less between two stretches is not estimated from


@dataclass(frozen=True, slots=True)
class RunningPart:
    """What of a window the equations of the twin hold in."""

    window: Window | None  # Without stretches in which the drive is off; None if too little is left
    note: str


def part_in_operation(problem: Problem, window: Window) -> RunningPart | None:
    """Return the longest part of ``window`` in which the twin states that its equations hold; None if that is all."""
    twin, reasons = problem.base_model, list[str]()
    for own in twin.operation:
        for _, _, reading in runs_outside(own, window)[:1]:
            unit, is_below = unit_text(twin.unit_of(own.signal)), reading < own.low
            limit = f"{own.low if is_below else own.high:g} {unit}"
            reasons.append(f"{own.signal} was below {limit}" if is_below else f"{own.signal} was above {limit}")
    return _longest_part(window, out_of_operation(twin, window), " and ".join(reasons)) if reasons else None


def running_part(problem: Problem, window: Window) -> RunningPart | None:
    """Return the longest part of ``window`` in which the drive is on; None if it is so all the time."""
    off = off_records(problem, window)
    return _longest_part(window, off, "the drive was switched off") if off.any() else None


def _longest_part(window: Window, off: Mask, why: str) -> RunningPart:
    runs = [(start, end) for start, end in runs_of(~off) if end - start >= MIN_ON_SHARE * window.records]
    seconds = float(window.grid.steps[off].sum())
    note = f"{why} for {seconds:.3g} s, in which no equation of the twin holds"
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
            if end - start - begin >= MIN_RUN:
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
