"""Windows that are never decided: after some in a row, the reason names the levels of noise and how to find them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.state import initial_state
from otolith.discovery.alternatives import WindowDecision
from otolith.health.text import texts_in
from otolith.machine import load_machine
from tests.adaptation.test_parameters_at_bounds import MACHINE, PERIOD, RECORDS, TWIN
from tests.messages import assert_says


@pytest.mark.parametrize(("before", "is_named"), [(0, False), (2, False), (3, True), (6, True)])
def test_windows_that_stay_undecided_name_the_levels(tmp_path: Path, before: int, *, is_named: bool) -> None:
    """A torque that wanders, of which no level is stated; ``before`` windows contradicted their predictions."""
    (tmp_path / "servo.toml").write_text(TWIN, encoding="utf-8")
    (tmp_path / "m.toml").write_text(MACHINE, encoding="utf-8")
    problem = load_machine(tmp_path / "m.toml", with_driver=False).problem
    random, speed, disturbance, rows = np.random.default_rng(3), 0.0, 0.0, []
    for index in range(RECORDS):
        torque = 0.1 * float(np.sign(np.sin(2.0 * np.pi * index * PERIOD / 8.0)))
        rows.append((torque, speed + 0.5 * random.normal()))
        disturbance += -0.02 * disturbance + 2e-4 * random.normal()
        for _ in range(20):
            friction = 5e-5 * speed + 0.0366 * np.tanh(speed / 2.0)
            speed += PERIOD / 20.0 * (torque + disturbance - friction) / 1e-4
    state = replace(initial_state("servo", "here", replace(problem, process_noise=(0.3,))), contradictions=before)
    _, report = adapt(state, Window.whole(0, 0.0, PERIOD, ("T", "w"), np.array(rows)))
    assert report.document.decision is WindowDecision.SUSPECTED
    reason = report.document.parameters["T_c"].reason
    assert ("otolith noise" in reason) == is_named
    if is_named:
        assert_says(reason, f"{before + 1} windows", "[noise]", "[process_noise]")
        assert_says(texts_in("de").translated(reason), "Zeitfenster in Folge", "'otolith noise'")
