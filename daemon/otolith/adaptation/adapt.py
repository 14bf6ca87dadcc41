"""The heart: one pure function from a state and a window to the next state and a report.

Time comes in with the window and randomness with the seed, so that every run can be reproduced bit for bit, and the
work can move between processes without loss.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation.reporting import Learned, document_of, traces_of
from otolith.adaptation.state import State, without_component
from otolith.discovery.adopted import FADES_AFTER, adopted, alternatives, approving, faded, slot_of, words
from otolith.discovery.hypotheses import Hypothesis, Reason
from otolith.discovery.phase_tracking import is_lost, left_out, moved_on, outlived, turned
from otolith.discovery.search import glance
from otolith.discovery.sequential_test import (
    REFUSED,
    TEACHING,
    Case,
    Lesson,
    Memory,
    considered,
    decided,
    is_sure_of_some,
    is_surprising,
    learn,
    refuse,
)
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.augmented import plain
from otolith.estimation.data_checks import counted_twice, stuck, without_spikes
from otolith.estimation.imm_filter import Belief, carried, overall, rebased
from otolith.estimation.objective import EXPLAINED
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import WindowEstimate, estimate, refine
from otolith.estimation.window_length import Need, next_records
from otolith.health.schema import Report

FEWEST_RECORDS = 5
SEARCHED = 5000  # records, the last ones of a window, in which components are looked for: a search has to end
PHASES = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)  # rad
LARGEST = 1e12  # of a value, in the unit of its signal: no sensor says that
NEVER = "are the signals and [noise] what the machine file says, in unit and size?"
SCATTERED = 3.0  # ratio of variances: windows disagree that much more than they say
CONTRADICTORY = (
    "windows disagree with each other {:.1f} times more than they should: the twin or [noise] lacks something"
)
UNUSED = "window not estimated from: "
UNEXPLAINED = "the twin does not explain the window up to the noise: another parameter, a component or a sensor is off"


def adapt(state: State, window: Window) -> tuple[State, Report]:
    """Adapt the twin to ``window``; a bad window leaves what is known where it was and is reported."""
    for component in outlived(state.problem, window):
        state = without_component(state, component)
    learned = _judge(state, window)
    learned = replace(learned, catalogue=approving(learned.catalogue, state.approved))
    standing, document = document_of(state, window, learned)
    after = replace(
        state,
        problem=learned.problem,
        memory=learned.memory,
        catalogue=learned.catalogue,
        standing=standing,
        records=_next_records(state, window, learned),
    )
    return after, Report(document, traces_of(state, window, learned))


def _judge(state: State, window: Window) -> Learned:
    """Sampling and sensors are looked at first: what lies must not teach."""
    problem, memory = state.problem, state.memory
    expected = carried(moved_on(memory.belief, problem, memory.turned, window), window.end)
    before = overall(expected, problem)
    untaught = Learned(memory, before, before, problem, state.catalogue)
    reasons = window.quality.reasons if window.quality.verdict is Verdict.BAD else _senseless(window)
    if reasons:
        return replace(untaught, reason=UNUSED + "; ".join(reasons))
    window, notes, vetoes = without_spikes(window, plain(problem), problem.noise)
    if not vetoes:
        vetoes = stuck(problem, window, _start(before, problem))
    if vetoes:
        return replace(untaught, memory=refuse(memory), lesson=Lesson.SENSOR, reason=UNUSED + "; ".join(vetoes))
    window, repeated = counted_twice(window, plain(problem))
    learned = _learn(state, window, expected, untaught)
    return replace(learned, reason="; ".join(filter(None, (*notes, *repeated, learned.reason))))


def _senseless(window: Window) -> tuple[str, ...]:
    """Why nothing can be estimated from a window, however well it was sampled."""
    if window.records < FEWEST_RECORDS:
        return (f"{window.records} records are too few",)
    if not (np.abs(window.values) < LARGEST).all():  # not a number is not smaller either
        return (f"a value is not finite or beyond {LARGEST:g}",)
    return ()


def _learn(state: State, window: Window, expected: Belief, untaught: Learned) -> Learned:
    """What the window says, weighed with what was ``expected`` at its end."""
    problem, memory, prior = state.problem, state.memory, untaught.before
    warm = any(entry.known for entry in state.standing.values())
    lost = is_lost(expected, problem)
    found = _refined(problem, window, prior, lost) if warm else estimate(problem, window, _start(prior, problem), prior)
    start = prior.mean if warm and not lost else np.array([entry.value for entry in found.parameters])
    recent = window if problem.components else window.since(max(window.records - SEARCHED, 0))
    seen = glance(problem, recent, prior, start)
    expectable = found.cost <= REFUSED and not is_surprising(expected, found.evidence, problem)
    if memory.case is None and expectable and found.cost <= EXPLAINED and seen.gain <= 0.0:
        return _expected(untaught, window, expected, found)
    untaught = replace(untaught, searched=True)
    considering = considered(memory, problem, recent, expected, (prior, seen))
    case: Case | None = considering
    lesson, best = decided(considering, problem)
    if lesson is Lesson.LEARNED and found.cost <= REFUSED:
        return _expected(untaught, window, expected, found)
    if lesson is Lesson.LEARNED:  # what came is gone again within the window
        case, lesson = None, Lesson.REFUSED
    if case is not None and lesson in TEACHING:
        return _changed(untaught, window, case, lesson, best)
    if case is not None and best.reason is Reason.COMPONENT and is_sure_of_some(case):
        # Which component it is may be open, but each of them leaves the parameters where the best one has them.
        after = overall(rebased(best.belief, best.problem, problem), problem)
        untaught = replace(untaught, before=after, after=after)
    learned = _said(replace(untaught, memory=refuse(memory, case), found=found, lesson=lesson, case=case))
    return learned if warm or lesson is not Lesson.REFUSED else replace(learned, reason=f"{learned.reason}; {NEVER}")


def _refined(problem: Problem, window: Window, prior: Prior, lost: list[int]) -> WindowEstimate:
    """In the valley that was known; of phases that nobody has followed, several are tried."""
    start = _start(prior, problem)
    tried = []
    for turn in PHASES if lost else (0.0,):
        begin = start.copy()
        begin[lost] += turn
        tried.append(refine(problem, window, begin, prior))
    return min(tried, key=lambda found: found.cost)


def _expected(untaught: Learned, window: Window, expected: Belief, found: WindowEstimate) -> Learned:
    """After a window that healthy change explains; a component that is no longer seen leaves the twin."""
    problem, now = untaught.problem, turned(untaught.problem, window, found.last_state)
    memory = learn(untaught.memory, expected, found.evidence, problem, now)
    after = overall(memory.belief, problem)
    catalogue = faded(untaught.catalogue, problem, after)
    gone = next((entry for entry in catalogue if entry.fading >= FADES_AFTER), None)
    learned = replace(untaught, memory=memory, after=after, found=found, lesson=Lesson.LEARNED, catalogue=catalogue)
    slot = None if gone is None else slot_of(problem, gone.component)
    if gone is None or slot is None:
        return _said(learned)
    fewer, bare, turn = left_out(problem, memory.belief, memory.turned, slot)
    if refine(fewer, window, _start(overall(bare, fewer), fewer), overall(bare, fewer)).cost > max(
        EXPLAINED, found.cost
    ):
        return _said(learned)  # it is still needed, however little is known of it
    rest = tuple(entry for entry in catalogue if entry is not gone)
    learned = replace(learned, lesson=Lesson.FADED, catalogue=rest)
    return _rebased(learned, window, fewer, replace(memory, belief=bare, turned=turn))


def _changed(untaught: Learned, window: Window, case: Case, lesson: Lesson, best: Hypothesis) -> Learned:
    """After windows that agree on a sudden change, on a component, or that one is gone."""
    catalogue = adopted(case, best, untaught.catalogue) if lesson is Lesson.DISCOVERED else untaught.catalogue
    if lesson is Lesson.FADED:
        catalogue = tuple(entry for entry in catalogue if slot_of(best.problem, entry.component) is not None)
    memory = Memory(best.belief, best.turned)
    learned = replace(untaught, lesson=lesson, catalogue=catalogue, case=case)
    return _rebased(learned, window, replace(best.problem, excluded=untaught.problem.excluded), memory)


def _rebased(learned: Learned, window: Window, problem: Problem, memory: Memory) -> Learned:
    """With another twin, of which ``memory`` is, or knowledge begun anew."""
    after = overall(memory.belief, problem)
    found = refine(problem, window, _start(after, problem), after)
    return _said(replace(learned, memory=memory, before=after, after=after, problem=problem, found=found))


def _said(learned: Learned) -> Learned:
    """With what there is to say of the window as a whole."""
    reasons = [] if learned.lesson is Lesson.LEARNED else [learned.lesson.value]
    case = learned.case
    if case is not None and learned.lesson in (Lesson.SENSOR, Lesson.SUSPECTED):
        others = [f"or {entry.text} ({entry.probability:.0%})" for entry in alternatives(case, case.best)[:2]]
        reasons += ["; ".join([f"{words(case.best)} ({case.probabilities[0]:.0%})", *others])]
    if learned.found is not None and learned.found.cost > EXPLAINED and learned.lesson is not Lesson.REFUSED:
        reasons.append(UNEXPLAINED)
    scatter = learned.memory.belief.scatter
    if scatter > SCATTERED:
        reasons.append(CONTRADICTORY.format(scatter**0.5))
    return replace(learned, reason="; ".join(reasons))


def _start(prior: Prior, problem: Problem) -> Array:
    """(free,) where the search begins."""
    return np.clip(prior.mean[: len(problem.free)], *problem.bounds)


def _next_records(state: State, window: Window, learned: Learned) -> int:
    problem, found, known = learned.problem, learned.found, learned.after
    if found is None:
        return state.records
    free = len(problem.free)
    trend: Array = np.sqrt(known.mean[free:] ** 2 + np.diag(known.covariance)[free:])
    need = Need(np.array([entry.sd for entry in found.parameters]), trend, found.cost <= EXPLAINED)
    return next_records(problem.window, window.records, window.sample_period, need)
