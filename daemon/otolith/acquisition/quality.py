"""Whether a window can be estimated from: judged by what it lacks, against the limits of the machine file."""

import re
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from otolith.acquisition.samples import EARLY, LOST_INTERVAL, MIN_CLOCK_SAMPLES, CyclicSeries, SignalPlan
from otolith.acquisition.window import GridSpan, Mask, Quality, TimeGrid, Verdict, runs_of

if TYPE_CHECKING:  # slow to import
    from otolith.acquisition.records import Records

# Thresholds: docs/reference/thresholds-acquisition.md has the origin of each.
CALENDAR = (1e8, 1e11)  # s: a time between them is Unix time and shown as a date
MAX_REASONS = 5  # kinds of refused windows that are listed
FIGURE = re.compile(r"(?<![\w.])\d[\d.]*")  # sentences that differ by their numbers only are of one kind


@dataclass(frozen=True, slots=True)
class QualityLimits:
    """Bounds that the worst signal of a window must keep for the window to be good."""

    missing: float = 1.0  # Share of the records of the grid without a sample, 0 to 1
    gap: float = np.inf  # Longest time without a sample, s
    jitter: float = 0.005  # Root mean square lateness of a cyclic signal of which samples are lost, s
    surplus: float = 0.02  # Share of samples of a cyclic signal for which there is no slot: a second sender
    irregularity: float = 0.3  # Standard deviation of the interval of a cyclic signal over its mean: a second sender
    same_time: float = 0.25  # Share of samples with time but not value of another: a coarse clock, or two machines


@dataclass(frozen=True, slots=True)
class Gap:
    """The longest time without a sample of a signal."""

    start: float  # s, in the time of the window
    length: float  # s


def assess_quality(
    records: "Records",
    plans: Mapping[str, SignalPlan],
    cyclic: Mapping[str, CyclicSeries],
    limits: QualityLimits,
    span: GridSpan,
) -> Quality:
    """Return the quality of a window; times are told as those of ``span``.

    A command that is recorded only when it changes has no gaps.
    """
    slots = span.records
    present = {name: ~records.missing[:, column] for column, name in enumerate(plans)}
    expected = [name for name in plans if name not in records.held]
    gaps = {name: longest_gap(present[name], records.grid, span.start, span.period) for name in expected}
    missing = {name: max(0.0, 1.0 - float(present[name].sum()) / max(slots, 1)) for name in expected}
    jitters = {name: float(np.sqrt(np.mean(item.lateness**2))) for name, item in cyclic.items() if len(item.lateness)}
    offsets = [float(np.median(item.lateness)) for item in cyclic.values() if len(item.lateness)]
    reasons = _useless(present, plans, records.unknown, span)
    reasons = reasons or [
        *_beyond(missing, limits.missing, "{1:.0%} of {0} is missing, more than missing_limit ({2:.0%})"),
        *_long_gap(gaps, limits.gap),
        *_beyond(
            {name: item.surplus / max(slots, 1) for name, item in cyclic.items()},
            limits.surplus,
            "{0} comes more often than it should: do two nodes send it? If not, raise surplus_limit ({2:.0%})",
        ),
        *_beyond(
            {name: item.irregularity for name, item in cyclic.items()},
            limits.irregularity,
            "{0} comes at irregular intervals: do two nodes send it? If not, raise irregularity_limit ({2:.0%})",
        ),
        *_beyond(
            records.ambiguous,
            limits.same_time,
            "{1:.0%} of the samples of {0} share a time but differ: log finer times, and one machine in a file; "
            "or raise same_time_limit ({2:.0%})",
        ),
        *_beyond(
            {
                name: 1e3 * jitter
                for name, jitter in jitters.items()
                if plans[name].is_cyclic and not _is_whole(cyclic[name], span)
            },
            1e3 * limits.jitter,
            "{0} arrives with {1:.3g} ms of jitter, more than jitter_limit ({2:.3g} ms)",
        ),
    ]
    return Quality(
        verdict=Verdict.BAD if reasons else Verdict.GOOD,
        missing=max(missing.values(), default=0.0),
        longest_gap=max((gap.length for gap in gaps.values()), default=0.0),
        jitter=max(jitters.values(), default=0.0),
        skew=max(offsets) - min(offsets) if offsets else 0.0,
        reasons=tuple(reasons),
    )


