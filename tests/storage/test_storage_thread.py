"""A thread that several writers share: each gets its turn, and an error of one concerns no other."""

import threading
from itertools import pairwise
from pathlib import Path

from otolith.storage.disk import StorageThread, WriterThread, phase_of
from otolith.storage.history_writer import MERGE_INTERVAL, Bounds, HistoryWriter
from tests.waiting import PATIENCE, wait_for


class Writer(WriterThread):
    def __init__(self, interval: float, *, fails: bool = False) -> None:
        super().__init__("writer", interval, "nothing is written")
        self.turns: list[str] = []
        self.fails = fails

    def write(self) -> None:
        self.turns.append(f"{'last' if self._stopping.is_set() else 'turn'} in {threading.current_thread().name}")
        if self.fails:
            raise OSError(28, "No space left on device")


def test_each_writer_has_its_turns_and_a_last_one() -> None:
    shared = StorageThread()
    often, rare, broken = Writer(0.01), Writer(1e6), Writer(0.01, fails=True)
    for writer in (often, rare, broken):
        writer.share(shared)
        writer.start()
    wait_for(lambda: len(often.turns) > 5)
    assert len(rare.turns) == 1  # at its start
    rare.wake()
    wait_for(lambda: len(rare.turns) == 2)
    wait_for(lambda: bool(broken.outage))
    for writer in (often, rare, broken):
        writer.stop(0.0)
    shared.stop(PATIENCE)
    for writer in (often, rare, broken):
        assert writer.turns[-1] == "last in storage"
        assert writer.turns.count("last in storage") == 1
    assert len({turn.rpartition(" ")[2] for writer in (often, rare, broken) for turn in writer.turns}) == 1


def test_machines_that_begin_together_do_not_write_together() -> None:
    phases = sorted(phase_of(f"hall.motor-{number:03d}") for number in range(200))
    assert phases[0] >= 0.0
    assert phases[-1] < 1.0
    gaps = [later - earlier for earlier, later in pairwise([*phases, phases[0] + 1.0])]
    assert max(gaps) < 0.1  # of the interval, in which no machine does what all do once in it


def test_the_histories_of_a_hall_write_their_values_at_different_times(tmp_path: Path) -> None:
    shared, merged = StorageThread(), list[float]()
    for number in range(3):
        writer = HistoryWriter(tmp_path / "history" / f"hall.motor-{number}.sqlite", Bounds(1_000_000, 1, 1))
        writer.share(shared)
        writer.start()
        merged.append(writer._merged_at)
        writer.stop(0.0)
    shared.stop(PATIENCE)
    assert max(merged) - min(merged) > MERGE_INTERVAL / 10
