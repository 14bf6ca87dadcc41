"""The one recorder process of a service, and the share in it that each machine has.

A share has the methods of a process that :mod:`otolith.runtime.recorder_supervisor` supervises, so one machine does not
notice that others are recorded by the same process: it ends for a share when its recording has ended, or with it.
"""

import time
from collections import deque
from typing import Any

from otolith.runtime.process import ChildProcess, RestartPauses

RECORDER_ROOM = (
    32  # windows of a machine that wait for the recorder; docs/reference/thresholds-runtime.md has its origin
)


class RecorderProcess:
    """The process. It is started with the first recording, and again when one is started after it has ended."""

    def __init__(self) -> None:
        self.child = ChildProcess("otolith-recorder", "otolith.publishing.recorder:main", RECORDER_ROOM)
        self._shares: dict[str, RecorderShare] = {}
        self._recordings = 0

    def share(self, name: str) -> "RecorderShare":
        """Return the share of the machine with this name, in place of one that it had."""
        self._shares[name] = RecorderShare(name, self)
        self.child.widen(RECORDER_ROOM * len(self._shares))
        return self._shares[name]

    def next_number(self) -> int:
        """Return the number of a new recording."""
        self._recordings += 1
        return self._recordings

    def start(self) -> None:
        """Start the process if it does not run."""
        if not self.child.alive:
            self.child.may_restart(time.monotonic())  # which logs how it has ended; the shares have pauses of their own
            self.child.start()

    def read(self) -> None:
        """Give each share what the process has answered."""
        for name, number, answer in self.child.replies():
            self._shares[name].receive(number, answer)

    def stop(self, seconds: float) -> None:
        """Let the process write what it has for up to ``seconds``, and end it."""
        self.child.stop(seconds)


class RecorderShare:
    """The recordings of one machine in the process; each has a number."""

    def __init__(self, name: str, whole: RecorderProcess) -> None:
        self.starts = 0
        self._name, self._whole = name, whole
        self._pauses = RestartPauses()
        self._started_at = 0.0
        self._number = 0  # of the present recording
        self._process_starts = 0  # of the process, when the present recording was started
        self._is_open = False
        self._answers: deque[Any] = deque()

    @property
    def alive(self) -> bool:
        """Whether the recording goes on."""
        child = self._whole.child
        return self._is_open and child.starts == self._process_starts and child.alive

    @property
    def deaths(self) -> int:
        """How often in a row a recording has ended before it was well."""
        return self._pauses.deaths

    @property
    def age(self) -> float:
        """Seconds since the recording was started."""
        return time.monotonic() - self._started_at

    @property
    def processor_time(self) -> float:
        """Processor time that the process has taken, s."""
        return self._whole.child.processor_time

    def start(self, opened: Any) -> None:
        """Start a recording."""
        self._whole.start()
        self.starts += 1
        self._number = self._whole.next_number()
        self._pauses.begin()
        self._started_at, self._process_starts = time.monotonic(), self._whole.child.starts
        self._answers.clear()
        self._is_open = self._send(opened)

    def may_restart(self, now: float) -> bool:
        """Return whether the recording has ended and its pause is over; ``now`` is monotonic time, s."""
        return not self.alive and self._pauses.is_over(now)

    def count_failed_start(self) -> None:
        """Count a start that could not be prepared as an end, so that the pause doubles."""
        self._pauses.begin()

    def reset_backoff(self) -> None:
        """Let the next start be immediate again."""
        self._pauses.deaths = 0

    def offer(self, report: Any) -> bool:
        """Queue a report without waiting; return False if the queue is full and the report was dropped."""
        return self._send(report)

    def replies(self) -> list[Any]:
        """Return the numbers of windows that were not yet written, one for each report since the last call."""
        self._whole.read()
        return [self._answers.popleft() for _ in range(len(self._answers))]

    def receive(self, number: int, answer: Any) -> None:
        """Take an answer of the process about the recording with this number."""
        if number != self._number:
            return
        if isinstance(answer, int):
            self._answers.append(answer)
        else:
            self._is_open = False

    def finish(self) -> None:
        """End the recording once what waits is written; the process goes on."""
        if self.alive:
            self._send(None)
        self._is_open = False

    def kill(self) -> None:
        """Kill the process, which hangs: all recordings end with it."""
        self._whole.child.kill()
        self._is_open = False

    def _send(self, content: Any) -> bool:
        return self._whole.child.offer((self._name, self._number, content))