def _is_whole(signal: CyclicSeries, span: GridSpan) -> bool:
    """Whether each slot of a signal in the window has a sample: their order then tells the slots of late ones too."""
    times = signal.series.within(span.start - EARLY * span.period, span.end - EARLY * span.period).times
    if signal.surplus or len(times) < MIN_CLOCK_SAMPLES:
        return False
    steps = np.diff(times)
    longest = max(float(steps.max()), float(times[0]) - span.start, span.end - float(times[-1]))
    return longest < LOST_INTERVAL * float(steps.min())


def _useless(
    present: Mapping[str, Mask],
    plans: Mapping[str, SignalPlan],
    unknown: Collection[str],
    span: GridSpan,
) -> list[str]:
    """Return why nothing can be estimated: no output came, or an input of which nothing is known."""
    outputs = [name for name, plan in plans.items() if plan.hold is None]
    silent = [name for name in outputs if not present[name].any()]
    if len(silent) < len(outputs):
        silent = []
    silent += [
        name for name, plan in plans.items() if name in unknown or (plan.hold == "foh" and not present[name].any())
    ]
    if not silent:
        return []
    when = f"from {time_text(span.start)} for {span.length:.4g} s"
    return [f"no samples of {', '.join(silent)} {when}: is the source on, and is its signal right in [signals]?"]


def _long_gap(gaps: Mapping[str, Gap], limit: float) -> list[str]:
    """Return a sentence for the signal with the longest gap, if it is beyond the limit."""
    name = max(gaps, key=lambda name: gaps[name].length, default="")
    if not name or gaps[name].length <= limit:
        return []
    when = f"for {gaps[name].length:.4g} s from {time_text(gaps[name].start)}"
    return [f"{name} has no sample {when}, longer than gap_limit ({limit:.4g} s)"]


def _beyond(values: Mapping[str, float], limit: float, text: str) -> list[str]:
    """Return a sentence for the worst signal, if it is beyond the limit."""
    name = max(values, key=lambda name: values[name], default="")
    return [text.format(name, values[name], limit)] if name and values[name] > limit else []


def longest_gap(present: Mask, grid: TimeGrid, start: float, period: float) -> Gap:
    """Return the longest time without a sample of a signal, from a ``period`` (s) after the sample before.

    ``present`` (records,) marks the records with a sample; the first record of ``grid`` is at ``start`` (s).
    """
    if grid.period is not None:
        first, last = max(runs_of(~present), key=lambda run: run[1] - run[0], default=(0, 0))
        return Gap(start + first * period, (last - first) * period)
    times = np.concatenate([[0.0], grid.offsets[present], [grid.length]])
    lengths = np.diff(times) - period * (np.arange(len(times) - 1) > 0)
    at = int(np.argmax(lengths))
    return Gap(start + float(times[at]) + period * (at > 0), max(float(lengths[at]), 0.0))


class ReasonCounts:
    """Counts the reasons for which windows are refused, by kind."""

    def __init__(self) -> None:
        self._counts = Counter[str]()
        self._examples: dict[str, str] = {}

    def add(self, window: int, reasons: Collection[str]) -> None:
        """Count the reasons of a window of that index."""
        for reason in reasons:
            kind = FIGURE.sub("…", reason)
            self._counts[kind] += 1
            self._examples.setdefault(kind, f"{reason} (window {window})")

    def most_frequent(self) -> list[tuple[int, str]]:
        """Return how often each of the ``MAX_REASONS`` most frequent kinds came, with its first example."""
        return [(count, self._examples[kind]) for kind, count in self._counts.most_common(MAX_REASONS)]


def is_of_calendar(seconds: float) -> bool:
    """Return whether a time of the data is Unix time; a log without a date counts from its start."""
    return CALENDAR[0] <= seconds < CALENDAR[1]


def time_text(seconds: float) -> str:
    """Return a time of the data: a date and time of day (UTC) for Unix seconds, else seconds."""
    if not is_of_calendar(seconds):
        return f"t = {seconds:.2f} s" if 1e3 <= abs(seconds) < CALENDAR[0] else f"t = {round(seconds, 9) + 0.0:.4g} s"
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S.%f}"[:-4] + " UTC"
