"""Evidence of events: bundles of a simulated motor, reproduced in other processes, bounded, and attacked."""

import io
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result

from otolith.acquisition.window import Window
from otolith.adaptation.adapt import adapt
from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import AdaptationState, OperatorDecisions, apply_decisions, initial_state
from otolith.cli.main import cli
from otolith.health.diagnosis import FindingFeatures, MonitoringPlan, diagnose
from otolith.health.schema import EventChange, FindingKind, Report
from otolith.machine import load_machine
from otolith.runtime.hall.machine import Task
from otolith.storage import evidence
from otolith.storage.evidence import (
    EVIDENCE,
    MACHINE,
    MAX_WAITING_BUNDLES,
    TWIN,
    EvidenceWriter,
    has_evidence,
    public_text,
    read_bundle,
)
from otolith.storage.exact_json import Decoder, encoded
from otolith.storage.learned_state import learned_state, restored
from otolith_drivers.errors import ConfigurationError, OtolithError
from otolith_drivers.plant.dc_motor import MotorScenario
from otolith_drivers.plant.scenario import load_scenario, simulate
from tests.acquisition.series import uncut
from tests.conftest import EXAMPLES, SIGNALS
from tests.messages import raises_saying
from tests.runtime.pools import OneMachine
from tests.storage.histories import event
from tests.waiting import PATIENCE, wait_for

FILE = load_machine(EXAMPLES / "dc-motor.toml", with_driver=False)
KEY, START = "demo.dc-motor", 1_700_000_000.0  # Unix s
WINDOWS, RECORDS, PERIOD = 26, 200, 0.01
BUDGET = 100_000_000  # bytes


def writer(folder: Path, max_bytes: int = BUDGET) -> EvidenceWriter:
    kept = EvidenceWriter(FILE)
    kept.folder, kept.max_bytes = folder, max_bytes
    return kept


def add(kept: EvidenceWriter, before: AdaptationState, window: Window, report: Report, after: AdaptationState) -> None:
    """Keep a window with packed states, of which the same one is packed once, as it is in the daemon."""
    kept.add(packed(before), window, report, packed(after))


def packed(state: AdaptationState) -> PackedState:
    known = PACKED.setdefault(id(state), (state, PackedState.of(state)))
    return known[1]


PACKED: dict[int, tuple[AdaptationState, PackedState]] = {}


