"""The main job over real parts: bus, worker, Zenoh and recording, observed by independent processes."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from otolith.acquisition.window import Array, Verdict
from otolith.cli.demo import compare
from tests.conftest import OwnMachine
from tests.system.conftest import Running, is_estimated
from tests.waiting import EXACT, PATIENCE, wait_for, within

CAN_LISTENER = """
import can, cantools, json, sys
database = cantools.database.load_file(sys.argv[1])
bus = can.Bus(interface="udp_multicast", channel=sys.argv[2], port=int(sys.argv[3]), hop_limit=0, fd=False)
seen = []
while len(seen) < 400:
    frame = bus.recv(60.0)
    assert frame is not None
    seen.append(frame)
bus.shutdown()
print(json.dumps([
    (database.get_message_by_frame_id(frame.arbitration_id).name, frame.timestamp,
     database.decode_message(frame.arbitration_id, frame.data))
    for frame in seen
]))
"""

ZENOH_LISTENER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
received, alive = [], []
with zenoh.open(config) as session:
    session.declare_subscriber("otolith/**", lambda s: received.append((str(s.key_expr), s.payload.to_string())))
    end = time.monotonic() + 60.0
    while sum(key.endswith("/report") for key, _ in received) < 2 and time.monotonic() < end:
        time.sleep(0.1)
    latest = [reply.ok.payload.to_string() for reply in session.get("otolith/demo/dc-motor/report") if reply.ok]
    alive = [str(reply.ok.key_expr) for reply in session.liveliness().get("otolith/*/*/alive") if reply.ok]
print(json.dumps({"received": received, "latest": latest, "alive": alive}))
"""


def independent(program: str, *arguments: object) -> Any:
    command = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=True)
    return json.loads(done.stdout)


def series(path: Path, entity: str) -> tuple[Array, Array]:
    """Times (s) and values (rows, columns) of an entity read back from a recording."""
    times, values = [], []
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) == entity and not chunk.is_static:
            batch = chunk.to_record_batch()
            times.append(batch.column("time").cast(pa.int64()).to_numpy() / 1e9)
            values.append(np.stack(batch.column("Scalars:scalars").to_numpy(zero_copy_only=False)))
    order = np.argsort(np.concatenate(times), kind="stable")
    return np.concatenate(times)[order], np.concatenate(values)[order]


@pytest.mark.timed
def test_frames_reports_and_recording_are_complete(running: Running) -> None:
    running.wait_for(lambda reports: len(reports) >= 2)
    machine = running.machine
    frames = independent(CAN_LISTENER, machine.dbc, machine.group, machine.port)
    assert {"MotorElectrical", "MotorMechanical"} == {name for name, _, _ in frames}
    electrical = [(stamp, values) for name, stamp, values in frames if name == "MotorElectrical"]
    counters = [values["ElectricalAliveCounter"] for _, values in electrical]
    assert set(np.diff(counters) % 256) == {1}
    seconds = electrical[-1][0] - electrical[0][0]
    assert seconds == pytest.approx(0.01 * (len(electrical) - 1), abs=within(0.1))

    published = independent(ZENOH_LISTENER, machine.endpoint)
    documents = [json.loads(text) for key, text in published["received"] if key.endswith("/report")]
    assert len(documents) >= 2
    assert all(report["schema"] == "otolith.report/1" for report in documents)
    assert {key for key, _ in published["received"]} >= {"otolith/demo/dc-motor/parameter/R_a"}
    assert json.loads(published["latest"][0])["machine"] == "dc-motor"
    assert published["alive"] == ["otolith/demo/dc-motor/alive"]

    reports = list(running.wait_for(lambda reports: len(reports) >= 7 and sum(map(is_estimated, reports)) >= 6))
    code, _ = running.stop()
    assert code == 0
    check_accuracy(running)
    verify = Path(sys.executable).with_name("rerun")
    done = subprocess.run([verify, "rrd", "verify", running.recording], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    times, values = series(running.recording, "/signals/i")
    for report in reports:
        half = 0.5 * (report.window.end - report.window.start) / report.window.records
        inside = (times >= report.window.start - half) & (times < report.window.end - half)
        # The grid of a window follows frames that a busy computer delays: a record of the next one may be inside.
        assert abs(inside.sum() - report.window.records) <= (0 if EXACT else 1)
        estimated = report.window.quality.verdict is Verdict.GOOD  # a bad window has no prediction
        whole = np.isfinite(values[inside][:, : 2 if estimated else 1]).all(axis=1)
        assert whole.mean() >= 1.0 - report.window.quality.missing
    known = [value for report in reports if (value := report.parameters["R_a"].value) is not None]
    _, resistance = series(running.recording, "/parameters/R_a")
    assert resistance[: len(known), 2].tolist() == known


def check_accuracy(running: Running) -> None:
    with running.truth.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if None not in row.values()]
    truth = {name: [float(row[name]) for row in rows] for name in rows[0]}
    # Values that are held, as they are in bad windows of a busy computer, may lag behind.
    compared = compare(running.reports if EXACT else list(filter(is_estimated, running.reports)), truth)
    assert len(compared) >= 5
    assert max(row.error for row in compared) <= 0.005
    latencies = [report.cost.latency_s for report in running.reports[1:]]
    assert all(latency is not None and latency < within(1.0) for latency in latencies)


