"""The API for notebooks: wrong arguments get one clear error, units are converted, and help() has shapes and units."""

import inspect
import math
import pydoc
import re
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from otolith import Twin
from otolith.notebook import ParameterRow, Residuals
from otolith.simulation.prediction import Prediction
from otolith_drivers.errors import ConfigurationError
from tests.messages import assert_says, raises_saying
from tests.simulation.recorded_motor import save_learned, write_files

TIMES = [0.0, 1.0]
PLAN: dict[str, Any] = {"t": TIMES, "V_a": [24.0, 24.0], "T_load": [0.02, 0.02]}
NOON = datetime(2026, 1, 31, 12, tzinfo=UTC)
pandas: Any = import_module("pandas")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_files(tmp_path_factory.mktemp("notebook"))


@pytest.fixture(scope="module")
def twin(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Twin:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STATE_DIRECTORY", str(tmp_path_factory.mktemp("state")))
        save_learned(files)
        return Twin.load(files)


def without(name: str) -> dict[str, Any]:
    return {key: column for key, column in PLAN.items() if key != name}


def with_column(name: str, column: object) -> dict[str, Any]:
    return {**PLAN, name: column}


WRONG_PLANS: list[tuple[Any, tuple[str, ...]]] = [
    (with_column("V_a", ["12", "24"]), ("V_a", "'12'", "row 0", "number")),
    (with_column("V_a", ["a", "b"]), ("V_a", "'a'", "row 0", "number")),
    (with_column("V_a", [1.0, None]), ("V_a", "None", "row 1", "number")),
    (with_column("V_a", [True, False]), ("V_a", "True", "number")),
    (with_column("V_a", [1.0, math.nan]), ("V_a", "nan", "row 1")),
    (with_column("V_a", [1.0, math.inf]), ("V_a", "inf", "row 1")),
    (with_column("V_a", [1.0 + 2.0j, 1.0]), ("V_a", "1+2j", "row 0")),
    (with_column("V_a", 24.0), ("V_a", "single value", "sequence")),
    (with_column("V_a", None), ("V_a", "single value")),
    (with_column("V_a", "high"), ("V_a", "single value")),
    (with_column("V_a", [[24.0], [24.0]]), ("V_a", "(2, 1)")),
    (with_column("V_a", [[1.0], [1.0, 2.0]]), ("V_a", "column of numbers")),
    (with_column("V_a", [24.0]), ("V_a", "one row", "t has 2 rows")),
    (with_column("T_load", [0.0, 0.0, 0.0]), ("T_load", "3 rows", "t has 2 rows")),
    (with_column("t", [1.0, 0.0]), ("t = 0 s", "row 1", "t = 1 s", "sort")),
    (with_column("t", [1.0, 1.0]), ("t = 1 s", "row 1", "repeat")),
    (with_column("t", [0.0, math.nan]), ("t", "nan", "row 1")),
    (with_column("t", ["0", "1"]), ("t", "'0'", "row 0")),
    (with_column("t", [datetime(2026, 1, 31, 12), datetime(2026, 1, 31, 13)]), ("t", "2026", "zone")),  # noqa: DTZ001
    (with_column("t", np.array(["2026-01-31", "2026-02-01"], dtype="datetime64[s]")), ("t", "2026", "zone")),
    (with_column("t", [0.0, 1e9]), ("inputs", "1000000", "0.01 s")),
    (with_column("t", [0, 10**400]), ("t", "row 1", "finite")),
    (with_column("V_a", [Fraction(10**400), 1]), ("V_a", "row 0", "finite")),
    (with_column("t", [NOON, None]), ("t", "None", "row 1", "zone")),
    (without("T_load"), ("T_load", "missing", "N*m", "V_a")),
    (without("t"), ("t", "missing")),
    ({}, ("t", "missing", "no column")),
    ({"t": [], "V_a": [], "T_load": []}, ("0 rows", "two rows")),
    ({"t": [0.0], "V_a": [1.0], "T_load": [0.0]}, ("one row", "two rows")),
    (with_column("V_a [mV]", [1.0, 1.0]), ("V_a", "V_a [mV]", "2 columns")),
    ({**without("V_a"), "V_a [A]": [1.0, 1.0]}, ("V_a", "A", "V")),
    ({**without("V_a"), "V_a [volts per fish]": [1.0, 1.0]}, ("V_a", "volts per fish")),
    ({**without("t"), "t [m]": TIMES}, ("t", "[m]", "s")),
    ({1: [0.0], None: [1.0]}, ("t", "missing")),
]


@pytest.mark.parametrize(("plan", "parts"), WRONG_PLANS)
def test_a_wrong_plan_is_named(twin: Twin, plan: Any, parts: tuple[str, ...]) -> None:
    with raises_saying(ConfigurationError, *parts):
        twin.simulate(plan)


WRONG_CALLS: list[tuple[Callable[[Twin, Path], object], tuple[str, ...]]] = [
    (lambda _, __: Twin.load(5), ("path", "5", "machine file")),  # type: ignore[arg-type]
    (lambda _, __: Twin.load(None), ("path", "None", "machine file")),  # type: ignore[arg-type]
    (lambda _, __: Twin.load(""), ("path", "''")),
    (lambda _, __: Twin.load(b"machine.toml"), ("path", "machine.toml")),  # type: ignore[arg-type]
    (lambda _, __: Twin.load("nowhere.toml"), ("nowhere.toml",)),
    (lambda _, files: Twin.load(files.parent), (f"{'notebook'}",)),
    (lambda _, files: Twin.load(files.with_name("plan.csv")), ("plan.csv",)),
    (lambda _, __: Twin.fresh({}), ("path", "{}")),  # type: ignore[arg-type]
    (lambda twin, _: twin.adapted(), ("recordings", "at least one")),
    (lambda twin, _: twin.adapted(None), ("recordings", "None")),  # type: ignore[arg-type]
    (lambda twin, files: twin.adapted([files.with_name("monday.csv")]), ("recordings", "one after the other")),  # type: ignore[arg-type]
    (lambda twin, _: twin.adapted("nowhere.csv"), ("nowhere.csv",)),
    (lambda twin, files: twin.adapted(files.with_name("plan.csv")), ("plan.csv", "'i'")),
    (lambda twin, _: twin.at("yesterday"), ("time", "yesterday", "seconds")),  # type: ignore[arg-type]
    (lambda twin, _: twin.at(None), ("time", "None", "seconds")),  # type: ignore[arg-type]
    (lambda twin, _: twin.at(math.nan), ("time", "nan")),
    (lambda twin, _: twin.at(10**400), ("time", "seconds")),
    (lambda twin, _: twin.at(10**5000), ("time", "seconds")),
    (lambda twin, _: twin.simulate(PLAN, seed=-(10**5000)), ("seed", "whole number")),
    (lambda twin, _: twin.with_value("R_a", 10**400), ("R_a", "ohm")),
    (lambda twin, _: twin.simulate(span=(0, 10**400)), ("span[1]", "seconds")),
    (lambda twin, _: twin.at(datetime(2026, 1, 31)), ("time", "2026", "zone")),  # noqa: DTZ001
    (lambda twin, _: twin.at(NOON), ("history",)),
    (lambda twin, _: twin.with_value("R_b", 5.0), ("R_b", "R_a")),
    (lambda twin, _: twin.with_value(None, 5.0), ("name", "None", "R_a")),  # type: ignore[arg-type]
    (lambda twin, _: twin.with_value("R_a", None), ("R_a", "None", "ohm")),  # type: ignore[arg-type]
    (lambda twin, _: twin.with_value("R_a", True), ("R_a", "True", "ohm")),
    (lambda twin, _: twin.with_value("R_a", [5.0]), ("R_a", "[5.0]", "ohm")),  # type: ignore[arg-type]
    (lambda twin, _: twin.with_value("R_a", "five"), ("R_a", "five", "ohm")),
    (lambda twin, _: twin.with_value("R_a", "5 V"), ("R_a", "5 V", "ohm")),
    (lambda twin, _: twin.with_value("R_a", math.nan), ("R_a", "nan", "12 ohm")),
    (lambda twin, _: twin.with_value("R_a", 50.0), ("R_a", "50", "12 ohm")),
    (lambda twin, _: twin.without("shaft/periodic"), ("shaft/periodic", "none")),
    (lambda twin, _: twin.without(None), ("component", "None")),  # type: ignore[arg-type]
    (lambda twin, _: twin.without(""), ("component", "''")),
    (lambda twin, _: twin.simulate(), ("inputs", "span")),
    (lambda twin, _: twin.simulate(5), ("inputs", "5", "dict")),
    (lambda twin, _: twin.simulate([1.0, 2.0]), ("inputs", "[1.0, 2.0]", "dict")),
    (lambda twin, _: twin.simulate(np.zeros((3, 3))), ("inputs", "dict")),
    (lambda twin, _: twin.simulate("nowhere.csv"), ("nowhere.csv",)),
    (lambda twin, files: twin.simulate(files.parent), (f"{'notebook'}",)),
    (lambda twin, _: twin.simulate(PLAN, seed=-1), ("seed", "-1", "0")),
    (lambda twin, _: twin.simulate(PLAN, seed=1.5), ("seed", "1.5")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(PLAN, seed=None), ("seed", "None")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(PLAN, seed="1"), ("seed", "'1'")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(PLAN, seed=True), ("seed", "True")),
    (lambda twin, _: twin.simulate(PLAN, span=(0.0, 1.0)), ("span", "plan")),
    (lambda twin, files: twin.simulate(files.with_name("plan.csv"), span=(0.0, 1.0)), ("plan.csv", "span")),
    (lambda twin, _: twin.simulate(span=5), ("span", "5", "(20, 80)")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(span="5..8"), ("span", "5..8", "(20, 80)")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(span=(1.0, 2.0, 3.0)), ("span", "(20, 80)")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(span=(80.0, 20.0)), ("span", "80", "20")),
    (lambda twin, _: twin.simulate(span=(0.0, math.inf)), ("span[1]", "inf")),
    (lambda twin, _: twin.simulate(span=(None, 1.0)), ("span[0]", "None")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(span=(0.0, 1.0)), ("dc-motor", "none of it")),
    (lambda twin, files: twin.simulate(files.with_name("tuesday.csv"), span=(1e6, 2e6)), ("tuesday.csv",)),
    (lambda twin, _: twin.simulate_along(PLAN), ("source", "simulate")),  # type: ignore[arg-type]
    (lambda twin, _: twin.residuals(None), ("recording", "None")),  # type: ignore[arg-type]
    (lambda twin, _: twin.residuals(PLAN), ("recording", "path")),  # type: ignore[arg-type]
    (lambda twin, files: twin.residuals(files.with_name("plan.csv")), ("plan.csv", "omega")),
    (lambda twin, _: twin.fmu("4"), ("version", "'4'", "'2', '3'")),  # type: ignore[arg-type]
    (lambda twin, _: twin.fmu(None), ("version", "None")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(PLAN).column("speed"), ("output", "speed", "omega")),
    (lambda twin, _: twin.simulate(PLAN).rmse(None), ("output", "None", "omega")),  # type: ignore[arg-type]
    (lambda twin, _: twin.simulate(PLAN).coverage(1), ("output", "1", "omega")),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("call", "parts"), WRONG_CALLS)
def test_a_wrong_argument_is_named(
    twin: Twin, files: Path, call: Callable[[Twin, Path], object], parts: tuple[str, ...]
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        call(twin, files)
    assert_says(str(caught.value), *parts)
    assert "\n" not in str(caught.value)


class NamedColumns:
    """A table that has ``column_names`` and no ``columns``, as an interface for several libraries may."""

    def __init__(self, columns: dict[str, Any]) -> None:
        self.column_names = list(columns)
        self._columns = columns

    def __getitem__(self, name: str) -> Any:
        return self._columns[name]


TABLES: list[Any] = [
    PLAN,
    {key: np.array(column) for key, column in PLAN.items()},
    {key: tuple(column) for key, column in PLAN.items()},
    {**PLAN, "note": ["a", "b"], "V_a": np.array([24, 24])},
    {**without("V_a"), "V_a [mV]": [24000.0, 24000.0]},
    {**without("V_a"), " V_a [kV] ": [0.024, 0.024]},
    {**without("T_load"), "T_load (mN*m)": [20.0, 20.0]},
    {**without("t"), "t [ms]": [0.0, 1000.0]},
    with_column("t", [NOON, NOON + timedelta(seconds=1)]),
    pandas.DataFrame(PLAN),
    pandas.DataFrame({**PLAN, "t": pandas.to_datetime([NOON, NOON + timedelta(seconds=1)])}, index=[5, 3]),
    pandas.DataFrame(PLAN).rename(columns={"V_a": "V_a [V]"}),
    pandas.DataFrame(PLAN).convert_dtypes(),
    pa.table(PLAN),
    pa.table({**PLAN, "t": pa.array([NOON, NOON + timedelta(seconds=1)], pa.timestamp("ms", tz="Europe/Berlin"))}),
    NamedColumns(PLAN),
]


@pytest.mark.parametrize("table", TABLES)
def test_each_kind_of_table_is_the_same_plan(twin: Twin, table: Any) -> None:
    expected, found = twin.simulate(PLAN), twin.simulate(table)
    np.testing.assert_allclose(found.values, expected.values, rtol=1e-5)  # Unix times are rounded to 0.2 µs
    np.testing.assert_allclose(found.driving, expected.driving, rtol=1e-9)


def test_the_times_of_a_plan_with_dates_are_unix_times(twin: Twin) -> None:
    found = twin.simulate(with_column("t", [NOON, NOON + timedelta(seconds=1)]))
    assert found.times[[0, -1]] == pytest.approx([NOON.timestamp(), NOON.timestamp() + 1.0])


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        (pandas.DataFrame({**PLAN, "V_a": [1.0, None]}), ("V_a", "nan", "row 1")),
        (pandas.DataFrame({**PLAN, "V_a": pandas.array([1, None], dtype="Int64")}), ("V_a", "row 1")),
        (pandas.DataFrame(PLAN)[["t", "V_a"]], ("T_load", "missing")),
        (pandas.DataFrame([[0, 1, 2, 3]], columns=["t", "V_a", "V_a", "T_load"]), ("V_a", "2 columns")),
        (pandas.DataFrame({"V_a": [1.0], "T_load": [1.0]}, index=pandas.Index([0.0], name="t")), ("t", "missing")),
        (pandas.DataFrame(columns=["t", "V_a", "T_load"], dtype=float), ("0 rows",)),
        (pa.table({**PLAN, "V_a": [1.0, None]}), ("V_a", "row 1")),
        (pa.table([[0.0], [1.0], [1.0], [0.0]], names=["t", "V_a", "V_a", "T_load"]), ("V_a", "2 columns")),
        (pa.table({**PLAN, "t": pa.array([0, 1], pa.timestamp("s"))}), ("t", "zone")),
        (pa.table({**PLAN, "t": pa.array([None, NOON], pa.timestamp("ms", tz="UTC"))}), ("t", "row 0")),
        (pa.table({**PLAN, "t": pa.array([NOON, None], pa.timestamp("ns", tz="UTC"))}), ("t", "row 1")),
        (pandas.DataFrame({**PLAN, "t": pandas.to_datetime([None, NOON], utc=True)}), ("t", "row 0")),
    ],
)
def test_a_wrong_table_is_named(twin: Twin, table: Any, parts: tuple[str, ...]) -> None:
    with raises_saying(ConfigurationError, *parts):
        twin.simulate(table)


