"""``otolith replay --output``: the reports of a serial replay bit for bit, whatever ends meanwhile."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from otolith.adaptation.state import AdaptationState, initial_state
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.batch.batch import MachineReplay, machine_replay, run_batch
from otolith.runtime.batch.local import LocalWorkers
from otolith.runtime.batch.outputs import OutputFormat, opened_output
from otolith.runtime.batch.task import ReplayOutcome, ReplayTask, perform_task
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import load_scenario
from tests.cli.commands import otolith
from tests.cli.replays import MACHINE, recorded
from tests.cli.test_replay_files import file_of
from tests.conftest import EXAMPLES
from tests.messages import assert_says, raises_saying
from tests.waiting import PATIENCE

BEGIN = 1_790_000_000.0  # Unix s


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Machine files and recordings of two motors; one becomes unbalanced in its second file."""
    folder = tmp_path_factory.mktemp("plant")
    scenario = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(scenario, MotorScenario)
    unbalance = scenario.faults[1].model_copy(update={"start": 9.0})
    for name, faults in {"ill": (unbalance,), "well": ()}.items():
        text = MACHINE.read_text(encoding="utf-8").replace('name = "motor"', f'name = "{name}"')
        (folder / "hall").mkdir(exist_ok=True)
        (folder / "hall" / f"{name}.toml").write_text(text, encoding="utf-8")
        rows = recorded(scenario.model_copy(update={"faults": faults}), 9)
        (folder / "data" / name).mkdir(parents=True)
        for number in range(3):
            part = rows[600 * number : 600 * (number + 1)]
            file_of(folder / "data" / name / f"{number}.csv", part, BEGIN + (30.0 if number else 0.0))
    return folder


@pytest.fixture(scope="module")
def serial(plant: Path) -> dict[str, str]:
    """What a serial replay prints of each machine."""
    return {
        name: otolith("replay", plant / "hall" / f"{name}.toml", *files(plant, name), "--json").stdout
        for name in ("ill", "well")
    }


def files(plant: Path, name: str) -> list[Path]:
    return sorted((plant / "data" / name).iterdir())


def written(folder: Path, name: str) -> str:
    return (folder / f"site.{name}.jsonl").read_text(encoding="utf-8")


def test_several_machines_have_the_reports_of_serial_replays(
    plant: Path, serial: dict[str, str], tmp_path: Path
) -> None:
    done = otolith("replay", plant / "hall", plant / "data", "--output", tmp_path / "out", "--jobs", 2)
    assert "site.ill" in done.stderr
    assert {name: written(tmp_path / "out", name) for name in serial} == serial
    again = otolith("replay", plant / "hall", plant / "data", "--output", tmp_path / "out", "--jobs", 2)
    assert "2 machines" in again.stderr
    assert {name: written(tmp_path / "out", name) for name in serial} == serial


class EachChunk:
    """Computes tasks in this process, and loses every other one on the way back."""

    room = 1

    def __init__(self, *, is_lossy: bool = False) -> None:
        self.is_lossy = is_lossy
        self.tasks = list[tuple[str, ReplayTask]]()
        self.count = 0

    def submit(self, key: str, task: ReplayTask) -> None:
        self.tasks.append((key, task))

    def finished(self) -> list[tuple[str, ReplayOutcome | None, str]]:
        done = list[tuple[str, ReplayOutcome | None, str]]()
        for key, task in self.tasks:
            self.count += 1
            is_lost = self.is_lossy and self.count % 2 == 0
            done.append((key, None, "lost") if is_lost else (key, perform_task(task), ""))
        self.tasks.clear()
        return done

    def close(self) -> None:
        """Nothing to end."""


def replay_of(plant: Path, name: str, output: Path, kind: OutputFormat = OutputFormat.JSONL) -> MachineReplay:
    machine = load_machine(plant / "hall" / f"{name}.toml", with_driver=False)
    output.mkdir(exist_ok=True)
    return machine_replay(machine, first(machine), files(plant, name), output, kind)


def first(machine: LoadedMachine) -> AdaptationState:
    names = machine.file.machine
    return initial_state(names.name, names.site, machine.problem, machine.plan)


