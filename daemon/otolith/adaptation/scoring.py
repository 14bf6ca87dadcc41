"""The levels of noise under which windows are likeliest, found along Fisher's information.

In variances, so that a level may become zero, and one that was begun far off comes back at once (scoring: N. K. Gupta,
R. K. Mehra, IEEE Transactions on Automatic Control 19, 1974; steps that stay above zero: C. L. Lawson, R. J. Hanson,
Solving Least Squares Problems, chapter 23).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith.adaptation.likelihood import Fit, Likelihood

HIDDEN = 0.02  # of the noise that a signal shows: a sensor that is better than that is not looked into further
NUDGE = 0.02  # of a variance, for differences
LEAST_NUDGE = 1e-3  # of the variance where the search begins
ROUNDS, TRIALS = 25, 6
NEAR, SHORTEST = 0.75, 0.1  # of a trial's length: how near is near enough, and the shortest after it
DONE = 0.05  # of the unlikelihood: an improvement that is not worth another step
ZERO = 2.706  # of the unlikelihood: the 95 % point for a variance at its bound, half of χ² of one degree
Told = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Ladder:
    """Levels (outputs + states,) by the shares of variances that are sought."""

    base: Array
    """(outputs + states,) where the search begins: shares of one."""
    least: Array
    """(outputs + states,) what a share of zero leaves."""
    sought: Mask
    """(outputs + states,); what is not sought stays at ``least``."""

    def levels(self, shares: Array) -> Array:
        """(sought,) -> (outputs + states,)."""
        found = self.least**2
        found[self.sought] += shares * self.base[self.sought] ** 2
        return np.asarray(np.sqrt(found))


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """Windows, fitted at some levels."""

    shares: Array
    """(sought,)."""
    levels: Array
    """(outputs + states,)."""
    fits: list[Fit]
    unlikelihood: float


@dataclass(frozen=True, slots=True, eq=False)
class Likeliest:
    """The end of a search."""

    levels: Array
    """(outputs + states,)."""
    deviations: Array
    """(outputs + states,) standard deviation of each level, of one at zero upwards; zero for what was not sought."""
    fits: list[Fit]
    unlikelihood: float


def fewest(likelihood: Likelihood, ladder: Ladder, fits: Sequence[Fit], told: Told) -> Likeliest:
    """The likeliest levels, with process noise only of states without whose noise the windows are less likely."""
    found = likeliest(likelihood, ladder, fits, told)
    while (idle := _idle(likelihood, ladder, found)).any():
        again = found.levels[idle].any()
        ladder = replace(
            ladder, base=np.where(found.levels > 0.0, found.levels, ladder.base), sought=ladder.sought & ~idle
        )
        if again:
            left = likeliest(likelihood, ladder, found.fits, told)
            hidden = np.where(idle, np.hypot(found.levels, found.deviations), found.deviations)
            found = replace(left, deviations=np.where(ladder.sought, left.deviations, hidden))
    return found


def _idle(likelihood: Likelihood, ladder: Ladder, found: Likeliest) -> Mask:
    """(outputs + states,) the states at zero, or else the one whose noise is hardly missed."""
    outputs = len(found.fits[0].objective.noise.outputs)
    candidates: Mask = ladder.sought & (np.arange(len(found.levels)) >= outputs)
    idle: Mask = candidates & (found.levels == 0.0)
    if idle.any() or not candidates.any():
        return idle
    missed = np.full(len(idle), np.inf)
    for index in np.flatnonzero(candidates):
        levels = found.levels.copy()
        levels[index] = 0.0
        missed[index] = likelihood.unlikelihood(likelihood.refitted(levels, found.fits)) - found.unlikelihood
    return np.asarray(candidates & (missed == missed.min()) & (missed < ZERO))


def likeliest(likelihood: Likelihood, ladder: Ladder, fits: Sequence[Fit], told: Told) -> Likeliest:
    """Of all levels that ``ladder`` seeks; ``fits`` were made at its base."""
    point = _at(likelihood, ladder, np.ones(int(ladder.sought.sum())), fits)
    for _ in range(ROUNDS):
        slope, curvature = _turn(likelihood, ladder, point)
        step = _aim(slope, curvature, point.shares) - point.shares
        promised = -float(slope @ step + 0.5 * step @ curvature @ step)
        told(f"log-likelihood {-0.5 * point.unlikelihood:.2f}")
        if promised < DONE:
            break
        better = _along(likelihood, ladder, point, step, float(slope @ step))
        if better is point:
            break
        point = better
    else:
        slope, curvature = _turn(likelihood, ladder, point)
    return Likeliest(point.levels, _deviations(ladder, point, curvature), point.fits, point.unlikelihood)


def _along(likelihood: Likelihood, ladder: Ladder, point: Point, step: Array, descent: float) -> Point:
    """The best of a few points along ``step``: where innovations are not normal, Fisher's step is often too long."""
    best, length = point, 1.0
    for _ in range(TRIALS):
        found = _at(likelihood, ladder, point.shares + length * step, point.fits)
        best = min(best, found, key=lambda entry: entry.unlikelihood)
        bend = found.unlikelihood - point.unlikelihood - length * descent
        lowest = -descent * length**2 / (2.0 * bend) if bend > 0.0 else np.inf
        if lowest > NEAR * length:
            break
        length = max(lowest, SHORTEST * length)
    return best