def fresh() -> AdaptationState:
    return initial_state("dc-motor", "demo", FILE.problem, FILE.plan)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An empty folder beside the state directory."""
    (tmp_path / "evidence").mkdir()
    return tmp_path / "evidence"


@pytest.fixture(scope="module")
def batch() -> list[Window]:
    """Windows of a motor whose winding loses turns from 3 s on, and whose shaft is out of balance from 15 s on."""
    scenario = load_scenario(EXAMPLES / "scenarios" / "demo.toml")
    assert isinstance(scenario, MotorScenario)
    drift, unbalance = scenario.faults
    faults = (drift.model_copy(update={"start": 3.0}), unbalance.model_copy(update={"start": 15.0}))
    ticks, cut = simulate(scenario.model_copy(update={"faults": faults})), []
    for index in range(WINDOWS):
        rows = np.array([[tick.measured[name] for name in SIGNALS.values()] for tick in islice(ticks, RECORDS)])
        cut.append(Window.whole(index, START + index * PERIOD * RECORDS, PERIOD, tuple(SIGNALS), rows))
    return cut


@pytest.fixture(scope="module")
def bundles(batch: list[Window], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The bundles of a daemon's worker; the first windows of some are in the middle of a test of hypotheses."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.setattr(evidence, "MIN_WINDOWS", 2)
        kept = writer(tmp_path_factory.mktemp("evidence"))
        pooled = OneMachine.of(fresh())
        pooled.pool.start(time.monotonic())

        def is_kept() -> bool:
            finished = pooled.poll(time.monotonic())
            for item in finished:
                kept.add(item.before, item.window, item.report, item.after)
            return bool(finished)

        try:
            for window in batch:
                pooled.submit(Task(uncut(window)), time.monotonic())
                wait_for(is_kept, 3 * PATIENCE)
        finally:
            pooled.pool.kill()
        kept.write()
    assert kept.dropped == 0
    return sorted(kept.folder.glob("*.zip"))


def reproduce(path: Path, *options: str) -> Result:
    return CliRunner().invoke(cli, ["reproduce", str(path), *options], standalone_mode=False)


def test_each_event_of_a_worker_is_reproduced(bundles: list[Path]) -> None:
    announced = [item for path in bundles for item in read_bundle(path).events]
    assert {item.part for item in announced} == {"winding", "shaft"}
    assert any(read_bundle(path).state.test is not None for path in bundles)
    for path in bundles:
        result = reproduce(path)
        assert result.return_value == 0, result.output
        assert "the same to the last bit" in result.stdout
        assert all(item.text in result.stdout for item in read_bundle(path).events)


def test_a_state_is_the_same_after_writing_and_reading_it(bundles: list[Path]) -> None:
    for path in bundles:
        with zipfile.ZipFile(path) as archive:
            assert encoded(read_bundle(path)) == archive.read(EVIDENCE).decode()


def test_the_rules_of_a_machine_file_are_kept(tmp_path: Path) -> None:
    rule = {"id": "cable", "finding": "limit", "subject": ["R_a"], "condition": "c", "cause": "c", "advice": "a"}
    lines = [f"{key} = {json.dumps(value)}" for key, value in rule.items()]
    path = tmp_path / "machine.toml"
    path.write_text("\n".join([FILE.path.read_text(encoding="utf-8"), "[[rule]]", *lines]), encoding="utf-8")
    plan = load_machine(path, with_driver=False).plan
    again = Decoder(FILE.twin).decode(MonitoringPlan, json.loads(encoded(plan)))
    low = FindingFeatures(FindingKind.LIMIT, "dc_motor", "R_a", "below")
    assert (again, diagnose(again.rules, low)["condition_id"]) == (plan, "cable")


def test_a_bundle_knows_which_inputs_have_no_sensor(batch: list[Window], folder: Path, tmp_path: Path) -> None:
    text = FILE.path.read_text(encoding="utf-8").replace('{ signal = "LoadTorque" }', '{ unknown = "constant" }')
    path = tmp_path / "machine.toml"
    path.write_text(text.replace('T_load = "0.2 mN*m"', ""), encoding="utf-8")
    machine = load_machine(path, with_driver=False)
    kept = EvidenceWriter(machine)
    kept.folder, before = folder, initial_state("dc-motor", "demo", machine.problem, machine.plan)
    values = batch[0].values[:, [batch[0].signals.index(name) for name in machine.twin.signals]]
    window = Window.whole(0, START, PERIOD, machine.twin.signals, values)
    after, report = adapt(before, window)
    add(kept, before, window, _raised(report), after)
    kept.write()
    (bundle,) = map(read_bundle, folder.glob("*.zip"))
    assert bundle.state.posterior.problem.twin == machine.twin
    again = adapt(bundle.state, bundle.windows[0].window)[1]
    assert again.document.parameters == report.document.parameters


def test_a_twin_that_the_machine_file_changes_is_reproduced(batch: list[Window], folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "machine.toml"
    tables = '[performance]\nomega_max = { required = "40 rad/s" }\n[operation]\nomega = { above = "1 rad/s" }\n'
    tables += "[discovery]\nenabled = false\n"
    path.write_text(f"{FILE.path.read_text(encoding='utf-8')}\n{tables}", encoding="utf-8")
    machine = load_machine(path, with_driver=False)
    kept, before = EvidenceWriter(machine), initial_state("dc-motor", "demo", machine.problem, machine.plan)
    kept.folder = folder
    for window in batch:
        after, report = adapt(before, window)
        add(kept, before, window, report, after)
        before = after
        if kept._waiting:
            break
    assert [figure.name for figure in machine.twin.performance if figure.required] == ["omega_max"]
    kept.write()
    (bundle,) = folder.glob("*.zip")
    assert read_bundle(bundle).state.posterior.problem.twin == machine.twin
    result = reproduce(bundle)
    assert (result.return_value, "the same to the last bit" in result.stdout) == (0, True), result.output


def test_the_bits_and_the_order_of_numbers_are_kept() -> None:
    values = np.asfortranarray([[0.1, -0.0, np.nan], [np.inf, -np.inf, 5e-324]])
    window = Window.whole(0, -0.0, PERIOD, ("a", "b", "c"), values)
    twin = replace(FILE.twin, inputs=(), outputs=tuple(replace(FILE.twin.outputs[0], name=name) for name in "abc"))
    read = Decoder(twin).decode(Window, json.loads(encoded(window)))
    assert read.values.tobytes("A") == values.tobytes("A")
    assert read.values.flags.f_contiguous
    assert read.values.flags.writeable
    assert np.signbit(read.start)


def test_evidence_after_a_restart_and_a_decision_is_reproduced(batch: list[Window], folder: Path) -> None:
    state = fresh()
    for window in batch[:10]:
        state, _ = adapt(state, window)
    state = restored(learned_state(state, ""), fresh())
    kept, decisions = writer(folder), OperatorDecisions(rejected=frozenset({"shaft/Coulomb/omega"}))
    for window in batch[10:]:
        before = apply_decisions(state, decisions) if window.index == 12 else state
        state, report = adapt(before, window)
        add(kept, before, window, report, state)
    kept.write()
    paths = sorted(folder.glob("*.zip"))
    items = read_bundle(paths[-1]).windows
    assert [index for index, item in enumerate(items) if item.state is not None] == [0, 2]
    result = reproduce(paths[-1], "--json")
    assert result.return_value == 0
    indices = [json.loads(line)["window"]["index"] for line in result.stdout.splitlines()]
    assert indices == list(range(10, 10 + len(items)))


@pytest.mark.parametrize("count", [1, 16, 17, 33, 40])
def test_the_last_windows_are_kept(batch: list[Window], folder: Path, count: int) -> None:
    kept, state = writer(folder), fresh()
    for index in range(count):
        after, report = replace(state, learned=index), _report() if index < count - 1 else _raised(_report())
        add(kept, state, replace(batch[0], index=index), report, after)
        state = after
    (wanted,) = kept._waiting
    bundle = wanted.bundle({}, ())
    first = bundle.windows[0].window.index
    assert [item.window.index for item in bundle.windows] == list(range(first, count))
    assert min(count, 16) <= len(bundle.windows) <= 32
    assert bundle.state.learned == max(first - 1, 0)
    assert [item.window.index for item in bundle.windows if item.state is not None] == ([0] if first == 0 else [])


def test_large_windows_are_fewer(batch: list[Window], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "MAX_WINDOW_BYTES", 3 * batch[0].values.nbytes)
    kept, state = writer(folder), fresh()
    for window in batch:
        add(kept, state, window, _report(), state)
    assert len((*kept._older, *kept._newer)) <= 6


@cache
def _report() -> Report:
    return adapt(fresh(), Window.whole(0, 0.0, PERIOD, tuple(SIGNALS), np.zeros((20, 4))))[1]


def fill(kept: EvidenceWriter, bundles: list[Path], count: int) -> None:
    """Request ``count`` bundles like the last one of ``bundles``, and write each."""
    read = read_bundle(bundles[-1])
    steps, before = [], read.state
    for item in read.windows:
        before = item.state or before
        after, report = adapt(before, item.window)
        steps.append((before, item.window, report, after))
        before = after
    for number in range(count):
        for step in steps if number == 0 else steps[-1:]:
            add(kept, *step)
        kept.write()


def test_the_oldest_bundles_are_deleted_for_new_ones(bundles: list[Path], folder: Path) -> None:
    others = [folder / "demo.dc-motor-2-000001-20260101T000000.zip", folder / "notes.zip"]
    for path in others:
        path.write_bytes(b"x" * 1_000_000)
    size = bundles[-1].stat().st_size
    fill(writer(folder, 3 * size), bundles, 6)
    own = sorted(set(folder.glob("*.zip")) - set(others))
    assert own[-1].name.startswith(f"{KEY}-000006-")
    assert 1 <= len(own) < 6
    assert sum(path.stat().st_size for path in own) <= 3 * size
    assert all(path.exists() for path in others)
    assert own[-1].stat().st_mode & 0o777 == 0o600


def test_a_machine_has_a_greatest_number_of_bundles(
    bundles: list[Path], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence, "MAX_BUNDLES", 2)
    fill(writer(folder), bundles, 4)
    assert [path.name[len(KEY) + 1 :][:6] for path in sorted(folder.glob("*.zip"))] == ["000003", "000004"]


def test_without_a_budget_nothing_is_kept(bundles: list[Path], folder: Path) -> None:
    fill(writer(folder, 0), bundles, 1)
    assert list(folder.iterdir()) == []


def test_a_bundle_that_is_too_large_is_counted(
    batch: list[Window], folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, kept = fresh(), writer(folder, 1000)
    report = _raised(_report())
    add(kept, state, batch[0], report, state)
    kept.write()
    assert "more than all may take" in caplog.text
    monkeypatch.setattr(evidence, "MAX_EVIDENCE_BYTES", 1000)
    add(kept, state, batch[0], report, state)
    kept.write()
    assert "more than 1000 bytes" in caplog.text
    assert (kept.dropped, list(folder.iterdir())) == (2, [])


def test_a_full_disk_is_logged_once_and_the_bundle_is_written_later(
    bundles: list[Path], folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(evidence, "MIN_WINDOWS", 3)
    kept = writer(folder)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        kept.start()
        with pytest.raises(OtolithError):
            fill(kept, bundles, 1)
        wait_for(lambda: bool(caplog.records))
        assert list(folder.iterdir()) == []
    kept.stop(PATIENCE)
    (path,) = folder.glob("*.zip")
    assert reproduce(path).return_value == 0
    levels = [record.levelno for record in caplog.records if record.levelno > logging.INFO]
    assert levels == [logging.WARNING]


def test_what_waits_for_the_disk_is_bounded(batch: list[Window], folder: Path) -> None:
    kept, state = writer(folder), fresh()
    report = _raised(_report())
    for _ in range(MAX_WAITING_BUNDLES + 3):
        add(kept, state, batch[0], report, state)
    assert kept.dropped == 3


def _raised(report: Report) -> Report:
    events = (event(0, 1.0, EventChange.RAISED),)
    return replace(report, document=report.document.model_copy(update={"events": events}))


def test_a_writer_that_is_killed_leaves_no_bundle(bundles: list[Path], folder: Path) -> None:
    script = (
        "import os, signal, sys; from pathlib import Path; from otolith.storage.disk import replace_file;"
        "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL);"
        f"replace_file(Path({str(folder)!r}) / '{KEY}-000001-20260101T000000.zip', b'torn', '{KEY}.new')"
    )
    killed = subprocess.run([sys.executable, "-c", script], check=False)
    assert killed.returncode == -signal.SIGKILL
    assert [path.name for path in folder.iterdir()] == [f"{KEY}.new"]
    fill(writer(folder), bundles, 1)
    (path,) = folder.iterdir()
    assert read_bundle(path).windows


def changed(path: Path, folder: Path, change: Callable[[dict[str, Any]], None], **members: str) -> Path:
    """Return a copy of a bundle with a changed ``evidence.json``, and with other texts of the named members."""
    target = folder / "changed.zip"
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in source.namelist():
            content = source.read(name).decode()
            if name == EVIDENCE:
                document = json.loads(content)
                change(document)
                content = json.dumps(document)
            archive.writestr(name, members.get(name.replace(".", "_"), content))
    return target


def test_a_report_that_differs_is_shown_with_its_place(bundles: list[Path], folder: Path) -> None:
    def forge(document: dict[str, Any]) -> None:
        step = document["windows"][1]
        report = json.loads(step["report"])
        report["parameters"]["R_a"]["value"] += 1e-15
        step["report"] = json.dumps(report, separators=(",", ":"), ensure_ascii=False)
        document["versions"]["numpy"] = "1.0\x1b[31m"

    result = reproduce(changed(bundles[-1], folder, forge))
    assert result.return_value == 1
    assert "not the same: window " in result.stdout
    assert "parameters.R_a.value: " in result.stdout
    assert "other versions here, on which the last bits may depend: numpy " in result.stdout
    assert "\x1b" not in result.stdout + result.stderr


@pytest.mark.parametrize("text", ["", "[", "{}", "[" * 100_000])
def test_a_forged_report_is_no_reproduction(bundles: list[Path], folder: Path, text: str) -> None:
    result = reproduce(changed(bundles[-1], folder, _set("windows", 0, "report", value=text)))
    assert (result.exception, result.return_value) == (None, 1)


def test_times_that_no_clock_has_are_shown(bundles: list[Path], folder: Path) -> None:
    for time_of in (1e300, -1e300, float("nan"), float("inf")):
        result = reproduce(changed(bundles[-1], folder, _set("windows", 0, "window", "start", value=time_of)))
        assert (result.exception, result.return_value) == (None, 1)


def _set(*place: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: Any) -> None:
        for key in place[:-1]:
            document = document[key]
        document[place[-1]] = value

    return change


FIRST = ("state",)
NO_NUMBERS = {"type": "<f8", "shape": [0], "order": "C", "bits": ""}
FORGED = {
    "another version": _set("version", value=99),
    "no version": lambda document: document.pop("version"),
    "an unknown key": _set("unknown", value=1),
    "an unmeasured input that the twin has not": _set(
        "unmeasured", value=[{"name": "no", "assumption": "constant", "expression": ""}]
    ),
    "an unmeasured input without an expression": _set(
        "unmeasured", value=[{"name": "T_load", "assumption": "proportional", "expression": ""}]
    ),
    "no windows": _set("windows", value=[]),
    "no state": _set("state", value=None),
    "a state of another type": _set(*FIRST, value=[1, 2]),
    "a field that does not exist": _set(*FIRST, "__class__", value="os.system"),
    "a text for a number": _set(*FIRST, "learned", value="1"),
    "a boolean for a number": _set(*FIRST, "records", value=True),
    "a reference to nothing": _set(*FIRST, "posterior", value={"=": 10**6}),
    "a reference to another type": _set("windows", 1, "window", value={"=": 0}),
    "a filter of another size": _set(*FIRST, "posterior", "belief", "mean", "shape", value=[1, 4]),
    "numbers that are no digits": _set(*FIRST, "posterior", "belief", "mean", "bits", value="xy"),
    "numbers of objects": _set(*FIRST, "posterior", "belief", "mean", "type", value="|O"),
    "noise of no sensor": _set(*FIRST, "posterior", "problem", "noise", value=[]),
    "signals of another machine": _set("windows", 0, "window", "signals", value=["a", "b", "c", "d"]),
    "a window without records": _set("windows", 0, "window", "values", "shape", value=[0, 4]),
    "records without times": _set("windows", 0, "window", "grid", "offsets", value=NO_NUMBERS),
}  # fmt: skip


@pytest.mark.parametrize("fault", FORGED)
def test_a_forged_bundle_gives_one_line(bundles: list[Path], folder: Path, fault: str) -> None:
    with pytest.raises(ConfigurationError) as raised:
        read_bundle(changed(bundles[-1], folder, FORGED[fault]))
    assert "no evidence that this Otolith can use, or damaged: " in str(raised.value)
    assert "\n" not in str(raised.value)


def archive_of(**members: bytes) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return packed.getvalue()


DAMAGED: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda _: b"",
    "text": lambda _: b"hello\n" * 100,
    "torn": lambda data: data[: len(data) // 2],
    "a bit": lambda data: data[: len(data) // 2] + bytes([data[len(data) // 2] ^ 1]) + data[len(data) // 2 + 1 :],
    "encrypted": lambda data: re.sub(b"(PK\x01\x02.{4})\x00", b"\\1\x01", data, flags=re.DOTALL),
    "a bomb": lambda _: archive_of(**{EVIDENCE: b"0" * (65 << 20), TWIN: b""}),
    "nested": lambda _: archive_of(**{EVIDENCE: b"[" * 1_000_000, TWIN: b""}),
    "a path": lambda _: archive_of(**{"../../../evidence.json": b"{}", "/tmp/twin.toml": b""}),  # noqa: S108
    "no text": lambda _: archive_of(**{EVIDENCE: b"\xff\xfe", TWIN: b""}),
    "a long number": lambda _: archive_of(**{EVIDENCE: b"9" * 10_000, TWIN: b""}),
}


@pytest.mark.parametrize("fault", DAMAGED)
def test_a_damaged_bundle_gives_one_line(bundles: list[Path], folder: Path, fault: str) -> None:
    path = folder / "damaged.zip"
    path.write_bytes(DAMAGED[fault](bundles[-1].read_bytes()))
    with pytest.raises(ConfigurationError) as raised:
        read_bundle(path)
    assert str(raised.value).startswith(f"{path}: no evidence that this Otolith can use, or damaged: ")
    assert "\n" not in str(raised.value)
    assert list(folder.iterdir()) == [path]


def test_a_packing_that_unpacks_without_a_bound_is_refused(folder: Path) -> None:
    path, size = folder / "bomb.zip", 3 * evidence.MAX_EVIDENCE_BYTES
    with zipfile.ZipFile(path, "w", zipfile.ZIP_BZIP2) as archive:
        archive.writestr(EVIDENCE, b"0" * size)
        archive.writestr(TWIN, b"")
        archive.getinfo(EVIDENCE).file_size = 100
    tracemalloc.start()
    with raises_saying(ConfigurationError, "bomb.zip", EVIDENCE, "deflate"):
        read_bundle(path)
    assert tracemalloc.get_traced_memory()[1] < size / 2  # a file is read into a buffer of its largest size
    tracemalloc.stop()


def test_a_forged_twin_is_not_run(bundles: list[Path], folder: Path) -> None:
    with zipfile.ZipFile(bundles[-1]) as archive:
        twin = archive.read(TWIN).decode()
    forged = twin.replace("(V_a", "(__import__('os').system('x')", 1)
    assert forged != twin
    path = changed(bundles[-1], folder, lambda _: None, twin_toml=forged)
    with pytest.raises(ConfigurationError) as raised:
        read_bundle(path)
    assert "\n" not in str(raised.value)


def test_a_bundle_that_is_missing_or_too_large_gives_one_line(folder: Path) -> None:
    for path, reason in ((folder / "none.zip", "cannot be read"), (Path("/dev/zero"), "larger than")):
        with pytest.raises(ConfigurationError, match=reason):
            read_bundle(path)


def test_the_machine_file_in_a_bundle_has_no_secrets() -> None:
    text = (EXAMPLES / "dc-motor.toml").read_text(encoding="utf-8")
    driver = """[driver]
