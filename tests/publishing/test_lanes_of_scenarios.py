"""The lanes of a page against the truth of random scenarios of the simulated motor, from its windows to the page."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.diagnosis import KINDS
from benchmarks.motor import CONFIG, RECORDS
from benchmarks.pictures import START, motor, page, reports_of

from otolith.health.limits import Level
from otolith.health.schema import ReportDocument
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.variants import often

WINDOWS, LENGTH = 45, 2.0  # s
PATIENCE = 16.0  # s from a change of the machine until it is announced: the demo promises 15 s for an unbalance
LONG_PATIENCE = 40.0  # s of an unbalance that is weaker than half of that
EARLY = 3.0  # s: a window begins before it is reported, and the page rounds to seconds
KINDS_OF_FAULTS = ("healthy", "drift", "unbalance", "frozen")
Levels = Callable[[float], Level]


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault of the motor, and the true state of the part that it is in over time (s)."""

    fault: dict[str, Any]
    part: str = ""
    truth: Levels = lambda _: Level.OK
    patience: float = PATIENCE


def scenario(seed: int) -> Scenario:
    """Return a random scenario; the kinds take turns."""
    noise = np.random.default_rng(1000 + seed)
    kind, start = KINDS_OF_FAULTS[seed % len(KINDS_OF_FAULTS)], float(noise.uniform(24.0, 50.0))
    fault: dict[str, Any] = {"kind": kind, "start": f"{start:.2f} s"}
    if kind == "drift":
        fault |= {"parameter": "R_a", "amount": f"{-noise.uniform(0.02, 0.06):.4f} ohm", "rate": "0.04 1/s"}
        return Scenario(fault, "winding", partial(level_of_resistance, resistance_of(fault, seed)))
    if kind == "unbalance":
        is_strong = bool(noise.random() < 0.5)
        acceleration = noise.uniform(4.2, 7.0) if is_strong else noise.uniform(1.5, 2.6)
        level = Level.ACT if is_strong else Level.WATCH
        fault |= {"acceleration": f"{acceleration:.3f} rad/s^2", "order": 1.0}
        patience = PATIENCE if is_strong else LONG_PATIENCE
        return Scenario(fault, "shaft", lambda at: Level.OK if at < start else level, patience)
    if kind == "frozen":
        fault |= {"signal": "ArmatureCurrent"}
        return Scenario(fault, "sensors", lambda at: Level.OK if at < start else Level.ACT)
    return Scenario({})


def resistance_of(fault: dict[str, Any], seed: int) -> np.ndarray[Any, Any]:
    """Return the true resistance at each tenth of a second."""
    plant: Any = load_scenario(CONFIG / "scenarios" / "demo.toml")
    plant = plant.model_copy(update={"faults": (KINDS["drift"].model_validate(fault),), "seed": seed})
    samples = islice(simulate(plant), 0, WINDOWS * RECORDS, 10)
    return np.array([sample.truth["R_a"] for sample in samples])


def level_of_resistance(values: np.ndarray[Any, Any], at: float) -> Level:
    value = float(values[int(np.clip(10.0 * at, 0, len(values) - 1))])
    passed = [limit.level for limit in motor().plan.parameters["R_a"].limits
              if (value < limit.value) is limit.is_lower]  # fmt: skip
    return max(passed, key=lambda level: level.rank, default=Level.OK)


def lanes(text: str) -> dict[str, list[tuple[Level, float, float]]]:
    """Return the states of each part in a page, with begin and end in s since the first window."""
    found: dict[str, list[tuple[Level, float, float]]] = {}
    for part, bar in re.findall(
        r'<div class="lane"><span>([^<]+)</span>\s*<div class="bar">(.*?)</div>', text, re.DOTALL
    ):
        pieces = re.findall(r'<i class="(\w+)"[^>]*title="[^:]*: ([\d :-]+?) to ([\d :-]+?)"', bar)
        found[part] = [(Level[name], seconds(begin), seconds(end)) for name, begin, end in pieces]
    return found


def seconds(time: str) -> float:
    return datetime.fromisoformat(time).timestamp() - START


def shown(pieces: list[tuple[Level, float, float]], at: float) -> Level | None:
    return next((level for level, begin, end in pieces if begin <= at < end), None)


def announced(documents: list[ReportDocument], part: str, at: float) -> Level | None:
    last = [row.health for row in documents if row.window.end - START <= at]
    health = last[-1] if last else None
    return None if health is None else health.parts[part].state if part in health.parts else Level.OK


@pytest.mark.parametrize("seed", often((2,), range(20)))
def test_lanes_show_what_was_announced_and_that_is_what_happened(seed: int, tmp_path: Path) -> None:
    case = scenario(seed)
    reports = reports_of(case.fault, WINDOWS, seed)
    found = lanes(page(reports, tmp_path))
    documents = [report.document for report in reports]
    assert {"winding", "shaft", "sensors", "whole machine"} <= found.keys()
    for at in np.arange(4.0, WINDOWS * LENGTH - 1.0, 1.0) + 0.5:
        now = {part: shown(pieces, at) for part, pieces in found.items()}
        for part in ("winding", "shaft", "sensors"):
            assert now[part] in {announced(documents, part, at), announced(documents, part, at - 1.0),
                                 announced(documents, part, at + 1.0)}, (part, at)  # fmt: skip
            is_own = part == case.part
            true = [case.truth(time) if is_own else Level.OK for time in np.arange(at - case.patience, at + EARLY, 0.1)]
            state = now[part]
            assert state is not None
            if state is Level.NO_DATA and case.part == "sensors":
                continue  # what a frozen sensor does not determine
            low, high = min(level.rank for level in true), max(level.rank for level in true)
            assert low <= state.rank <= high, (case, part, at, state)
        worst = max((level for part, level in now.items() if part != "whole machine" and level), key=lambda x: x.rank)
        assert now["whole machine"] in {worst, Level.OK if worst is Level.NO_DATA else worst}, (at, now)


def test_the_scenarios_reach_each_state() -> None:
    ends = {scenario(seed).part: scenario(seed).truth(WINDOWS * LENGTH - 1.0) for seed in (0, 1, 2, 3)}
    assert ends.keys() == {"", "winding", "shaft", "sensors"}
    assert [ends[part] is Level.OK for part in ("", "shaft", "sensors")] == [True, False, False]
    worst = max((scenario(seed).truth(WINDOWS * LENGTH - 1.0) for seed in (1, 5, 9)), key=lambda level: level.rank)
    assert worst is not Level.OK
