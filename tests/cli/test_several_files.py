"""Each command that takes recorded data takes several files, of which each is a recording of its own."""

import json
from pathlib import Path

import numpy as np
import pytest

from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith
from tests.messages import raises_saying

TWIN = """
[twin]
name = "lag"
title = "first-order lag"
source = "none"
validity = "any"

[states]
y = { unit = "1", bounds = [-1e6, 1e6], meaning = "output" }

[inputs]
u = { unit = "1", hold = "zoh", range = [-1e6, 1e6], meaning = "input" }

[outputs]
y = { unit = "1", noise = 0.01, meaning = "output" }

[parameters]
gain = { unit = "1", nominal = 2, bounds = [0.1, 20], role = "estimated", meaning = "gain" }

[constants]
tau = { unit = "s", value = 0.1, meaning = "time constant" }

[equations]
"der(y)" = "(gain*u - y)/tau"

[sites]
force = { into = "der(y)", mode = "additive", through = "1/tau", unit = "1", meaning = "what is added" }
"""
MACHINE = """
[machine]
name = "lag"
[twin]
file = "twin.toml"
[window]
length = "0.5 s"
sample_period = "10 ms"
"""


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    (tmp_path / "twin.toml").write_text(TWIN, encoding="utf-8")
    path = tmp_path / "machine.toml"
    path.write_text(MACHINE, encoding="utf-8")
    return path


def run(folder: Path, name: str, seed: int, seconds: float = 3.0) -> Path:
    """A run of the lag from rest, with the clock from 0, driven by a square wave."""
    random, y, rows = np.random.default_rng(seed), 0.0, ["t,u,y"]
    for index in range(int(100 * seconds)):
        u = 1.0 if index // 20 % 2 else -1.0
        rows.append(f"{index / 100:.2f},{u},{y + 0.01 * random.standard_normal():.5f}")
        y += (2.0 * u - y) * -np.expm1(-0.1)
    path = folder / name
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    return path


def test_check_adds_up_the_windows_of_several_files(machine: Path) -> None:
    files = [run(machine.parent, name, seed) for seed, name in enumerate(("a.csv", "b.csv"))]
    alone, both = (json.loads(otolith("check", machine, *given, "--json").stdout) for given in (files[:1], files))
    assert (alone["rows"], both["rows"]) == (300, 600)
    assert both["windows"]["count"] == 2 * alone["windows"]["count"] == 2 * both["windows"]["usable"] / 2
    assert both["steps_back"] == 0  # each file has a clock of its own
    assert both["data"] == ", ".join(map(str, files))


def test_noise_is_identified_from_several_files(machine: Path) -> None:
    files = [run(machine.parent, name, seed) for seed, name in enumerate(("a.csv", "b.csv", "c.csv"))]
    document = json.loads(otolith("noise", machine, *files, "--json").stdout)
    assert document["windows"] == 18
    (level,) = (row for row in document["outputs"] if row["name"] == "y")
    assert 0.008 <= level["value"] <= 0.012


def test_commission_takes_several_files(machine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    files = [run(machine.parent, name, seed) for seed, name in enumerate(("a.csv", "b.csv"))]
    assert "[noise]" in otolith("commission", machine, *files, "--yes").output


@pytest.mark.parametrize("command", ["check", "noise"])
def test_a_file_that_cannot_be_read_is_the_one_that_is_named(machine: Path, command: str) -> None:
    good, bad = run(machine.parent, "a.csv", 1), machine.parent / "b.csv"
    bad.write_text("t,u\n0,1\n", encoding="utf-8")
    with raises_saying(ConfigurationError, "b.csv", "'y'"):
        otolith(command, machine, good, bad)
