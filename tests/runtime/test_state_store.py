"""What the daemon keeps and hears of components while it runs, in real files and behind a disk that does not answer."""

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

DRY = Component("shaft", "Coulomb", "omega", -0.004)
KEPT = (ComponentRecord(AdoptedComponent(DRY, 5.0), (-0.004,), (1e-5,)),)
AT_ONCE = within(0.1)  # s: far less than a disk that does not answer


def is_being_read(pipe: Path, held: list[int]) -> bool:
    """Whether somebody waits for what is written into ``pipe``; the end to close is put into ``held`` then."""
    with contextlib.suppress(OSError):
        held.append(os.open(pipe, os.O_WRONLY | os.O_NONBLOCK))
    return bool(held)


@pytest.fixture
def keeper(tmp_path: Path) -> StateStore:
    return StateStore("here", "motor", find_twin("dc_motor"), tmp_path / "components")


@pytest.fixture
def house(keeper: StateStore) -> Iterator[WriterThread]:
    found = WriterThread(keeper, keeper.stamp())
    found.start()
    yield found
    found.stop(1.0)


def test_the_latest_is_on_disk_when_it_stops(keeper: StateStore, house: WriterThread) -> None:
    for amplitude in (-0.001, -0.002, -0.003, -0.004):
        house.keep((ComponentRecord(AdoptedComponent(DRY, 5.0), (amplitude,), (1e-5,)),))
    house.stop(PATIENCE)
    assert keeper.components() == KEPT


def test_the_specialist_is_heard_once_for_every_word(keeper: StateStore, house: WriterThread) -> None:
    assert house.new_decisions() is None
    for word in (OperatorDecisions(approved=frozenset({DRY.key})), OperatorDecisions(rejected=frozenset({DRY.key}))):
        keeper.decide(word)
        heard: list[OperatorDecisions | None] = []

        def is_heard(heard: list[OperatorDecisions | None] = heard) -> bool:
            heard.append(house.new_decisions())
            return heard[-1] is not None

        wait_for(is_heard)
        assert heard[-1] == word
        assert house.new_decisions() is None


def test_what_was_known_at_the_start_is_not_heard_again(keeper: StateStore) -> None:
    keeper.decide(OperatorDecisions(approved=frozenset({DRY.key})))
    house = WriterThread(keeper, keeper.stamp())
    house.start()
    house.keep(KEPT)
    wait_for(keeper.known.exists)
    house.stop(PATIENCE)
    assert house.new_decisions() is None


@pytest.mark.timed
def test_nobody_waits_for_a_disk_that_does_not_answer(keeper: StateStore, house: WriterThread) -> None:
    """A pipe into which nobody writes, where the specialist's file is expected: who reads it is held up."""
    keeper.said.parent.mkdir(parents=True)
    os.mkfifo(keeper.said)
    held: list[int] = []
    wait_for(lambda: is_being_read(keeper.said, held))
    begun = time.monotonic()
    house.keep(KEPT)
    assert house.new_decisions() is None
    assert time.monotonic() - begun < AT_ONCE
    house.stop(0.2)
    assert time.monotonic() - begun < 0.2 + AT_ONCE
    assert not keeper.known.exists()
    os.close(held.pop())
    wait_for(keeper.known.exists)  # late, but all the same
    assert keeper.components() == KEPT


def test_what_the_disk_does_not_take_is_tried_again(
    keeper: StateStore, house: WriterThread, caplog: pytest.LogCaptureFixture
) -> None:
    folder = keeper.known.parent
    folder.write_text("a file where a folder should be", encoding="utf-8")
    house.keep(KEPT)
    wait_for(lambda: "components are not kept" in caplog.text)
    folder.unlink()
    house.stop(PATIENCE)
    assert keeper.components() == KEPT
    assert caplog.text.count("components are not kept") == 1
