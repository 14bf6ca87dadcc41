"""Noise of measured inputs: how much of their fast changes the machine does not follow.

Noise of an input drives the twin, but not the machine. So the innovations follow the noise with the opposite sign,
while they follow nothing that really drives the machine. Process noise alone has the same spectrum; it is this
correlation that tells them apart. ``docs/explanation/noise-identification.md`` has the equations.

One window shows little: its parameters and its initial state explain what the noise of an input does to it. They then
differ from window to window by more than the noise of the sensors allows. So the correlations of windows are summed: of
a record by :func:`input_noise`, of a running twin by :class:`InputNoiseSums`. Each window is fitted alone, so that a
parameter that has changed between windows is no evidence of noise.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.commissioning.consistency import MIN_REGIME
from otolith.commissioning.likelihood import Fits, FittedWindow
from otolith.discovery.noise_hypothesis import MIN_NOISE_FACTOR, input_noise_bounds
from otolith.estimation.evidence import CHANCE_DEVIATE, SIGNIFICANT_DEVIATE, Elimination
from otolith.estimation.minimisers import continued
from otolith.estimation.window_fit import ALONE_STEPS, Fit
from otolith.twin.definition import Input

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
DRAWS = 16  # of noise for each window of a record, by which the expected correlation is computed
SECOND_DIFFERENCE_GAIN = np.sqrt(6.0)  # for white noise
RUNNING_DRAWS = 4  # of noise for each window of a running twin: other windows have others
SUMMED_EVERY = 8  # windows, of which one is always added
SUMMED_RATIO = 1.2  # ratio of variances above which windows differ by more than they should: then each is added
FORGETTING = 0.98  # of the sums, with each window that is added
RISEN = 3.0  # times the largest changes before: the sums begin again, as noise may have begun
MIN_POWER = 1e-6  # χ² of what the fast changes of an input do to a window: less shows nothing


@dataclass(frozen=True, slots=True)
class Correlation:
    """Of the innovations of windows with the fast changes of one input."""

    observed: float = 0.0
    expected: float = 0.0  # For noise of unit variance, in the square of the input's unit
    variance: float = 0.0  # Of ``observed``, if nothing is noise
    bound: float = 0.0  # Largest changes from sample to sample of the windows
    windows: int = 0  # That are summed

    def plus(self, other: "Correlation", kept: float = 1.0) -> "Correlation":
        """Return the sum, with a share ``kept`` of this one."""
        return Correlation(
            kept * self.observed + other.observed,
            kept * self.expected + other.expected,
            kept**2 * self.variance + other.variance,
            max(self.bound, other.bound),
            self.windows + other.windows,
        )

    @property
    def deviate(self) -> float:
        """Standard deviations by which it exceeds that without noise."""
        return self.observed / float(np.sqrt(self.variance)) if self.variance > 0.0 < self.expected else 0.0


@dataclass(frozen=True, slots=True)
class InputNoise:
    """What windows show of the noise of one input."""

    name: str
    shown: float  # Standard deviation of its changes from sample to sample, of the machine or of noise
    share: float  # Of the variance of ``shown``: how much of it is noise
    sd: float  # Standard deviation of ``share``

    @property
    def is_significant(self) -> bool:
        """Whether the innovations show that a part is noise."""
        return self.share > CHANCE_DEVIATE * self.sd

    @property
    def level(self) -> float:
        """Standard deviation of the noise, in the unit of the input."""
        return self.shown * float(np.sqrt(np.clip(self.share, 0.0, 1.0)))

    @property
    def level_sd(self) -> float:
        """Standard deviation of :attr:`level`."""
        return 0.5 * self.shown * self.sd / float(np.sqrt(np.clip(self.share, self.sd, 1.0)))

    @property
    def limit(self) -> float:
        """Largest noise that the windows do not contradict."""
        return self.shown * float(np.sqrt(np.clip(self.share + 2.0 * self.sd, 0.0, 1.0)))


def input_noise(fits: Fits, source: Input, shown: float, seed: int) -> InputNoise | None:
    """Return how much of the changes ``shown`` by an input is noise; None if no window has a sample in each record."""
    random, total = np.random.default_rng(seed), Correlation()
    for fit in fits:
        if not fit.window.missing_in(source.name).any():
            total = total.plus(_correlation(fit, source.name, shown, DRAWS, random))
    if not total.expected:
        return None
    expected = shown**2 * total.expected
    return InputNoise(source.name, shown, total.observed / expected, float(np.sqrt(total.variance)) / abs(expected))


@dataclass(frozen=True, slots=True)
class InputNoiseSums:
    """What the windows of a running twin show of the noise of inputs for which none is stated."""

    sums: tuple[Correlation, ...] = ()  # Of each input; empty before the first window

    def after(self, fitted: Fit) -> "InputNoiseSums":
        """Return the sums with the window of a fit, if the twin explains it without its prior."""
        window, bounds = fitted.window, input_noise_bounds(fitted.problem, fitted.window)
        if not bounds.any() or fitted.problem.open_loop:
            return self
        objective = fitted.objective
        alone = continued(objective, fitted.without_prior(), ALONE_STEPS)
        own = FittedWindow(window, objective, alone.guess, alone)
        if not own.is_explained:
            return self
        random = np.random.default_rng((fitted.problem.seed, window.index))
        sums = self.sums or (Correlation(),) * len(bounds)
        rows = zip(fitted.problem.base_model.inputs, bounds.tolist(), strict=True)
        added = [
            _limited(_correlation(own, source.name, level, RUNNING_DRAWS, random))
            if level and not window.missing_in(source.name).any()
            else Correlation()
            for source, level in rows
        ]
        since = [old if new.bound <= RISEN * old.bound else Correlation() for old, new in zip(sums, added, strict=True)]
        summed = tuple(old.plus(new, FORGETTING) for old, new in zip(since, added, strict=True))
        return InputNoiseSums(summed)

    def levels(self, fitted: Fit) -> tuple[float, ...] | None:
        """Return the levels of the problem of ``fitted`` with the noise that the sums show; None if they show none.

        A sum that exceeds what the samples of this window allow is from noise that has ended; it gives no level.
        """
        bounds = input_noise_bounds(fitted.problem, fitted.window).tolist()
        levels = list(fitted.problem.levels)
        for at, (own, bound) in enumerate(zip(self.sums, bounds, strict=False)):
            noise = float(np.sqrt(own.observed / own.expected)) if own.deviate > SIGNIFICANT_DEVIATE else np.inf
            if noise < MIN_NOISE_FACTOR * bound and own.windows >= MIN_REGIME:
                levels[at] = min(noise, bound)
        return None if tuple(levels) == fitted.problem.levels else tuple(levels)


def _limited(own: Correlation) -> Correlation:
    """Return the correlation of one window, observed no larger than if all that it has shown were noise."""
    most = own.bound**2 * own.expected + CHANCE_DEVIATE * float(np.sqrt(own.variance))
    return replace(own, observed=min(own.observed, most))


def _correlation(fit: FittedWindow, name: str, level: float, draws: int, random: np.random.Generator) -> Correlation:
    """Return the correlation of a window; so many ``draws`` of noise of that ``level`` give what is expected."""
    window, unknowns, response = fit.window, Elimination.of(fit.result.jacobian), _response_to(fit, name)
    fast = unknowns.left(response(_fast(window, window.column(name))))
    power = float(fast @ fast)
    if not MIN_POWER <= power < np.inf:  # false where the twin diverges
        return Correlation()
    expected = 0.0
    for noise in level * random.standard_normal((draws, window.records)):
        expected += float(unknowns.left(response(noise)) @ response(_fast(window, noise)))
    observed, variance = float(fit.result.residuals @ fast), fit.discount * power
    own = Correlation(observed, expected / draws / level**2, variance, level, 1)
    return own if np.isfinite(expected) else Correlation()


def _fast(window: Window, values: Array) -> Array:
    """Return the fast changes (records,) of ``values``: at each record the distance from the line of its neighbours."""
    offsets, fast = window.grid.offsets, np.zeros(len(values))
    share = (offsets[1:-1] - offsets[:-2]) / (offsets[2:] - offsets[:-2])
    fast[1:-1] = values[1:-1] - (1.0 - share) * values[:-2] - share * values[2:]
    return np.asarray(2.0 * fast / SECOND_DIFFERENCE_GAIN)


def _response_to(fit: FittedWindow, name: str) -> Callable[[Array], Array]:
    """Return the function from a change (records,) of an input to that (residuals,) of the whitened innovations."""
    objective, guess = fit.objective, fit.guess[None]
    column = [driven.name for driven in objective.kernel.definition.inputs].index(name)
    predicted = objective.residuals(objective.predict(guess))

    def response(change: Array) -> Array:
        inputs = objective.excitation.inputs.copy()
        inputs[:, column] += change
        excitation = replace(objective.excitation, inputs=inputs)
        with np.errstate(over="ignore", invalid="ignore"):
            moved = objective.kernel.simulate(objective.parameters(guess), guess[:, objective.free :], excitation)
            return np.asarray((objective.residuals(moved) - predicted).ravel())

    return response
