"""Jobs, several at a time, each in a process that ends with this one: simulating and estimating take a whole core."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

from benchmarks.paper.discovery import Discovery, Search, discover
from benchmarks.paper.study import Job, Limit, Study, study
from otolith.runtime.process import ChildProcess
from otolith_drivers.errors import OtolithError, ServiceError

MOST = 4  # processes: there are no more jobs that take long
TOLD_EVERY = 20  # steps
PATIENCE = 1.0  # s between two looks whether a process has died

# What is done, and what comes of it.
Work = Job | Search
Found = Study | Limit | Discovery


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a job has come."""

    job: Work
    steps: int
    doing: str


def main(connection: Any) -> None:
    """Do jobs until None comes."""
    while (job := connection.recv()) is not None:

        def tell(steps: int, doing: str, job: Work = job) -> None:
            if steps % TOLD_EVERY == 1:
                connection.send(Progress(job, steps, doing))

        try:
            connection.send(discover(job, tell) if isinstance(job, Search) else study(job, tell))
        except OtolithError as error:
            connection.send(error)


def perform(jobs: Sequence[Work], hear: Callable[[Progress], None]) -> list[Found]:
    """What the jobs find, in their order; ``hear`` is told of progress.

    Raises:
        OtolithError: an example file that cannot be used, or a process that died.
    """
    waiting, found = list(jobs), dict[Work, Found]()
    cores = len(os.sched_getaffinity(0))
    pool = [
        ChildProcess(f"otolith-paper-{number}", f"{__name__}:main", 2) for number in range(min(cores, MOST, len(jobs)))
    ]
    busy: dict[ChildProcess, Work] = {}
    try:
        while len(found) < len(jobs):
            for child in pool:
                if waiting and child not in busy:
                    busy[child] = waiting.pop(0)
                    _hand_over(child, busy[child])
            wait([waitable for child in busy for waitable in child.waitables], PATIENCE)
            for child, job in list(busy.items()):
                for said in child.replies():
                    if isinstance(said, Progress):
                        hear(said)
                    elif isinstance(said, OtolithError):
                        raise said
                    else:
                        found[job] = said
                        del busy[child]
                        hear(Progress(job, job.steps, f"{job.row.name}: done"))
                if child in busy and not child.alive:
                    raise ServiceError(f"the process of {job.row.name} died: is there enough memory?")
    finally:
        for child in pool:
            child.kill()
    return [found[job] for job in jobs]


def _hand_over(child: ChildProcess, job: Work) -> None:
    if not child.alive:
        child.start()
    child.offer(job)
