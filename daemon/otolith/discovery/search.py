"""A glance at every window: whether a search for components would be worth its time.

Step 3 of the method: which component, moved parameter or lying sensor explains what the twin leaves of a window.

Candidates are screened by the twin's linearised response, inner numbers searched by swarms, and the best polished
jointly with everything else in the completed twin; evidence tells what is better, over "nothing has happened" and over
"parameters have moved".
"""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.candidates import (
    CLEARLY,
    COARSE,
    LARGEST,
    TRIED,
    Candidate,
    allowed_forms,
    candidates,
    component_of,
    evaluated,
    rivals_of,
    screened,
    threshold_like,
)
from otolith.discovery.hypotheses import (
    FaultHypothesis,
    FaultType,
    FittedHypothesis,
    extend_prior,
    fit_hypothesis,
    residual_variance_factor,
    with_candidate,
)
from otolith.discovery.linear_response import LinearResponse
from otolith.estimation.arrival_cost import Prior, initial_prior
from otolith.estimation.augmented import base_model
from otolith.estimation.objective import EXPLAINED, Objective
from otolith.estimation.problem import Problem
from otolith.twin.augmentation import MAX_COMPONENTS, sources
from otolith.twin.component_families import SourceKind

LOOKED_AT = 4  # windows, in one of which families are tried that the linear picture underrates


@dataclass(frozen=True, slots=True, eq=False)
class ScreeningResult:
    """What a window would gain at most, by a coarse look."""

    gain: float
    """In -2 log evidence, over parameters only; positive for something worth a search."""
    landscape: LinearResponse
    lacking: bool = False
    """Whether it is worth it only if the twin has lacked it from the first window on."""


def screening_test(problem: Problem, window: Window, prior: Prior, start: Array) -> ScreeningResult:
    """A coarse look at what a component would gain, around ``start`` (free parameters, ...)."""
    landscape = LinearResponse(problem, window, prior, start[: len(problem.free)])
    # Lines of the spectrum cost most: those over time are looked at in one window, those over angles in the next.
    turn = (SourceKind.TIME, SourceKind.PLACE)[window.index % 2]
    found = [
        entry
        for entry in allowed_forms(problem, landscape.x)
        if problem.discover
        and (len(entry.model.phases) == 1 or sources(base_model(problem))[entry.source].kind is turn)
    ]
    _, _, scores = screened(landscape, problem, found, COARSE)
    gain = float(scores.max(initial=-np.inf)) - CLEARLY
    if gain <= 0.0 and problem.discover and window.index % LOOKED_AT == 0:
        held = _held(problem, window, landscape) - CLEARLY
        return ScreeningResult(max(gain, held), landscape, lacking=held > 0.0)
    return ScreeningResult(gain, landscape)


def _held(problem: Problem, window: Window, landscape: LinearResponse) -> float:
    """What a family would gain that the linear picture underrates, whatever was known of the parameters."""
    found = allowed_forms(problem, landscape.x)
    rivals = rivals_of(problem, found)
    guesses = [(entry, entry.bounds[0]) for entry in found if entry.model.threshold_like and not rivals.lies(entry)]
    gains = evaluated(landscape, guesses)
    settled = [
        (guess, pair, 0.0)
        for guess, pair in zip(guesses, gains.amplitudes, strict=True)
        if 0.0 < np.abs(pair).max() < LARGEST
    ]
    fresh, best = initial_prior(problem), -np.inf
    for (structure, inner), pair, _ in threshold_like(problem, settled):
        candidate = Candidate(
            component_of(problem, window, structure, inner, pair), rivals.of(structure), of_sensor=False
        )
        tried = with_candidate(problem, window, fresh, candidate)
        left = residual_variance_factor([tried.chi_square], tried.informed.count)
        price = tried.deviance(tried.informed.count, 1.0) - tried.chi_square
        price += len(problem.free) * np.log(tried.informed.count)
        best = max(best, (landscape.chi_square - tried.chi_square) / left - price)
    return best


FEW, WORTHY = 3, 0.5  # parameters one of which might have moved, and their share of the best gain
PARTS = 8  # of a window, to see where in it something has begun
FAR_OFF = 20.0  # square of an innovation, in units of its noise: one record in a hundred thousand
CALM = 5.0  # standard deviations of χ², up to which a part of a window looks as it should


def search(problem: Problem, window: Window, prior: Prior, seen: ScreeningResult) -> list[FittedHypothesis]:
    """Explanations of ``window``, of all reasons; the first one is that nothing has happened."""
    names = ", ".join(entry.name for entry in problem.free if not entry.name.startswith("_"))
    found = [fit_hypothesis(FaultHypothesis(FaultType.NOTHING), problem, window, prior)]
    if len(problem.free) > 1:
        moved = FaultHypothesis(FaultType.PARAMETER, names, len(problem.free))
        found.append(fit_hypothesis(moved, problem, window, initial_prior(problem), prior.mean))
    found += _one_moved(problem, window, prior, seen.landscape)
    found += [with_candidate(problem, window, prior, entry) for entry in candidates(problem, seen.landscape, window)]
    best = min((entry for entry in found if entry.reason is FaultType.COMPONENT), key=_left, default=None)
    while best is not None and len(best.problem.components) < MAX_COMPONENTS:
        more = _further(best, window)
        if more is None:
            break
        found.append(more)
        best = more
    if seen.lacking or not _convinces(found):
        found += _always_lacking(problem, window, prior)
    return found


