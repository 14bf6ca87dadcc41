"""Search of one case, compared with the truth."""

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.discovery.draw import Case, draw
from benchmarks.discovery.setting import RankedHypotheses, problem, search_and_rank
from benchmarks.discovery.truth import same
from otolith.discovery.hypotheses import FaultType, FittedHypothesis
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.problem import indices

BAYES_FACTOR_150 = 2.0 * math.log(150.0)  # in -2 log evidence: decides between two hypotheses
QUANTILE_95 = 1.96  # standard deviations on either side of which 95 % lie


@dataclass(frozen=True, slots=True)
class CaseResult:
    """Result of one case."""

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
    """Key of the best hypothesis, or its fault type if it is no component."""
    best_family: str
    first: bool
    """The truth, or an equivalent of it, is best."""
    decided: bool
    """Only equivalents of the truth are within a factor of 150 of the best."""
    named: bool
    """The truth is within a factor of 150 of the best."""
    behind: float
    """Distance of the truth from the best in -2 log evidence; infinite if it was not tried."""
    tried: bool
    """The true hypothesis was fitted."""
    noticed: bool
    """By the screening test."""
    detected: bool
    """A component or a sensor is clearly better than nothing and than other parameters."""
    estimated_amplitude: float
    """By the true hypothesis; not a number if it was not tried."""
    sd: float
    chi_square: float
    """Of the truth, per value."""
    ranking: tuple[tuple[str, float], ...]
    """The first hypotheses, and the distance of each from the best."""
    false_gain: float

    @property
    def normalised_error(self) -> float:
        """Error of the amplitude in its standard deviations."""
        return (self.estimated_amplitude - self.amplitude) / self.sd if self.tried else math.nan

    @property
    def covered(self) -> bool:
        """Whether the 95 % interval has the true amplitude."""
        return abs(self.normalised_error) <= QUANTILE_95


def run_case(number: int, seed: int) -> CaseResult:
    """The case of that number."""
    case = draw(number, seed)
    return judge(case, search_and_rank(problem(), case.window, case.prior))


def judge(case: Case, ranked: RankedHypotheses) -> CaseResult:
    """Compare a search with the truth.

    Hypotheses that are equivalent to the truth count as the truth, and need not be decided between.
    """
    equivalent, least = same(case.truth), ranked.deviances[0]
    best, true_hypothesis = ranked.hypotheses[0], None
    for hypothesis in ranked.hypotheses:
        true_hypothesis = hypothesis if hypothesis.name == case.truth.key else true_hypothesis
    right = [
        value
        for hypothesis, value in zip(ranked.hypotheses, ranked.deviances, strict=True)
        if hypothesis.name in equivalent
    ]
    first = best.name in equivalent
    others = [
        value - least
        for index, (hypothesis, value) in enumerate(zip(ranked.hypotheses, ranked.deviances, strict=True))
        if index and not (first and hypothesis.name in equivalent)
    ]
    simpler = [
        value - least
        for hypothesis, value in zip(ranked.hypotheses, ranked.deviances, strict=True)
        if hypothesis.type in {FaultType.NOTHING, FaultType.PARAMETER}
    ]
    behind = min(right, default=math.inf) - least
    amplitude, sd, chi_square = (
        (math.nan, math.nan, math.nan) if true_hypothesis is None else _amplitude(true_hypothesis, ranked.count)
    )
    return CaseResult(
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
        decided=min(others, default=math.inf) > BAYES_FACTOR_150,
        named=behind <= BAYES_FACTOR_150,
        behind=behind,
        tried=true_hypothesis is not None,
        noticed=ranked.screening.gain > 0.0,
        detected=min(simpler) > DECISIVE,
        estimated_amplitude=amplitude,
        sd=sd,
        chi_square=chi_square,
        ranking=tuple(
            (label(hypothesis), value - least)
            for hypothesis, value in zip(ranked.hypotheses, ranked.deviances, strict=True)
        )[:6],
        false_gain=case.false_gain,
    )


def label(hypothesis: FittedHypothesis) -> str:
    """Name of a hypothesis."""
    return hypothesis.type.value if hypothesis.type in {FaultType.NOTHING, FaultType.PARAMETER} else hypothesis.name


def _family(best: FittedHypothesis, case: Case) -> str:
    """Family for the table; an equivalent of the truth has the family of the truth."""
    if best.name in same(case.truth):
        return case.truth.family
    if best.type is FaultType.COMPONENT:
        return "two or more" if len(best.problem.components) > 1 else best.problem.components[0].family
    return "sensor" if best.type is FaultType.SENSOR else best.type.name.lower()


def _amplitude(hypothesis: FittedHypothesis, count: float) -> tuple[float, float, float]:
    """Amplitude, its standard deviation with trends and initial state unknown, and χ² per value."""
    index = indices(hypothesis.problem, 0)[0]
    normal = hypothesis.fit.result.jacobian.T @ hypothesis.fit.result.jacobian
    size = np.sqrt(np.maximum(np.diag(normal), 1e-300))
    inverse = np.linalg.pinv(normal / np.outer(size, size), rcond=1e-13, hermitian=True)
    sd = math.sqrt(max(float(inverse[index, index]), 0.0)) / float(size[index])
    return float(hypothesis.fit.result.guess[index]), max(sd, 1e-300), hypothesis.chi_square / count