def test_a_batch_that_is_stopped_and_started_after_each_task_has_the_same_reports(
    plant: Path, serial: dict[str, str], tmp_path: Path
) -> None:
    starts = 0
    while not (item := replay_of(plant, "ill", tmp_path)).is_over:
        starts += 1
        workers, seen = EachChunk(is_lossy=True), list[int]()
        run_batch([item], workers, lambda: bool(seen), lambda _: seen.append(1), seconds=0.0)  # noqa: B023
        with (tmp_path / "site.ill.jsonl").open("a", encoding="utf-8") as stream:
            stream.write("what was written after the checkpoint")
    assert starts >= 4
    assert replay_of(plant, "ill", tmp_path).output.reports == 9
    assert written(tmp_path, "ill").startswith(serial["ill"])


def test_parquet_has_a_row_for_each_report(plant: Path, serial: dict[str, str], tmp_path: Path) -> None:
    item = replay_of(plant, "ill", tmp_path, OutputFormat.PARQUET)
    run_batch([item], EachChunk(), lambda: False, lambda _: None, seconds=0.0)
    table = pq.read_table(tmp_path / "site.ill.parquet")
    reports = [json.loads(line) for line in serial["ill"].splitlines()]
    assert [json.loads(text) for text in table["report"].to_pylist()] == reports
    assert table["R_a"].to_pylist() == [report["parameters"]["R_a"]["value"] for report in reports]
    assert table["index"].to_pylist() == [report["window"]["index"] for report in reports]
    assert len(list((tmp_path / "site.ill.parquet").iterdir())) > 1


def test_a_worker_that_is_killed_costs_no_report(plant: Path, serial: dict[str, str], tmp_path: Path) -> None:
    items = [replay_of(plant, name, tmp_path) for name in serial]
    workers, killed = LocalWorkers(2), list[int]()
    try:
        pids = [worker._process.pid for worker in workers._workers]
        assert all(isinstance(pid, int) for pid in pids)

        def kill(replays: Sequence[MachineReplay]) -> None:
            if not killed and any(not item.is_over for item in replays):
                killed.append(pids[0])
                os.kill(pids[0], signal.SIGKILL)

        run_batch(items, workers, lambda: False, kill, seconds=0.0)
    finally:
        workers.close()
    assert killed
    assert {name: written(tmp_path, name) for name in serial} == serial


class Deadly(EachChunk):
    """Loses each task of one machine."""

    def finished(self) -> list[tuple[str, ReplayOutcome | None, str]]:
        done = super().finished()
        return [(key, None, "gone") if key == "site.ill" else (key, outcome, "") for key, outcome, _ in done]


def test_a_task_that_kills_its_workers_ends_its_machine_only(
    plant: Path, serial: dict[str, str], tmp_path: Path
) -> None:
    items = [replay_of(plant, name, tmp_path) for name in serial]
    run_batch(items, Deadly(), lambda: False, lambda _: None)
    assert_says(items[0].failure, "gone", "3")
    assert written(tmp_path, "well") == serial["well"]


@pytest.mark.parametrize(
    ("work", "ended_by"),
    [
        ("while True: pass", signal.SIGPROF),
        ("import re; re.match('(a*)*b', 40 * 'a')", signal.SIGPROF),  # no other thread of Python runs meanwhile
        ("import time; time.sleep(60.0)", signal.SIGALRM),
    ],
)
def test_a_task_that_has_no_end_ends_its_worker(work: str, ended_by: signal.Signals) -> None:
    code = f"from otolith.runtime.batch.task import limited\nwith limited(0.2, 2.0):\n    {work}"
    limit = 2.0 if ended_by is signal.SIGALRM else PATIENCE
    code = code.replace("2.0)", f"{limit})", 1)
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE).returncode == -ended_by


def test_a_task_that_ends_leaves_its_worker_alone() -> None:
    code = "import time\nfrom otolith.runtime.batch.task import limited\nwith limited(0.2, 0.2): pass\n"
    code += "end = time.process_time() + 0.5\nwhile time.process_time() < end: pass"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=PATIENCE).returncode == 0


