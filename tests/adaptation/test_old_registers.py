"""A drive renews its registers as often as they are read: their age jumps where the computer is late, near a step."""

from pathlib import Path

import numpy as np
import pytest
from benchmarks.sampling.measure import FREE, replayed, write_machine
from benchmarks.sampling.plant import Inputs, Motor, simulate
from benchmarks.sampling.schedules import NOISE, OUTPUTS, Schedule, Timing

from otolith.discovery.alternatives import WindowDecision
from otolith.health.schema import Status
from otolith.machine import load_machine
from tests.variants import often

PERIOD, WINDOW, WINDOWS, STEPPED = 0.01, 2.0, 12, 5  # s; windows, and the one with the only step of the voltage
RESTING, STEP, LOAD = 12.0, 10.0, 0.02  # V, V, N·m
CLOSED_AFTER = 3  # windows
SDS, COVERED = 5.0, 0.9
MOTOR = Motor()


def table(seed: int, late_for: float) -> str:
    """Return readings of a motor whose ages jump from almost a period to zero, for ``late_for`` s from the step on."""
    random, grid = np.random.default_rng(seed), PERIOD * np.arange(round(WINDOWS * WINDOW / PERIOD) + 20)
    renewed, step = random.uniform(5e-4, 3e-3), WINDOW * STEPPED + random.uniform(0.3, 1.3)
    first = int(np.searchsorted(grid, step)) + random.integers(-2, 8)
    read = grid.copy()
    read[first : first + round(late_for / PERIOD)] += renewed + 1e-4
    images = np.maximum(PERIOD * np.floor((read - renewed) / PERIOD) + renewed, 0.0)
    times, rows = np.unique(images, return_inverse=True)
    levels = np.array([RESTING, RESTING + STEP * random.choice([-1.0, 1.0])])
    wave = 0.5 * LOAD * np.sin(random.uniform(1.0, 3.0) * times)
    inputs = Inputs(np.array([0.0, step]), levels, times, LOAD + wave)
    friction = np.array([[MOTOR.R_a, MOTOR.K_e], [MOTOR.K_t, -MOTOR.D]])
    outputs = simulate(MOTOR, np.linalg.solve(friction, [RESTING, LOAD]), 0.0, inputs, times)
    outputs += random.normal(size=outputs.shape) * [NOISE[name] for name in OUTPUTS]
    values = np.column_stack([inputs.voltage(images), inputs.load(images), outputs[rows]])
    lines = [",".join(map(repr, row)) for row in np.column_stack([read, values]).tolist()]
    return "\n".join(["t,V_a,T_load,i,omega", *lines, ""])


@pytest.mark.parametrize("seeds", often([1], [1, 20]))
@pytest.mark.parametrize("late_for", [0.1, 0.6, WINDOW * WINDOWS])
def test_an_age_that_jumps_near_a_step_moves_no_estimate_and_adds_no_component(
    late_for: float, seeds: int, tmp_path: Path
) -> None:
    """The inductance is known; the step alone would show it up to a tenth too small or too large."""
    machine = load_machine(write_machine(tmp_path, Schedule(rows=Timing(PERIOD), polled=True)), with_driver=False)
    path, inside = tmp_path / "recording.csv", []
    for seed in range(seeds):
        path.write_text(table(seed, late_for), encoding="utf-8")
        documents = replayed(machine, path)
        assert len(documents) == WINDOWS
        assert not any(document.components for document in documents)
        assert all(item.decision is WindowDecision.LEARNED for item in documents[STEPPED + CLOSED_AFTER :])
        for document in documents[STEPPED:]:
            for name in FREE:
                truth, published = getattr(MOTOR, name), document.parameters[name]
                if published.status in (Status.ESTIMATED, Status.HELD, Status.AMBIGUOUS):
                    assert published.value is not None
                    assert published.low is not None
                    assert published.high is not None
                    assert abs(published.value - truth) <= SDS * (published.sd or 0.0), document.window.index
                    inside.append(published.low <= truth <= published.high)
    assert len(inside) > 10 * seeds
    assert np.mean(inside) >= COVERED
