"""``otolith components`` and ``otolith commission``: decisions of the operator survive restarts."""

import io
import json
import math
import tomllib
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from benchmarks.discovery.motor import SIGNALS, Faults, simulate_motor

from otolith.adaptation.state import (
    AdaptationState,
    OperatorDecisions,
    apply_decisions,
    initial_state,
    restore_components,
)
from otolith.cli.commissioning import commission as command
from otolith.cli.commissioning.commission import asked as asked_about
from otolith.cli.main import cli
from otolith.estimation.problem import key_of
from otolith.machine import load_machine
from otolith.storage.state_store import StateStore
from otolith_drivers.errors import ConfigurationError, ServiceError
from otolith_drivers.user_dirs import state_directory
from tests.cli.commands import otolith
from tests.cli.replays import MACHINE
from tests.conftest import EXAMPLES
from tests.messages import raises_saying

KEY = "shaft/periodic/angle(omega)"
STDOUT, STDERR = "standard output", "standard error"


def torque(t: float, angle: float, *_: float) -> float:
    return 0.004 * math.sin(angle)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motor that has always been a little out of balance."""
    samples = simulate_motor("sweep", 24.0, Faults(torque=torque), seed=5)
    path = tmp_path_factory.mktemp("data") / "healthy.csv"
    table = np.column_stack([0.01 * np.arange(len(samples)), samples])
    np.savetxt(path, table, delimiter=",", header="t," + ",".join(SIGNALS), comments="", fmt="%.9g")
    return path


@pytest.fixture(scope="module")
def kept_files() -> dict[str, bytes]:
    """What a commissioning wrote, once one has run, as it needs the state directory of a test."""
    return {}


@pytest.fixture
def commissioned(data: Path, kept_files: dict[str, bytes]) -> tuple[str, str]:
    """Standard output and error of a commissioning that this test's state directory has the files of."""
    folder = store().components_path.parent
    if not kept_files:
        result = otolith("commission", MACHINE, data, "--windows", "8", answers="y\n")
        assert result.exit_code == 0
        kept_files.update({path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()})
        kept_files.update({STDOUT: result.stdout.encode(), STDERR: result.stderr.encode()})
    folder.mkdir(parents=True, exist_ok=True)
    for name in kept_files.keys() - {STDOUT, STDERR}:
        (folder / name).write_bytes(kept_files[name])
    return kept_files[STDOUT].decode(), kept_files[STDERR].decode()


@pytest.mark.full
@pytest.mark.usefixtures("commissioned")
def test_components_of_other_signals_are_not_restored() -> None:
    """Correcting a wrong unit must drop the components that it caused."""
    machine = load_machine(MACHINE, with_driver=False)
    names, folder = (machine.file.machine.site, machine.file.machine.name), store().components_path.parent
    records = store().components()
    StateStore(*names, machine.twin, folder, "before").save_components(records)
    assert StateStore(*names, machine.twin, folder, "before").components() == records
    assert StateStore(*names, machine.twin, folder, "after").components() == ()


def test_signal_fingerprint_depends_on_scale_unit_and_place(tmp_path: Path) -> None:
    """Neither the port of the same device matters, nor when its samples come."""
    text = (EXAMPLES / "dc-motor-modbus.toml").read_text(encoding="utf-8")
    fingerprints = []
    current = "register = 2, type"
    changes = {
        "": "",
        "port = 1502": "port = 1503",
        'unit = "A"': 'unit = "mA"',
        "register = 4": "register = 5",
        current: f'delay = "5 ms", {current}',
    }
    for old, new in changes.items():
        path = tmp_path / "machine.toml"
        path.write_text(text.replace(old, new) if old else text, encoding="utf-8")
        fingerprints.append(load_machine(path, with_driver=False).signal_fingerprint)
    assert fingerprints[0] == fingerprints[1]
    assert fingerprints[0] == fingerprints[4]
    assert len(set(fingerprints)) == 3


def store() -> StateStore:
    machine = load_machine(MACHINE, with_driver=False)
    return StateStore(machine.file.machine.site, machine.file.machine.name, machine.twin)


