"""Exported texts are the twin: the program gives the trajectories of the kernel, with all components."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.objective import input_matrix, time_offsets
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import Component, augment
from otolith.machine import library_twins
from otolith.simulation.export_modelica import identifier, modelica_expression, modelica_text
from otolith.simulation.export_python import python_text
from otolith.simulation.exported import exported_twin
from otolith.simulation.plan import planned_window
from otolith.simulation.simulate import STEP_RECORDS, substeps_of
from otolith.twin.expressions import parse
from otolith.twin.kernel import Excitation, kernel_of
from tests.simulation.motors import PERIOD, library_state, posterior, problem
from tests.variants import often

COMPONENTS = (
    (Component("shaft", "periodic", "angle(omega)", 0.005, 1.0, 0.3, 0.5, 2.0),
     Component("winding", "linear", "omega", 0.02),
     Component("sensor of omega", "constant", "", 0.5)),
    (Component("shaft", "Coulomb", "omega", 0.004, 0.5, low=0.1, high=2.0),
     Component("sensor of T_load", "periodic", "t", 0.01, 6.0, 0.2, 1.0, 9.0),
     Component("gain of omega", "periodic", "angle(omega)", 0.02, 2.0, 0.1, 0.5, 4.0)),
    (Component("shaft", "exponential", "t", 1e-3, 0.2, low=0.01, high=1.0, origin=-3.0),
     Component("winding", "power", "i", 0.1, 1.5, low=0.3, high=4.0),
     Component("sensor of i", "negative exponential", "V_a", 0.1, 0.1, low=0.01, high=1.0)),
)  # fmt: skip


def completed(components: tuple[Component, ...]) -> Posterior:
    """The motor with components."""
    twin = augment(problem(), components)
    return replace(posterior().remap_parameters(twin), phase=PhaseAdvance(-1.99, PERIOD, (0.0,) * 3, (1.0, 10.0)))


def trajectories(state: Posterior) -> tuple[Array, Array]:
    """Those of the exported program, and those of the kernel, along steps of the inputs."""
    own = state.problem
    twin, times = own.base_model, PERIOD * np.arange(60, dtype=np.float64)
    columns = {item.name: np.where(np.arange(60) < STEP_RECORDS, item.low, item.high) for item in twin.inputs}
    window = planned_window(twin, times, columns, PERIOD, 0.0)
    count = substeps_of(state)
    program: dict[str, Any] = {"__name__": "exported"}
    exec(python_text(exported_twin(state), ("a test",), count), program)  # noqa: S102 - our own text
    found = program["simulate"](times, np.column_stack(list(columns.values())))
    known = dict(own.known) | time_offsets(own, 0.0)
    known |= dict(zip((item.name for item in own.free), state.at_last_record().prior().mean, strict=False))
    values = np.array([[known.get(item.name, item.nominal) for item in own.twin.parameters]])
    assert state.phase is not None
    reached = np.zeros((1, len(own.twin.states)))
    reached[0, : len(twin.states)] = state.phase.last_state
    excitation = Excitation(input_matrix(own.twin, window), window.grid, substeps=count)
    return found, kernel_of(own.twin).simulate(values, reached, excitation)[0]


@pytest.mark.parametrize("name", often(["dc_motor"], library_twins()))
def test_the_exported_program_is_the_kernel(name: str) -> None:
    found, exact = trajectories(library_state(name))
    assert np.isfinite(exact).all()
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("components", COMPONENTS, ids=lambda row: ", ".join(item.key for item in row))
def test_components_are_exported_at_their_sites(components: tuple[Component, ...]) -> None:
    found, exact = trajectories(completed(components))
    bare, _ = trajectories(posterior())
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-9)
    assert np.abs(found - bare).max() > 1e-3


def test_the_program_runs_by_itself_and_says_what_is_known(tmp_path: Path) -> None:
    program = tmp_path / "motor.py"
    text = python_text(exported_twin(completed(COMPONENTS[0])), ('a "note"\\ of """ a machine',), 4)
    program.write_text(text, encoding="utf-8")
    code = f"import runpy, sys; runpy.run_path({str(program)!r}, run_name='__main__'); print(*sys.modules)"
    command = [sys.executable, "-I", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "R_a = 6.5" in done.stdout
    assert "otolith" not in done.stdout.split()
    assert re.search(r'"R_a": 6\.5,  # ohm, ± 0\.0392, estimated: armature resistance', text)
    assert re.search(r'"J": 0\.001171,  # kg\*m\^2, given: moment of inertia', text)
    assert "shaft/periodic/angle(omega)" in text
    assert max(map(len, text.splitlines())) < 200


def test_the_model_has_an_equation_for_each_unknown() -> None:
    """Modelica needs as many equations as variables that are no parameters and no inputs, and balanced parentheses."""
    text = modelica_text(exported_twin(completed(COMPONENTS[0])), ("a note",), "motor-1")
    declared, _, equations = text.partition("\nequation\n")
    unknown = re.findall(r"^  (?:output )?Real (\w+)", declared, re.MULTILINE)
    rows = [line for line in equations.splitlines() if line.startswith("  ")]
    left = [re.fullmatch(r"  (?:der\()?(\w+)\)? = .*;", row) for row in rows]
    assert sorted(unknown) == sorted(row[1] for row in left if row is not None)
    assert len(unknown) == len(rows) == 8
    known = {*unknown, *re.findall(r"^  (?:parameter|input) Real (\w+)", declared, re.MULTILINE), "der", "sin", "time"}
    assert set(re.findall(r"[A-Za-z_]\w*", re.sub(r"\b\d+(\.\d+)?(e-?\d+)?", "", "\n".join(rows)))) <= known
    assert all(row.count("(") == row.count(")") for row in rows)
    assert text.startswith("model motor_1 ")
    assert text.endswith("end motor_1;\n")


@pytest.mark.parametrize(
    ("written", "expected"),
    [
        ("a - (b - c)", "a - (b - c)"),
        ("a/(b*c)", "a / (b * c)"),
        ("-x**2", "-x ^ 2"),
        ("x^-1.5", "x ^ (-1.5)"),
        ("(a + b)*c", "(a + b) * c"),
        ("a*-b", "a * (-b)"),
        ("where(v < 0, -pi, max(a, b))", "(if v < 0 then -3.141592653589793 else max(a, b))"),
        ("end_ + model", "end_ + model_"),
    ],
)
def test_expressions_of_modelica_mean_the_same(written: str, expected: str) -> None:
    assert modelica_expression(parse(written)) == expected


def test_names_are_those_of_modelica() -> None:
    assert [identifier(name) for name in ("omega", "in", "press-3", "3d")] == ["omega", "in_", "press_3", "m_3d"]