def test_without_a_state_each_result_says_what_to_do(files: Path) -> None:
    fresh = Twin.fresh(files)
    assert fresh.time is None
    for call in (lambda: fresh.simulate(PLAN), fresh.python, fresh.modelica, fresh.fmu, fresh.at_limit):
        with pytest.raises(ConfigurationError) as caught:
            call()
        assert "\n" not in str(caught.value)


PUBLIC = Twin, ParameterRow, Prediction, Residuals
SHAPE = re.compile(r"\((records|rows|parameters)[^)]*\)")
UNIT = re.compile(r"\bunits?\b|\bs\b|Unix|0 to 1|standard deviations|without unit", re.IGNORECASE)


def own_names(kind: type) -> list[str]:
    return [name for name in vars(kind) if not name.startswith("_")]


@pytest.mark.parametrize("kind", PUBLIC)
def test_help_has_every_public_name_with_shape_and_unit(kind: type) -> None:
    """Those of fields are lines of the docstring of the class; methods and properties have their own."""
    shown = pydoc.TextDoc().docclass(kind)
    described = inspect.getdoc(kind) or ""
    assert is_dataclass(kind)
    for item in fields(kind):
        line = re.search(rf"^ *{item.name}: (.*(?:\n {{8,}}.*)*)", described, re.MULTILINE)
        assert line, f"{kind.__name__}.{item.name} is not in help()"
        assert line[1].split("\n")[0] in shown
        if item.type in ("Array", Prediction.__annotations__["values"]):
            assert SHAPE.search(line[1]), line[0]
        if item.type in ("Array", Prediction.__annotations__["values"], "float", float):
            assert UNIT.search(line[1]), line[0]
    for name in own_names(kind):
        member = inspect.getattr_static(kind, name)
        if name in {item.name for item in fields(kind)}:
            continue
        function = getattr(member, "fget", None) or getattr(member, "__func__", member)
        text, result = inspect.getdoc(function), str(inspect.signature(function).return_annotation)
        assert text, f"{kind.__name__}.{name} has no docstring"
        if "Array" in result or "ndarray" in result:
            assert SHAPE.search(text), f"{kind.__name__}.{name} has no shape"
        if "Array" in result or "ndarray" in result or "float" in result:
            assert UNIT.search(text), f"{kind.__name__}.{name} has no unit"