def test_a_batch_whose_process_is_killed_is_continued(plant: Path, serial: dict[str, str], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "otolith", "replay", str(plant / "hall"), str(plant / "data")]
    command += ["--output", str(tmp_path / "out"), "--jobs", "1"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE)
    deadline = time.monotonic() + 60.0
    while not (tmp_path / "out" / "site.ill.checkpoint").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.kill()
    process.communicate()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "continued" in done.stderr
    assert {name: written(tmp_path / "out", name) for name in serial} == serial


def test_a_file_that_cannot_be_read_ends_its_machine_only(plant: Path, serial: dict[str, str], tmp_path: Path) -> None:
    for name in ("ill", "well"):
        (tmp_path / "data" / name).mkdir(parents=True)
        for file in files(plant, name):
            (tmp_path / "data" / name / file.name).write_bytes(file.read_bytes())
    (tmp_path / "data" / "ill" / "1.csv").write_text("nothing of it\n", encoding="utf-8")
    with raises_saying(OtolithError, "site.ill", "1.csv"):
        otolith("replay", plant / "hall", tmp_path / "data", "--output", tmp_path / "out", "--jobs", 1)
    assert written(tmp_path / "out", "well") == serial["well"]
    assert serial["ill"].startswith(written(tmp_path / "out", "ill"))
    assert written(tmp_path / "out", "ill").count("\n") == 2  # the third window waits for what follows


def test_a_checkpoint_of_something_else_is_refused(plant: Path, tmp_path: Path) -> None:
    item = replay_of(plant, "ill", tmp_path)
    run_batch([item], workers := EachChunk(), lambda: workers.count > 0, lambda _: None, seconds=0.0)
    machine = load_machine(plant / "hall" / "ill.toml", with_driver=False)
    with raises_saying(ConfigurationError, "site.ill.checkpoint", "data"):
        machine_replay(machine, first(machine), files(plant, "ill")[:2], tmp_path, OutputFormat.JSONL)
    with raises_saying(ConfigurationError, "site.ill.checkpoint", "format"):
        machine_replay(machine, first(machine), files(plant, "ill"), tmp_path, OutputFormat.PARQUET)
    whole = (tmp_path / "site.ill.checkpoint").read_bytes()
    for damaged in (whole[:-20], whole.replace(b"\n", b"\n1"), b"{}\n" + whole.partition(b"\n")[2], b"", b"\xff"):
        (tmp_path / "site.ill.checkpoint").write_bytes(damaged)
        with raises_saying(ConfigurationError, "damaged"):
            replay_of(plant, "ill", tmp_path)
    (tmp_path / "site.ill.checkpoint").unlink()
    with raises_saying(ConfigurationError, "site.ill.jsonl", "checkpoint"):
        replay_of(plant, "ill", tmp_path)


def test_two_replays_do_not_write_into_one_folder(plant: Path, tmp_path: Path) -> None:
    with opened_output(tmp_path), raises_saying(ServiceError, str(tmp_path), "another"):
        otolith("replay", plant / "hall", plant / "data", "--output", tmp_path)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--jobs", 2), "--output"),
        (("--output", "{out}", "--json"), "--state"),
        (("--output", "{out}", "--ca", "ca.pem"), "--scheduler"),
        (("--output", "{out}", "--scheduler", "tcp://127.0.0.1:8786", "--jobs", 2), "--jobs"),
        (("--output", "{out}", "--scheduler", "10.0.0.5"), "tcp://"),
        (("--output", "{out}", "--scheduler", "tls://10.0.0.5:8786"), "--certificate"),
    ],
)
def test_options_that_do_not_go_together_are_named(
    options: tuple[object, ...], said: str, plant: Path, tmp_path: Path
) -> None:
    given = [str(option).replace("{out}", str(tmp_path / "out")) for option in options]
    with pytest.raises(Exception, match=said):
        otolith("replay", plant / "hall" / "ill.toml", plant / "data" / "ill" / "0.csv", *given)
