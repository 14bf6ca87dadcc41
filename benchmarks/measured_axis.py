"""A measured servo axis (EMPS): mass and friction window by window, and the components that a twin of it lacks.

    python -m benchmarks.measured_axis FOLDER

FOLDER holds ``data_emps.csv`` of A. Janot, M. Gautier, M. Brunot (Data set and reference models of EMPS, Workshop on
Nonlinear System Identification Benchmarks, 2019), which is not part of this project: time (s), set-point (m), position
(m), voltage (V). Every window is predicted before it is adapted to: the error of the twin's position in open loop, with
the numbers of the windows before, and the initial state fitted to the window.
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
from otolith.discovery.search import ROUNDS, STEPS_OF_ROUND
from otolith.estimation.information import QUANTILE, Prior
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import fit
from otolith.health.schema import ParameterDocument, ReportDocument
from otolith.machine import find_twin

FILE = "data_emps.csv"
FORCE = 35.1507  # N/V
PERIOD, RECORDS = 1e-3, 2000
FRICTION_WIDTH = 5e-4  # m/s: velocity within which dry friction changes its sign
POSITION_ERROR = 1e-3  # m: about the error in open loop
FROZEN = 1e-6  # of a standard deviation: the prior that keeps parameters at their values
DRY_FRICTION = r" \+ F_c(_up|_down)?\*tanh\(v/v_s\)"
WIDTH = 250  # columns of the tables


def windows(folder: Path) -> tuple[Window, ...]:
    """Windows of 2 s with force (N) and position (m)."""
    table = np.loadtxt(folder / FILE, delimiter=",", skiprows=1)
    values = np.column_stack([FORCE * table[:, 3], table[:, 2]])
    pieces = [values[start : start + RECORDS] for start in range(0, len(values) - RECORDS + 1, RECORDS)]
    return tuple(Window.whole(k, 2.0 * k, PERIOD, ("F", "x"), piece) for k, piece in enumerate(pieces))


def full_problem(name: str) -> Problem:
    """A twin of the library with all parameters free but the velocity at which friction changes its sign."""
    twin = find_twin(name)
    free = tuple(parameter for parameter in twin.parameters if parameter.name != "v_s")
    return Problem(twin, (("v_s", FRICTION_WIDTH),), free, noise=(twin.outputs[0].noise,))


def without_dry_friction(problem: Problem) -> Problem:
    """The same problem with a twin that lacks dry friction."""
    twin = problem.twin
    definitions = tuple((name, re.sub(DRY_FRICTION, "", text), meaning) for name, text, meaning in twin.definitions)
    parameters = tuple(parameter for parameter in problem.free if not parameter.name.startswith("F_c"))
    bare = replace(twin, name=f"{twin.name}_bare", definitions=definitions, parameters=parameters)
    return replace(problem, twin=bare, known=(), free=parameters)


@dataclass(frozen=True, slots=True)
class Row:
    """One window: its report, and the error of its prediction from the windows before."""

    document: ReportDocument
    components: str
    """Components in the twin before the window."""
    error: float
    """m, root mean square."""
    error_without: float
    """m, of the same twin without discovery."""


def run_record(problem: Problem, record: Sequence[Window]) -> list[Row]:
    """Adapt to the whole record, window by window."""
    state = initial_state("axis", "lab", problem)
    without = initial_state("axis", "lab", replace(problem, discover=False))
    rows = []
    for window in record:
        components = _names(state)
        error = open_loop_error(state, window)
        error_alone = open_loop_error(without, window) if components else error
        state, report = adapt(state, window)
        without, _ = adapt(without, window)
        rows.append(Row(report.document, components, error, error_alone))
    return rows


def _names(state: AdaptationState) -> str:
    return ", ".join(component.key for component in state.problem.components)


def open_loop_error(state: AdaptationState, window: Window) -> float:
    """Root mean square error (m) of the window in open loop, with the initial state fitted to it."""
    problem, free = replace(state.problem, open_loop=True, noise=(POSITION_ERROR,)), len(state.problem.free)
    posterior = state.posterior.predict(window).prior()
    frozen = Prior(posterior.mean * (np.arange(2 * free) < free), FROZEN**2 * posterior.covariance)
    fitted = fit(problem, window, frozen, frozen.mean, ROUNDS * STEPS_OF_ROUND).result
    objective = Objective(problem, window, fitted.guess[:free])
    predicted = objective.simulate(np.concatenate([fitted.guess[:free], fitted.guess[2 * free :]]))
    return float(objective.rmse(predicted)[0])


def page(title: str, rows: Sequence[Row]) -> Table:
    """A row for each window."""
    names = list(rows[0].document.parameters)
    table = Table(title=title)
    for heading in ("window", *names, "components", "prediction error", "without components", "decision"):
        table.add_column(heading, justify="left" if heading in ("components", "decision") else "right")
    for row in rows:
        values = (_interval(row.document.parameters[name]) for name in names)
        components = "; ".join(component.equation for component in row.document.components)
        error, without = f"{1e3 * row.error:.3g} mm", f"{1e3 * row.error_without:.3g} mm" if row.components else ""
        table.add_row(
            str(row.document.window.index), *values, components, error, without, row.document.decision.name.lower()
        )
    return table


def _interval(parameter: ParameterDocument) -> str:
    if parameter.value is None or parameter.sd is None:
        return ""
    return f"{parameter.value:.5g} ± {QUANTILE * parameter.sd:.2g} {parameter.unit}"


def verdict(rows: Sequence[Row]) -> str:
    """Effect of the components on the prediction of new windows."""
    predicted = [row for row in rows if row.components]
    if not predicted:
        return "no component is discovered"
    error, without = (
        1e3 * float(np.sqrt(np.mean(np.square(values))))
        for values in ([row.error for row in predicted], [row.error_without for row in predicted])
    )
    last = "; ".join(component.equation for component in rows[-1].document.components) or "nothing"
    return (
        f"in the twin at the end: {last}; {len(predicted)} windows predicted with components: error {error:.3g} mm, "
        f"without {without:.3g} mm ({100.0 * (error / without - 1.0):+.0f} %)"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help=f"with {FILE}")
    folder = parser.parse_args().folder
    if not (folder / FILE).is_file():
        parser.error(f"{folder / FILE}: no such file")
    record, console = windows(folder), Console(width=WIDTH)
    directional, symmetric = (full_problem(name) for name in ("servo_axis_directional", "servo_axis"))
    best = identify_noise(directional, record[::2]).applied(directional)
    own = identify_noise(symmetric, record[::2]).applied(symmetric)
    cases = [
        ("the full twin, friction by direction", best),
        ("its dry friction left out", without_dry_friction(best)),
        ("friction the same in both directions", own),
    ]
    for title, problem in cases:
        rows = run_record(problem, record)
        console.print(page(title, rows))
        console.print(f"{title}: {verdict(rows)}", end="\n\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
