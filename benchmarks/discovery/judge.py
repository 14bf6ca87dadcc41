"""One case searched and judged."""

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.discovery.draw import Case, draw
from benchmarks.discovery.setting import Ranked, problem, ranked
from benchmarks.discovery.truth import same
from otolith.discovery.candidates import CLEARLY
from otolith.discovery.hypotheses import FaultType, FittedHypothesis
from otolith.estimation.augmented import indices

APART = 2.0 * math.log(150.0)  # in -2 log evidence: what decides between two explanations
INTERVAL = 1.96  # standard deviations on either side of which 95 % lie


@dataclass(frozen=True, slots=True)
class Judged:
    """One line of the details."""

    number: int
    kind: str
    truth: str
    """Its key."""
    family: str
    times: float
    """Of the detection limit."""
    amplitude: float
    inner: float
    best: str
    """Key of the best explanation, or its reason where it is no component."""
    best_family: str
    first: bool
    """The truth, or what is the same in this motor, is best."""
    decided: bool
    """No other than the truth's equals comes within a factor of 150 of the best."""
    named: bool
    """The truth is within a factor of 150 of the best."""
    behind: float
    """How far in -2 log evidence the truth is behind the best; infinite where it was not tried."""
    tried: bool
    """The truth itself was polished."""
    noticed: bool
    """By the glance."""
    detected: bool
    """A component or a sensor is clearly better than nothing and than other parameters."""
    found_amplitude: float
    """By the explanation that is the truth; not a number where it was not tried."""
    sd: float
    chi_square: float
    """Of the truth, per value."""
    ranking: tuple[tuple[str, float], ...]
    """The first few explanations, and how far each is behind."""
    false_gain: float

    @property
    def off(self) -> float:
        """How many standard deviations the amplitude is off."""
        return (self.found_amplitude - self.amplitude) / self.sd if self.tried else math.nan

    @property
    def covered(self) -> bool:
        """Whether the 95 % interval has the true amplitude."""
        return abs(self.off) <= INTERVAL


def judged(number: int, seed: int) -> Judged:
    """The case of that number."""
    case = draw(number, seed)
    return verdict(case, ranked(problem(), case.window, case.prior))


def verdict(case: Case, found: Ranked) -> Judged:
    """What came out of a search.

    Explanations that are the same function as the truth count as one with it: the best of them is the truth, and two
    of them do not have to be told apart to be decided.
    """
    alike, least = same(case.truth), found.deviances[0]
    best, own = found.explanations[0], None
    for entry in found.explanations:
        own = entry if entry.name == case.truth.key else own
    right = [value for entry, value in zip(found.explanations, found.deviances, strict=True) if entry.name in alike]
    first = best.name in alike
    others = [
        value - least
        for place, (entry, value) in enumerate(zip(found.explanations, found.deviances, strict=True))
        if place and not (first and entry.name in alike)
    ]
    simpler = [
        value - least
        for entry, value in zip(found.explanations, found.deviances, strict=True)
        if entry.reason in {FaultType.NOTHING, FaultType.PARAMETER}
    ]
    behind = min(right, default=math.inf) - least
    amplitude, sd, left = (math.nan, math.nan, math.nan) if own is None else _measured(own, found.count)
    return Judged(
        number=case.number,
        kind=case.kind,
        truth=case.truth.key,
        family=case.truth.family,
        times=case.times,
        amplitude=case.truth.amplitude,
        inner=case.truth.inner,
        best=label(best),
        best_family=_family(best, case),
        first=first,
        decided=min(others, default=math.inf) > APART,
        named=behind <= APART,
        behind=behind,
        tried=own is not None,
        noticed=found.glance.gain > 0.0,
        detected=min(simpler) > CLEARLY,
        found_amplitude=amplitude,
        sd=sd,
        chi_square=left,
        ranking=tuple(
            (label(entry), value - least) for entry, value in zip(found.explanations, found.deviances, strict=True)
        )[:6],
        false_gain=case.false_gain,
    )


def label(entry: FittedHypothesis) -> str:
    """Of any explanation."""
    return entry.reason.value if entry.reason in {FaultType.NOTHING, FaultType.PARAMETER} else entry.name


def _family(best: FittedHypothesis, case: Case) -> str:
    """For the table: of an equal of the truth it is the truth's."""
    if best.name in same(case.truth):
        return case.truth.family
    if best.reason is FaultType.COMPONENT:
        return "two or more" if len(best.problem.components) > 1 else best.problem.components[0].family
    return "sensor" if best.reason is FaultType.SENSOR else best.reason.name.lower()


def _measured(entry: FittedHypothesis, count: float) -> tuple[float, float, float]:
    """Amplitude, its standard deviation with trends and initial state unknown, and χ² per value."""
    place = indices(entry.problem, 0)[0]
    normal = entry.fit.jacobian.T @ entry.fit.jacobian
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-13, hermitian=True)
    sd = math.sqrt(max(float(inverse[place, place]), 0.0)) / float(size[place])
    return float(entry.fit.guess[place]), max(sd, 1e-300), entry.chi_square / count
