"""State store and writer thread, with real files and with a disk that does not answer."""

import errno
import os
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest

from otolith.adaptation.packed_state import PackedState
from otolith.adaptation.state import (
    AdaptationState,
    ComponentRecord,
    OperatorDecisions,
    component_records,
    initial_state,
    restore_components,
)
from otolith.discovery.decision import AdoptedComponent
from otolith.estimation.problem import Component
from otolith.machine import load_machine
from otolith.storage.state_store import LockedError, StateStore, StateWriter
from otolith_drivers.errors import ConfigurationError, OtolithError, ServiceError
from otolith_drivers.user_dirs import writable
from tests.cli.replays import MACHINE
from tests.messages import raises_saying
from tests.waiting import PATIENCE, wait_for, within

FRICTION = Component("shaft", "Coulomb", "omega", -0.004, inner=0.1, low=0.05, high=1.0)
PROBLEM = load_machine(MACHINE, with_driver=False).problem
IMMEDIATELY = within(0.1)  # s: far less than a disk that does not answer


def with_friction(amplitude: float) -> AdaptationState:
    """Return a state with dry friction of ``amplitude`` (N·m)."""
    record = ComponentRecord(AdoptedComponent(FRICTION, 5.0), (amplitude, 0.1), (1e-5, 1e-3))
    return restore_components(initial_state("motor", "here", PROBLEM), (record,))


STATE = with_friction(-0.004)
SAVED = component_records(STATE)


@pytest.fixture
def store(tmp_path: Path) -> StateStore:
    return StateStore("here", "motor", PROBLEM.base_model, tmp_path / "components")


@pytest.fixture
def writer(store: StateStore) -> Iterator[StateWriter]:
    thread = StateWriter(store, store.operator.time())
    thread.start()
    yield thread
    thread.stop(1.0)


def test_the_latest_components_are_on_disk_after_stop(store: StateStore, writer: StateWriter) -> None:
    for amplitude in (-0.001, -0.002, -0.003, -0.004):
        writer.save(PackedState.of(with_friction(amplitude)))
    writer.stop(PATIENCE)
    assert store.components() == SAVED


def test_every_change_of_decisions_is_returned_once(store: StateStore, writer: StateWriter) -> None:
    assert writer.new_decisions() is None
    key = frozenset({FRICTION.key})
    for decisions in (OperatorDecisions(approved=key), OperatorDecisions(rejected=key)):
        store.operator.write(decisions)
        received: list[OperatorDecisions] = []

        def has_changed(received: list[OperatorDecisions] = received) -> bool:
            change = writer.new_decisions()
            received.extend([] if change is None else [change])
            return bool(received)

        wait_for(has_changed)
        assert received == [decisions]
        assert writer.new_decisions() is None


def test_decisions_known_at_the_start_are_not_returned(store: StateStore) -> None:
    store.operator.write(OperatorDecisions(approved=frozenset({FRICTION.key})))
    writer = StateWriter(store, store.operator.time())
    writer.start()
    writer.save(PackedState.of(STATE))
    wait_for(store.components_path.exists)
    writer.stop(PATIENCE)
    assert writer.new_decisions() is None


