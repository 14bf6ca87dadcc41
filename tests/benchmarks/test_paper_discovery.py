"""The paper's unbalanced shaft and leak: discovered, drawn and told as promised."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from benchmarks.paper import __main__ as comparison
from benchmarks.paper.__main__ import paper
from benchmarks.paper.discovery import Course, Discovery, Search, discover
from benchmarks.paper.output import document, pages
from benchmarks.paper.plots import draw
from benchmarks.paper.scenarios import UNKNOWNS, plan_of, unknown_of
from benchmarks.paper.study import Kind
from click.testing import CliRunner
from matplotlib.image import imread
from rich.console import Console

from otolith.cli.common import examples_directory
from otolith_drivers.plant.scenario import load_scenario

SHORT = 20.0  # s


def quiet(_steps: int, _doing: str) -> None:
    pass


@cache
def discovered(name: str, kind: Kind, seconds: float) -> Discovery:
    """A scenario with an unknown component."""
    return discover(Search(unknown_of(name), kind, seconds), quiet)


def numbers_of(made: Discovery) -> dict[str, Course]:
    return {entry.number.name: entry for entry in made.courses}


def test_an_unbalanced_shaft_is_discovered_as_it_is() -> None:
    """The paper: 0.5 and 0.02 rad/s, 1.6 %, 0.22 %."""
    made = discovered("unbalance", Kind.IDEAL, 40.0)
    amplitude, frequency, phase = (numbers_of(made)[name] for name in ("amplitude", "frequency", "phase"))
    assert made.met
    assert made.onset == made.begun == 0.0
    assert made.adopted is not None
    assert made.adopted <= 10.0
    assert made.before["omega"] > 0.4
    assert made.after["omega"] <= 0.0005
    assert np.nanmax(amplitude.errors) <= 0.0002
    assert np.nanmax(frequency.errors) <= 0.00002
    assert np.nanmax(phase.errors) <= 0.001
    assert amplitude.scale * amplitude.value[-1] == pytest.approx(5.0, rel=0.0002)
    assert {entry.coverage for entry in made.courses} == {1.0}


def test_a_leak_is_discovered_as_it_is() -> None:
    made = discovered("hydraulic-leak", Kind.IDEAL, 190.0)
    (factor,) = made.courses
    assert made.met
    assert made.onset == pytest.approx(made.begun, abs=0.5)
    assert made.adopted is not None
    assert made.adopted <= 180.0
    assert made.before["p"] > 9000.0
    assert made.after["p"] < 0.2
    assert np.nanmax(factor.errors) <= 1e-6
    assert factor.coverage == 1.0


def test_a_leak_is_discovered_in_noise() -> None:
    """Half a per cent of the signals' standard deviation: other shapes explain as much until the lift has moved on."""
    made = discovered("hydraulic-leak", Kind.NOISY, 260.0)
    (factor,) = made.courses
    assert made.met
    assert np.nanmax(factor.errors) <= 0.01
    assert factor.coverage is not None
    assert factor.coverage >= 0.9


def test_a_component_that_nobody_has_seen_is_told_and_missed(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    made = discovered("unbalance", Kind.IDEAL, 4.0)
    assert (made.adopted, made.equation, made.after, made.met) == (None, "", {}, False)
    (said,) = json.loads(document([made], []))["unknown"]
    assert not said["met"]
    assert "value" not in said["numbers"]["amplitude"]
    for page in pages([made]):
        Console(width=120).print(page)
    assert "not discovered" in capsys.readouterr().out
    assert [path.stem for path in draw([], [made], tmp_path)] == ["unbalance-before-fig-12"]


def test_a_component_that_comes_and_goes_or_has_company_is_not_what_was_sought() -> None:
    made = discovered("unbalance", Kind.IDEAL, 40.0)
    assert not replace(made, kept=False).met
    assert not replace(made, others=("shaft/linear/omega",)).met


def test_before_and_after_are_drawn(tmp_path: Path) -> None:
    written = draw([], [discovered("hydraulic-leak", Kind.IDEAL, 190.0)], tmp_path)
    kinds = [path.stem.removeprefix("hydraulic-leak-") for path in written]
    assert kinds == ["before-fig-19-20", "after-fig-21-22", "numbers"]
    for path in written:
        assert np.ptp(imread(path)[..., :3]) == 1.0


def test_every_unknown_row_seeks_what_appears_in_its_scenario() -> None:
    for row in UNKNOWNS:
        scenario = load_scenario(examples_directory() / "scenarios" / f"{row.name}.toml")
        twin = plan_of(row).problem.twin
        assert len(scenario.faults) == 1
        assert row.component.split("/")[0] in [site.name for site in twin.sites]
        assert row.output in [entry.name for entry in twin.outputs]
        assert scenario.faults[0].start + 60.0 <= min(row.seconds, comparison.QUICK)


def test_the_command_tells_of_unknown_components(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(comparison, "QUICK", SHORT)
    arguments = ["--quick", "--noise", "--no-plots", "--json", "--scenario", "unbalance"]
    result = CliRunner().invoke(paper, arguments, standalone_mode=False)
    assert result.return_value == 0, result.output
    whole = json.loads(result.stdout)
    assert whole["met"]
    assert not whole["scenarios"]
    (ideal,), (noisy,) = whole["unknown"], whole["unknown_noisy"]
    assert ideal["numbers"]["amplitude"]["target"] == 0.0002
    assert ideal["paper"] == {"before": 0.5, "after": 0.02}
    assert noisy["numbers"]["amplitude"]["error"] < 0.01
