"""A measured servo axis (EMPS): its mass and friction window by window, and what is found that a twin of it lacks.

    python -m benchmarks.measured_axis FOLDER

FOLDER holds ``data_emps.csv`` of A. Janot, M. Gautier, M. Brunot (Data set and reference models of EMPS, Workshop on
Nonlinear System Identification Benchmarks, 2019), which is not part of this project: time (s), set-point (m), position
(m), voltage (V). Every window is foretold before it is learned from: how far the twin's position strays
in it, in open loop, with the numbers of the windows before and the initial state that suits it best.
"""

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.commissioning.identification import identify_noise
from otolith.discovery.hypotheses import FaultHypothesis, FaultType, fit_hypothesis
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.imm_filter import moment_match, predict
from otolith.estimation.information import QUANTILE
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.health.schema import ParameterDocument, ReportDocument
from otolith.machine import find_twin

FILE = "data_emps.csv"
FORCE = 35.1507  # N/V
PERIOD, RECORDS = 1e-3, 2000
TURN = 5e-4  # m/s: velocity within which dry friction turns over
STRAYS = 1e-3  # m: about what it is off by
CERTAIN = 1e-6  # of a standard deviation: what is learned is not learned again
TURNED_OFF = r" \+ F_c(_up|_down)?\*tanh\(v/v_s\)"
ROOM = 250  # columns


def windows(folder: Path) -> tuple[Window, ...]:
    """Of 2 s, with force (N) and position (m)."""
    table = np.loadtxt(folder / FILE, delimiter=",", skiprows=1)
    values = np.column_stack([FORCE * table[:, 3], table[:, 2]])
    pieces = [values[start : start + RECORDS] for start in range(0, len(values) - RECORDS + 1, RECORDS)]
    return tuple(Window.whole(k, 2.0 * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


def full(name: str) -> Problem:
    """Everything of a twin of the library is free but where friction turns over."""
    twin = find_twin(name)
    free = tuple(entry for entry in twin.parameters if entry.name != "v_s")
    return Problem(twin, (("v_s", TURN),), free, noise=(twin.outputs[0].noise,))


def without_dry_friction(problem: Problem) -> Problem:
    """The same axis by a twin whose author has forgotten it."""
    twin = problem.twin
    definitions = tuple((name, re.sub(TURNED_OFF, "", text), meaning) for name, text, meaning in twin.definitions)
    parameters = tuple(entry for entry in problem.free if not entry.name.startswith("F_c"))
    bare = replace(twin, name=f"{twin.name}_bare", definitions=definitions, parameters=parameters)
    return replace(problem, twin=bare, known=(), free=parameters)


@dataclass(frozen=True, slots=True)
class Row:
    """One window: what the report says, and how it had been foretold from all windows before it."""

    document: ReportDocument
    components: str
    """That were in the twin before the window."""
    strayed: float
    """m, root mean square."""
    strayed_without: float
    """m, of the same twin that never looked for components."""


def lived(problem: Problem, record: Sequence[Window]) -> list[Row]:
    """The whole record, window by window."""
    state, plain = initial_state("axis", "lab", problem), initial_state("axis", "lab", replace(problem, discover=False))
    found = []
    for window in record:
        components = _names(state)
        off = strayed(state, window)
        off_without = strayed(plain, window) if components else off
        state, report = adapt(state, window)
        plain, _ = adapt(plain, window)
        found.append(Row(report.document, components, off, off_without))
    return found


def _names(state: AdaptationState) -> str:
    return ", ".join(entry.key for entry in state.problem.components)


def strayed(state: AdaptationState, window: Window) -> float:
    """Root mean square (m) of the window in open loop, from the initial state that suits it best."""
    problem, free = replace(state.problem, open_loop=True, noise=(STRAYS,)), len(state.problem.free)
    known = moment_match(predict(state.memory.belief, window.end), state.problem)
    still = Prior(known.mean * (np.arange(2 * free) < free), CERTAIN**2 * known.covariance)
    fit = fit_hypothesis(FaultHypothesis(FaultType.NOTHING), problem, window, still).fit
    objective = Objective(problem, window, fit.guess[:free])
    predicted = objective.simulate(np.concatenate([fit.guess[:free], fit.guess[2 * free :]]))
    return float(objective.rmse(predicted)[0])


def page(title: str, rows: Sequence[Row]) -> Table:
    """Window by window."""
    names = list(rows[0].document.parameters)
    table = Table(title=title)
    for heading in ("window", *names, "found", "off by, foretold", "without components", "made of it"):
        table.add_column(heading, justify="left" if heading in ("found", "made of it") else "right")
    for row in rows:
        values = (_interval(row.document.parameters[name]) for name in names)
        found = "; ".join(f"{entry.equation}" for entry in row.document.components)
        off, without = f"{1e3 * row.strayed:.3g} mm", f"{1e3 * row.strayed_without:.3g} mm" if row.components else ""
        table.add_row(str(row.document.window.index), *values, found, off, without, row.document.decision.name.lower())
    return table


def _interval(entry: ParameterDocument) -> str:
    if entry.value is None or entry.sd is None:
        return ""
    return f"{entry.value:.5g} ± {QUANTILE * entry.sd:.2g} {entry.unit}"


def verdict(rows: Sequence[Row]) -> str:
    """What components did to windows that had not been learned from yet."""
    told = [row for row in rows if row.components]
    if not told:
        return "nothing else is found"
    off, without = (np.sqrt(np.mean(np.square(each))) for each in
                    ([row.strayed for row in told], [row.strayed_without for row in told]))  # fmt: skip
    last = "; ".join(entry.equation for entry in rows[-1].document.components) or "nothing"
    return (
        f"in the twin at the end: {last}; {len(told)} windows foretold with components: off by {1e3 * off:.3g} mm, "
        f"without by {1e3 * without:.3g} mm ({100.0 * (off / without - 1.0):+.0f} %)"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help=f"with {FILE}")
    folder = parser.parse_args().folder
    if not (folder / FILE).is_file():
        parser.error(f"{folder / FILE}: there is no such file")
    record, console = windows(folder), Console(width=ROOM)
    directional, symmetric = (full(name) for name in ("servo_axis_directional", "servo_axis"))
    best = identify_noise(directional, record[::2]).applied(directional)
    own = identify_noise(symmetric, record[::2]).applied(symmetric)
    told = [
        ("the full twin, friction by direction", best),
        ("its dry friction left out", without_dry_friction(best)),
        ("friction the same in both directions", own),
    ]
    for title, problem in told:
        rows = lived(problem, record)
        console.print(page(title, rows))
        console.print(f"{title}: {verdict(rows)}", end="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
