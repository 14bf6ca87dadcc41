"""Benchmarks are run by hand, but they do run."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

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
    "UKF (filterpy), calm": "filterpy",
    "UKF (filterpy), awake": "filterpy",
    "MHE (CasADi, IPOPT), calm": "casadi",
    "MHE (CasADi, IPOPT), awake": "casadi",
}


def run(module: str, *arguments: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{module}", *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout
    return done.stdout


def needs(library: str) -> None:
    if library and importlib.util.find_spec(library) is None:
        pytest.skip(f"{library} is installed by 'make bench' only")


@pytest.fixture(scope="module")
def compared() -> dict[str, Any]:
    document: dict[str, Any] = json.loads(run("bench_estimators", "--quick", "--json"))
    return document


def test_the_bus_is_listened_to_beside_a_bare_loop() -> None:
    said = run("bench_can", "2")
    assert "bus.recv alone" in said
    assert "into the rings" in said


def test_a_drive_is_polled_beside_a_bare_loop() -> None:
    said = run("bench_modbus", "2")
    assert "bare pymodbus loop" in said
    assert "200 Hz asked" in said


def test_every_entry_of_make_bench_is_run_here() -> None:
    found = {path.stem for path in (ROOT / "benchmarks").glob("bench_*.py")}
    assert found == {*TIMINGS, "bench_can", "bench_estimators", "bench_modbus"}


@pytest.mark.parametrize("name", TIMINGS)
def test_it_runs(name: str) -> None:
    needs(TIMINGS[name])
    run(name)


@pytest.mark.parametrize("name", COMPARED)
def test_a_rival_is_compared(name: str, compared: dict[str, Any]) -> None:
    needs(COMPARED[name])
    (row,) = (row for row in compared["rows"] if row["name"] == name)
    assert row["seconds"] > 0.0
    if not name.startswith("paper"):  # its swarm is cut short here
        assert all(error < 1.0 for error in row["error"].values()), row  # per cent
        assert len(row["error"]) == 3


def test_no_rival_is_forgotten(compared: dict[str, Any]) -> None:
    names = {row["name"] for row in compared["rows"]}
    assert names <= set(COMPARED)
    assert {COMPARED[name] for name in set(COMPARED) - names} == set(compared["missing"].values())


def test_the_ablation_runs() -> None:
    arguments = ("--starts", "2", "--twin", "resonator", "--json")
    rows = json.loads(run("estimators.ablation", *arguments))
    assert [row["twin"] for row in rows] == ["resonator"]
    assert all(0.0 <= share <= 1.0 for row in rows for share in row["found"].values())
