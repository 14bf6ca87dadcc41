"""What a recording offers to the twin of a machine: sampling, excitation, expected accuracy and computing time.

The expected accuracy is the Cramér-Rao bound of a window at the nominal parameters. It needs no estimate, and it is as
right as the noise levels of the machine file.
"""

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from statistics import median
from typing import Any, Generic, TypeVar

import numpy as np

from otolith.acquisition.playback import RecordingStatistics, SignalSampling
from otolith.acquisition.quality import ReasonCounts, time_text
from otolith.acquisition.samples import Check, SignalPlan
from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation.state import initial_state
from otolith.estimation.information import QUANTILE, AccuracyTarget, Identifiability, classify, information
from otolith.estimation.objective import Objective, adc_step
from otolith.estimation.problem import Problem, WindowOptions
from otolith.estimation.sensor_models import shown_model
from otolith.health.times import in_local_time
from otolith.machine import LoadedMachine
from otolith.machine_file import whole_length
from otolith.runtime.replay import Replay, Stopped, open_recordings
from otolith.runtime.worker import perform, warm_up
from otolith_drivers.errors import counted
from otolith_drivers.units import unit_text

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_ANALYSED = 8  # windows whose information is computed
TIMED_WINDOWS = 4  # whose computing time is measured
TIMING_BUDGET = 20.0  # s of computing, after which no further window is timed
MIN_MOTION = 12.0  # standard deviations of the noise: range of an output that moves in a window
MAX_PERIOD_ERROR = 0.02  # share by which the sample period may differ from the interval of the fastest signal
MAX_LENGTHENING = 10.0  # times the length of a window: a parameter that needs more needs another experiment
MAX_TRIED, LENGTH_FACTOR = 4, 1.5  # longer windows that are tried, each by this factor at least
MAX_TRIED_LENGTH = 600.0  # s: that of the longest window
MIN_PROPOSED_WINDOWS = 3  # windows of the proposed length that the recording has at least
MIN_REMARKED_JITTER = 0.5  # of the interval: a larger jitter is remarked
MIN_LEVELS = 20  # different values of a signal, below which the ends of its range are steps of its converter
MIN_AT_END = 0.02  # share of the samples at one end of the range that is remarked,
MIN_END_RATIO = 5.0  # if it is larger than that of the values next to it by this factor
WIDTH = 80  # columns of a terminal

Item = TypeVar("Item")


