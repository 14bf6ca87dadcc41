"""Step 3 of the method: which component, moved parameter or faulty sensor explains what the twin leaves of a window.

:func:`screening_test` asks of every window whether a search is worth its time. :func:`search` proposes hypotheses from
the linear response, searches their inner parameters by swarms, and fits the best of them jointly with all parameters.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.candidates import (
    COARSE,
    DECISIVE,
    MAX_CANDIDATES,
    Alternatives,
    Candidate,
    Screening,
    allowed_forms,
    component_of,
    find_candidates,
    screen,
    threshold_like,
)
from otolith.discovery.hypotheses import (
    FaultHypothesis,
    FaultType,
    FittedHypothesis,
    Proposal,
    all_parameters_moved,
    nothing_happened,
    residual_variance_factor,
    with_candidate,
)
from otolith.discovery.linear_response import LinearResponse
from otolith.estimation.arrival_cost import Prior, extend_prior, forget_parameter, initial_prior
from otolith.estimation.augmented import base_model
from otolith.estimation.objective import EXPLAINED, Objective
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import Fit, WindowEstimate, fit
from otolith.twin.augmentation import MAX_COMPONENTS, sources
from otolith.twin.component_families import SourceKind

THRESHOLD_TEST_EVERY = 4  # windows: in one of them, families that the linear response underrates are fitted
MAX_STEPS = 25  # of Gauss-Newton for a hypothesis
MAX_RECORDS = 5000  # last records of a window that are searched
PARTS = 8  # of a window, fitted one after another to find an onset
FAR_OFF = 20.0  # squared innovation in units of its variance: one record in a hundred thousand
EXPECTED_SPREAD = 5.0  # standard deviations of χ² up to which a part of a window is as predicted
MIN_RECORDS_AFTER = 60  # records after an onset that say anything about it
MAX_MOVED, MIN_MOVED_SHARE = 3, 0.5  # parameters tried alone, and their least share of the best gain


@dataclass(frozen=True, slots=True, eq=False)
class ScreeningResult:
    """Whether a search of a window is worth its time."""

    gain: float
    """Largest gain in -2 log evidence over parameters only, minus what is decisive; positive if worth a search."""
    fitted: Fit
    """Its start is the linearisation point."""
    response: LinearResponse
    always_lacking: bool = False
    """Whether only a component with a threshold, fitted under the initial prior, gains enough."""

    @property
    def is_positive(self) -> bool:
        """Whether a search is worth its time."""
        return self.gain > 0.0


def fit_hypotheses(proposals: Iterable[Proposal], window: Window) -> list[FittedHypothesis]:
    """Fit each proposal to ``window``."""
    return [
        FittedHypothesis(item.hypothesis, fit(item.problem, window, item.prior, item.start, MAX_STEPS))
        for item in proposals
    ]


def linearised(problem: Problem, window: Window, prior: Prior, start: Array) -> Fit:
    """Return a fit of no steps: the window, linearised at ``start`` (free, ...)."""
    return fit(problem, window, prior, start, max_steps=0)


def screen_window(predicted: Posterior, estimated: WindowEstimate, *, determined: bool) -> ScreeningResult:
    """Screen the window of an estimate, around the prediction.

    While no parameter is determined or a phase is unknown, it is screened around the estimate instead.

    Of a very long window the last records are screened, so that a search ends before the next window.
    """
    problem, prior, window = predicted.problem, predicted.prior(), estimated.fit.window
    is_known = determined and not predicted.unknown_phases()
    is_long = window.records > MAX_RECORDS and not problem.components
    if is_known and not is_long:
        return screening_test(estimated.fit)
    start = prior.mean if is_known else np.array([parameter.value for parameter in estimated.parameters])
    recent = window.since(window.records - MAX_RECORDS) if is_long else window
    return screening_test(linearised(problem, recent, prior, start))


def screening_test(fitted: Fit) -> ScreeningResult:
    """Return what a component would gain at most, around the start of ``fitted``, on a coarse grid.

    Spectra cost most: those over time are tested in one window, those over angles in the next.
    """
    problem, index = fitted.problem, fitted.window.index
    response = LinearResponse(fitted)
    kind = (SourceKind.TIME, SourceKind.PLACE)[index % 2]
    source_kinds = [source.kind for source in sources(base_model(problem))]
    forms = [
        form
        for form in allowed_forms(problem, response.x)
        if problem.discover and (len(form.model.phases) == 1 or source_kinds[form.source] is kind)
    ]
    gain = float(screen(response, forms, COARSE).scores.max(initial=-np.inf)) - DECISIVE
    if gain <= 0.0 and problem.discover and index % THRESHOLD_TEST_EVERY == 0:
        threshold_gain = _threshold_gain(response) - DECISIVE
        return ScreeningResult(max(gain, threshold_gain), fitted, response, always_lacking=threshold_gain > 0.0)
    return ScreeningResult(gain, fitted, response)


def _threshold_gain(response: LinearResponse) -> float:
    """Return what the threshold-like families would gain if nothing were known of the parameters; they are fitted."""
    problem, fresh = response.problem, initial_prior(response.problem)
    forms = allowed_forms(problem, response.x)
    alternatives = Alternatives.among(problem, forms)
    guesses = [
        (form, form.bounds[0]) for form in forms if form.model.threshold_like and not alternatives.is_sensor(form)
    ]
    screening = Screening.of(response, guesses, alternatives)
    readable = [guess for guess in map(screening.__getitem__, range(len(guesses))) if guess.is_readable]
    proposals = [
        with_candidate(problem, fresh, Candidate(component_of(response, guess), alternatives.of(guess.form), False))
        for guess in threshold_like(problem, readable)
    ]
    best = -np.inf
    for fitted in fit_hypotheses(proposals, response.window):
        count = fitted.fit.count
        variance_factor = residual_variance_factor([fitted.chi_square], count)
        penalty = fitted.deviance(count, 1.0) - fitted.chi_square + len(problem.free) * np.log(count)
        best = max(best, (response.chi_square - fitted.chi_square) / variance_factor - penalty)
    return best


def search(screening: ScreeningResult) -> list[FittedHypothesis]:
    """Return hypotheses of all types, fitted to the screened window; the first one is that nothing has happened."""
    problem, prior, window = screening.fitted.problem, screening.fitted.prior, screening.fitted.window
    proposals = [nothing_happened(problem, prior)]
    if len(problem.free) > 1:
        proposals.append(all_parameters_moved(problem, prior.mean))
    proposals += _one_parameter_moved(problem, prior, screening.response)
    proposals += [with_candidate(problem, prior, candidate) for candidate in find_candidates(screening.response)]
    fitted = fit_hypotheses(proposals, window)
    components = [item for item in fitted if item.type is FaultType.COMPONENT]
    best = min(components, key=_chi_square, default=None)
    while best is not None and len(best.problem.components) < MAX_COMPONENTS:
        best = _with_another_component(best)
        fitted += [] if best is None else [best]
    if screening.always_lacking or not _is_convincing(fitted):
        fitted += _always_lacking(fitted[0])
    return fitted


def _chi_square(fitted: FittedHypothesis) -> float:
    return fitted.chi_square


def _is_convincing(fitted: list[FittedHypothesis]) -> bool:
    """Whether one hypothesis with at most one component explains the window, decisively better than nothing."""
    null, count = fitted[0], fitted[0].fit.count
    variance_factor = residual_variance_factor(map(_chi_square, fitted), count)
    best = min(fitted, key=lambda item: item.deviance(count, variance_factor))
    gain = null.deviance(count, variance_factor) - best.deviance(count, variance_factor)
    added = len(best.problem.components) - len(null.problem.components)
    return gain > DECISIVE and added <= 1 and best.chi_square <= EXPLAINED**2 * count


def _one_parameter_moved(problem: Problem, prior: Prior, response: LinearResponse) -> list[Proposal]:
    """Propose that one parameter, estimated or known, has moved: those that would explain most."""
    known = dict(problem.known)
    given = [
        replace(parameter, nominal=known[parameter.name])
        for parameter in base_model(problem).parameters
        if parameter.name in known and parameter.low < known[parameter.name] < parameter.high
    ]
    parameters = [*problem.free, *given]
    gains = response.score_parameters([parameter.name for parameter in parameters])
    proposals = []
    for index in np.argsort(-gains, kind="stable")[:MAX_MOVED].tolist():
        if gains[index] <= MIN_MOVED_SHARE * gains.max(initial=0.0):
            continue
        parameter = parameters[index]
        moved = FaultHypothesis(FaultType.PARAMETER, parameter.label, 1, float(len(parameters)))
        if index < len(problem.free):
            proposals.append(Proposal(moved, problem, forget_parameter(prior, problem, index), prior.mean))
        else:
            rest = tuple(pair for pair in problem.known if pair[0] != parameter.name)
            wider = replace(problem, free=(*problem.free, parameter), known=rest)
            extended = extend_prior(prior, problem, wider)
            proposals.append(Proposal(moved, wider, extended, extended.mean))
    return proposals


def _with_another_component(best: FittedHypothesis) -> FittedHypothesis | None:
    """Return the best hypothesis with one more component of the machine, or None if it gains nothing decisive."""
    window = best.fit.window
    screening = screening_test(best.fit.linearised_at_end())
    if not screening.is_positive:
        return None
    candidates = [candidate for candidate in find_candidates(screening.response) if not candidate.of_sensor]
    proposals = [
        with_candidate(best.problem, best.fit.prior, candidate, best) for candidate in candidates[: MAX_CANDIDATES // 2]
    ]
    further = min(fit_hypotheses(proposals, window), key=_chi_square, default=None)
    if further is None:
        return None
    count = best.fit.count
    gain = best.deviance(count, 1.0) - further.deviance(count, 1.0)
    return further if gain / residual_variance_factor([further.chi_square], count) > DECISIVE else None


def _always_lacking(null: FittedHypothesis) -> list[FittedHypothesis]:
    """Fit components under the initial prior: a twin that always lacked one has wrong parameters."""
    problem, window = null.problem, null.fit.window
    (moved,) = fit_hypotheses([all_parameters_moved(problem, null.fit.prior.mean)], window)
    screening = screening_test(moved.fit.linearised_at_end())
    if not screening.is_positive:
        return []
    candidates = [candidate for candidate in find_candidates(screening.response) if not candidate.of_sensor]
    proposals = [with_candidate(problem, moved.fit.prior, candidate, moved) for candidate in candidates]
    return fit_hypotheses(proposals, window)


def search_from_onset(predicted: Posterior, screening: ScreeningResult) -> tuple[Posterior, list[FittedHypothesis]]:
    """Search the screened window from the record at which something begins that the prediction does not explain.

    Return the prediction there, and the hypotheses. What begins in the last records is left to the next window: then
    the null hypothesis is the only one.
    """
    window = screening.fitted.window
    onset = find_onset(predicted, window)
    if not onset:
        return predicted, search(screening)
    first = max(min(onset, window.records - MIN_RECORDS_AFTER), 0)
    later, rest = _advance_phases(predicted, window, first), window.since(first)
    problem, prior = later.problem, later.prior()
    if window.records - onset < MIN_RECORDS_AFTER:
        return later, fit_hypotheses([nothing_happened(problem, prior)], rest)
    return later, search(screening_test(linearised(problem, rest, prior, prior.mean)))


def find_onset(predicted: Posterior, window: Window) -> int:
    """Return the record of the onset, or 0 if there is none within the window."""
    as_predicted: FittedHypothesis | None = None
    record = 0
    null = nothing_happened(predicted.problem, predicted.prior())
    for part in range(1, PARTS + 1):
        end = window.records * part // PARTS
        (fitted,) = fit_hypotheses([null], window.until(end))
        count = fitted.fit.count
        if fitted.chi_square > count + EXPECTED_SPREAD * np.sqrt(2.0 * count):
            break
        as_predicted, record = fitted, end
    else:
        return 0
    if as_predicted is None:
        return 0
    return _first_far_off(as_predicted, window.until(min(record + window.records // PARTS, window.records)), record)


def _first_far_off(fitted: FittedHypothesis, window: Window, record: int) -> int:
    """Return the first record from ``record`` on that is far from the one-step prediction of the fit."""
    guess, free = fitted.fit.result.guess, len(fitted.problem.free)
    objective = Objective(fitted.problem, window, guess[:free])
    constant = np.concatenate([guess[:free], guess[2 * free :]])
    squared = (objective.residuals(objective.predict(constant[None]))[0] ** 2).max(axis=1)
    late = np.flatnonzero((squared > FAR_OFF) & (np.arange(window.records) >= record))
    return int(late[0]) if len(late) else window.records


def _advance_phases(predicted: Posterior, window: Window, first: int) -> Posterior:
    """Return the prediction with phases at record ``first``."""
    problem = predicted.problem
    if not first or not problem.components:
        return predicted
    before = window.until(first)
    (fitted,) = fit_hypotheses([nothing_happened(problem, predicted.prior())], before)
    return predicted.propagate_phases(fitted.fit.advance(), window.since(first))
