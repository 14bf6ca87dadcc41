"""A pool with machines of which only the state is given: their windows come from a test, not from rings."""

from dataclasses import dataclass

from otolith.acquisition.ring import Rings
from otolith.acquisition.samples import SignalPlan
from otolith.acquisition.windower import Windower
from otolith.adaptation.state import AdaptationState
from otolith.runtime.hall.machine import FinishedWindow, Machine, Task
from otolith.runtime.hall.pool import Pool, Worker

LENGTH = 2.0  # s of a window


def machine_of(state: AdaptationState) -> Machine:
    signals = state.problem.twin.signals
    windower = Windower([SignalPlan(name) for name in signals], state.records, 0.01)
    return Machine(state, Rings(signals, 1), windower, LENGTH)


@dataclass
class OneMachine:
    """A pool of one worker for one machine."""

    machine: Machine
    pool: Pool

    @classmethod
    def of(cls, state: AdaptationState) -> "OneMachine":
        machine = machine_of(state)
        return cls(machine, Pool([machine]))

    @property
    def worker(self) -> Worker:
        return self.pool.workers[0]

    def submit(self, task: Task, now: float) -> None:
        self.pool.submit(self.machine, task, now)

    def poll(self, now: float) -> list[FinishedWindow]:
        return [finished for _, finished in self.pool.poll(now)]