class EvenSpread(Generic[Item]):
    """At most ``count`` of many items, evenly spread; holds at most twice as many at a time."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._kept: list[Item] = []
        self._stride, self._seen = 1, 0

    def add(self, item: Item) -> None:
        """Add an item."""
        if self._seen % self._stride == 0:
            self._kept.append(item)
        self._seen += 1
        if len(self._kept) > 2 * self._count:
            self._kept, self._stride = self._kept[::2], 2 * self._stride

    def chosen(self) -> list[Item]:
        """Return the items, from the first to the last of those that are held."""
        count = min(self._count, len(self._kept))
        return [self._kept[round(index * (len(self._kept) - 1) / max(count - 1, 1))] for index in range(count)]


@dataclass(frozen=True, slots=True, eq=False)
class SignalPreview(SignalSampling):
    """How one signal was sampled."""

    unit: str
    step: float  # Quantisation step in the unit of the signal; 0 if the values show none


@dataclass(frozen=True, slots=True)
class ExpectedAccuracy:
    """How accurately the analysed windows determine one parameter."""

    unit: str
    nominal: float
    required: float  # Largest half-width of the 95 % interval of a determined parameter
    half_width: float | None  # Expected from one window, median over the windows; None if not determined
    determined: int  # Windows that are expected to determine it
    reason: str  # Why the other windows do not


@dataclass(frozen=True, slots=True)
class WindowPreview:
    """The windows of the recording, and what is expected of them."""

    length_s: float
    sample_period_s: float
    count: int
    usable: int  # Of good quality
    moving: int  # Usable windows in which an output moves by more than its noise
    analysed: int
    refusals: tuple[str, ...]  # Why windows were refused, one sentence per cause with its count
    parameters: dict[str, ExpectedAccuracy]

    @property
    def usable_share(self) -> float:
        """Share of usable windows, 0 to 1."""
        return self.usable / max(self.count, 1)


@dataclass(frozen=True, slots=True)
class Preview:
    """Everything that was measured of a recording."""

    data: str
    rows: int
    start: float | None  # Time of the earliest row, s
    end: float | None
    steps_back: int
    sources: tuple[str, ...]  # Where each signal comes from, a line per signal
    signals: dict[str, SignalPreview]
    windows: WindowPreview  # As the machine file configures them
    proposed: WindowPreview  # With the proposed length and sample period; the same if those of the file fit
    is_partial: bool  # Whether only first rows were read, and neither another window nor computing time examined
    computing_s: float | None  # Of a window of proposed, s, median of some windows; None if not measured
    longest_computing_s: float | None  # The longest of these times, s
    remarks: tuple[str, ...]

    @property
    def is_usable(self) -> bool:
        """Whether parameters can be estimated from any window, as the machine file configures them."""
        return self.windows.usable > 0

    def document(self) -> dict[str, Any]:
        """Return the preview as plain values for JSON."""
        document = asdict(self)
        for signal in document["signals"].values():
            del signal["values"]
        return document


def preview_recording(
    machine: LoadedMachine,
    data: Sequence[Path],
    stopped: Stopped = lambda: False,
    *,
    max_rows: int | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Preview:
    """Return the preview of ``data``: of its first ``max_rows`` rows, without a proposal and computing times, if given.

    Each file is a recording of its own. It is read once, and again for each other window that is tried. ``progress``
    is called from time to time with a text.

    Raises:
        ConfigurationError: the file cannot be read as the signals of the twin.
    """
    survey = _survey(machine, data, stopped, max_rows, progress)
    proposed, longer, seconds = survey, "", list[float]()
    if max_rows is None:
        proposed, longer = _proposal(machine, survey, lambda other: _survey(other, data, stopped, None, progress))
        progress("measuring the computing time of windows")
        seconds = _computing_seconds(proposed.machine, proposed.chosen)
    statistics = survey.statistics
    samplings = statistics.signals()
    return Preview(
        data=", ".join(map(str, data)),
        rows=statistics.rows,
        start=statistics.first if statistics.rows else None,
        end=statistics.last if statistics.rows else None,
        steps_back=statistics.steps_back,
        sources=survey.sources,
        signals={name: _signal(machine.twin.unit_of(name), sampling) for name, sampling in samplings.items()},
        windows=survey.windows,
        proposed=proposed.windows,
        is_partial=max_rows is not None,
        computing_s=median(seconds) if seconds else None,
        longest_computing_s=max(seconds, default=None),
        remarks=(
            *survey.warnings,
            *_remarks(survey.plans, statistics, samplings),
            *_sensor_remarks(machine, survey.chosen),
            *filter(None, [longer]),
        ),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Survey:
    """One reading of the data."""

    machine: LoadedMachine
    sources: tuple[str, ...]
    warnings: tuple[str, ...]  # Of the reader
    plans: tuple[SignalPlan, ...]
    statistics: RecordingStatistics
    windows: WindowPreview
    chosen: list[Window]  # The windows that were analysed


def _proposal(
    machine: LoadedMachine, survey: _Survey, again: Callable[[LoadedMachine], _Survey]
) -> tuple[_Survey, str]:
    """Return the survey of a window that fits the data better, made by ``again``, and what a longer one would bring.

    If none is better, it is ``survey``. Parameters that a window trades with each other may become separable in one
    that holds a step of the inputs: then longer ones are tried; the shortest that determines most parameters is taken.
    """
    best = _better_window(machine, survey, again)
    if not best.windows.moving or not any(map(_is_traded, best.windows.parameters.values())):
        return best, ""
    statistics, period = survey.statistics, best.windows.sample_period_s
    longest = min(max(statistics.last - statistics.first, 0.0) / MIN_PROPOSED_WINDOWS, MAX_TRIED_LENGTH)
    length, latest = best.windows.length_s, best
    for _ in range(MAX_TRIED):
        length = whole_length(_nice_above(LENGTH_FACTOR * length), period)
        if length > longest or not (tried := again(_with_window(machine, length, period))).windows.moving:
            break  # no recording holds one
        latest = tried
        if _separable(latest) > _separable(best):
            best = latest
            if _separable(best) == len(machine.problem.free):
                break
    following = whole_length(_nice_above(LENGTH_FACTOR * best.windows.length_s), period)
    if best is survey or latest is not best or following > longest:
        return best, "" if latest is best else _longer(best, latest)
    longer = again(_with_window(machine, following, period))
    return best, _longer(best, longer) if longer.windows.moving else ""


def _is_traded(accuracy: ExpectedAccuracy) -> bool:
    """Whether the usual window leaves a parameter so wide that more of the same records would not determine it."""
    return accuracy.half_width is None or (accuracy.half_width / accuracy.required) ** 2 > MAX_LENGTHENING


def _separable(survey: _Survey) -> int:
    """Return how many parameters half of the analysed windows determine within what is asked."""
    windows = survey.windows
    return sum(2 * accuracy.determined >= max(windows.analysed, 1) for accuracy in windows.parameters.values())


def _nice_above(wanted: float) -> float:
    """Return the least of 1, 2 and 5 times a power of ten that is not below ``wanted``."""
    digit = 10.0 ** math.floor(math.log10(wanted))
    return next(factor * digit for factor in (1.0, 2.0, 5.0, 10.0) if factor * digit >= wanted * (1.0 - 1e-9))


def _longer(best: _Survey, longer: _Survey) -> str:
    """Return what the windows of ``longer`` determine, beside those of ``best``."""
    parts = []
    for name, accuracy in longer.windows.parameters.items():
        here = best.windows.parameters[name].half_width
        unit = unit_text(accuracy.unit)
        now, then = (
            "undetermined" if width is None else f"±{width:.2g} {unit}".rstrip()
            for width in (here, accuracy.half_width)
        )
        parts.append(f"{name} {then} instead of {now}")
    return f"a window of {longer.windows.length_s:g} s would bring: {', '.join(parts)}"


def _better_window(machine: LoadedMachine, survey: _Survey, again: Callable[[LoadedMachine], _Survey]) -> _Survey:
    """Return the survey of a window whose period and length fit the accuracy that is asked; ``survey`` without one."""
    statistics, window = survey.statistics, machine.file.window
    period = _proposed_period(statistics, window.sample_period)
    length = _proposed_length(survey.windows, max(statistics.last - statistics.first, 0.0), period)
    if (length, period) == (window.length, window.sample_period):
        return survey
    other = again(_with_window(machine, length, period))
    is_better = other.windows.usable and other.windows.usable_share >= survey.windows.usable_share
    return other if is_better else survey


def _survey(
    machine: LoadedMachine,
    data: Sequence[Path],
    stopped: Stopped,
    max_rows: int | None,
    progress: Callable[[str], None],
) -> _Survey:
    """Read the data once, and return what they offer to windows as ``machine`` configures them."""
    usable, moving = EvenSpread[Window](MAX_ANALYSED), EvenSpread[Window](MAX_ANALYSED)
    counts, refusals = Counter[str](), ReasonCounts()
    with open_recordings(machine, data) as reader:
        sources = tuple(reader.describe())
        run = Replay(machine, reader, stopped)
        for window in run.windows():
            counts["all"] += 1
            progress(f"preview of window {window.index}, {run.progress:.0%} of the data")
            refusals.add(window.index, window.quality.reasons)
            if window.quality.verdict is Verdict.GOOD:
                counts["usable"] += 1
                usable.add(window)
                if _moves(machine.problem, window):
                    counts["moving"] += 1
                    moving.add(window)
            if max_rows is not None and run.statistics.rows > max_rows:
                break
        warnings = tuple(reader.warnings())
    chosen = moving.chosen() or usable.chosen()
    preview = WindowPreview(
        length_s=machine.file.window.length,
        sample_period_s=machine.file.window.sample_period,
        count=counts["all"],
        usable=counts["usable"],
        moving=counts["moving"],
        analysed=len(chosen),
        refusals=tuple(f"{count} like: {example}" for count, example in refusals.most_frequent()),
        parameters=expected_accuracy(machine.problem, chosen),
    )
    return _Survey(machine, sources, warnings, machine.plans(reader.sampling), run.statistics, preview, chosen)


def _moves(problem: Problem, window: Window) -> bool:
    for output, noise in zip(problem.twin.outputs, problem.noise, strict=True):
        values = window.column(output.name)[~window.missing_in(output.name)]
        if len(values) and np.ptp(values) > MIN_MOTION * noise + 2.0 * adc_step(values):
            return True
    return False


def expected_accuracy(problem: Problem, windows: Sequence[Window]) -> dict[str, ExpectedAccuracy]:
    """Return by name how accurately ``windows`` determine the free parameters, if these are nominal."""
    required = problem.determined_within * problem.scale
    half_widths = np.full((len(windows), len(problem.free)), np.inf)
    reasons: list[list[tuple[Identifiability, str]]] = []
    for row, window in zip(half_widths, windows, strict=True):
        objective = Objective(problem, _without_constant_outputs(problem, window), problem.nominal)
        _, jacobian = objective.linearise(objective.guess(problem.nominal))
        uncertainty = information(jacobian, objective.high - objective.low, 1.0)
        row[:] = QUANTILE * uncertainty.sd[: len(row)]
        targets = [AccuracyTarget(float(required[index]), free.unit, False) for index, free in enumerate(problem.free)]
        reasons.append([classify(uncertainty, index, objective.names, target) for index, target in enumerate(targets)])
    accuracies = {}
    for index, free in enumerate(problem.free):
        kinds = [row[index] for row in reasons if row[index][0] is not Identifiability.DETERMINED]
        usual = Counter(kind for kind, _ in kinds).most_common(1)
        usual_width = float(np.median(half_widths[:, index])) if len(windows) else math.inf
        accuracies[free.name] = ExpectedAccuracy(
            unit=free.unit,
            nominal=free.nominal,
            required=float(required[index]),
            half_width=usual_width if math.isfinite(usual_width) else None,
            determined=int(np.count_nonzero(half_widths[:, index] <= required[index])),
            reason=next((text for kind, text in kinds if kind is usual[0][0]), "") if usual else "",
        )
    return accuracies


def _without_constant_outputs(problem: Problem, window: Window) -> Window:
    """Return the window without the samples of outputs that keep one value: without noise they are no measurement."""
    missing = window.missing.copy()
    for output in problem.twin.outputs:
        present = ~window.missing_in(output.name)
        if present.any() and np.ptp(window.column(output.name)[present]) == 0.0:
            missing[:, window.signals.index(output.name)] = True
    return replace(window, missing=missing)


def _proposed_period(statistics: RecordingStatistics, configured: float) -> float:
    """Return the interval of the fastest signal in s, with three digits; ``configured`` if that fits."""
    intervals = (sampling.interval_s for sampling in statistics.signals().values())
    fastest = min((interval for interval in intervals if interval is not None), default=math.inf)
    if not math.isfinite(fastest) or abs(fastest / configured - 1.0) <= MAX_PERIOD_ERROR:
        return configured
    return float(f"{np.clip(fastest, 1e-4, 10.0):.3g}")


def _proposed_length(windows: WindowPreview, duration: float, period: float) -> float:
    """Return a length in s, a multiple of ``period``, at which a window determines what a longer window can.

    The variance of an estimate falls with the length. If there is no window, it is one that fits into ``duration``.
    """
    longest = duration / MIN_PROPOSED_WINDOWS
    if not windows.count:
        return whole_length(min(longest, windows.length_s), period)
    factors = [
        (accuracy.half_width / accuracy.required) ** 2
        for accuracy in windows.parameters.values()
        if accuracy.half_width is not None
    ]
    wanted = max((factor for factor in factors if factor <= MAX_LENGTHENING), default=1.0) * windows.length_s
    if wanted <= windows.length_s or wanted > longest:
        return whole_length(windows.length_s, period)
    return whole_length(min(_nice_above(wanted), longest, MAX_TRIED_LENGTH), period)


def _with_window(machine: LoadedMachine, length: float, period: float) -> LoadedMachine:
    """Return the machine with windows of ``length`` s and ``period`` s between records."""
    window = machine.file.window
    if (length, period) == (window.length, window.sample_period):
        return machine
    changes = {"length": length, "sample_period": period, "shortest": None, "longest": None}
    file = machine.file.model_copy(update={"window": window.model_copy(update=changes)})
    records = round(length / period)
    problem = replace(machine.problem, window=WindowOptions(records, records, records, period))
    return replace(machine, file=file, problem=problem)


def _computing_seconds(machine: LoadedMachine, windows: Sequence[Window]) -> list[float]:
    """Return the computing times of some windows that are estimated from, s.

    The first is left out if there are others: its estimate begins with a search of all of the bounds.
    """
    identity = machine.file.machine
    state = initial_state(identity.name, identity.site, machine.problem)
    seconds: list[float] = []
    if windows:
        warm_up(state)
    for window in windows[:TIMED_WINDOWS]:
        result = perform(state, window)
        state = result.state
        if result.report is not None and result.report.document.fit is not None:
            seconds.append(result.seconds)
        if sum(seconds) > TIMING_BUDGET:
            break
    return seconds[1:] or seconds


def _signal(unit: str, sampling: SignalSampling) -> SignalPreview:
    counted_of = {item.name: getattr(sampling, item.name) for item in fields(sampling)}
    return SignalPreview(**counted_of, unit=unit, step=adc_step(sampling.values))


def _remarks(
    plans: Iterable[SignalPlan], statistics: RecordingStatistics, samplings: dict[str, SignalSampling]
) -> Iterator[str]:
    """Yield what a user should know of the rows, a sentence each; signals with the same remark share it."""
    if statistics.first_step_back is not None:
        line, time, before = statistics.first_step_back
        count = f"{counted(statistics.steps_back, 'step')} back in time"
        first = ", the first" if statistics.steps_back > 1 else ""
        yield f"{count}{first} in line {line}: {time_text(time)} after {time_text(before)}"
    shared: dict[str, list[str]] = {}
    for plan in plans:
        sampling = samplings[plan.name]
        remarks = [*_signal_remarks(sampling)]
        if plan.hold != "zoh" and Check.STALE in plan.checks:  # a command repeats what it holds
            remarks += _renewal_remarks(sampling)
        if plan.hold is None and sampling.samples > 1 and not np.ptp(sampling.values):
            remarks.append("the value never changes, so it determines no parameter")
        if plan.hold != "zoh":  # a command is often at the end of its range
            remarks += _end_remarks(sampling.values)
        for remark in remarks:
            shared.setdefault(remark, []).append(plan.name)
    yield from (f"{', '.join(names)}: {remark}" for remark, names in shared.items())


def _end_remarks(values: Array) -> Iterator[str]:
    """Yield at which end of its range a measurement stays, as a saturated sensor does; zero is a machine at rest."""
    levels, counts = np.unique(values, return_counts=True)
    if len(levels) < MIN_LEVELS:
        return
    for name, at, near in (("smallest", 0, slice(1, 4)), ("largest", -1, slice(-4, -1))):
        share = counts[at] / len(values)
        if levels[at] and share >= MIN_AT_END and counts[at] > MIN_END_RATIO * counts[near].mean():
            exactly = f"{share:.0%} of the samples have exactly its {name} value, {levels[at]:.4g}"
            yield f"{exactly}: if the sensor ends there, leave these cells blank"


def _sensor_remarks(machine: LoadedMachine, windows: Sequence[Window]) -> Iterator[str]:
    """Yield which sensors have a dead band or renew their reading at edges, and what to write then."""
    problem = machine.problem
    for output, noise in zip(problem.base_model.outputs, problem.noise, strict=True):
        if problem.sensor(output.name).holds:
            continue
        shown = shown_model(windows, output.name, noise)
        if shown.dead_band:
            key, how = f'dead_band = "{shown.dead_band:.3g} {output.unit}"', "the value stays, and changes by at least"
            what = f"{how} {shown.dead_band:.3g} {unit_text(output.unit)}, as of a sensor with a dead band"
        elif shown.renewed:
            key = f'renewed = "{shown.renewed:.3g} ({output.unit})*s"'
            what = "a new value comes after the same distance each, as of a speed from the times of edges"
        else:
            continue
        yield f"{output.name}: {what}: write {key} under it in [signals], so that repeated values are no readings"


def _renewal_remarks(sampling: SignalSampling) -> Iterator[str]:
    if sampling.renewal > 1 and sampling.interval_s is not None:
        every = duration_text(sampling.renewal * sampling.interval_s)
        yield f"the value changes with every {_ordinal(sampling.renewal)} sample only, about every {every}"


def _signal_remarks(sampling: SignalSampling) -> Iterator[str]:
    if not sampling.samples:
        yield "no sample"
    if (gap := sampling.longest_gap_s) is not None:
        start, line = sampling.longest_gap_start, sampling.longest_gap_line
        yield f"the longest gap is {duration_text(gap)}, from {time_text(start or 0.0)} to line {line}"
    if sampling.duplicates:
        share = sampling.duplicates / sampling.samples
        count = f"{counted(sampling.duplicates, 'sample')} ({share:.0%})"
        yield f"at time and with the value of the sample before: {count}"
    if sampling.repeated_times:
        count = counted(sampling.repeated_times, "sample")
        yield f"at the time of the sample before, but with another value: {count}; log times with more digits"
    if sampling.jitter > MIN_REMARKED_JITTER:
        yield f"the intervals vary by {sampling.jitter:.0%} (standard deviation over median)"


def _ordinal(number: int) -> str:
    ending = "th" if 10 <= number % 100 <= 20 else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def duration_text(seconds: float) -> str:
    """Return a duration with three digits, in ms below one second; 999.6 of them would be 1e+03."""
    return f"{seconds * 1e3:.3g} ms" if seconds < 0.9995 else f"{seconds:.4g} s"


def computing_time_text(seconds: float, longest: float, length: float) -> str:
    """Return usual and longest computing time of a window of ``length`` s, and whether it is too long for operation."""
    text = f"a window of {length:.9g} s takes {duration_text(seconds)} to compute, at most {duration_text(longest)}"
    return f"slower than real time: {text}" if seconds > length else text


def preview_lines(preview: Preview, zone: str | None = None) -> Iterator[str]:
    """Yield the whole preview as lines of text, at most 80 columns wide, with times in a zone."""
    seconds = (preview.end or 0.0) - (preview.start or 0.0)
    yield f"{Path(preview.data).name}: {counted(preview.rows, 'row')} in {seconds:.6g} s"
    yield f"  {'signal':18}{'samples':>10}{'every':>9}{'jitter':>8}{'gaps':>7}{'longest':>9}{'step':>10}{'twice':>7}"
    for name, signal in preview.signals.items():
        label = f"{name} [{signal.unit}]"
        every = "-" if signal.interval_s is None else duration_text(signal.interval_s)
        longest = "-" if signal.longest_gap_s is None else duration_text(signal.longest_gap_s)
        step = f"{signal.step:.3g}" if signal.step else "-"
        cells = f"{signal.samples:>10}{every:>9}{signal.jitter:>8.1%}{signal.gaps:>7}{longest:>9}{step:>10}"
        yield f"  {label if len(label) <= 18 else name[:18]:18}{cells}{signal.duplicates + signal.repeated_times:>7}"
    for remark in preview.remarks:
        yield from _wrapped(f"! {in_local_time(remark, zone)}")
    yield from _window_lines(preview.windows)
    if preview.proposed != preview.windows:
        window = preview.proposed
        yield "proposed for the machine file:"
        yield "  [window]"
        yield f'  length = "{window.length_s:.9g} s"'
        yield f'  sample_period = "{window.sample_period_s * 1e3:.6g} ms"'
        yield from _window_lines(window)
    yield from _accuracy_lines(preview.proposed)
    if preview.computing_s is not None and preview.longest_computing_s is not None:
        times = (preview.computing_s, preview.longest_computing_s)
        yield from _wrapped(computing_time_text(*times, preview.proposed.length_s), indent="")


def short_lines(preview: Preview, zone: str | None = None) -> Iterator[str]:
    """Yield the preview in a few lines, for the start of a replay, with times in a zone."""
    rates: dict[str, list[str]] = {}
    for name, signal in preview.signals.items():
        rates.setdefault("-" if signal.interval_s is None else duration_text(signal.interval_s), []).append(name)
    every = "; ".join(f"{', '.join(names)} every {rate}" for rate, names in rates.items())
    yield from _wrapped(f"{counted(preview.rows, 'row')} of {Path(preview.data).name}: {every}")
    for remark in preview.remarks:
        yield from _wrapped(f"! {in_local_time(remark, zone)}")
    yield from _window_lines(preview.windows)
    expected = [
        f"{name} " + (f"±{row.half_width:.2g} {unit_text(row.unit)}".rstrip() if row.half_width else "undetermined")
        for name, row in preview.windows.parameters.items()
        if preview.windows.analysed
    ]
    if expected:
        yield from _wrapped(f"expected 95 % intervals from one window: {', '.join(expected)}")
    if preview.is_partial:
        yield from _wrapped("not examined: a better window, the computing time; 'otolith check' does so")


def _window_lines(windows: WindowPreview) -> Iterator[str]:
    grid = f"windows of {windows.length_s:.9g} s with a record every {duration_text(windows.sample_period_s)}"
    motion = f"{windows.moving} with motion" if windows.usable else "none to estimate from"
    yield f"{grid}: {windows.count}, {windows.usable} usable, {motion}"
    for refusal in windows.refusals:
        yield from _wrapped(f"! refused: {refusal}")


def _accuracy_lines(windows: WindowPreview) -> Iterator[str]:
    if not windows.analysed:
        return
    yield f"  {'parameter':14}{'nominal':>24}{'95 % interval':>15}{'required':>12}{'determined':>13}"
    for name, accuracy in windows.parameters.items():
        expected = "none" if accuracy.half_width is None else f"±{accuracy.half_width:.2g}"
        nominal = f"{accuracy.nominal:.5g} {unit_text(accuracy.unit)}".rstrip()
        cells = f"{nominal:>24}{expected:>15}{f'±{accuracy.required:.2g}':>12}"
        yield f"  {name:14}{cells}{f'{accuracy.determined} of {windows.analysed}':>13}"
    for name, accuracy in windows.parameters.items():
        if accuracy.reason:
            others = " in the other windows" if accuracy.determined else ""
            yield from _wrapped(f"! {name}{others}: {accuracy.reason}")


def _wrapped(text: str, indent: str = "  ") -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent="    ")
