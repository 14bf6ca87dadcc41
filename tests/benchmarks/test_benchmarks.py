"""Each benchmark runs with a small budget."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.full  # they test the benchmarks, not the product

ROOT = Path(__file__).parents[2]
TIMINGS = {"bench_discovery": "", "bench_kernels": "casadi", "bench_window": ""}
COMPARED = {
    "Otolith warm, published": "",
    "Otolith warm, window alone": "",
    "Otolith cold": "",
    "paper, adaptive inertia": "",
    "paper, inertia fixed": "",
    "paper, pure Python": "",
    "least_squares, solve_ivp": "",
    "least_squares, lsim": "",
    "least_squares, own Numba kernel": "",
    "differential_evolution": "",
    "UKF (filterpy), constant": "filterpy",
    "UKF (filterpy), drifting": "filterpy",
    "MHE (CasADi, IPOPT), constant": "casadi",
    "MHE (CasADi, IPOPT), drifting": "casadi",
}


def run(module: str, *arguments: str) -> str:
    process = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{module}", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert process.stdout
    return process.stdout


def skip_without(library: str) -> None:
    if library and importlib.util.find_spec(library) is None:
        pytest.skip(f"{library} is installed by 'make bench' only")


@pytest.fixture(scope="module")
def compared() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(run("bench_estimators", "--quick", "--json"))
    return document


def test_bench_can_runs() -> None:
    printed = run("bench_can", "0.5")
    assert "bus.recv alone" in printed
    assert "into the rings" in printed


def test_bench_modbus_runs() -> None:
    printed = run("bench_modbus", "0.5")
    assert "bare pymodbus loop" in printed
    assert "200 Hz asked" in printed


def test_every_benchmark_of_make_bench_is_tested() -> None:
    modules = {path.stem for path in (ROOT / "benchmarks").glob("bench_*.py")}
    assert modules == {*TIMINGS, "bench_can", "bench_estimators", "bench_modbus"}


@pytest.mark.parametrize("name", TIMINGS)
def test_a_timing_benchmark_runs(name: str) -> None:
    skip_without(TIMINGS[name])
    run(name, "--quick")


@pytest.mark.parametrize("name", COMPARED)
def test_an_estimator_is_compared(name: str, compared: dict[str, Any]) -> None:
    skip_without(COMPARED[name])
    (row,) = (row for row in compared["rows"] if row["name"] == name)
    assert row["seconds"] > 0.0
    if not name.startswith("paper"):  # --quick shortens its swarm
        assert all(error < 1.0 for error in row["error"].values()), row  # per cent
        assert len(row["error"]) == 3


def test_no_estimator_is_missing(compared: dict[str, Any]) -> None:
    names = {row["name"] for row in compared["rows"]}
    assert names <= set(COMPARED)
    assert {COMPARED[name] for name in set(COMPARED) - names} == set(compared["missing"].values())


def test_the_ablation_runs() -> None:
    arguments = ("--starts", "2", "--twin", "resonator", "--json")
    rows = json.loads(run("estimators.ablation", *arguments))
    assert [row["twin"] for row in rows] == ["resonator"]
    assert all(0.0 <= share <= 1.0 for row in rows for share in row["global_optimum"].values())
