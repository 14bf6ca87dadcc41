"""Step 3 of the method: which component, moved parameter or faulty sensor explains what the twin leaves of a window.

:mod:`otolith.discovery.screening` tests whether a window is worth a search. :func:`search` proposes hypotheses from the
linear response, refines their inner parameters, and fits the best of them jointly with all parameters.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.candidates import (
    MAX_CANDIDATES,
    Candidate,
    components_of,
    find_candidates,
    periodic_errors,
    threshold_like,
)
from otolith.discovery.hypotheses import (
    FaultHypothesis,
    FaultType,
    FittedHypothesis,
    Proposal,
    all_parameters_moved,
    delay_score,
    evidence_factor,
    is_possible,
    largest_chi_square,
    nothing_happened,
    with_candidate,
    with_components,
)
from otolith.discovery.linear_response import LinearResponse, chi_square_of_parameters
from otolith.discovery.noise_hypothesis import changing_commands, noisier_signals
from otolith.discovery.screening import (
    CompetingForms,
    ScoredGuesses,
    ScreeningResult,
    allowed_forms,
    linearised,
    screen_fit,
)
from otolith.estimation.evidence import CERTAIN_DEVIATE, DECISIVE, discount, is_explained
from otolith.estimation.information import Prior, extend_prior, forget_parameter, initial_prior
from otolith.estimation.objective import Objective
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem, indices
from otolith.estimation.timing import DELAY_RATIO, delayable, largest_delay, trial_delays
from otolith.estimation.window_fit import Fit, fit
from otolith.twin.components import MAX_COMPONENTS
from otolith.twin.definition import Parameter

ROUNDS, STEPS_OF_ROUND = 5, 5  # of Gauss-Newton for a hypothesis
FAR_WORSE = 10.0  # times the least χ² of all candidates: one that leaves more after a round is not fitted further
PARTS = 8  # of a window, fitted one after another to find an onset
FAR_OFF = 20.0  # squared innovation in units of its variance: one record in a hundred thousand
MIN_RECORDS_AFTER = 60  # measured records after an onset from which its cause can be identified
MAX_LATE, MIN_LATE_SHARE = 3, 0.1  # signals whose delays are tried, and their least share of the best gain
DELAY_STEPS = 4  # of Gauss-Newton for a delay
MIN_DELAY_GAIN = 0.1  # in -2 log evidence: a smaller step of a delay is not worth a fit
MAX_MOVED, MIN_MOVED_SHARE = 3, 0.5  # parameters tried alone, and their least share of the best gain


def fit_hypotheses(proposals: Iterable[Proposal], window: Window, far_worse: float = np.inf) -> list[FittedHypothesis]:
    """Fit each proposal to ``window``, in rounds, each with the damping of a new start.

    One whose χ² is ``far_worse`` times that of the best one, or more, is not fitted further.
    """
    fitted = [_first_round(item, window) for item in proposals]
    for _ in range(1, ROUNDS):
        limit = far_worse * min(map(_chi_square, fitted), default=0.0)
        fitted = [
            replace(item, fit=item.fit.continued(STEPS_OF_ROUND)) if item.chi_square <= limit else item
            for item in fitted
        ]
    limit = FAR_WORSE * min(map(_chi_square, fitted), default=0.0)
    return [
        replace(item, fit=item.fit.resolved(ROUNDS * STEPS_OF_ROUND)) if item.chi_square <= limit else item
        for item in fitted
    ]


def explained_again(fitted: FittedHypothesis, item: Proposal, window: Window, before: Posterior) -> FittedHypothesis:
    """Return ``fitted``, or a fit that starts at the last state ``before`` the window, if that is better.

    It is for a hypothesis that explained the window before. A state that is not measured starts at its nominal value,
    from which the fit may reach a local minimum.
    """
    if before.phase is None or not before.phase.last_state or item.problem.delays:
        return fitted
    steps = ROUNDS * STEPS_OF_ROUND
    again = fit(item.problem, window, item.prior, item.start, steps, state=before.phase.last_state).resolved(steps)
    return replace(fitted, fit=again) if again.chi_square < fitted.fit.chi_square else fitted


def _first_round(item: Proposal, window: Window) -> FittedHypothesis:
    result = fit(item.problem, window, item.prior, item.start, STEPS_OF_ROUND)
    if not item.problem.delays:
        return FittedHypothesis(item.hypothesis, result)
    outputs = [window.missing_in(output.name) for output in item.problem.base_model.outputs]
    return FittedHypothesis(item.hypothesis, result, max(float((~np.array(outputs)).sum()) - result.count, 0.0))


def screening_test(fitted: Fit) -> ScreeningResult:
    """Return whether what ``fitted`` leaves of its window is worth a search, around the start of the fit."""
    screening = screen_fit(fitted)
    return with_threshold_test(screening) if screening.needs_threshold_test else screening


def with_threshold_test(screening: ScreeningResult) -> ScreeningResult:
    """Return the screening with what the threshold-like families gain if they are fitted."""
    gain = _threshold_gain(screening.response) - DECISIVE
    return replace(screening, gain=max(screening.gain, gain), always_lacking=gain > 0.0)


def _threshold_gain(response: LinearResponse) -> float:
    """Return what the threshold-like families would gain if nothing were known of the parameters; they are fitted."""
    problem, fresh = response.problem, initial_prior(response.problem)
    forms = allowed_forms(problem, response.x)
    competing = CompetingForms.among(problem, forms)
    guesses = [(form, form.bounds[0]) for form in forms if form.model.threshold_like and not competing.is_sensor(form)]
    scored = ScoredGuesses.of(response, guesses, competing)
    readable = [guess for guess in map(scored.__getitem__, range(len(guesses))) if guess.is_readable]
    proposals = [
        with_candidate(problem, fresh, Candidate(component, competing.of(guess.form), False))
        for guess, component in components_of(response, threshold_like(problem, readable))
    ]
    best = -np.inf
    for fitted in fit_hypotheses(proposals, response.window):
        count = fitted.fit.count
        divisor = evidence_factor([fitted])
        # The initial prior leaves all parameters free, so that the penalty counts them beside those of the component.
        stated = replace(fitted.hypothesis, added=fitted.hypothesis.added + len(problem.free))
        best = max(best, (response.chi_square - fitted.chi_square) / divisor - stated.penalty(count))
    return best


def search(screening: ScreeningResult) -> list[FittedHypothesis]:
    """Return hypotheses of all types, fitted to the screened window; the first one is that nothing has happened.

    Simple hypotheses come first: one cause each. Several causes are searched for only where these do not explain the
    window convincingly.
    """
    fitted = _single_causes(screening)
    fitted += _periodic_errors(screening, fitted)
    if _convincing(fitted) is None:
        fitted += _several_moved(fitted)
    fitted += _several_components(fitted)
    if screening.always_lacking or _convincing(fitted) is None:
        fitted += _always_lacking(fitted[0])
    fitted += _periodic_errors(screening, fitted)
    return _without_local_minima(fitted)


def _single_causes(screening: ScreeningResult) -> list[FittedHypothesis]:
    """Fit the null hypothesis, and those of one cause: parameters, a component or sensor, noise, a delay."""
    problem, prior, window = screening.fitted.problem, screening.fitted.prior, screening.fitted.window
    proposals = [nothing_happened(problem, prior)]
    if len(problem.free) > 1:
        proposals.append(all_parameters_moved(problem, prior.mean))
    proposals += [_moved(problem, prior, *row) for row in _would_explain_most(problem, screening.response)]
    candidates = [with_candidate(problem, prior, candidate) for candidate in find_candidates(screening.response)]
    fitted = [*fit_hypotheses(proposals, window), *_possible(fit_hypotheses(candidates, window, FAR_WORSE))]
    gains = screening.response.score_delays().gain
    least = min(map(_chi_square, fitted))
    fitted += [*changing_commands(fitted[0], gains), *late_signals(fitted[0], gains, least)]
    return fitted + noisier_signals(fitted[0], min(map(_chi_square, fitted)))


def _periodic_errors(screening: ScreeningResult, fitted: list[FittedHypothesis]) -> list[FittedHypothesis]:
    """Fit each sine of an angle or position also as the error of a sensor: else only a force would be periodic."""
    known, own = fitted[0].problem.components, screening.fitted
    limit = largest_chi_square(min(map(_chi_square, fitted)), own.count)
    near = [item for item in fitted if item.chi_square <= limit]
    added = [component for item in near for component in item.problem.components if component not in known]
    taken = {component.key for item in fitted for component in item.problem.components}
    errors = periodic_errors(screening.response, added, taken)
    return fit_hypotheses([with_candidate(own.problem, own.prior, error) for error in errors], own.window, FAR_WORSE)


def _several_components(fitted: list[FittedHypothesis]) -> list[FittedHypothesis]:
    """Fit further components beside the best one, one more at a time, and what each combination has without one.

    It ends when one more component gains nothing decisive, or another hypothesis explains the window convincingly.
    """
    more: list[FittedHypothesis] = []
    best = min((item for item in fitted if item.type is FaultType.COMPONENT), key=_chi_square, default=None)
    while best is not None and len(best.problem.components) < MAX_COMPONENTS:
        if _convincing([*fitted, *more]) not in (None, best):
            break
        further = _best_of(_with_another_component(best, MAX_CANDIDATES // 2))
        if further is None or _gain(further, best) <= DECISIVE:
            break
        more += [further, *_sub_structures(further, [*fitted, *more])]
        best = further
    return more


def _without_local_minima(fitted: list[FittedHypothesis]) -> list[FittedHypothesis]:
    """Return the hypotheses; those of moved parameters are also fitted from values with the effect of the best one.

    With a component, a fit may reach another minimum. The component needs evidence against the parameters alone there.
    """
    best = min(fitted, key=_chi_square)
    if best.type is FaultType.PARAMETER or not best.fit.is_explained:
        return fitted
    unexplained = [item for item in fitted if item.type is FaultType.PARAMETER and not item.fit.is_explained]
    again = fit_hypotheses((_instead_of_components(item, best.fit) for item in unexplained), fitted[0].fit.window)
    refitted = dict(zip(unexplained, again, strict=True))
    return [min(item, refitted.get(item, item), key=_chi_square) for item in fitted]


def _instead_of_components(item: FittedHypothesis, best: Fit) -> Proposal:
    """Propose ``item`` from parameters with the effect, to first order, of the components that only ``best`` has.

    At the values of ``best`` alone, a fit would start at the parameters before they moved.
    """
    problem, labels = best.problem, [free.label for free in best.problem.free]
    added = [indices(problem, slot)[0] for slot in range(len(item.problem.components), len(problem.components))]
    moved = [labels.index(label) for label in item.name.split(", ") if label in labels]
    values, slopes = best.parameters.copy(), best.result.jacobian[: -len(best.prior.mean)]
    values[moved] += np.linalg.lstsq(slopes[:, moved], slopes[:, added] @ values[added])[0]
    known = dict(zip(labels, values.tolist(), strict=True))
    own = zip(item.problem.free, item.fit.parameters.tolist(), strict=True)
    start = np.array([known.get(free.label, value) for free, value in own])
    return Proposal(item.hypothesis, item.problem, item.fit.prior, start)


def late_signals(null: FittedHypothesis, gains: Array, least: float = np.inf) -> list[FittedHypothesis]:
    """Return the hypotheses that one signal is late or early against all others, for those of the largest ``gains``.

    A signal is early if all others are late by the same time. If only one other shows a delay at all, that one is late.
    A signal that shows none has a gain by chance: χ² of one degree of freedom times the variance that the null leaves.
    One is left out if it is far worse than other hypotheses, of which the best leaves χ² of ``least``, and not nearly
    right at any trial delay: between two of these, a late signal leaves at most that share of what the null leaves.
    """
    least_gain = max(MIN_LATE_SHARE * gains.max(initial=0.0), DECISIVE)
    by_chance = DECISIVE * discount(null.chi_square, null.fit.count)
    may_be_early = sum(gain > by_chance for gain in gains.tolist()) > 2
    late = list[FittedHypothesis]()
    for index in np.argsort(-gains, kind="stable")[:MAX_LATE].tolist():
        best = min([least, *map(_chi_square, late)])
        most = max(FAR_WORSE * best, (DELAY_RATIO - 1.0) ** 2 * null.chi_square) / null.fit.count
        item = _late_signal(null, index, most, may_be_early=may_be_early) if gains[index] > least_gain else None
        late += [] if item is None else [item]
    return late


def _late_signal(null: FittedHypothesis, index: int, most: float, *, may_be_early: bool) -> FittedHypothesis | None:
    """Fit the delay of one signal: the best of a grid, then Gauss-Newton steps of the delay.

    None if the best of the grid leaves ``most`` per measured value, or more.
    """
    window, names = null.fit.window, delayable(null.problem.base_model)
    limit = largest_delay(window.grid.length, window.sample_period)
    earliest = -limit if may_be_early else 0.0
    stated = FaultHypothesis(FaultType.TIMING, f"{names[index]} is late", 1, float(len(names)))

    def proposal(delay: float) -> Proposal:
        late = replace(null.problem, delays=((names[index], float(np.clip(delay, earliest, limit))),))
        return Proposal(stated, late, null.fit.prior, null.fit.prior.mean)

    periods = trial_delays(1.0, limit / window.sample_period)
    periods = periods[periods * window.sample_period >= earliest]
    # Late by whole periods, regular samples stay in common records: else there would be twice as many.
    delays = (window.sample_period * np.unique(np.where(np.abs(periods) < 1.0, periods, np.rint(periods)))).tolist()
    left, first = _best_of_grid(proposal, delays, window)
    if left >= most:
        return None
    (best,) = fit_hypotheses([first], window)
    for _ in range(DELAY_STEPS):
        ((_, delay),), score = best.problem.delays, delay_score(best.fit, names[index])
        if score.step**2 * score.information < MIN_DELAY_GAIN:
            break
        (trial,) = fit_hypotheses([proposal(delay + score.step)], window)
        if trial.chi_square >= best.chi_square:
            break
        best = trial
    return best


def _best_of_grid(proposal: Callable[[float], Proposal], delays: list[float], window: Window) -> tuple[float, Proposal]:
    """Return the least χ² per measured value that a delay leaves, and the proposal of that delay.

    Every second one is tried, then the neighbours of the best. Parameters are not fitted: what they explain to first
    order is projected out.
    """

    @cache
    def unexplained(at: int) -> float:
        item = proposal(delays[at])
        fitted = linearised(item.problem, window, item.prior, item.start)
        return chi_square_of_parameters(fitted) / fitted.count

    at = min(range(0, len(delays), 2), key=unexplained)
    best = min(range(max(at - 1, 0), min(at + 2, len(delays))), key=unexplained)
    return unexplained(best), proposal(delays[best])


def _chi_square(fitted: FittedHypothesis) -> float:
    return fitted.chi_square


def _convincing(fitted: list[FittedHypothesis]) -> FittedHypothesis | None:
    """Return the best hypothesis if it explains the window decisively, with at most one component added."""
    null, count, divisor = fitted[0], fitted[0].fit.count, evidence_factor(fitted)
    best = min(fitted, key=lambda item: item.evidence(count, divisor).deviance)
    gain = null.evidence(count, divisor).over(best.evidence(count, divisor))
    added = len(best.problem.components) - len(null.problem.components)
    return best if gain > DECISIVE and added <= 1 and is_explained(best.chi_square, count) else None


def _would_explain_most(problem: Problem, response: LinearResponse) -> list[tuple[str, int]]:
    """Return the labels of the parameters that would explain most if they moved, and how many are considered."""
    labels = [*(item.label for item in problem.free), *(item.name for item in _given(problem))]
    names = [*(item.name for item in problem.free), *labels[len(problem.free) :]]
    gains = response.score_parameters(names)
    leading = np.argsort(-gains, kind="stable")[:MAX_MOVED].tolist()
    return [(labels[at], len(labels)) for at in leading if gains[at] > MIN_MOVED_SHARE * gains.max(initial=0.0)]


def _given(problem: Problem) -> list[Parameter]:
    """Return the parameters that the machine file gives as known, within their bounds."""
    known = dict(problem.known)
    return [
        replace(parameter, nominal=known[parameter.name])
        for parameter in problem.base_model.parameters
        if parameter.name in known and parameter.low < known[parameter.name] < parameter.high
    ]


def _moved(
    problem: Problem, prior: Prior, label: str, alternatives: float, before: FittedHypothesis | None = None
) -> Proposal:
    """Return the hypothesis that a parameter has moved, and those of the fit ``before``, which is of ``problem``."""
    start = prior.mean if before is None else np.array(before.fit.parameters)
    labels = [label] if before is None else [*before.name.split(", "), label]
    order = [item.name for item in problem.base_model.parameters]
    name = ", ".join(sorted(labels, key=lambda own: order.index(own) if own in order else len(order)))
    added, others = (0, 1.0) if before is None else (before.hypothesis.added, before.hypothesis.alternatives)
    stated = FaultHypothesis(FaultType.PARAMETER, name, added + 1, others * alternatives)
    free = [item.label for item in problem.free]
    if label in free:
        return Proposal(stated, problem, forget_parameter(prior, problem, free.index(label)), start)
    parameter = next(item for item in _given(problem) if item.name == label)
    rest = tuple(pair for pair in problem.known if pair[0] != label)
    wider = replace(problem, free=(*problem.free, parameter), known=rest)
    extended = forget_parameter(extend_prior(prior, problem, wider), wider, len(problem.free))
    return Proposal(stated, wider, extended, np.append(start[: len(problem.free)], parameter.nominal))


def _several_moved(fitted: list[FittedHypothesis]) -> list[FittedHypothesis]:
    """Fit the hypotheses that further parameters have moved beside the best single one, one more at a time.

    Without them a component would take the place of a second known parameter.
    """
    single = [item for item in fitted if item.type is FaultType.PARAMETER and item.hypothesis.added == 1]
    best, more = min(single, key=_chi_square, default=None), list[FittedHypothesis]()
    while best is not None and not best.fit.is_explained and best.hypothesis.added < MAX_MOVED:
        response = LinearResponse(best.fit.linearised_at_end())
        named = [row for row in _would_explain_most(best.problem, response) if row[0] not in best.name.split(", ")]
        proposals = [_moved(best.problem, best.fit.prior, label, number, best) for label, number in named]
        further = _best_of(fit_hypotheses(proposals, best.fit.window, FAR_WORSE))
        if further is None or _gain(further, best) <= DECISIVE:
            break
        more.append(further)
        best = further
    return more


def _best_of(fitted: list[FittedHypothesis]) -> FittedHypothesis | None:
    """Return the most probable one of hypotheses that state one thing more than the same other one."""
    return min(fitted, key=lambda item: item.evidence(item.fit.count, 1.0).deviance, default=None)


def _gain(further: FittedHypothesis, before: FittedHypothesis) -> float:
    """Return by how much -2 log evidence falls from ``before`` to ``further``."""
    count, divisor = before.fit.count, evidence_factor([further])
    return before.evidence(count, divisor).over(further.evidence(count, divisor))


def _with_another_component(fitted: FittedHypothesis, first: int = MAX_CANDIDATES) -> list[FittedHypothesis]:
    """Fit the hypotheses of one more component of the machine beside ``fitted``; none where that leaves nothing.

    Of the candidates the ``first`` are fitted, and those with thresholds, which the linear response underrates.
    """
    screening = screening_test(fitted.fit.linearised_at_end())
    if not screening.is_positive:
        return []
    candidates = [candidate for candidate in find_candidates(screening.response) if not candidate.of_sensor]
    chosen = candidates[:first] + [item for item in candidates[first:] if item.component.model.threshold_like]
    proposals = [with_candidate(fitted.problem, fitted.fit.prior, candidate, fitted) for candidate in chosen]
    return _possible(fit_hypotheses(proposals, fitted.fit.window, FAR_WORSE))


def _sub_structures(whole: FittedHypothesis, fitted: list[FittedHypothesis]) -> list[FittedHypothesis]:
    """Fit the hypotheses that lack one component of ``whole`` and are not among ``fitted``.

    They compete with it, so that each component needs evidence of its own.
    """
    null, window = fitted[0], whole.fit.window
    known = {component.key for component in null.problem.components}
    added = [component for component in whole.problem.components if component.key not in known]
    present = {frozenset(component.key for component in item.problem.components) for item in fitted}
    smaller = [[component for component in added if component is not lacking] for lacking in added]
    alternatives = whole.hypothesis.alternatives ** (1.0 - 1.0 / max(len(added), 1))
    proposals = [
        with_components(null.problem, null.fit.prior, rest, alternatives, FaultType.COMPONENT)
        for rest in smaller
        if frozenset((*known, *(component.key for component in rest))) not in present
    ]
    return _possible(fit_hypotheses(proposals, window, FAR_WORSE))


def _possible(fitted: list[FittedHypothesis]) -> list[FittedHypothesis]:
    """Return the hypotheses whose components lie within their physical ranges."""
    return [item for item in fitted if is_possible(item.problem, item.fit.parameters)]


def _always_lacking(null: FittedHypothesis) -> list[FittedHypothesis]:
    """Fit components under the initial prior: a twin that always lacked one has wrong parameters."""
    proposal = all_parameters_moved(null.problem, null.fit.prior.mean)
    (moved,) = fit_hypotheses([proposal], null.fit.window)
    return _with_another_component(moved)


def search_from_onset(predicted: Posterior, screening: ScreeningResult) -> tuple[Posterior, list[FittedHypothesis]]:
    """Search the screened window from the record at which something begins that the prediction does not explain.

    Return the prediction there, and the hypotheses. Onsets among the first records are searched for only if no single
    cause explains the whole window: otherwise the cause has begun with it.
    """
    window = screening.fitted.window
    if screening.always_late:
        return predicted, search(screening)
    if onset := find_onset(predicted, window):
        return _search_since(predicted, screening, onset)
    fitted = search(screening)
    onset = 0 if _is_explained(fitted) else _early_onset(predicted, window)
    if not onset:
        return predicted, fitted
    later, again = _search_since(predicted, screening, onset)
    return (later, again) if _is_explained(again) else (predicted, fitted)


def _search_since(
    predicted: Posterior, screening: ScreeningResult, onset: int
) -> tuple[Posterior, list[FittedHypothesis]]:
    """Return the prediction at record ``onset``, and the hypotheses about the window from there on.

    What begins in the last records is left to the next window: then the null hypothesis is the only one.
    """
    window = screening.fitted.window
    measured = np.flatnonzero(screening.fitted.objective.present.any(axis=1))
    latest = int(measured[-MIN_RECORDS_AFTER]) if len(measured) >= MIN_RECORDS_AFTER else 0
    first = min(onset, latest)
    later, rest = _advance_phases(predicted, window, first), window.since(first)
    (null,) = fit_hypotheses([nothing_happened(later.problem, later.prior())], rest)
    return later, [null] if onset > latest else search(screening_test(null.fit))


def _is_explained(fitted: list[FittedHypothesis]) -> bool:
    """Whether a hypothesis with one component added, or none, leaves no more than the noise of the window."""
    simple = len(fitted[0].problem.components) + 1
    return any(_leaves_noise(item) for item in fitted if len(item.problem.components) <= simple)


def _leaves_noise(fitted: FittedHypothesis) -> bool:
    count = fitted.fit.count
    return bool(fitted.unexplained <= count + CERTAIN_DEVIATE * np.sqrt(2.0 * count))


def find_onset(predicted: Posterior, window: Window) -> int:
    """Return the record of the onset, or 0 if there is none within the window, or none after its first part."""
    before: FittedHypothesis | None = None
    record, part = 0, window.records // PARTS
    for number in range(1, PARTS + 1):
        end = max(window.records * number // PARTS, 1)
        fitted = _as_predicted(predicted, window.until(end))
        if fitted is None:
            return 0 if before is None else _first_far_off(before, window.until(min(record + part, end)), record)
        before, record = fitted, end
    return 0


def _early_onset(predicted: Posterior, window: Window) -> int:
    """Return the record of an onset in the first part of the window, before which all is as predicted; 0 for none."""
    first = window.until(max(window.records // PARTS, 1))
    record = first.records // 2
    while record:
        if (before := _as_predicted(predicted, first.until(record))) is not None:
            return _first_far_off(before, first, record)
        record //= 2
    return 0


def _as_predicted(predicted: Posterior, window: Window) -> FittedHypothesis | None:
    """Return the null hypothesis fitted to the window, or None if it leaves more than the prediction allows."""
    (fitted,) = fit_hypotheses([nothing_happened(predicted.problem, predicted.prior())], window)
    return fitted if _leaves_noise(fitted) else None


def _first_far_off(fitted: FittedHypothesis, window: Window, record: int) -> int:
    """Return the first record from ``record`` on that is far from the one-step prediction of the fit."""
    objective = Objective(fitted.problem, window, fitted.fit.parameters)
    squared = (objective.residuals(objective.predict(fitted.fit.guess[None]))[0] ** 2).max(axis=1)
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
