"""The benchmark of sampling schedules runs from the command line."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.full  # they test the benchmarks, not the product

ROOT = Path(__file__).parents[2]


def test_the_benchmark_prints_the_figures_of_the_selected_scenarios() -> None:
    command = [sys.executable, "-m", "benchmarks.sampling", "uniform rows", "--windows", "10", "--json"]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    document = json.loads(process.stdout)
    assert process.returncode == (0 if all(case["met"] for case in document.values()) else 1), process.stderr
    assert set(document) >= {"uniform rows", "uniform rows, noisy load"}
    for case in document.values():
        assert case["windows"] == case["allowed"] == 10
        assert all(0.0 < share < 0.01 for share in case["bound"].values())
