"""The replay of recorded samples as a function of samples and state.

:class:`ReplayState` is all that later reports need of earlier samples, open tests included: a replay that is split
anywhere, and continued from that state in another process, gives the same reports bit for bit. The caller opens files.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from otolith.acquisition.playback import Playback, PlaybackState
from otolith.acquisition.quality import time_text
from otolith.acquisition.window import Verdict, Window
from otolith.adaptation.state import AdaptationState, initial_state
from otolith.health.schema import CountersDocument, Report
from otolith.machine import LoadedMachine
from otolith.runtime.worker import perform
from otolith_drivers.base import Sampling, sampling_of
from otolith_drivers.errors import counted
from otolith_drivers.replay.readers import Rows


@dataclass(frozen=True, slots=True, eq=False)
class ReplayState:
    """All that later reports need of earlier samples."""

    adaptation: AdaptationState
    sampling: Mapping[str, Sampling]  # Meaning of the times of each signal
    playback: PlaybackState | None = None  # None before the first sample
    windows: int = 0
    windows_bad: int = 0
    windows_missed: int = 0
    lost: int = 0  # Samples that were sent but are not in the data


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Recorded rows, and what the data lack up to their end."""

    rows: Rows
    lost: int = 0  # Samples that were sent but are not in the data, as their counters show


def first_state(machine: LoadedMachine, sampling: Sampling | Mapping[str, Sampling]) -> ReplayState:
    """Return the state before the first sample; ``sampling`` is the meaning of the times of the data."""
    names = machine.file.machine
    adaptation = initial_state(names.name, names.site, machine.problem, machine.plan)
    return ReplayState(adaptation, {name: sampling_of(sampling, name) for name in machine.twin.signals})


def replay_segment(
    machine: LoadedMachine, samples: Iterable[Samples], state: ReplayState, *, is_last: bool = False
) -> tuple[list[Report], ReplayState]:
    """Return the reports that ``samples`` complete, and the state after them.

    ``is_last`` says that no further sample comes, so no window waits for one. Nothing that was given is changed.
    """
    player, reports = Player(machine, state), list[Report | None]()
    for part in samples:
        reports += [player.adapt(window, part.lost) for window in player.playback.windows(part.rows)]
    if is_last:
        reports += [player.adapt(window, player.state.lost) for window in player.playback.rest()]
    return [report for report in reports if report is not None], player.state


class Player:
    """Rows through rings, windower and adaptation core, from a state on."""

    def __init__(self, machine: LoadedMachine, state: ReplayState, *, timing: bool = False) -> None:
        """With ``timing`` the reports have computing times, so that they differ from run to run."""
        window, plans = machine.file.window, machine.plans(state.sampling)
        self.playback = Playback(plans, machine.records, window.sample_period, machine.limits, machine.observed)
        if state.playback is not None:
            self.playback.restore(state.playback)
        self._state, self._timing, self._length = state, timing, window.length

    @property
    def state(self) -> ReplayState:
        """The state after all rows so far, whose windows must have been taken."""
        return replace(self._state, playback=self.playback.state)

    @property
    def adaptation(self) -> AdaptationState:
        """What was learned so far."""
        return self._state.adaptation

    @adaptation.setter
    def adaptation(self, adaptation: AdaptationState) -> None:
        self._state = replace(self._state, adaptation=adaptation)

    @property
    def windows(self) -> int:
        """Windows so far."""
        return self._state.windows

    @property
    def windows_missed(self) -> int:
        """Windows that could not be computed."""
        return self._state.windows_missed

    def adapt(self, window: Window, lost: int) -> Report | None:
        """Return the report of a window, or None if the adaptation failed, which costs this window only.

        ``lost`` is the number of samples that the data lack.
        """
        before = self._state
        result = perform(before.adaptation, window)
        self.playback.windower.records = result.state.records
        self._state = state = replace(
            before,
            adaptation=result.state,
            windows=before.windows + 1,
            windows_bad=before.windows_bad + (window.quality.verdict is Verdict.BAD),
            windows_missed=before.windows_missed + (result.report is None),
            lost=lost,
        )
        if result.report is None:
            return None
        counts = self.playback.counts
        cost = result.report.document.cost.model_copy(update={"seconds": result.seconds if self._timing else None})
        counters = CountersDocument(
            received=counts.received,
            bad=counts.bad,
            lost=counts.lost + lost,
            windows=state.windows,
            windows_bad=state.windows_bad,
            windows_missed=state.windows_missed,
        )
        document = result.report.document.model_copy(update={"counters": counters, "cost": cost})
        return Report(document, result.report.traces)

    def warnings(self, place: str) -> list[str]:
        """Return what became of the rows, one sentence each; ``place`` is what their lines number."""
        counts, unused, length = self.playback.counts, self.playback.unused_seconds, self._length
        lines = []
        if counts.first_late is not None:
            line, late_time, latest = counts.first_late
            first = f"the first in {place} {line}, at {time_text(late_time)} after {time_text(latest)} above"
            lines.append(f"rows that came after their window was closed: {counts.late}, {first}")
        if counts.gaps:
            lines.append(
                f"gaps longer than a window, skipped: {counts.gaps}, the longest of {counts.longest_gap:.3g} s"
            )
        if counts.segments:
            lines.append(f"recordings in the file: {counts.segments + 1}; each begins with a window of its own")
        if counts.repeated:
            lines.append(f"samples at the time of another one, not used twice: {counts.repeated}")
        if counts.stale:
            lines.append(f"readings of registers that had not been renewed, not used: {counts.stale}")
        if self.windows_missed:
            lines.append(f"windows that could not be computed: {self.windows_missed}")
        if unused >= length / 2:
            lines.append(f"the last {unused:.3g} s are too short for a window of {length:g} s")
        return lines

    def why_no_window(self) -> str:
        """Return why no row was in a window."""
        rows = self.playback.counts.rows
        reason = f"{counted(rows, 'row')} {'is' if rows == 1 else 'are'} too short for a window of {self._length:g} s"
        return f"{reason}: record for longer, or shorten [window] length"
