"""Run several jobs at a time, each in a child process."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any

from benchmarks.paper.discovery import Discovery, Search, discover
from benchmarks.paper.study import Job, Limit, Study, study
from otolith.runtime.process import ChildProcess
from otolith_drivers.errors import OtolithError, ServiceError

MAX_PROCESSES = 4  # processes: more would wait for the longest jobs only
PROGRESS_EVERY = 20  # steps between two messages of a child
POLL_SECONDS = 1.0  # s between two checks whether a child has died

AnyJob = Job | Search
Result = Study | Limit | Discovery


@dataclass(frozen=True, slots=True)
class Progress:
    """How many of its steps a job has done."""

    job: AnyJob
    steps: int
    activity: str


def main(connection: Any) -> None:
    """Entry point of the child: run jobs until None arrives."""
    while (job := connection.recv()) is not None:

        def on_progress(steps: int, activity: str, job: AnyJob = job) -> None:
            if steps % PROGRESS_EVERY == 1:
                connection.send(Progress(job, steps, activity))

        try:
            connection.send(discover(job, on_progress) if isinstance(job, Search) else study(job, on_progress))
        except OtolithError as error:
            connection.send(error)


def run_jobs(jobs: Sequence[AnyJob], on_progress: Callable[[Progress], None]) -> list[Result]:
    """The results of the jobs, in their order; ``on_progress`` is called from time to time.

    Raises:
        OtolithError: an example file cannot be used, or a child died.
    """
    waiting, results = list(jobs), dict[AnyJob, Result]()
    cores = len(os.sched_getaffinity(0))
    children = [
        ChildProcess(f"otolith-paper-{number}", f"{__name__}:main", 2)
        for number in range(min(cores, MAX_PROCESSES, len(jobs)))
    ]
    busy: dict[ChildProcess, AnyJob] = {}
    try:
        while len(results) < len(jobs):
            for child in children:
                if waiting and child not in busy:
                    busy[child] = waiting.pop(0)
                    _start(child, busy[child])
            wait([waitable for child in busy for waitable in child.waitables], POLL_SECONDS)
            for child, job in list(busy.items()):
                for message in child.replies():
                    if isinstance(message, Progress):
                        on_progress(message)
                    elif isinstance(message, OtolithError):
                        raise message
                    else:
                        results[job] = message
                        del busy[child]
                        on_progress(Progress(job, job.steps, f"{job.row.name}: done"))
                if child in busy and not child.alive:
                    raise ServiceError(f"the process of {job.row.name} died: is there enough memory?")
    finally:
        for child in children:
            child.kill()
    return [results[job] for job in jobs]


def _start(child: ChildProcess, job: AnyJob) -> None:
    if not child.alive:
        child.start()
    child.offer(job)
