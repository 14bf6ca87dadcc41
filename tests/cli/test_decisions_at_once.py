"""Two commands at once: neither loses what the other has decided."""

import fcntl
import math
import os
from collections.abc import Callable
from dataclasses import replace

import pytest

from otolith.adaptation.state import OperatorDecisions, initial_state
from otolith.cli.commissioning.commission import _decide
from otolith.health.events import HealthState
from otolith.health.notes import Deed, OperatorNote
from otolith.machine import load_machine
from otolith.storage.decisions import DecisionsFile
from otolith.storage.state_store import StateStore, store_of
from tests.cli.commands import otolith
from tests.cli.replays import MACHINE
from tests.health.test_baseline import HEALTHY, history

KEY = "shaft/periodic/t"
COMMANDS: dict[str, tuple[Callable[[StateStore], object], Callable[[OperatorDecisions], bool]]] = {
    "baseline": (lambda _: otolith("baseline", MACHINE), lambda after: math.isclose(after.baselines["R_a"].value, 7.0)),
    "clear": (lambda _: otolith("baseline", MACHINE, "--clear"), lambda after: not after.baselines),
    "reset": (lambda _: otolith("reset", MACHINE, "R_a"), lambda after: "R_a" in after.resets),
    "reject": (lambda _: otolith("components", "reject", MACHINE, KEY), lambda after: KEY in after.rejected),
    "commission": (lambda store: _decide(store, set(), {"other"}), lambda after: "other" in after.rejected),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_note_that_comes_while_a_command_decides_is_kept(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A person acknowledges an event as soon as the command has read the decisions, if the file is not locked."""
    machine = load_machine(MACHINE, with_driver=False)
    store = store_of(machine)
    names, health = machine.file.machine, HealthState(histories={"R_a": history(7.0, 50)})
    store.save(replace(initial_state(names.name, names.site, machine.problem, machine.plan), health=health))
    store.operator.write(OperatorDecisions(approved=frozenset({KEY}), baselines={"R_a": HEALTHY}))
    read, given = DecisionsFile.read, list[OperatorNote]()

    def read_and_note(file: DecisionsFile) -> OperatorDecisions:
        decisions = read(file)
        folder = os.open(file.path.parent, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
            given.append(OperatorNote(id=f"{len(given)}", deed=Deed.ACKNOWLEDGE, event="e@1", by="anna", at=1.0))
            file.write(replace(read(file), notes=tuple(given)))
        except BlockingIOError:
            pass  # the command has the lock: the person waits for it
        finally:
            os.close(folder)
        return decisions

    run, is_decided = COMMANDS[name]
    with monkeypatch.context() as patch:
        patch.setattr(DecisionsFile, "read", read_and_note)
        run(store)
    after = store.decisions()
    assert is_decided(after)
    assert after.notes == tuple(given)