@pytest.mark.timed
def test_callers_do_not_wait_for_a_disk_that_hangs(
    store: StateStore, writer: StateWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_read, answers = threading.Event(), threading.Event()

    def hang() -> OperatorDecisions:
        is_read.set()
        answers.wait(PATIENCE)
        return OperatorDecisions()

    store.operator.write(OperatorDecisions())
    monkeypatch.setattr(store, "decisions", hang)
    assert is_read.wait(PATIENCE)
    begun = time.monotonic()
    writer.save(PackedState.of(STATE))
    assert writer.new_decisions() is None
    assert time.monotonic() - begun < IMMEDIATELY
    writer.stop(0.2)
    assert time.monotonic() - begun < 0.2 + IMMEDIATELY
    assert not store.components_path.exists()
    answers.set()
    wait_for(store.components_path.exists)  # written late, but not lost
    assert store.components() == SAVED


@pytest.mark.parametrize("other", ["pipe", "device", "folder"])
def test_what_is_no_file_in_the_place_of_a_file_is_refused(store: StateStore, other: str) -> None:
    """A pipe, above all, must not block the daemon at its start."""
    store.components_path.parent.mkdir()
    for path in (store.components_path, store.decisions_path):
        if other == "pipe":
            os.mkfifo(path)
        elif other == "device":
            path.symlink_to("/dev/zero")
        else:
            path.mkdir()
    initial = with_friction(-0.003)
    state, note = store.restore(initial)
    assert state is initial
    assert "not a file; the file is kept as" in note
    with pytest.raises(ConfigurationError, match="not a file"):
        store.decisions()
    store.save(STATE)
    assert store.components() == SAVED


def test_a_failed_write_is_tried_again_and_logged_once(
    store: StateStore, writer: StateWriter, caplog: pytest.LogCaptureFixture
) -> None:
    folder = store.components_path.parent
    folder.write_text("a file where a folder should be", encoding="utf-8")
    writer.save(PackedState.of(STATE))
    wait_for(lambda: "what was learned is not saved" in caplog.text)
    folder.unlink()
    writer.stop(PATIENCE)
    assert store.components() == SAVED
    assert caplog.text.count("what was learned is not saved") == 1


def test_no_error_ends_the_thread_and_decisions_are_read_after_it(
    store: StateStore, writer: StateWriter, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(_: AdaptationState) -> None:
        raise MemoryError

    with monkeypatch.context() as patch:
        patch.setattr(store, "save", fail)
        writer.save(PackedState.of(STATE))
        wait_for(lambda: "what was learned is not saved: MemoryError" in caplog.text)
        store.operator.write(OperatorDecisions(approved=frozenset({FRICTION.key})))
        wait_for(lambda: writer.new_decisions() is not None)
    writer.stop(PATIENCE)
    assert store.components() == SAVED


def test_a_state_directory_that_can_be_used_later_is_used_then(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("otolith.storage.disk.WRITE_RETRY", 0.0)
    folder = tmp_path / "components"
    StateStore("here", "motor", PROBLEM.base_model, folder).save(with_friction(-0.001))
    folder.rename(tmp_path / "away")
    folder.write_text("as a disk that is not there yet")
    store = StateStore("here", "motor", PROBLEM.base_model, folder)
    with pytest.raises(ServiceError) as raised:
        store.lock_or_later()
    writer = StateWriter(store, 0.0)
    writer.fail(raised.value)
    writer.start()
    writer.save(PackedState.of(with_friction(-0.002)))
    wait_for(lambda: str(folder) in writer.outage)
    folder.unlink()
    (tmp_path / "away").rename(folder)
    wait_for(lambda: not writer.outage and not writer._unsaved and not writer._to_save)
    with pytest.raises(LockedError):
        StateStore("here", "motor", PROBLEM.base_model, folder).lock()
    writer.stop(PATIENCE)
    (kept,) = folder.glob("*.kept.json")
    assert kept.name in caplog.text
    assert "-0.002" in store.components_path.read_text()
    assert "-0.001" in kept.read_text()
    store.unlock()


def test_another_process_that_came_first_ends_who_waited_for_the_directory(tmp_path: Path) -> None:
    folder = tmp_path / "components"
    folder.write_text("")
    store = StateStore("here", "motor", PROBLEM.base_model, folder)
    with pytest.raises(ServiceError):
        store.lock_or_later()
    folder.unlink()
    other = StateStore("here", "motor", PROBLEM.base_model, folder)
    other.lock()
    writer = StateWriter(store, 0.0)
    writer.save(PackedState.of(with_friction(-0.002)))
    writer.write()
    assert writer.locked_out is not None
    assert not other.components_path.exists()
    other.unlock()


def test_a_second_process_cannot_take_the_lock(store: StateStore) -> None:
    other = StateStore("here", "motor", PROBLEM.base_model, store.components_path.parent)
    with store.locked():
        with pytest.raises(ServiceError, match=f"motor at here: process {os.getpid()} of Otolith already uses"):
            other.lock()
        with pytest.raises(ServiceError, match="already uses"):
            other.save(STATE)
        store.save(STATE)
    other.lock()
    other.unlock()
    StateStore("here", "pump", PROBLEM.base_model, store.components_path.parent).lock()


def other_store(store: StateStore) -> StateStore:
    return StateStore("here", "motor", PROBLEM.base_model, store.components_path.parent)


def test_a_lock_whose_folder_was_removed_is_taken_again(store: StateStore, writer: StateWriter) -> None:
    """As by an operator who removes the state of a running daemon: a second one must not write the same files."""
    store.lock()
    shutil.rmtree(store.lock_path.parent, ignore_errors=True)  # the thread may make it again meanwhile
    wait_for(store.lock_path.exists)
    with pytest.raises(ServiceError, match="already uses"):
        other_store(store).lock()
    writer.stop(PATIENCE)  # it is the only thread that takes the lock again
    assert writer.locked_out is None
    shutil.rmtree(store.lock_path.parent)
    store.save(STATE)
    assert store.components() == SAVED
    with pytest.raises(ServiceError, match="already uses"):
        other_store(store).save(STATE)
    store.unlock()
    other_store(store).lock()


def test_who_finds_another_process_in_the_place_of_its_lock_writes_nothing(store: StateStore) -> None:
    store.lock()
    store.lock_path.unlink()
    with other_store(store).locked():
        writer = StateWriter(store, store.operator.time())
        writer.start()
        writer.save(PackedState.of(STATE))
        wait_for(lambda: writer.locked_out is not None)
        writer.stop(PATIENCE)
        assert f"process {os.getpid()} of Otolith already uses" in str(writer.locked_out)
    assert not store.components_path.exists()


def test_a_lock_file_that_is_a_link_is_refused(store: StateStore, tmp_path: Path) -> None:
    store.lock_path.parent.mkdir()
    store.lock_path.symlink_to(tmp_path / "other")
    with raises_saying(ServiceError, "locked", "link", "move it away"):
        store.lock()
    assert not (tmp_path / "other").exists()


def test_a_state_of_another_user_is_named_with_the_way_out(store: StateStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after a copy by root; monitoring without what was learned would be silent about it."""
    with store.locked():
        pass
    monkeypatch.setattr(os, "geteuid", lambda: store.lock_path.stat().st_uid + 1)
    monkeypatch.setattr(os, "open", Mock(side_effect=PermissionError(errno.EACCES, "Permission denied")))
    with raises_saying(ServiceError, "Permission denied", "belongs to user", "chown --recursive"):
        store.lock()
    monkeypatch.setattr(os, "access", lambda *_: False)
    with raises_saying(ServiceError, "not writable", "belongs to user", "chown"):
        writable(store.lock_path.parent)


def test_a_file_in_the_place_of_a_folder_is_named(store: StateStore) -> None:
    store.lock_path.parent.touch()
    with raises_saying(ServiceError, "components", "not a folder", "move it away"):
        store.lock()


def test_a_folder_in_the_place_of_a_temporary_file_is_named(store: StateStore) -> None:
    store.save(STATE)
    (store.components_path.parent / f"{store.components_path.name}.new").mkdir()
    with raises_saying(ServiceError, "here.motor.json.new", "folder", "remove"):
        store.save(with_friction(-0.001))
    assert store.components() == SAVED


def test_a_folder_that_must_not_be_searched_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the folder of another user: units and kernels are then not cached."""
    monkeypatch.setattr(Path, "exists", Mock(side_effect=PermissionError(errno.EACCES, "Permission denied")))
    monkeypatch.setattr(Path, "lstat", Mock(side_effect=PermissionError(errno.EACCES, "Permission denied")))
    with pytest.raises(ServiceError, match=r"cannot be created: Permission denied$"):
        writable(tmp_path / "closed" / "units")


def test_root_gives_the_open_file_to_the_owner_of_the_folder_and_never_a_path(
    store: StateStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon's user owns the folder and replaces what root is writing by a link, just before the owner changes."""
    victim, given = tmp_path / "victim", list[int]()
    victim.write_text("of root", encoding="utf-8")
    change_owner = os.fchown

    def swap_and_give(handle: int, user: int, group: int) -> None:
        for path in store.decisions_path.parent.glob("*.new"):
            path.unlink()
            path.symlink_to(victim)
        given.append(os.fstat(handle).st_ino)
        change_owner(handle, user, group)

    def refuse(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(os, "fchown", swap_and_give)
    monkeypatch.setattr(os, "chown", refuse)
    before = victim.stat()
    store.operator.write(OperatorDecisions(approved=frozenset({FRICTION.key})))
    assert given
    assert before.st_ino not in given
    assert (victim.stat().st_uid, victim.read_text(encoding="utf-8")) == (before.st_uid, "of root")


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give files away")
def test_what_root_writes_belongs_to_the_user_of_the_daemon(store: StateStore) -> None:
    folder = store.decisions_path.parent
    os.chown(folder.parent, 12345, 12345)
    store.operator.write(OperatorDecisions())
    with store.locked():
        owners = {path.stat().st_uid for path in (folder, store.decisions_path, store.lock_path)}
    assert owners == {12345}


def test_nothing_is_written_through_a_folder_that_was_replaced_by_a_link(store: StateStore, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    store.components_path.parent.symlink_to(elsewhere)
    with pytest.raises(ServiceError):
        store.operator.write(OperatorDecisions())
    with pytest.raises(ServiceError):
        store.save(STATE)
    assert list(elsewhere.iterdir()) == []


def test_a_failed_write_leaves_the_file_as_it_was_and_nothing_else(
    store: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.save(STATE)
    names, before = sorted(store.components_path.parent.iterdir()), store.components_path.read_bytes()

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(ServiceError, match="No space left"):
        store.save(with_friction(-0.001))
    assert sorted(store.components_path.parent.iterdir()) == names
    assert store.components_path.read_bytes() == before


def test_a_state_that_is_larger_than_what_is_read_is_not_written(
    store: StateStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("otolith.storage.decisions.MAX_STATE_BYTES", 100)
    with pytest.raises(ServiceError, match="larger than 100 bytes"):
        store.save(STATE)


def test_decisions_of_a_newer_version_are_kept_and_refused(store: StateStore) -> None:
    store.decisions_path.parent.mkdir()
    store.decisions_path.write_text('{"version": 99, "approved": ["shaft/Coulomb/omega"]}', encoding="utf-8")
    with pytest.raises(OtolithError, match="version 99"):
        store.decisions()
    assert "shaft/Coulomb/omega" in store.decisions_path.read_text(encoding="utf-8")
