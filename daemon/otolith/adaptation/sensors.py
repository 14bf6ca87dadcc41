"""Sensors that lie: channels that stand still or at their limit, and channels whose scale is wrong.

What a sensor says is held against the twin as it was known before; a lie must not teach.
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.adaptation.objective import EXPLAINED, Objective, quantum
from otolith.adaptation.polish import polish
from otolith.adaptation.prior import Prior, whitening
from otolith.adaptation.problem import Problem

SHORTEST = 5  # records of the same value that are looked at
STUCK = 0.05  # share of records beyond which a channel is not believed
FAR = 6.0  # standard deviations that the twin must move, or be away, while the channel stands still
STEP = 1e-4  # of gain (1) and offset (of the noise), for differences
SENSOR_STEPS = 30  # of the polish
LARGEST_ERROR = 0.5  # of a gain
KINDS = ((True, False), (False, True), (True, True))  # gain, offset, both: at constant speed one of them will do
CLEARLY = 10.0  # in -2 log evidence: a Bayes factor of 150


def stuck(problem: Problem, window: Window, parameters: Array) -> list[str]:
    """Which channels stand still while the twin, with ``parameters`` (free,), moves; a sentence for each."""
    found = []
    told: Array | None = None
    for index, entry in enumerate(problem.twin.outputs):
        values = window.column(entry.name)
        runs = [run for run in _runs(values) if not window.missing_in(entry.name)[run].any()]
        if sum(run.stop - run.start for run in runs) <= STUCK * window.records:
            continue
        if told is None:
            objective = Objective(replace(problem, open_loop=True), window, parameters)
            told = objective.simulate(objective.guess(parameters))
        far = FAR * problem.noise[index] + 2.0 * quantum(values)
        lies = [run for run in runs if _disagrees(told[run, index], float(values[run.start]), far)]
        if sum(run.stop - run.start for run in lies) > STUCK * window.records:
            beyond = np.concatenate([told[run, index] for run in lies]) - values[lies[0].start]
            found.append(_sentence(entry.name, entry.unit, values, lies[0], float(np.median(beyond))))
    return found


def _runs(values: Array) -> list[slice]:
    """Stretches of one and the same value."""
    same = np.concatenate([[False], np.diff(values) == 0.0, [False]]).astype(np.int8)
    edges = np.flatnonzero(np.diff(same))
    runs = [slice(int(start), int(end) + 1) for start, end in zip(edges[::2], edges[1::2], strict=True)]
    return [run for run in runs if run.stop - run.start >= SHORTEST]


def _disagrees(told: Array, value: float, far: float) -> bool:
    """Whether the twin moves while the channel does not, and is away from it at that."""
    if not np.isfinite(told).all():
        return False
    return bool(np.ptp(told) > far and np.abs(told - value).max() > far)


def _sentence(name: str, unit: str, values: Array, lie: slice, beyond: float) -> str:
    """``beyond`` is how far the twin is above the value at which the channel stands still."""
    value = float(values[lie.start])
    clipped = np.ptp(values) > 0.0 and (
        (value == values.max() and beyond > 0.0) or (value == values.min() and beyond < 0.0)
    )
    kind = "is clipped at" if clipped else "is frozen at"
    return f"{name} {kind} {value:.6g} {unit} while the twin moves on: look at the sensor"


@dataclass(frozen=True, slots=True)
class SensorFault:
    """A wrong scale that explains a window."""

    output: str
    gain: float
    offset: float
    unit: str
    evidence: float
    """-2 log evidence (BIC), smaller is better."""

    def __str__(self) -> str:
        """What an engineer would say."""
        parts = [f"{self.gain - 1.0:+.1%}"] if self.gain != 1.0 else []
        parts += [f"{self.offset:+.2g} {self.unit}"] if self.offset != 0.0 else []
        return (
            f"{self.output} reads {' and '.join(parts)} off: that explains the window better than any change of the "
            "parameters, so look at the sensor and its scale"
        )


def wrong_scale(
    problem: Problem, window: Window, prior: Prior, chi_square: float, known: str = ""
) -> SensorFault | None:
    """The output whose gain and offset explain ``window`` clearly better than new parameters do.

    ``prior`` is what was known of the parameters before, ``chi_square`` is what the best new ones leave. For an output
    that is ``known`` to lie it is enough that its scale explains the window: not every window can tell.
    """
    objective = Objective(problem, window, np.clip(prior.mean[: len(problem.free)], *problem.bounds))
    penalty = np.log(objective.count)
    faults = []
    for index, entry in enumerate(problem.twin.outputs):
        for freedom in KINDS:
            scaled = _Scaled(objective, prior, index, freedom)
            fit = polish(scaled, scaled.start(), SENSOR_STEPS)
            gain, offset = map(float, fit.guess[:2])
            inside = abs(gain - 1.0) < 0.99 * LARGEST_ERROR
            if inside and fit.chi_square <= EXPLAINED**2 * objective.count:
                evidence = fit.chi_square + sum(freedom) * penalty
                faults.append(SensorFault(entry.name, gain, offset, entry.unit, evidence))
    faults.sort(key=lambda fault: fault.evidence)
    for fault in faults:
        if fault.output == known:
            return fault
    return faults[0] if faults and faults[0].evidence + CLEARLY < chi_square + objective.free * penalty else None


class _Scaled:
    """The objective of one sensor's gain and offset, beside the parameters as they were known and the initial state."""

    def __init__(self, objective: Objective, prior: Prior, index: int, freedom: tuple[bool, bool]) -> None:
        self._objective, self._index, free = objective, index, objective.free
        self._mean = prior.mean[:free]
        self._root = whitening(prior.covariance[:free, :free])
        reach = max(float(np.ptp(objective.measured[:, index])), 1e3 * float(objective.noise.outputs[index]))
        gain, offset = LARGEST_ERROR * freedom[0], reach * freedom[1]
        # The initial state lies where the sensor would have shown it, had it been right.
        wider = np.zeros(len(objective.low))
        first = 0.5 * (objective.low + objective.high)[free:]
        wider[free:] = 2.0 * LARGEST_ERROR * np.abs(first) + reach
        self.low = np.concatenate([[1.0 - gain, -offset], objective.low - wider])
        self.high = np.concatenate([[1.0 + gain, offset], objective.high + wider])

    def start(self) -> Array:
        """(guess,) with a sensor that is right."""
        return np.concatenate([[1.0, 0.0], self._objective.guess(self._mean)])

    def linearised(self, guess: Array) -> tuple[Array, Array]:
        """(gain, offset, parameters, states) -> residuals, with those of the prior, and their derivatives."""
        objective, noise = self._objective, float(self._objective.noise.outputs[self._index])
        residuals, jacobian = self._at(guess)
        columns = []
        for place, step in enumerate((STEP, STEP * noise)):
            moved = guess.copy()
            moved[place] += step
            columns.append((self._at(moved)[0] - residuals) / step)
        free = objective.free
        believed = np.zeros((free, len(guess)))
        believed[:, 2 : 2 + free] = self._root
        off = self._root @ (guess[2 : 2 + free] - self._mean)
        return np.concatenate([residuals, off]), np.vstack([np.column_stack([*columns, jacobian]), believed])

    def _at(self, guess: Array) -> tuple[Array, Array]:
        """As if the sensor had been right: its noise is divided by the gain as well."""
        gain, offset = map(float, guess[:2])
        residuals, jacobian = self._objective.reading(self._index, gain, offset).linearised(guess[2:])
        scale = np.ones(self._objective.measured.shape)
        scale[:, self._index] = gain
        return residuals * scale.ravel(), jacobian * scale.reshape(-1, 1)