def test_commission_approve_reject_and_forget(commissioned: tuple[str, str]) -> None:
    lines, asked = commissioned
    assert "noise" in tomllib.loads(lines)  # only lines of a machine file go to standard output
    assert f"found {KEY}: 0.0040" in asked or f"found {KEY}: 0.0039" in asked
    assert KEY in store().decisions().approved

    listed = otolith("components", "list", MACHINE)
    assert KEY in listed.stdout
    assert "approved" in listed.stdout
    document = json.loads(otolith("components", "list", MACHINE, "--json").stdout)
    assert document["approved"] == [KEY]
    assert document["components"][0]["adopted"]["component"]["family"] == "periodic"

    machine = load_machine(MACHINE, with_driver=False)
    state = apply_decisions(
        restore_components(initial_state("m", "s", machine.problem), store().components()), store().decisions()
    )
    assert [component.key for component in state.problem.components] == [KEY]

    records = store().components()
    assert asked_about(machine, records, decide=lambda: None) == (set(), set())  # nobody was there to be asked
    assert asked_about(machine, records, decide=lambda: True) == ({KEY}, set())

    otolith("components", "reject", MACHINE, KEY)
    assert store().decisions() == OperatorDecisions(rejected=frozenset({KEY}))
    state = apply_decisions(
        restore_components(initial_state("m", "s", machine.problem), store().components()), store().decisions()
    )
    assert state.problem.components == ()
    assert KEY in state.problem.excluded

    otolith("components", "forget", MACHINE, KEY)
    assert not store().decisions().rejected
    assert KEY in store().decisions().forgotten


@pytest.mark.full
@pytest.mark.usefixtures("commissioned")
def test_a_replay_begins_with_the_approved_components_and_leaves_out_the_rejected_ones(data: Path) -> None:
    first = otolith("replay", MACHINE, data, "--json").stdout.splitlines()[0]
    (component,) = json.loads(first)["components"]
    assert (component["id"], component["approval"]) == (KEY, "approved")
    assert component["values"]["amplitude"]["value"] == pytest.approx(0.004, rel=0.1)
    otolith("components", "reject", MACHINE, KEY)
    documents = map(json.loads, otolith("replay", MACHINE, data, "--json").stdout.splitlines())
    assert not any(document["components"] for document in documents)


def test_commission_without_an_answer_keeps_nothing(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(click.Abort):
        cli.main(["commission", str(MACHINE), str(data), "--windows", "2"], standalone_mode=False)
    assert "nothing is kept" in capsys.readouterr().err
    assert store().decisions() == OperatorDecisions()
    assert store().components() == ()


def test_an_unknown_component_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no component 'shaft/periodic'"):
        otolith("components", "approve", MACHINE, "shaft/periodic")


def test_list_of_a_machine_without_components() -> None:
    assert "no component has been found" in otolith("components", "list", MACHINE).output


def test_an_invalid_state_file_is_refused_by_name() -> None:
    files = store()
    files.components_path.parent.mkdir(parents=True, exist_ok=True)
    files.components_path.write_text('{"version": 1, "twin": "dc_motor", "components": [{}]}', encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"components.0.adopted.*move the file away"):
        files.components()
    files.decisions_path.write_text("half a fi", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=files.decisions_path.name):
        files.decisions()


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ('families = ["periodik"]', "unknown name 'periodik'"),
        ('sites = ["shfat"]', "shaft"),
        ('inputs = ["angle(i)"]', "angle.omega."),
        ('sensors = ["omeag"]', "omega"),
    ],
)
def test_an_invalid_restriction_of_the_search_is_an_error(tmp_path: Path, line: str, word: str) -> None:
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.read_text(encoding="utf-8") + f"\n[discovery]\n{line}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=word):
        load_machine(machine, with_driver=False)


def test_a_restricted_search_excludes_the_rest(tmp_path: Path) -> None:
    machine = tmp_path / "machine.toml"
    text = MACHINE.read_text(encoding="utf-8") + '\n[discovery]\nfamilies = ["periodic"]\nsites = ["shaft"]\n'
    machine.write_text(text, encoding="utf-8")
    excluded = load_machine(machine, with_driver=False).problem.excluded
    assert KEY not in excluded
    assert "shaft/linear/omega" in excluded
    assert "winding/periodic/t" in excluded
    assert not any(key.startswith("sensor of") for key in excluded)


