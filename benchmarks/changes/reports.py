"""The reports of a fixed list of runs, to show that a change of the code leaves them as they were.

Print them before the change with ``--json``, and give that file as ``--against`` after it: each run has then the same
reports bit for bit, other numbers only, or another statement.
"""

import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import measured_axis
from benchmarks.changes.healthy import with_load_noise
from benchmarks.changes.machines import DC_MOTOR, LAB_MOTOR, PUMP, REVERSING_MOTOR, TWO_MASS
from benchmarks.changes.observe import Case, recordings
from benchmarks.changes.plants import HEALTHY, Change, Plant, Term
from otolith.acquisition.window import Array, Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.estimation.problem import Problem

Run = list[Any]
"""The document of each window, as JSON has it."""
BEFORE, AFTER = 4, 6  # windows
MEASURED_WINDOWS = 6
MEASURED_NOISE = 1e-5  # m: about what the twin leaves
MEASURED = "servo_axis, measured"
LEAST = 1e-9  # a smaller number is none, for example the probability of an alternative
NUMBER = re.compile(r"\d+(\.\d+)?(e-?\d+)?")
CLOSE = 1e-6  # relative difference of numbers that count as equal


def _late(random: np.random.Generator, plant: Plant, rows: dict[str, Array], signal: str, seconds: float) -> None:
    """Show a signal later than the others in the windows after the change."""
    first, periods = BEFORE * plant.records, round(seconds / plant.period)
    rows[signal][first:] = rows[signal][first - periods : -periods]


def cases() -> list[Case]:
    """Return the simulated runs: one for each kind of alternative."""
    motor = Case("", DC_MOTOR, HEALTHY, ("R_a", "D"), healthy=BEFORE, changed=AFTER)
    resistance, stiffness = DC_MOTOR.parameters["R_a"], TWO_MASS.parameters["k_s"]
    unbalance = Change(terms={"shaft": Term("periodic", "t", 0.004, 25.0)})
    brushes = Change(terms={"winding": Term("Coulomb", "i", -0.6, 0.02)})
    return [
        replace(motor, name="healthy"),
        replace(motor, name="step of R_a", after=Change(parameters={"R_a": 1.2 * resistance}), onset=0.4),
        replace(motor, name="unbalance", after=unbalance),
        replace(motor, name="brushes", after=brushes),
        replace(motor, name="always brushes", plant=REVERSING_MOTOR, before=brushes, after=brushes),
        replace(motor, name="brushes end", plant=REVERSING_MOTOR, after=brushes, changed=10, later=((10, HEALTHY),)),
        replace(motor, name="two known values", after=Change(parameters={"J": 1.5e-3, "K_t": 0.045})),
        replace(motor, name="two terms", after=Change(terms={**brushes.terms, **unbalance.terms})),
        replace(motor, name="omega late", disturb=partial(_late, signal="omega", seconds=0.05)),
        replace(motor, name="noisy sensors", noise=3.0),
        replace(motor, name="noisy load", disturb=partial(with_load_noise, signal="T_load", level=2e-3)),
        replace(motor, name="gain of i", after=Change(gains={"i": 1.12}), free=("R_a", "K_t", "D")),
        replace(motor, name="gain of omega", plant=LAB_MOTOR, after=Change(gains={"omega": 1.15}), free=()),
        replace(motor, name="pump, head", plant=PUMP, after=Change(parameters={"h_0": 10.0}), free=("h_0", "k_v")),
        replace(
            motor, name="two masses", plant=TWO_MASS, after=Change(parameters={"k_s": 0.8 * stiffness}), free=("k_s",)
        ),
    ]


def names() -> list[str]:
    """Return the names of all runs; that of the measured axis needs ``OTOLITH_DATA``."""
    return [*(case.name for case in cases()), *([MEASURED] if _measured() else [])]


def _measured() -> Path | None:
    folder = Path(os.environ.get("OTOLITH_DATA", "")) / "emps"
    return folder if (folder / measured_axis.FILE).is_file() else None


def run(name: str, seed: int) -> Run:
    """Return the reports of one run."""
    if name == MEASURED and (folder := _measured()):
        problem = replace(measured_axis.full_problem("servo_axis"), noise=(MEASURED_NOISE,))
        return _documents(problem, measured_axis.windows(folder)[:MEASURED_WINDOWS])
    case = next(item for item in cases() if item.name == name)
    (windows,) = recordings(case, case.problem, [0], seed)
    return _documents(case.problem, windows)


def _documents(problem: Problem, windows: Iterable[Window]) -> Run:
    state, documents = initial_state(problem.twin.name, "bench", problem), []
    for window in windows:
        state, report = adapt(state, window)
        documents.append(json.loads(report.document.model_dump_json()))
    return documents


def fingerprint(documents: Run) -> str:
    """Return a short text that is the same only for equal reports."""
    return hashlib.sha256(json.dumps(documents, sort_keys=True).encode()).hexdigest()[:12]


@dataclass(frozen=True, slots=True)
class Difference:
    """How the reports of a run differ from earlier ones."""

    largest: float
    """Relative difference of two numbers."""
    place: str
    """Of these numbers."""
    others: tuple[str, ...]
    """Places of what is no number and differs; numbers in texts do not count, which are rounded."""

    @property
    def text(self) -> str:
        """What differs, in words."""
        if self.others:
            return f"differs at {'; '.join(self.others[:3])}"
        return f"numbers differ by up to {self.largest:.1e}: {self.place}" if self.place else "the same"

    @property
    def is_close(self) -> bool:
        """Whether only numbers differ, and hardly."""
        return not self.others and self.largest <= CLOSE


def compare(now: Any, before: Any) -> Difference:
    """Compare the reports of a run with those before."""
    largest, others = (0.0, ""), []
    for place, own, other in _pairs(now, before, ""):
        if own == other:
            continue
        are_numbers = isinstance(own, float) and isinstance(other, float)
        if not are_numbers and _without_numbers(own) != _without_numbers(other):
            others.append(f"{place}: {str(other)[:60]} -> {str(own)[:60]}")
        difference = abs(own - other) / max(abs(own), abs(other), LEAST) if are_numbers else 0.0
        largest = max(largest, (difference, place))
    return Difference(*largest, tuple(others))


def _without_numbers(value: Any) -> Any:
    return NUMBER.sub("#", value) if isinstance(value, str) else value


def _pairs(now: Any, before: Any, place: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield each value with the one before, and where they stand."""
    if isinstance(now, Mapping) and isinstance(before, Mapping) and now.keys() == before.keys():
        rows = [(key, now[key], before[key]) for key in now]
    elif isinstance(now, Sequence) and isinstance(before, list) and len(now) == len(before):
        rows = [(str(at), *own) for at, own in enumerate(zip(now, before, strict=True))]
    else:
        yield place, now, before
        return
    for key, own, other in rows:
        yield from _pairs(own, other, f"{place}/{key}")