def _at(likelihood: Likelihood, ladder: Ladder, shares: Array, fits: Sequence[Fit]) -> Point:
    levels = ladder.levels(shares)
    refitted = likelihood.refitted(levels, fits)
    return Point(shares, levels, refitted, likelihood.unlikelihood(refitted))


def _turn(likelihood: Likelihood, ladder: Ladder, point: Point) -> tuple[Array, Array]:
    """Slope (sought,) of the unlikelihood by the shares, and curvature (sought, sought): twice Fisher's information."""
    nudges = NUDGE * np.maximum(point.shares, LEAST_NUDGE)
    still = likelihood.sight(point.levels, point.fits)
    nudged = [likelihood.sight(ladder.levels(row), point.fits) for row in point.shares + np.diag(nudges)]
    moved = np.array([(entry.spread - still.spread) / by for entry, by in zip(nudged, nudges, strict=True)])
    curvature = 2.0 * moved @ moved.T
    slope = (np.array([entry.unlikelihood for entry in nudged]) - still.unlikelihood) / nudges
    return slope - 0.5 * nudges * np.diag(curvature), curvature


def _aim(slope: Array, curvature: Array, shares: Array) -> Array:
    """(sought,) where the parabola is lowest among shares that are not negative."""
    from scipy.optimize import nnls  # noqa: PLC0415 - SciPy is loaded by those who learn noise only

    size = np.sqrt(np.maximum(np.diag(curvature), np.finfo(float).tiny))
    bends, directions = np.linalg.eigh(curvature / np.outer(size, size))
    seen = bends > 1e-9 * bends.max(initial=0.0)
    rows = np.sqrt(bends[seen])[:, None] * directions[:, seen].T
    lowest = rows @ (size * shares) - (directions[:, seen].T @ (slope / size)) / np.sqrt(bends[seen])
    return np.asarray(nnls(rows, lowest)[0] / size)


def _deviations(ladder: Ladder, point: Point, curvature: Array) -> Array:
    """From the variances' to the levels', of which one may be zero."""
    found = np.zeros(len(point.levels))
    variances = np.maximum(np.diag(np.linalg.pinv(0.5 * curvature, hermitian=True)), 0.0)
    by = np.sqrt(variances) * ladder.base[ladder.sought] ** 2
    levels = point.levels[ladder.sought]
    found[ladder.sought] = np.sqrt(levels**2 + by) - levels
    return found