user = "SECRET"
password = "SECRET" # SECRET
api_token = "SECRET"
key = "SECRET"
list = [{ pass = "SECRET", x = 1.5 }]"""
    text = text.replace("[driver]", driver, 1) + '\n[zenoh.access]\npasswords = "SECRET"\n'
    text += '[outlets.webhook]\nurl = "https://example.org/SECRET"\n'
    text = text.replace("[machine]", '[machine]\non_event = ["/bin/x", "--token", "SECRET"]', 1)
    public = public_text(tomllib.loads(text))
    assert "SECRET" not in public
    read = tomllib.loads(public)
    assert read["driver"] == {"type": "can", "dbc": "dc-motor.dbc"}
    assert read["parameters"] == tomllib.loads(text)["parameters"]


def test_any_letters_of_a_machine_file_are_kept() -> None:
    tables = {"signals": {"i": {"topic": "M\u00fchle/\U0001f600", "field": 'a"b\\c\n'}}}
    assert tomllib.loads(public_text(tables)) == tables


def test_the_files_of_a_bundle_are_those_of_the_machine(bundles: list[Path], folder: Path) -> None:
    with zipfile.ZipFile(bundles[-1]) as archive:
        assert set(archive.namelist()) == {EVIDENCE, MACHINE, TWIN}
        archive.extractall(folder)
    read = load_machine(folder / MACHINE, with_driver=False)
    assert (read.problem, read.plan, read.twin) == (FILE.problem, FILE.plan, FILE.twin)


@pytest.mark.parametrize("kind", ["files", "values", "depth"])
def test_a_small_bundle_is_little_work(folder: Path, kind: str) -> None:
    path = folder / "small.zip"
    content = {"files": "{}", "values": f"[{'[],' * 10_000_000}1]", "depth": "[" * 10_000_000}[kind]
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(EVIDENCE, content)
        archive.writestr(TWIN, "")
        for number in range(100 if kind == "files" else 0):
            archive.writestr(f"{number}", "")
    begin = time.process_time()
    with pytest.raises(ConfigurationError) as raised:
        read_bundle(path)
    assert str(raised.value).startswith(f"{path}: ")
    assert {"files": "files", "values": "values", "depth": "values"}[kind] in str(raised.value)
    assert time.process_time() - begin < 2.0


@pytest.mark.parametrize(
    ("key", "change", "expected"),
    [
        ("limit/R_a", EventChange.RAISED, True),
        ("component/shaft/periodic", EventChange.CLEARED, True),
        ("limit/R_a", EventChange.ACKNOWLEDGED, False),
        ("limit/R_a", EventChange.UNSHELVED, False),
        ("source/encoder", EventChange.RAISED, False),
        ("data", EventChange.RAISED, False),
        ("output/history", EventChange.CLEARED, False),
    ],
)
def test_only_what_was_computed_has_evidence(key: str, change: EventChange, expected: bool) -> None:
    changed = event(0, 1.0, change).model_copy(update={"id": f"{key}@1.0"})
    assert has_evidence(changed) == expected
