"""Record a scenario, replay it through the daemon's code, and compare each window with the truth and its bound."""

import re
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.sampling.bound import efficient_estimate
from benchmarks.sampling.plant import Motor
from benchmarks.sampling.schedules import NOISE, Recording, Schedule, record
from otolith.acquisition.window import Array, Mask
from otolith.discovery.alternatives import ACCEPTED
from otolith.estimation.information import QUANTILE
from otolith.health.schema import ParameterDocument, ReportDocument, Status
from otolith.machine import LoadedMachine, load_machine
from otolith.runtime.replay import Replay, open_recorded

FREE = ("R_a", "D", "J")
WINDOW = 2.0  # s
WINDOWS_PER_RECORDING = 10
DETERMINED_WITHIN = 0.1  # of the nominal value: half-width of the interval that is asked for
LEVEL = 0.95  # of the intervals
SPREAD = 0.15  # share by which each constant of a recorded motor may differ from that of the machine file
FILE_NAME = "recording.csv"


@dataclass(frozen=True, slots=True)
class WindowOutcome:
    """One window of a recording; arrays are (free,), NaN for what the report lacks."""

    document: ReportDocument
    truth: Array
    bound: Array
    """Cramér-Rao bound of the standard deviations; infinite without."""
    efficient_error: Array
    """Error of the estimate that reaches the bound."""
    raw: Array
    """Estimates of this window alone."""
    raw_sd: Array
    low: Array
    """Published 95 % interval."""
    high: Array

    @property
    def is_allowed(self) -> bool:
        """Whether the bound allows the interval that is asked for, of each parameter."""
        nominal = np.array([self.document.parameters[name].nominal for name in FREE])
        return bool((QUANTILE * self.bound <= DETERMINED_WITHIN * nominal).all())

    @property
    def is_estimated(self) -> bool:
        """Whether the window updated the estimates, and each parameter counts as estimated."""
        estimated = all(self.document.parameters[name].status is Status.ESTIMATED for name in FREE)
        return self.document.decision in ACCEPTED and estimated


def write_machine(folder: Path, schedule: Schedule, extra: str = "") -> Path:
    """Write the machine file of a scenario, with the sensors' true noise, and return its path."""
    noise = {name: level for name, level in NOISE.items() if name != "T_load" or schedule.load_noise}
    units = {"i": "A", "omega": "rad/s", "T_load": "N*m"}
    lines = ["[machine]", 'name = "motor"', "[twin]", 'name = "dc_motor"', "[parameters]"]
    lines += ['R_a = { value = "6.5 ohm", estimate = true }', 'D = { value = "0.00143 N*m*s/rad", estimate = true }']
    lines += ['J = { value = "0.001171 kg*m^2", estimate = true }', "[noise]"]
    lines += [f'{name} = "{level!r} {units[name]}"' for name, level in noise.items()]
    if schedule.polled:
        lines += ["[window]", 'times = "polled"']
    path = folder / "machine.toml"
    path.write_text("\n".join([*lines, extra]) + "\n", encoding="utf-8")
    return path


def some_motor(random: np.random.Generator) -> Motor:
    """Return a motor whose resistance, damping and inertia differ from those of the machine file."""
    nominal = Motor()
    factors = random.uniform(1.0 - SPREAD, 1.0 + SPREAD, 3)
    return Motor(R_a=nominal.R_a * float(factors[0]), D=nominal.D * float(factors[1]), J=nominal.J * float(factors[2]))


def replayed(machine: LoadedMachine, data: Path) -> list[ReportDocument]:
    """Return the reports of a recorded file."""
    with open_recorded(machine, data) as opened:
        return [report.document for report in Replay(machine, opened).reports()]