def _convinces(found: list[FittedHypothesis]) -> bool:
    """Whether one of them explains the window, by one component at most, and clearly better than nothing does."""
    records = found[0].informed.count
    left = residual_variance_factor((entry.chi_square for entry in found), records)
    best = min(found, key=lambda entry: entry.deviance(records, left))
    gained = found[0].deviance(records, left) - best.deviance(records, left)
    more = len(best.problem.components) - len(found[0].problem.components)
    return gained > CLEARLY and more <= 1 and best.chi_square <= EXPLAINED**2 * records


def _always_lacking(problem: Problem, window: Window, prior: Prior) -> list[FittedHypothesis]:
    """The twin may have lacked something from the first window on, and what is known of parameters be wrong for it."""
    names = ", ".join(entry.label for entry in problem.free)
    fresh = initial_prior(problem)
    moved = fit_hypothesis(
        FaultHypothesis(FaultType.PARAMETER, names, len(problem.free)), problem, window, fresh, prior.mean
    )
    seen = screening_test(problem, window, fresh, moved.fit.guess)
    if seen.gain <= 0.0:
        return []
    tried = [entry for entry in candidates(problem, seen.landscape, window) if not entry.of_sensor]
    return [with_candidate(problem, window, fresh, entry, moved) for entry in tried]


def _one_moved(problem: Problem, window: Window, prior: Prior, landscape: LinearResponse) -> list[FittedHypothesis]:
    """One parameter may have moved, be it estimated or taken as known: those that would explain most."""
    known = dict(problem.known)
    given = [
        replace(entry, nominal=known[entry.name])
        for entry in base_model(problem).parameters
        if entry.name in known and entry.low < known[entry.name] < entry.high
    ]
    all_of_them = [*problem.free, *given]
    gains = landscape.parameter_gains([entry.name for entry in all_of_them])
    found = []
    for index in np.argsort(-gains, kind="stable")[:FEW].tolist():
        if gains[index] <= WORTHY * gains.max(initial=0.0):
            continue
        entry = all_of_them[index]
        claim = FaultHypothesis(FaultType.PARAMETER, entry.label, 1, float(len(all_of_them)))
        if index < len(problem.free):
            found.append(fit_hypothesis(claim, problem, window, _but_for(prior, problem, index), prior.mean))
        else:
            rest = tuple(pair for pair in problem.known if pair[0] != entry.name)
            wider = replace(problem, free=(*problem.free, entry), known=rest)
            found.append(fit_hypothesis(claim, wider, window, extend_prior(prior, problem, wider)))
    return found


def _but_for(prior: Prior, problem: Problem, index: int) -> Prior:
    """What is known, but nothing of one parameter."""
    mean, covariance, fresh = prior.mean.copy(), prior.covariance.copy(), initial_prior(problem)
    for at in (index, index + len(problem.free)):
        mean[at] = fresh.mean[at]
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = fresh.covariance[at, at]
    return Prior(mean, covariance)


def onset(problem: Problem, window: Window, prior: Prior) -> int:
    """The record at which a window begins that the twin as it was does not foretell; 0 if it is so from the start."""
    calm: FittedHypothesis | None = None
    record = 0
    for part in range(1, PARTS + 1):
        end = window.records * part // PARTS
        tried = fit_hypothesis(FaultHypothesis(FaultType.NOTHING), problem, window.until(end), prior)
        count = tried.informed.count
        if tried.chi_square > count + CALM * np.sqrt(2.0 * count):
            break
        calm, record = tried, end
    else:  # all of it is, in itself, as it could be
        return 0
    if calm is None:
        return 0
    # On from where all was well, as if it had stayed so: the first record that is far off.
    following = window.until(min(record + window.records // PARTS, window.records))
    objective = Objective(problem, following, calm.fit.guess[: len(problem.free)])
    free = len(problem.free)
    still = np.concatenate([calm.fit.guess[:free], calm.fit.guess[2 * free :]])
    off = (objective.residuals(objective.predict(still[None]))[0] ** 2).max(axis=1) > FAR_OFF
    late = np.flatnonzero(off & (np.arange(following.records) >= record))
    return int(late[0]) if len(late) else following.records


def _left(found: FittedHypothesis) -> float:
    return found.chi_square


def _further(best: FittedHypothesis, window: Window) -> FittedHypothesis | None:
    """The best explanation with one more component of the machine, if that is worth it."""
    seen = screening_test(best.problem, window, best.prior, best.fit.guess)
    if seen.gain <= 0.0:
        return None
    tried = [entry for entry in candidates(best.problem, seen.landscape, window) if not entry.of_sensor][: TRIED // 2]
    more = [with_candidate(best.problem, window, best.prior, entry, best) for entry in tried]
    found = min(more, key=_left, default=None)
    if found is None:
        return None
    records = best.informed.count
    gained = best.deviance(records, 1.0) - found.deviance(records, 1.0)
    return found if gained / residual_variance_factor([found.chi_square], records) > CLEARLY else None
