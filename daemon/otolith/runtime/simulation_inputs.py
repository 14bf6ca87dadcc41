"""What drives a simulation, from a file: planned inputs, or a recording, whose outputs are compared with it."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from pathlib import Path

import numpy as np

from otolith.acquisition.quality import time_text
from otolith.acquisition.window import Array, Verdict, Window
from otolith.machine import LoadedMachine
from otolith.runtime.replay import Replay, open_by_name, open_recorded, open_span
from otolith.simulation.plan import MAX_RECORDS, follows
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.replay.readers import Reader, Rows, holds_frames, is_recording
from otolith_drivers.replay.span import SpanReader

MAX_LEAD = 5  # windows of a recording, one of which must be usable. docs/reference/thresholds-runtime.md
COUNTS = re.compile(r"^bad cells: \d+, bad rows: \d+, the first in line (\d+): ")


@dataclass(frozen=True, slots=True, eq=False)
class PlannedRows:
    """Planned inputs."""

    path: Path
    times: Array  # (rows,) s; they rise
    columns: dict[str, Array]  # (rows,) of each input of the twin in its unit, all finite
    ignored: tuple[str, ...] = ()  # Columns that no input uses


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStretch:
    """The windows of a recording, as a daemon would cut them."""

    path: Path
    windows: tuple[Window, ...]
    warnings: tuple[str, ...] = ()

    def lead(self) -> int:
        """Return the number of the first window that can show the state of the machine: another one follows it.

        Raises:
            ConfigurationError: none of the first :data:`MAX_LEAD` can.
        """
        found = _lead(self.windows)
        if found is None:
            reasons = [reason for window in self.windows[:MAX_LEAD] for reason in window.quality.reasons]
            reason = reasons[0] if reasons else "behind each is a gap"
            fault = f"none of the first {MAX_LEAD} windows can be used: {reason}"
            raise ConfigurationError(f"{self.path}: {fault}: give a span that begins later")
        return found


def _lead(windows: Sequence[Window]) -> int | None:
    """See :meth:`RecordedStretch.lead`."""
    usable = (
        index
        for index, (window, after) in enumerate(pairwise(windows[: MAX_LEAD + 1]))
        if window.quality.verdict is Verdict.GOOD and follows(after, window)
    )
    return next(usable, None)


def read_inputs(
    machine: LoadedMachine, data: Path, span: tuple[float, float] | None = None
) -> PlannedRows | RecordedStretch:
    """Return the inputs in ``data``: a recording if it has all signals of the twin, otherwise a plan.

    Of a recording, ``span`` (s, as its times) are begin and end of what is used.

    Raises:
        ConfigurationError: the file cannot be read, lacks an input, or has a value or time that cannot be meant.
    """
    if _is_recording(machine, data):
        with open_recorded(machine, data) as reader:
            return _recorded(machine, reader if span is None else SpanReader(reader, *span))
    if span is not None:
        raise ConfigurationError(f"{data}: a plan, which is used as a whole: leave the span out")
    return read_plan(machine, data)


def _is_recording(machine: LoadedMachine, data: Path) -> bool:
    """Whether a file has the outputs of the twin as well; also if it cannot be read, which its reader says."""
    if is_recording(data) or holds_frames(data) or not data.is_file():
        return data.is_file() or "=" in str(data)
    try:
        with open_recorded(machine, data):
            return True
    except ConfigurationError:
        return False


def read_plan(machine: LoadedMachine, data: Path) -> PlannedRows:
    """Return a table with a column ``t`` and one for each input; raises as :func:`read_inputs`."""
    inputs = tuple(item.name for item in machine.twin.inputs)
    if not inputs:
        raise ConfigurationError(
            f"{data}: the twin {machine.twin.name!r} has no measured input: nothing can be planned"
        )
    with open_by_name(machine, data, inputs) as reader:
        parts, count = list[Rows](), 0
        for part in reader.chunks():
            parts.append(part)
            count += len(part.times)
            if count > MAX_RECORDS:
                raise ConfigurationError(f"{data}: more than {MAX_RECORDS} rows: shorten the plan")
        rows = reduce(Rows.followed_by, parts)
        faults, ignored = reader.warnings(), reader.ignored
        if reader.bad:
            cause = COUNTS.sub(r"line \1: ", faults[0]) if faults else "a cell that is no number"
            raise ConfigurationError(f"{data}: {cause}: correct it, as no value of a plan may be left out")
    _check(machine, data, rows)
    return PlannedRows(data, rows.times, {name: rows.columns[name] for name in inputs}, ignored)


def _check(machine: LoadedMachine, data: Path, rows: Rows) -> None:
    """Raise ConfigurationError if a time does not rise, or a value is missing."""
    back = np.flatnonzero(np.diff(rows.times) <= 0.0)
    if len(back):
        at = int(back[0]) + 1
        times = f"t = {rows.times[at]:.12g} s is not after t = {rows.times[at - 1]:.12g} s of the row above"
        raise ConfigurationError(f"{data}:{rows.lines[at]}: {times}: sort the rows by t, and remove those that repeat")
    for item in machine.twin.inputs:
        blank = np.flatnonzero(~np.isfinite(rows.columns[item.name]))
        if len(blank):
            where = f"{data}:{rows.lines[int(blank[0])]}: no value of {item.name} [{item.unit}]"
            or_none = "or one so large that it stands for none"
            raise ConfigurationError(f"{where}, {item.meaning}, {or_none}: write one in each row, or leave the row out")


def read_recorded(machine: LoadedMachine, span: tuple[float, float]) -> RecordedStretch:
    """Return what the daemon of ``machine`` has recorded in ``span`` (Unix s); raises as :func:`read_inputs`."""
    with open_span(machine, *span) as reader:
        return _recorded(machine, reader)


def _recorded(machine: LoadedMachine, reader: Reader) -> RecordedStretch:
    """Return the windows of a recording; raises as :func:`read_inputs`."""
    replay, windows, records = Replay(machine, reader), list[Window](), 0
    for window in replay.windows():
        windows.append(window)
        records += window.records
        if records > MAX_RECORDS:
            raise ConfigurationError(f"{reader.path}: more than {MAX_RECORDS} records: choose a shorter span of it")
    if len(windows) < 2:
        length = f"{machine.file.window.length:g} s"
        needed = f"two windows of {length} are needed, the first of which shows the state of the machine"
        raise ConfigurationError(f"{reader.path}: {len(windows)} windows: {needed}: give a longer span or recording")
    return RecordedStretch(reader.path, tuple(windows), (*replay.warnings(), *_remarks(windows)))


def _remarks(windows: Sequence[Window]) -> Iterator[str]:
    """Yield what of the ``windows`` is not predicted, or from inputs that are not known."""
    begin = (_lead(windows) or 0) + 1
    gaps = (index for index in range(begin, len(windows)) if not follows(windows[index], windows[index - 1]))
    end = next(gaps, len(windows))
    if end < len(windows):
        gap = f"a gap from {time_text(windows[end - 1].end)} to {time_text(windows[end].start)}"
        yield f"{gap}: what is after it is not predicted: give a span that begins there"
    bad = [window for window in windows[begin:end] if window.quality.verdict is not Verdict.GOOD]
    if bad:
        first = f"the first from {time_text(bad[0].start)}: {'; '.join(bad[0].quality.reasons)}"
        yield f"windows with data that cannot be used: {len(bad)}, {first}; bands do not contain errors of its inputs"