def measure(schedule: Schedule, windows: int, seed: int, folder: Path) -> Iterator[WindowOutcome]:
    """Yield at least ``windows`` windows, each recording with another motor and from a cold start."""
    random = np.random.default_rng(seed)
    machine = load_machine(write_machine(folder, schedule), with_driver=False)
    data = folder / FILE_NAME
    for _ in range(-(-windows // WINDOWS_PER_RECORDING)):
        length = WINDOWS_PER_RECORDING * WINDOW + WINDOW / 2
        recording = record(schedule, some_motor(random), length, random)
        data.write_text(recording.table(), encoding="utf-8")
        for document in replayed(machine, data):
            yield outcome(recording, document)


def outcome(recording: Recording, document: ReportDocument, shift: float = 0.0) -> WindowOutcome:
    """Compare a report with the truth; ``shift`` is the time of the table minus that of the recording, s."""
    efficient = efficient_estimate(recording, document.window.start - shift, document.window.end - shift, FREE)
    parameters = [document.parameters[name] for name in FREE]
    columns = [_column(parameters, key) for key in ("raw", "raw_sd", "low", "high")]
    truth = np.array([getattr(recording.motor, name) for name in FREE])
    return WindowOutcome(document, truth, efficient.bound, efficient.error, *columns)


def _column(parameters: Sequence[ParameterDocument], key: str) -> Array:
    values = [getattr(parameter, key) for parameter in parameters]
    return np.array([np.nan if value is None else value for value in values])


def run(schedule: Schedule, windows: int, seed: int) -> "Summary":
    """Return the figures of a scenario."""
    with tempfile.TemporaryDirectory() as folder:
        return summarise(list(measure(schedule, windows, seed, Path(folder))))


@dataclass(frozen=True, slots=True)
class Summary:
    """The figures of a scenario; arrays are (free,)."""

    windows: int
    learned: int
    allowed: int
    """Windows whose bound allows the interval that is asked for."""
    estimated: float
    """Share of those that are estimated; NaN without any."""
    raw_coverage: Array
    """Share of the 95 % intervals of single windows that hold the truth."""
    efficient_coverage: Array
    """The same of the efficient estimates of these windows: by how much it differs from 95 % is chance."""
    published_coverage: Array
    spread: Array
    """Root mean square error of single windows over their bounds."""
    efficient_spread: Array
    """The same of the efficient estimates of these windows: by how much it differs from 1 is chance."""
    bias: Array
    """Mean error of single windows over their bounds."""
    bound: Array
    """Median bound over the true value."""
    reasons: tuple[tuple[str, int], ...]
    """Most frequent decisions of windows that were not used, and why; N stands for a number."""

    @property
    def coverage(self) -> Array:
        """Share of intervals of single windows that hold the truth, without what chance does to all estimates."""
        return self.raw_coverage - self.efficient_coverage + LEVEL

    @property
    def error_ratio(self) -> Array:
        """Root mean square error of single windows over that of the efficient estimates of these windows."""
        return self.spread / self.efficient_spread


def summarise(outcomes: Sequence[WindowOutcome]) -> Summary:
    """Return the figures of the windows of one scenario; every window with a raw estimate counts."""
    allowed = [outcome.is_estimated for outcome in outcomes if outcome.is_allowed]
    keys = ("truth", "bound", "efficient_error", "raw", "raw_sd", "low", "high")
    truth, bound, efficient, raw, raw_sd, low, high = (
        np.array([getattr(item, key) for item in outcomes]) for key in keys
    )
    pulls, present = (raw - truth) / bound, np.isfinite(raw)
    efficient = np.where(present, efficient / bound, np.nan)
    unused = [item.document for item in outcomes if item.document.decision not in ACCEPTED]
    texts = [f"{document.decision.value}: {'; '.join(document.window.quality.reasons)}" for document in unused]
    texts = [re.sub(r"\d[\d.]*", "N", text) for text in texts]
    learned = len(outcomes) - len(unused)
    return Summary(
        windows=len(outcomes),
        learned=learned,
        allowed=len(allowed),
        estimated=float(np.mean(allowed)) if allowed else float("nan"),
        raw_coverage=_share(np.abs(raw - truth) <= QUANTILE * raw_sd, present),
        efficient_coverage=_share(np.abs(efficient) <= QUANTILE, np.isfinite(efficient)),
        published_coverage=_share((low <= truth) & (truth <= high), np.isfinite(low)),
        spread=_mean(pulls**2) ** 0.5,
        efficient_spread=_mean(efficient**2) ** 0.5,
        bias=_mean(pulls),
        bound=np.median(bound / truth, axis=0),
        reasons=tuple(Counter(texts).most_common(3)),
    )


def _share(holds: Mask, present: Mask) -> Array:
    count = present.sum(axis=0)
    return np.where(count > 0, (holds & present).sum(axis=0) / np.maximum(count, 1), np.nan)


def _mean(values: Array) -> Array:
    """Return the mean of each column, without what is not finite."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    return np.where(count > 0, np.where(finite, values, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)
