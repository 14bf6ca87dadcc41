"""The twin language: each wrong file gets one precise error, and hostile expressions are never evaluated.

A case is a folder with ``twin.toml`` and a list of what its error contains, in which ``{file}`` stands for the file.
"""

import ast
import builtins
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from otolith.machine import LIBRARY, find_twin, load_machine, load_twin
from otolith.machine import library_twins as library
from otolith.twin.expressions import (
    FUNCTIONS,
    ExpressionError,
    describe,
    dimension_of,
    infer_dimension,
    names_in,
    parse,
)
from otolith.twin.kernel import Excitation, kernel_of
from otolith.twin.kernel_sources import kernel_source
from otolith.twin.language import read_twin
from otolith.twin.symbolic import to_sympy
from otolith_drivers.config_files import SourceFile
from otolith_drivers.errors import ConfigurationError
from tests.messages import assert_refuses, assert_says_what_is_listed, raises_saying
from tests.twin.reference import Reference

GOLDEN = Path(__file__).parents[1] / "golden" / "twins"
CASES = sorted(path.parent for path in GOLDEN.glob("*/twin.toml"))
BASE = (LIBRARY / "dc_motor.toml").read_text(encoding="utf-8")


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_wrong_file_gets_its_error(case: Path) -> None:
    with pytest.raises(ConfigurationError) as caught:
        load_twin(case / "twin.toml")
    assert_says_what_is_listed(str(caught.value).replace(str(case / "twin.toml"), "{file}"), case)


def test_there_are_at_least_thirty_wrong_files() -> None:
    assert len(CASES) >= 30


@pytest.mark.parametrize("name", library())
def test_library_twins_are_fully_described(name: str) -> None:
    twin = find_twin(name)
    assert twin.name == name
    assert twin.source
    assert twin.validity
    assert twin.sites
    groups = (twin.states, twin.inputs, twin.outputs, twin.parameters, twin.sites)
    assert all(row.meaning for group in groups for row in group)
    assert all(meaning for _, _, meaning in twin.definitions)


ALPHABET = st.sampled_from([*"iVRxJ_019.+-*/^()[]{}<>=,'\"\\:;@ \t", *FUNCTIONS, "i", "R_a", "where", "**", "lambda ",
                            "__class__", "()", "1e9", "if ", " else ", "for ", "\n", "é", "Ω", "\0"])  # fmt: skip


@settings(max_examples=500)
@given(st.lists(ALPHABET, max_size=60).map("".join) | st.text(max_size=80))
def test_any_expression_is_refused_or_parsed(text: str) -> None:
    """A parsed expression has allowed nodes only and can be turned into algebra."""
    try:
        tree = parse(text)
    except ExpressionError as error:
        if not 1 <= error.column <= len(text) + 1:
            raise
        return
    allowed = (ast.Constant, ast.Name, ast.UnaryOp, ast.BinOp, ast.Call, ast.Compare, ast.operator, ast.unaryop,
               ast.cmpop, ast.expr_context)  # fmt: skip
    assert all(isinstance(node, allowed) for node in ast.walk(tree))
    known = dict.fromkeys(names_in(tree), dimension_of("1"))
    infer_dimension(tree, known)
    to_sympy(tree, {name: to_sympy(parse("1 + 1"), {}) for name in known})


@settings(max_examples=200)
@given(st.lists(st.sampled_from(BASE.split()), max_size=80).map(" ".join) | st.text(max_size=200))
def test_any_file_is_read_or_refused(text: str) -> None:
    for page in (text, BASE + "\n" + text, BASE.replace("(K_t*i - T_load - D*omega) / J", text.replace('"', "'"))):
        try:
            read_twin(SourceFile(Path("any.toml"), page))
        except ConfigurationError as error:
            assert_refuses(error, "any.toml")


