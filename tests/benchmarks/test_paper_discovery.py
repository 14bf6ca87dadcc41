"""The paper's unbalanced shaft and leak: discovery, plots, tables, JSON."""

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
from benchmarks.paper.scenarios import UNKNOWNS, machine_of, unknown_row_of
from benchmarks.paper.study import Kind
from click.testing import CliRunner
from matplotlib.image import imread
from rich.console import Console

from otolith.cli.common import shipped_directory
from otolith_drivers.plant.scenario import load_scenario

pytestmark = pytest.mark.full  # they test the benchmarks, not the product

SHORT = 20.0  # s


def quiet(_steps: int, _activity: str) -> None:
    pass


@cache
def discovered(name: str, kind: Kind, seconds: float) -> Discovery:
    """Discovery in a scenario with an unknown component."""
    return discover(Search(unknown_row_of(name), kind, seconds), quiet)


def numbers_of(discovery: Discovery) -> dict[str, Course]:
    return {course.number.name: course for course in discovery.courses}


def test_an_unbalanced_shaft_is_discovered() -> None:
    """The paper has residuals of 0.5 and 0.02 rad/s, and errors of 1.6 % and 0.22 %."""
    discovery = discovered("unbalance", Kind.IDEAL, 40.0)
    amplitude, frequency, phase = (numbers_of(discovery)[name] for name in ("amplitude", "frequency", "phase"))
    assert discovery.met
    assert discovery.onset == discovery.begun == 0.0
    assert discovery.adopted is not None
    assert discovery.adopted <= 10.0
    assert discovery.before["omega"] > 0.4
    assert discovery.after["omega"] <= 0.0005
    assert np.nanmax(amplitude.errors) <= 0.0002
    assert np.nanmax(frequency.errors) <= 0.00002
    assert np.nanmax(phase.errors) <= 0.001
    assert amplitude.scale * amplitude.value[-1] == pytest.approx(5.0, rel=0.0002)
    assert {course.coverage for course in discovery.courses} == {1.0}


def test_a_leak_is_discovered() -> None:
    discovery = discovered("hydraulic-leak", Kind.IDEAL, 190.0)
    (factor,) = discovery.courses
    assert discovery.met
    assert discovery.onset == pytest.approx(discovery.begun, abs=0.5)
    assert discovery.adopted is not None
    assert discovery.adopted <= 180.0
    assert discovery.before["p"] > 9000.0
    assert discovery.after["p"] < 0.2
    assert np.nanmax(factor.errors) <= 1e-6
    assert factor.coverage == 1.0


def test_a_leak_is_discovered_in_noise() -> None:
    """Noise is 0.5 % of the signals' standard deviation: other families fit as well until the lift moves further."""
    discovery = discovered("hydraulic-leak", Kind.NOISY, 260.0)
    (factor,) = discovery.courses
    assert discovery.met
    assert np.nanmax(factor.errors) <= 0.01
    assert factor.coverage is not None
    assert factor.coverage >= 0.9


def test_an_undiscovered_component_misses_the_target(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    discovery = discovered("unbalance", Kind.IDEAL, 4.0)
    assert (discovery.adopted, discovery.equation, discovery.after, discovery.met) == (None, "", {}, False)
    (described,) = json.loads(document([discovery], []))["unknown"]
    assert not described["met"]
    assert "value" not in described["numbers"]["amplitude"]
    for page in pages([discovery]):
        Console(width=120).print(page)
    assert "not discovered" in capsys.readouterr().out
    assert [path.stem for path in draw([], [discovery], tmp_path)] == ["unbalance-before-fig-12"]


def test_a_lost_or_additional_component_misses_the_target() -> None:
    discovery = discovered("unbalance", Kind.IDEAL, 40.0)
    assert not replace(discovery, kept=False).met
    assert not replace(discovery, others=("shaft/linear/omega",)).met


def test_discovery_plots_show_before_and_after(tmp_path: Path) -> None:
    written = draw([], [discovered("hydraulic-leak", Kind.IDEAL, 190.0)], tmp_path)
    kinds = [path.stem.removeprefix("hydraulic-leak-") for path in written]
    assert kinds == ["before-fig-19-20", "after-fig-21-22", "numbers"]
    for path in written:
        assert np.ptp(imread(path)[..., :3]) == 1.0


def test_every_unknown_row_fits_its_scenario() -> None:
    for row in UNKNOWNS:
        scenario = load_scenario(shipped_directory("config") / "scenarios" / f"{row.name}.toml")
        twin = machine_of(row).problem.twin
        assert len(scenario.faults) == 1
        assert row.component.split("/")[0] in [site.name for site in twin.sites]
        assert row.output in [output.name for output in twin.outputs]
        assert scenario.faults[0].start + 60.0 <= min(row.seconds, comparison.QUICK)


def test_the_command_reports_unknown_components(monkeypatch: pytest.MonkeyPatch) -> None:
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
