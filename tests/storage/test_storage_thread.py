"""A thread that several writers share: each gets its turn, and an error of one concerns no other."""

import threading

from otolith.storage.disk import StorageThread, WriterThread
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