def test_a_sensor_that_cannot_be_wrong_is_no_hypothesis(tmp_path: Path) -> None:
    machine = tmp_path / "machine.toml"
    text = MACHINE.read_text(encoding="utf-8") + '\n[discovery]\nsensors = ["i"]\n'
    machine.write_text(text, encoding="utf-8")
    excluded = load_machine(machine, with_driver=False).problem.excluded
    assert {key_of("sensor of omega", "constant", ""), key_of("sensor of V_a", "linear", "V_a")} <= excluded
    places = {key.partition("/")[0] for key in excluded}
    assert all(place.startswith(("sensor of ", "gain of ")) for place in places)
    assert "gain of omega" in places
    assert "sensor of i" not in places


@pytest.mark.usefixtures("commissioned")
def test_reset_records_what_to_forget_and_keeps_decisions() -> None:
    shown = otolith("reset", MACHINE, "R_a", KEY, "--dry-run").stdout
    assert shown.splitlines() == ["R_a would be forgotten", f"{KEY} would be forgotten"]
    assert not store().decisions().resets
    assert otolith("reset", MACHINE, "R_a", KEY).exit_code == 0
    decisions = store().decisions()
    assert decisions.resets.keys() == {"R_a", KEY}
    assert decisions.approved == {KEY}
    assert (
        len(otolith("reset", MACHINE).stdout.splitlines())
        == len(load_machine(MACHINE, with_driver=False).problem.free) + 1
    )
    assert store().decisions().resets.keys() == {"R_a", KEY, "*"}
    machine = load_machine(MACHINE, with_driver=False)
    warm, note = store().restore(initial_state("m", "s", machine.problem))
    assert note == ""
    assert [component.key for component in warm.problem.components] == [KEY]
    assert apply_decisions(warm, store().decisions()).problem.components == ()


def test_reset_of_an_unknown_name_names_the_nearest() -> None:
    with raises_saying(ConfigurationError, "'R_b'", "'R_a'"):
        otolith("reset", MACHINE, "R_b")


def test_reset_works_where_the_saved_state_is_damaged() -> None:
    files = store()
    files.components_path.parent.mkdir(parents=True, exist_ok=True)
    files.components_path.write_text("half a fi", encoding="utf-8")
    result = otolith("reset", MACHINE)
    assert "components cannot be named" in result.stderr
    assert store().decisions().resets.keys() == {"*"}


@pytest.mark.full
@pytest.mark.parametrize(("share", "replays"), [(1.0, 2), (0.005, 1)])
def test_commission_replays_with_the_levels_of_the_file_unless_they_explain_no_window(
    share: float, replays: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each window of a replay that explains none is searched in vain, which takes ten times as long."""
    file, data, count, replayed = tmp_path / "machine.toml", tmp_path / "healthy.csv", [0], command._replayed
    text = MACHINE.read_text(encoding="utf-8").replace('"5 mA"', f'"{5 * share} mA"')
    file.write_text(text.replace('"0.02 rad/s"', f'"{0.02 * share} rad/s"'), encoding="utf-8")
    samples = simulate_motor("sweep", 12.0, Faults(), seed=5)
    times = 0.01 * np.arange(len(samples))[:, None]
    np.savetxt(data, np.hstack([times, samples]), delimiter=",", header="t," + ",".join(SIGNALS), comments="")

    def counting(*arguments: Any) -> tuple[AdaptationState, dict[str, str]]:
        count[0] += 1
        return replayed(*arguments)

    monkeypatch.setattr(command, "_replayed", counting)
    assert otolith("commission", file, data).exit_code == 0
    assert count == [replays]


@pytest.mark.usefixtures("commissioned")
def test_commission_keeps_what_was_learned_before_beside(data: Path) -> None:
    result = otolith("commission", MACHINE, data, "--windows", "2", answers="y\n")
    (kept,) = store().components_path.parent.glob("*.kept.json")
    assert f"what was learned before is kept as {kept}" in result.stderr


def test_commission_refuses_while_a_daemon_runs(data: Path) -> None:
    with store().locked(), pytest.raises(ServiceError, match="already uses its state: stop it"):
        otolith("commission", MACHINE, data)


def test_who_only_reads_writes_nothing() -> None:
    """A copy of a state directory, or one on a read-only disk, can be read."""
    assert otolith("components", "list", MACHINE).exit_code == 0
    assert not state_directory().exists()
