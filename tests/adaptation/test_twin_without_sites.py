"""A twin that names no place for a component: windows are learned, changes are named, and nothing is missed."""

from collections.abc import Callable
from pathlib import Path

import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.estimation.problem import Problem
from otolith.machine import LIBRARY
from otolith.twin.language import read_twin
from otolith_drivers.config_files import read
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.faults import Fault, Step, Unbalance
from tests.variants import often

Cut = Callable[..., list[tuple[Window, float]]]
FAULTS: dict[str, tuple[Fault, ...]] = {
    "healthy": (),
    "step": (Step(kind="step", parameter="R_a", start="5 s", amount="0.6 ohm"),),
    "unbalance": (Unbalance(kind="unbalance", start="5 s", acceleration="5 rad/s^2", frequency="10 rad/s"),),
}


@pytest.mark.full
@pytest.mark.parametrize("fault", often(["step"], FAULTS))
def test_a_twin_without_sites_is_estimated(tmp_path: Path, scenario: MotorScenario, windows: Cut, fault: str) -> None:
    text, sites, _ = (LIBRARY / "dc_motor.toml").read_text(encoding="utf-8").partition("[sites]")
    assert sites
    (tmp_path / "bare.toml").write_text(text, encoding="utf-8")
    twin = read_twin(read(tmp_path / "bare.toml"))
    known = tuple((row.name, row.nominal) for row in twin.parameters if row.name != "R_a")
    free = tuple(row for row in twin.parameters if row.name == "R_a")
    state = initial_state("motor", "bench", Problem(twin, known, free, (0.005, 0.02), input_noise=(0.0, 0.0002)))
    decisions, error = [], None
    for window, truth in windows(scenario.model_copy(update={"faults": FAULTS[fault]}), 8):
        state, report = adapt(state, window)
        decisions.append(report.document.decision)
        value = report.document.parameters["R_a"].value
        error = None if value is None else abs(value / truth - 1.0)
    if fault == "unbalance":
        assert WindowDecision.LEARNED not in decisions[3:]
    else:
        assert error is not None
        assert error < 0.01