@pytest.mark.timed
def test_a_killed_worker_is_restarted(running: Running) -> None:
    running.wait_for(lambda reports: len(reports) >= 2)
    running.child("worker").kill()
    reports = running.wait_for(lambda reports: len(reports) >= 6 and is_estimated(reports[-1]))
    last = reports[-1].counters
    assert last is not None
    assert last.worker_restarts == 1
    assert last.windows_missed <= within(2)
    assert last.windows_missed == reports[-1].window.index + 1 - len(reports)
    assert (last.lost, last.bad) == (0, 0)
    for before, after in pairwise(reports):
        if after.window.index == before.window.index + 1:
            assert after.window.start == pytest.approx(before.window.end, abs=within(0.005))  # half a period


def test_a_killed_recorder_changes_nothing_else(running: Running) -> None:
    before = running.wait_for(lambda reports: len(reports) >= 2)[-1].counters
    wait_for(lambda: running.recording.exists() and running.recording.stat().st_size > 0)
    running.child("recorder").kill()
    reports = running.wait_for(lambda reports: len(reports) >= 5)
    last = reports[-1].counters
    assert before is not None
    assert last is not None
    assert (last.windows_missed, last.worker_restarts, last.lost) == (before.windows_missed, 0, 0)
    wait_for(lambda: len(list((running.folder / "state").rglob("*.rrd"))) == 1)  # the second recorder writes another
    running.stop()
    assert running.recording.stat().st_size > 0


def catches(pid: int, number: signal.Signals) -> bool:
    """Whether the process has a handler of its own for the signal: Python has one for SIGINT, we for both."""
    status = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    caught = next(line.split()[1] for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught, 16) >> (number - 1) & 1)


@pytest.mark.timed
@pytest.mark.parametrize(
    "moment", [0.2, 3.5, *(pytest.param(moment, marks=pytest.mark.full) for moment in (0.02, 0.5, 1.0, 1.5))]
)
def test_ctrl_c_ends_every_process_within_three_seconds(own_machine: OwnMachine, tmp_path: Path, moment: float) -> None:
    """The whole process group gets the signal, as from a terminal."""
    limit = within(3.0)
    command = [sys.executable, "-m", "otolith", "run", str(own_machine.machine), "--recording", str(tmp_path / "a.rrd")]
    shared = set(Path("/dev/shm").iterdir())  # noqa: S108 - looked at, not written to
    daemon = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    time.sleep(moment)  # the moment is what is tested
    early = not catches(daemon.pid, signal.SIGTERM)
    children = psutil.Process(daemon.pid).children(recursive=True)
    begun = time.monotonic()
    for process in [psutil.Process(daemon.pid), *children]:
        process.send_signal(signal.SIGINT)
    try:
        _, errors = daemon.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        # Python itself may lose a signal while it imports its own modules, before our code is reached.
        os.killpg(daemon.pid, signal.SIGINT if early else signal.SIGKILL)
        begun = time.monotonic()
        _, errors = daemon.communicate(timeout=limit)
        assert early, f"the daemon did not end: {errors}"
    assert time.monotonic() - begun < limit
    # In the first hundredths of a second the interpreter has not reached our code, and may print its own traceback.
    assert "otolith" not in errors.partition("Traceback")[2]
    assert daemon.returncode in (130, -signal.SIGINT) or (daemon.returncode == 1 and "Traceback" in errors)
    _, left = psutil.wait_procs(children, timeout=limit / 3.0)
    # Where the first process of a container reaps nobody, an ended orphan stays listed as a zombie.
    assert [process for process in left if process.status() != psutil.STATUS_ZOMBIE] == []
    assert set(Path("/dev/shm").iterdir()) <= shared  # noqa: S108


@pytest.mark.timed
def test_demo_estimates_what_was_injected(tmp_path: Path, own_machine: OwnMachine) -> None:
    command = [sys.executable, "-m", "otolith", "demo", "--duration", "20", "--json"]
    command += ["--machine", str(own_machine.machine), "--scenario", str(own_machine.scenario)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=False)
    assert done.returncode == 0, done.stderr
    assert "the twin is compiled" in done.stderr
    verdict = json.loads(done.stdout)
    assert verdict["right"]
    assert len(verdict["windows"]) >= 2
    assert Path(verdict["recording"]).is_relative_to(tmp_path)


@pytest.mark.full
def test_demo_is_exit_code_one_for_a_wrong_estimate(own_machine: OwnMachine) -> None:
    text = own_machine.machine.read_text(encoding="utf-8")
    for name in ("K_t", "K_e"):  # a single wrong constant is named, and the estimates stay right
        text = text.replace(f'{name} = "0.038', f'{name} = "0.045')
    own_machine.machine.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "otolith", "demo", "--duration", "10", "--json"]
    command += ["--machine", str(own_machine.machine), "--scenario", str(own_machine.scenario)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3 * PATIENCE, check=False)
    assert done.returncode == 1, done.stderr
    assert not json.loads(done.stdout)["right"]