@pytest.mark.parametrize(
    "case", [case for case in CASES if case.name.startswith("hostile")], ids=lambda case: case.name
)
def test_hostile_expression_is_never_evaluated(case: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError

    for name in ("eval", "exec"):
        monkeypatch.setattr(builtins, name, never)
    with pytest.raises(ConfigurationError):
        load_twin(case / "twin.toml")


@pytest.mark.parametrize(
    ("text", "column"),
    [
        ("a + 1/0", 5),
        ("a + log(0 - 1)", 5),
        ("a*(0-1)^0.5", 3),
        ("0/0", 1),
        ("a + b.c", 5),
        ("  a.b", 3),
        ("a^2 + b^2 + c.d", 13),
        ("a + (b", 5),
        ("f(x)", 1),
        ("a**b", 1),
        ("x + 1e99", 5),
    ],
)
def test_error_names_the_column_of_the_fault(text: str, column: int) -> None:
    with pytest.raises(ExpressionError) as caught:
        parse(text)
    assert caught.value.column == column


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("R*i", "V"),
        ("sqrt(R*i*i)", None),
        ("i^2*R", "W"),
        ("L/R", "s"),
        ("where(i > 0, R*i, 0)", "V"),
        ("abs(i)/i", "1"),
        ("max(R*i, 0)", "V"),
        ("exp(-i/i)", "1"),
        ("sqrt(L/R/L*R)", "1"),
        ("pi*i", "A"),
        ("i^0", "1"),
        ("i^0.1*i^0.2/i^0.3", "1"),
        ("i^1.1/i^0.4/i^0.7*R", "ohm"),
    ],
)
def test_expression_has_its_dimension(text: str, unit: str | None) -> None:
    known = {"R": dimension_of("ohm"), "i": dimension_of("A"), "L": dimension_of("H")}
    assert infer_dimension(parse(text), known) == (dimension_of("W") ** 0.5 if unit is None else dimension_of(unit))


def test_dimensions_are_described_in_common_units() -> None:
    assert describe(dimension_of("kg*m^2/(s^3*A)")) == "V"
    assert describe(dimension_of("kg*m^2/s^2")) == "N*m"
    assert describe(dimension_of("mol*m^5/s^7")) == "m^5*mol/s^7"
    assert describe(dimension_of("1")) == "a plain number"


def test_other_units_give_the_same_machine() -> None:
    """Millihenry, rpm and kg·cm²: the equations still hold, because each symbol enters with the factor of its unit."""
    other = BASE
    for old, new in (
        ('unit = "H", nominal = 0.673, bounds = [0.2, 2]', 'unit = "mH", nominal = 673, bounds = [200, 2000]'),
        (
            'unit = "kg*m^2", nominal = 0.001171, bounds = [0.0003, 0.005]',
            'unit = "kg*cm^2", nominal = 11.71, bounds = [3, 50]',
        ),
        ('omega = { unit = "rad/s"', 'omega = { unit = "rpm"'),
    ):
        assert old in other
        other = other.replace(old, new)
    twins = [read_twin(SourceFile(Path("a.toml"), BASE)), read_twin(SourceFile(Path("b.toml"), other))]
    drive = Excitation.uniform(np.column_stack([np.full(100, 12.0), np.full(100, 0.02)]), 0.01)
    predicted = []
    for twin in twins:
        parameters = np.array([[parameter.nominal for parameter in twin.parameters]])
        predicted.append(kernel_of(twin).simulate(parameters, np.zeros((1, 2)), drive)[0])
    assert predicted[1][:, 0] == pytest.approx(predicted[0][:, 0], rel=1e-9)
    assert predicted[1][:, 1] == pytest.approx(predicted[0][:, 1] * 60 / (2 * np.pi), rel=1e-9)


FORMULAS = [
    "where(u > 0, a*x, -b)", "max(where(x < 1, u, a), b)", "abs(where(x < 1, u, -a))*x", "sign(sqrt(x/b + 4) - 2)*x",
    "where(u < 1, where(x < a, u, b), x)", "-x^2 + (-x)^3 - x^-2", "x^(1/3) + x^0.5*sign(u)", "atan2(u, x + 3)",
    "min(x, max(u, a))", "exp(a*log(x + 2)) + 2^-1*x", "abs(u - x)*(u - x)", "tanh(u/a)*cosh(x) - sinh(x)/3",
]  # fmt: skip


