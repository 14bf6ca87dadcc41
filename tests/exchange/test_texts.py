"""Exported texts are the twin: the program gives the trajectories of the kernel, with all components."""

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from otolith.acquisition.window import Array
from otolith.estimation.problem import Component
from otolith.exchange.export_modelica import identifier, modelica_expression, modelica_text
from otolith.exchange.export_python import python_text
from otolith.exchange.exported import exported_twin
from otolith.machine import library_twins
from otolith.twin.expressions import names_in, parse
from tests.exchange.driven import COMPONENTS, Driven, awkward_state, completed
from tests.simulation.motors import library_state, posterior
from tests.variants import often


def program_trajectories(driven: Driven) -> Array:
    """Those of the exported program."""
    program: dict[str, Any] = {"__name__": "exported"}
    exec(python_text(exported_twin(driven.state), ("a test",), driven.substeps), program)  # noqa: S102 - our own text
    found: Array = program["simulate"](driven.times, np.column_stack(list(driven.columns.values())))
    return found


@pytest.mark.parametrize("name", often(["dc_motor"], library_twins()))
def test_the_exported_program_is_the_kernel(name: str) -> None:
    driven = Driven(library_state(name))
    assert np.isfinite(driven.exact).all()
    np.testing.assert_allclose(program_trajectories(driven), driven.exact, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("components", COMPONENTS, ids=lambda row: ", ".join(item.key for item in row))
def test_components_are_exported_at_their_sites(components: tuple[Component, ...]) -> None:
    driven = Driven(completed(components))
    found = program_trajectories(driven)
    np.testing.assert_allclose(found, driven.exact, rtol=1e-6, atol=1e-9)
    assert np.abs(found - program_trajectories(Driven(posterior()))).max() > 1e-3


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
    tree = parse(written)
    names = {name: identifier(name) for name in names_in(tree)}
    assert modelica_expression(tree, names) == expected


def test_names_are_those_of_modelica() -> None:
    assert [identifier(name) for name in ("omega", "in", "press-3", "3d")] == ["omega", "in_", "press_3", "m_3d"]


def test_no_two_quantities_share_a_name() -> None:
    """The author may have a name that another one gets because it is a word of Modelica."""
    text = modelica_text(exported_twin(awkward_state()), ("a note",), "end_")
    declared = re.findall(r"^  (?:parameter |input |output )?Real (\w+)", text, re.MULTILINE)
    assert len(declared) == len(set(declared)) == 13
    assert not {"end", "Real", "end_"} & set(declared)  # words of the language, and the model itself
    driven = Driven(awkward_state())
    np.testing.assert_allclose(program_trajectories(driven), driven.exact, rtol=1e-6, atol=1e-9)
