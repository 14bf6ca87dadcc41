"""Step 3 of the method: which component, moved parameter or lying sensor explains what the twin leaves of a window.

Candidates are screened by the twin's linearised response, inner numbers searched by swarms, and the best polished
jointly with everything else in the completed twin; evidence tells what is better, over "nothing has happened" and over
"parameters have moved".
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Window
from otolith.adaptation.claims import (
    Claim,
    Explanation,
    Reason,
    explanation,
    extended,
    unexplained,
    with_candidate,
)
from otolith.adaptation.completion import plain
from otolith.adaptation.glance import Glance, glance
from otolith.adaptation.landscape import Landscape
from otolith.adaptation.objective import EXPLAINED, Objective
from otolith.adaptation.prior import Prior, vague
from otolith.adaptation.problem import Problem
from otolith.adaptation.screening import CLEARLY, TRIED, candidates
from otolith.twin.slots import SLOTS

FEW, WORTHY = 3, 0.5  # parameters one of which might have moved, and their share of the best gain
PARTS = 8  # of a window, to see where in it something has begun
FAR_OFF = 20.0  # square of an innovation, in units of its noise: one record in a hundred thousand
CALM = 5.0  # standard deviations of χ², up to which a part of a window looks as it should


def search(problem: Problem, window: Window, prior: Prior, seen: Glance) -> list[Explanation]:
    """Explanations of ``window``, of all reasons; the first one is that nothing has happened."""
    names = ", ".join(entry.name for entry in problem.free if not entry.name.startswith("_"))
    found = [explanation(Claim(Reason.NOTHING), problem, window, prior)]
    if len(problem.free) > 1:
        moved = Claim(Reason.PARAMETER, names, len(problem.free))
        found.append(explanation(moved, problem, window, vague(problem), prior.mean))
    found += _one_moved(problem, window, prior, seen.landscape)
    found += [with_candidate(problem, window, prior, entry) for entry in candidates(problem, seen.landscape, window)]
    best = min((entry for entry in found if entry.reason is Reason.COMPONENT), key=_left, default=None)
    while best is not None and len(best.problem.components) < SLOTS:
        more = _further(best, window)
        if more is None:
            break
        found.append(more)
        best = more
    if seen.lacking or not _convinces(found):
        found += _always_lacking(problem, window, prior)
    return found


def _convinces(found: list[Explanation]) -> bool:
    """Whether one of them explains the window, by one component at most, and clearly better than nothing does."""
    records = found[0].informed.count
    left = unexplained((entry.chi_square for entry in found), records)
    best = min(found, key=lambda entry: entry.deviance(records, left))
    gained = found[0].deviance(records, left) - best.deviance(records, left)
    more = len(best.problem.components) - len(found[0].problem.components)
    return gained > CLEARLY and more <= 1 and best.chi_square <= EXPLAINED**2 * records


def _always_lacking(problem: Problem, window: Window, prior: Prior) -> list[Explanation]:
    """The twin may have lacked something from the first window on, and what is known of parameters be wrong for it."""
    names = ", ".join(entry.label for entry in problem.free)
    fresh = vague(problem)
    moved = explanation(Claim(Reason.PARAMETER, names, len(problem.free)), problem, window, fresh, prior.mean)
    seen = glance(problem, window, fresh, moved.fit.guess)
    if seen.gain <= 0.0:
        return []
    tried = [entry for entry in candidates(problem, seen.landscape, window) if not entry.of_sensor]
    return [with_candidate(problem, window, fresh, entry, moved) for entry in tried]


def _one_moved(problem: Problem, window: Window, prior: Prior, landscape: Landscape) -> list[Explanation]:
    """One parameter may have moved, be it estimated or taken as known: those that would explain most."""
    known = dict(problem.known)
    given = [
        replace(entry, nominal=known[entry.name])
        for entry in plain(problem).parameters
        if entry.name in known and entry.low < known[entry.name] < entry.high
    ]
    all_of_them = [*problem.free, *given]
    gains = landscape.parameter_gains([entry.name for entry in all_of_them])
    found = []
    for index in np.argsort(-gains, kind="stable")[:FEW].tolist():
        if gains[index] <= WORTHY * gains.max(initial=0.0):
            continue
        entry = all_of_them[index]
        claim = Claim(Reason.PARAMETER, entry.label, 1, float(len(all_of_them)))
        if index < len(problem.free):
            found.append(explanation(claim, problem, window, _but_for(prior, problem, index), prior.mean))
        else:
            rest = tuple(pair for pair in problem.known if pair[0] != entry.name)
            wider = replace(problem, free=(*problem.free, entry), known=rest)
            found.append(explanation(claim, wider, window, extended(prior, problem, wider)))
    return found


def _but_for(prior: Prior, problem: Problem, index: int) -> Prior:
    """What is known, but nothing of one parameter."""
    mean, covariance, fresh = prior.mean.copy(), prior.covariance.copy(), vague(problem)
    for at in (index, index + len(problem.free)):
        mean[at] = fresh.mean[at]
        covariance[at, :] = covariance[:, at] = 0.0
        covariance[at, at] = fresh.covariance[at, at]
    return Prior(mean, covariance)


def onset(problem: Problem, window: Window, prior: Prior) -> int:
    """The record at which a window begins that the twin as it was does not foretell; 0 if it is so from the start."""
    calm: Explanation | None = None
    record = 0
    for part in range(1, PARTS + 1):
        end = window.records * part // PARTS
        tried = explanation(Claim(Reason.NOTHING), problem, window.until(end), prior)
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


def _left(found: Explanation) -> float:
    return found.chi_square


def _further(best: Explanation, window: Window) -> Explanation | None:
    """The best explanation with one more component of the machine, if that is worth it."""
    seen = glance(best.problem, window, best.prior, best.fit.guess)
    if seen.gain <= 0.0:
        return None
    tried = [entry for entry in candidates(best.problem, seen.landscape, window) if not entry.of_sensor][: TRIED // 2]
    more = [with_candidate(best.problem, window, best.prior, entry, best) for entry in tried]
    found = min(more, key=_left, default=None)
    if found is None:
        return None
    records = best.informed.count
    gained = best.deviance(records, 1.0) - found.deviance(records, 1.0)
    return found if gained / unexplained([found.chi_square], records) > CLEARLY else None
