"""``otolith components`` and ``otolith commission``: the specialist's word, kept over restarts."""

import io
import json
import math
import tomllib
from pathlib import Path

import click
import numpy as np
import pytest
from benchmarks.discovery.motor import SIGNALS, Faults, simulate_motor
from click.testing import CliRunner, Result

from otolith.adaptation.state import OperatorDecisions, apply_decisions, initial_state, restore_components
from otolith.cli.main import cli
from otolith.machine import load_machine
from otolith.runtime.state_store import StateStore
from otolith_drivers.errors import ConfigurationError
from tests.cli.replays import MACHINE
from tests.conftest import EXAMPLES

KEY = "shaft/periodic/angle(omega)"


def torque(t: float, angle: float, *_: float) -> float:
    return 0.004 * math.sin(angle)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motor that has always been a little out of balance."""
    told = simulate_motor("sweep", 24.0, Faults(torque=torque), seed=5)
    path = tmp_path_factory.mktemp("data") / "healthy.csv"
    table = np.column_stack([0.01 * np.arange(len(told)), told])
    np.savetxt(path, table, delimiter=",", header="t," + ",".join(SIGNALS), comments="", fmt="%.9g")
    return path


def otolith(*arguments: str | Path, said: str = "") -> Result:
    return CliRunner().invoke(cli, list(map(str, arguments)), input=said, catch_exceptions=False, standalone_mode=False)


def test_what_was_found_in_other_signals_is_not_believed(data: Path) -> None:
    """A unit that was wrong, and is put right, must not leave behind what it made the daemon find."""
    assert otolith("commission", MACHINE, data, "--windows", "8", said="y\n").exit_code == 0
    plan = load_machine(MACHINE, with_driver=False)
    names, folder, found = (
        (plan.file.machine.site, plan.file.machine.name),
        keeper().known.parent,
        keeper().components(),
    )
    StateStore(*names, plan.twin, folder, "before").keep(found)
    assert StateStore(*names, plan.twin, folder, "before").components() == found
    assert StateStore(*names, plan.twin, folder, "after").components() == ()


def test_a_plan_knows_how_its_signals_are_said(tmp_path: Path) -> None:
    """Scale, unit and place matter; over which wire they come does not."""
    text = (EXAMPLES / "dc-motor-modbus.toml").read_text(encoding="utf-8")
    heard = []
    changes = {"": "", "port = 1502": "port = 1503", 'unit = "A"': 'unit = "mA"', "register = 4": "register = 5"}
    for old, new in changes.items():
        path = tmp_path / "machine.toml"
        path.write_text(text.replace(old, new) if old else text, encoding="utf-8")
        heard.append(load_machine(path, with_driver=False).signal_fingerprint)
    assert heard[0] == heard[1]
    assert len(set(heard)) == 3


def keeper() -> StateStore:
    plan = load_machine(MACHINE, with_driver=False)
    return StateStore(plan.file.machine.site, plan.file.machine.name, plan.twin)


def test_what_belongs_to_the_machine_is_learned_and_obeyed(data: Path) -> None:
    asked = otolith("commission", MACHINE, data, "--windows", "8", said="y\n")
    assert "noise" in tomllib.loads(asked.stdout)  # nothing else goes where it may be redirected into the file
    assert f"found {KEY}: 0.0040" in asked.stderr or f"found {KEY}: 0.0039" in asked.stderr
    assert KEY in keeper().decisions().approved

    listed = otolith("components", "list", MACHINE)
    assert KEY in listed.stdout
    assert "approved" in listed.stdout
    document = json.loads(otolith("components", "list", MACHINE, "--json").stdout)
    assert document["approved"] == [KEY]
    assert document["components"][0]["adopted"]["component"]["family"] == "periodic"

    plan = load_machine(MACHINE, with_driver=False)
    state = apply_decisions(
        restore_components(initial_state("m", "s", plan.problem), keeper().components()), keeper().decisions()
    )
    assert [entry.key for entry in state.problem.components] == [KEY]

    otolith("components", "reject", MACHINE, KEY)
    assert keeper().decisions() == OperatorDecisions(rejected=frozenset({KEY}))
    state = apply_decisions(
        restore_components(initial_state("m", "s", plan.problem), keeper().components()), keeper().decisions()
    )
    assert state.problem.components == ()
    assert KEY in state.problem.excluded

    otolith("components", "forget", MACHINE, KEY)
    assert not keeper().decisions().rejected
    assert KEY in keeper().decisions().forgotten


def test_a_question_that_nobody_answers_keeps_nothing_and_says_so(
    data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())
    with pytest.raises(click.Abort):
        cli.main(["commission", str(MACHINE), str(data), "--windows", "4"], standalone_mode=False)
    assert "nothing is kept" in capsys.readouterr().err
    assert keeper().decisions() == OperatorDecisions()
    assert keeper().components() == ()


def test_what_nobody_has_heard_of_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="no component 'shaft/periodic'"):
        otolith("components", "approve", MACHINE, "shaft/periodic")


def test_a_machine_without_components_says_so() -> None:
    assert "no component has been found" in otolith("components", "list", MACHINE).output


def test_a_file_that_is_not_ours_is_refused_by_name() -> None:
    one = keeper()
    one.known.parent.mkdir(parents=True, exist_ok=True)
    one.known.write_text('{"version": 1, "twin": "dc_motor", "components": [{}]}', encoding="utf-8")
    with pytest.raises(ConfigurationError, match=r"components.0.adopted.*move it away"):
        one.components()
    one.said.write_text("half a fi", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=one.said.name):
        one.decisions()


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ('families = ["periodik"]', "'periodik' is none of them"),
        ('sites = ["shfat"]', "shaft"),
        ('inputs = ["angle(i)"]', "angle.omega."),
    ],
)
def test_a_restriction_that_cannot_be_meant_is_an_error(tmp_path: Path, line: str, word: str) -> None:
    machine = tmp_path / "machine.toml"
    machine.write_text(MACHINE.read_text(encoding="utf-8") + f"\n[discovery]\n{line}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=word):
        load_machine(machine, with_driver=False)


def test_a_restricted_search_leaves_the_rest_out(tmp_path: Path) -> None:
    machine = tmp_path / "machine.toml"
    text = MACHINE.read_text(encoding="utf-8") + '\n[discovery]\nfamilies = ["periodic"]\nsites = ["shaft"]\n'
    machine.write_text(text, encoding="utf-8")
    excluded = load_machine(machine, with_driver=False).problem.excluded
    assert KEY not in excluded
    assert "shaft/linear/omega" in excluded
    assert "winding/periodic/t" in excluded
