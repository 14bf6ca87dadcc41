"""A replay that is split anywhere, and continued from what a file keeps of it, gives the same reports bit for bit."""

import json
from collections.abc import Callable
from functools import reduce
from itertools import pairwise
from pathlib import Path

import pytest

from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.replay import Replay, open_recorded
from otolith.runtime.segment import ReplayState, Samples, first_state, replay_segment
from otolith.storage.exact_json import Decoder, encoded
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import load_scenario
from otolith_drivers.replay.readers import Rows
from tests.cli.replays import MACHINE, recorded, written
from tests.conftest import EXAMPLES

WINDOWS = 10
SPLITS: dict[str, Callable[[int], list[int]]] = {
    "in every window": lambda count: list(range(137, count, 137)),
    "one row, and then the rest": lambda count: [1, count - 1],
    "row by row where the first window ends": lambda _: list(range(195, 215)),
}


@pytest.fixture(scope="module")
def machine() -> LoadedMachine:
    return load_machine(MACHINE, with_driver=False)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """From 9 s on the shaft is unbalanced, which hypotheses compete to explain for three windows."""
    scenario = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(scenario, MotorScenario)
    unbalance = scenario.faults[1].model_copy(update={"start": 9.0})
    rows = recorded(scenario.model_copy(update={"faults": (unbalance,)}), WINDOWS)
    return written(tmp_path_factory.mktemp("data"), rows)


def kept(machine: LoadedMachine, state: ReplayState) -> ReplayState:
    """The state as another process reads it from a file."""
    again: ReplayState = Decoder(machine.twin).decode(ReplayState, json.loads(encoded(state)))
    return again


@pytest.mark.parametrize("split", SPLITS)
def test_a_replay_that_is_split_gives_the_same_reports(split: str, data: Path, machine: LoadedMachine) -> None:
    with open_recorded(machine, data) as opened:
        whole = [report.document.to_json() for report in Replay(machine, opened).reports()]
    with open_recorded(machine, data) as opened:
        rows = reduce(Rows.followed_by, opened.chunks())
        state = first_state(machine, opened.sampling)
    assert len(whole) == WINDOWS

    parts, tests = list[str](), 0
    cuts = [0, *SPLITS[split](len(rows.times)), len(rows.times)]
    for first, last in pairwise(cuts):
        samples, before = [Samples(rows.part(slice(first, last)))], encoded(state)
        reports, after = replay_segment(machine, samples, state, is_last=last == len(rows.times))
        assert encoded(state) == before
        parts += [report.document.to_json() for report in reports]
        tests += after.adaptation.test is not None
        state = kept(machine, after)
        assert encoded(state) == encoded(after)
    assert parts == whole
    assert tests >= 3 or split != "in every window"