@pytest.mark.parametrize("first", range(0, len(FORMULAS), 4))
def test_every_kind_of_formula_is_compiled_right(first: int) -> None:
    """Value and derivatives of outputs agree with Python's evaluation of their texts and its differences."""
    names = {f"y_{index}": formula for index, formula in enumerate(FORMULAS[first : first + 4])}
    outputs = "\n".join(f'{name} = {{ unit = "1", noise = 1, meaning = "output" }}' for name in names)
    equations = "\n".join(f'{name} = "{formula}"' for name, formula in names.items())
    page = f"""
[twin]
name = "any"
title = "any"
source = "test"
[states]
x = {{ unit = "1", meaning = "state", initial = 1.3, bounds = [-10, 10] }}
[inputs]
u = {{ unit = "1", hold = "zoh", meaning = "input" }}
[outputs]
{outputs}
[parameters]
a = {{ unit = "1", nominal = 0.7, bounds = [0, 5], meaning = "a" }}
b = {{ unit = "1", nominal = 1.9, bounds = [0, 5], meaning = "b" }}
k = {{ unit = "1/s", nominal = 0.3, bounds = [0, 5], meaning = "rate" }}
[equations]
"der(x)" = "-k*x + 0*k*u*a*b"
{equations}
"""
    twin = read_twin(SourceFile(Path("any.toml"), page))
    parameters, initial = np.array([0.7, 1.9, 0.3]), np.array([1.3])
    drive = Excitation.uniform(np.array([[0.4], [2.3], [-1.1], [0.9], [0.2]]), 0.1, 8)
    result = kernel_of(twin).sensitivities(parameters, initial, drive)
    expected = Reference(twin, parameters).simulate(initial, drive.inputs, 0.1)
    assert result.outputs == pytest.approx(expected, rel=1e-9, abs=1e-11)
    for column, step in enumerate(1e-6 * np.eye(4)):
        ahead, behind = (
            Reference(twin, parameters + sign * step[:3]).simulate(initial + sign * step[3:], drive.inputs, 0.1)
            for sign in (1.0, -1.0)
        )
        assert result.slopes[:, :, column] == pytest.approx((ahead - behind) / 2e-6, rel=1e-5, abs=1e-7)


def test_definitions_that_grow_too_large_are_refused() -> None:
    swelling = "\n".join(f'd{n} = "d{n - 1}*(d{n - 1} + i)"' for n in range(2, 15))
    page = BASE.replace("[equations]", f'[definitions]\nd1 = "i"\n{swelling}\n\n[equations]').replace(
        "K_e*omega)", "K_e*omega + 0*d14*V_a)"
    )
    with pytest.raises(ConfigurationError, match="written out"):
        read_twin(SourceFile(Path("any.toml"), page.replace('d1 = "i"', 'd1 = "i/i"').replace(" + i)", " + 1)")))


def test_only_checked_names_reach_generated_code() -> None:
    page = BASE.replace('title = "', 'title = "\\"\\"\\" INJECTED ').replace('source = "', 'source = "INJECTED ')
    assert "INJECTED" not in kernel_source(read_twin(SourceFile(Path("any.toml"), page)))
    for name in ('x\\"\\"\\"\\nimport os', "a b", "a.b", "1a", ""):
        with pytest.raises(ConfigurationError, match=r"is not a name|control character"):
            read_twin(SourceFile(Path("any.toml"), BASE.replace('name = "dc_motor"', f'name = "{name}"', 1)))


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("omeg = { above = 1 }", ("omeg", "did you mean")),
        ("J = { above = 1 }", ("no signal",)),
        ("omega = {}", ("omega", "state one")),
        ("omega = { above = 5, below = 5 }", ("above 5", "below 5")),
        ('omega = { above = "3 V" }', ("omega", "V")),
    ],
)
def test_a_wrong_range_of_operation_is_refused(row: str, said: tuple[str, ...], tmp_path: Path) -> None:
    path = tmp_path / "twin.toml"
    path.write_text(f"{BASE}\n[operation]\n{row}\n", encoding="utf-8")
    with raises_saying(ConfigurationError, str(path), "operation", *said):
        load_twin(path)


def test_a_machine_file_replaces_the_range_of_a_signal(tmp_path: Path) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(
        f'[machine]\nname = "m"\n[twin]\nfile = "{LIBRARY / "pump"}.toml"\n'
        '[operation]\nomega = { above = "600 rpm" }\nu = { above = 0.2, below = 0.9 }\n',
        encoding="utf-8",
    )
    ranges = {own.signal: (own.low, own.high) for own in load_machine(path, with_driver=False).twin.operation}
    assert ranges == {"omega": (pytest.approx(20.0 * np.pi), np.inf), "u": (0.2, 0.9)}


def test_a_range_of_what_no_sensor_measures_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "machine.toml"
    path.write_text(
        '[machine]\nname = "m"\n[twin]\nname = "dc_motor"\n[signals]\nT_load = { unknown = "constant" }\n'
        "[operation]\nT_load = { above = 0 }\n",
        encoding="utf-8",
    )
    with raises_saying(ConfigurationError, str(path), "operation.T_load", "no sensor"):
        load_machine(path, with_driver=False)
