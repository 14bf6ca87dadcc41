"""``otolith replay`` of many files: within the descriptors of a process, with their order, gaps and overlaps told."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from otolith.adaptation.state import OperatorDecisions
from otolith.cli.replay import replay
from otolith.machine import load_machine
from otolith.storage.state_store import store_of
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.user_dirs import state_directory
from tests.cli.commands import otolith
from tests.cli.replays import HEADING, MACHINE, Lines, recorded
from tests.messages import assert_says, raises_saying

BEGIN = 1_790_000_000.0  # Unix s
WINDOWS_OF = """
import resource, sys
from pathlib import Path
resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]),) * 2)
from otolith.machine import load_machine
from otolith.runtime.replay import Replay, open_recordings
machine = load_machine(Path(sys.argv[2]), with_driver=False)
with open_recordings(machine, sorted(Path(sys.argv[3]).iterdir())) as data:
    print(sum(1 for window in Replay(machine, data).windows()))
"""


@pytest.fixture
def rows(scenario: MotorScenario) -> Lines:
    return recorded(scenario.model_copy(update={"faults": ()}), 1)


def file_of(path: Path, rows: Lines, begin: float) -> Path:
    """The rows as a table whose times begin at ``begin``."""
    lines = [",".join(HEADING), *(",".join([f"{begin + float(time):.3f}", *rest]) for time, *rest in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_two_hundred_files_need_no_more_descriptors_than_one(tmp_path: Path, rows: Lines) -> None:
    for number in range(200):
        file_of(tmp_path / f"{number:03d}.csv", rows, BEGIN + 1800.0 * number)
    command = [sys.executable, "-c", WINDOWS_OF, "32", str(MACHINE), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["200"], done.stderr


@pytest.mark.parametrize(
    ("begins", "said"),
    [
        ((BEGIN, BEGIN + 2.0), ()),  # the next begins where the one before ends
        ((BEGIN, BEGIN + 3602.0, BEGIN + 3664.0), (("gap",), ("2, the longest of 3600", "1.csv"))),
        ((BEGIN + 3600.0, BEGIN), (("order",), ("1.csv", "0.csv", "2026-09-21 14:13:20"))),
        ((BEGIN, BEGIN + 1.0), (("order",), ("1.csv", "0.csv"))),
        ((0.0, 0.0, 0.0), ()),  # each counts from its own start
        ((0.0, 1.0), (("order",), ("1.csv", "0.csv"))),
    ],
)
def test_gaps_and_overlaps_of_files_are_told(
    begins: tuple[float, ...], said: tuple[tuple[str, ...], ...], tmp_path: Path, rows: Lines,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    files = [file_of(tmp_path / f"{number}.csv", rows, begin) for number, begin in enumerate(begins)]
    replay(MACHINE, files, None, as_json=True, stopped=lambda: False)
    told = capsys.readouterr()
    lines = [line for line in told.err.splitlines() if "two files" in line or "one above" in line]
    assert len(lines) == (1 if said else 0)
    if said:
        assert ("in the order" in lines[0]) == (said[0] == ("order",))
        assert_says(lines[0], *said[1])
    windows = [json.loads(line)["window"]["start"] for line in told.out.splitlines()]
    assert windows == pytest.approx(list(begins))


def test_a_replay_tells_whose_decisions_it_uses_and_takes_those_that_are_named(tmp_path: Path, rows: Lines) -> None:
    data, store = file_of(tmp_path / "data.csv", rows, 0.0), store_of(load_machine(MACHINE, with_driver=False))
    quiet = otolith("replay", MACHINE, data, "--json")
    with store.locked():
        store.operator.write(OperatorDecisions(rejected=frozenset({"shaft/periodic/t"})))
    told = otolith("replay", MACHINE, data, "--json")
    assert str(store.decisions_path) not in quiet.stderr
    assert_says(told.stderr, str(store.decisions_path), "rejected", "shaft/periodic/t")

    copy = tmp_path / "copy"
    shutil.copytree(state_directory(), copy)
    store.operator.write(OperatorDecisions())
    named = otolith("replay", MACHINE, data, "--json", "--state", copy)
    assert_says(named.stderr, str(copy / "components" / store.decisions_path.name), "rejected")
    assert str(store.decisions_path) not in named.stderr
    none = otolith("replay", MACHINE, data, "--json")
    assert "rejected" not in none.stderr


def test_a_folder_that_is_no_state_directory_is_refused(tmp_path: Path, rows: Lines) -> None:
    with raises_saying(ConfigurationError, str(tmp_path), "components"):
        otolith("replay", MACHINE, file_of(tmp_path / "data.csv", rows, 0.0), "--state", tmp_path)
