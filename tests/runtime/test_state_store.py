"""State store and writer thread, with real files and with a disk that does not answer."""

import contextlib
import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from otolith.adaptation.state import ComponentRecord, OperatorDecisions
from otolith.discovery.adopted import AdoptedComponent
from otolith.estimation.problem import Component
from otolith.machine import find_twin
from otolith.runtime.state_store import StateStore, WriterThread
from tests.waiting import PATIENCE, wait_for, within

FRICTION = Component("shaft", "Coulomb", "omega", -0.004, inner=0.1, low=0.05, high=1.0)
SAVED = (ComponentRecord(AdoptedComponent(FRICTION, 5.0), (-0.004, 0.1), (1e-5, 1e-3)),)
IMMEDIATELY = within(0.1)  # s: far less than a disk that does not answer


def is_being_read(pipe: Path, descriptors: list[int]) -> bool:
    """Return whether a thread waits to read from ``pipe``, and append a descriptor that keeps it waiting."""
    with contextlib.suppress(OSError):
        descriptors.append(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
    return bool(descriptors)


@pytest.fixture
def store(tmp_path: Path) -> StateStore:
    return StateStore("here", "motor", find_twin("dc_motor"), tmp_path / "components")


@pytest.fixture
def writer(store: StateStore) -> Iterator[WriterThread]:
    thread = WriterThread(store, store.decisions_time())
    thread.start()
    yield thread
    thread.stop(1.0)


def test_the_latest_components_are_on_disk_after_stop(store: StateStore, writer: WriterThread) -> None:
    for amplitude in (-0.001, -0.002, -0.003, -0.004):
        writer.save((ComponentRecord(AdoptedComponent(FRICTION, 5.0), (amplitude, 0.1), (1e-5, 1e-3)),))
    writer.stop(PATIENCE)
    assert store.components() == SAVED


def test_every_change_of_decisions_is_returned_once(store: StateStore, writer: WriterThread) -> None:
    assert writer.new_decisions() is None
    key = frozenset({FRICTION.key})
    for decisions in (OperatorDecisions(approved=key), OperatorDecisions(rejected=key)):
        store.save_decisions(decisions)
        received: list[OperatorDecisions] = []

        def has_changed(received: list[OperatorDecisions] = received) -> bool:
            change = writer.new_decisions()
            received.extend([] if change is None else [change])
            return bool(received)

        wait_for(has_changed)
        assert received == [decisions]
        assert writer.new_decisions() is None


def test_decisions_known_at_the_start_are_not_returned(store: StateStore) -> None:
    store.save_decisions(OperatorDecisions(approved=frozenset({FRICTION.key})))
    writer = WriterThread(store, store.decisions_time())
    writer.start()
    writer.save(SAVED)
    wait_for(store.components_path.exists)
    writer.stop(PATIENCE)
    assert writer.new_decisions() is None


@pytest.mark.timed
def test_callers_do_not_wait_for_a_disk_that_hangs(store: StateStore, writer: WriterThread) -> None:
    """A named pipe without a writer stands in for the decisions file: reading it blocks."""
    store.decisions_path.parent.mkdir(parents=True)
    os.mkfifo(store.decisions_path)
    descriptors: list[int] = []
    wait_for(lambda: is_being_read(store.decisions_path, descriptors))
    begun = time.monotonic()
    writer.save(SAVED)
    assert writer.new_decisions() is None
    assert time.monotonic() - begun < IMMEDIATELY
    writer.stop(0.2)
    assert time.monotonic() - begun < 0.2 + IMMEDIATELY
    assert not store.components_path.exists()
    os.close(descriptors.pop())
    wait_for(store.components_path.exists)  # written late, but not lost
    assert store.components() == SAVED


def test_a_failed_write_is_tried_again_and_logged_once(
    store: StateStore, writer: WriterThread, caplog: pytest.LogCaptureFixture
) -> None:
    folder = store.components_path.parent
    folder.write_text("a file where a folder should be", encoding="utf-8")
    writer.save(SAVED)
    wait_for(lambda: "components are not saved" in caplog.text)
    folder.unlink()
    writer.stop(PATIENCE)
    assert store.components() == SAVED
    assert caplog.text.count("components are not saved") == 1
