"""Whether a window may teach: what is made of one, by what healthy change foretold and by what else could explain it.

A window that no healthy change explains is either wrong or the first after something has happened. So nothing is
learned from it: a case is opened (see :mod:`otolith.adaptation.case`), and the next windows decide it.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from otolith.acquisition.window import Window
from otolith.adaptation.case import Case, followed, joined, opened
from otolith.adaptation.claims import Claim, Reason, explanation
from otolith.adaptation.discovery import onset, search
from otolith.adaptation.fusion import Belief, begin_belief, contradicted, overall, surprise, updated
from otolith.adaptation.glance import Glance, glance
from otolith.adaptation.hypothesis import Hypothesis
from otolith.adaptation.objective import EXPLAINED
from otolith.adaptation.prior import Evidence, Prior
from otolith.adaptation.problem import Problem
from otolith.adaptation.tracking import Turned, moved_on, turned

DEVIATE = 6.0  # of the standard normal distribution: once in a thousand million windows
REFUSED = 4.0  # cost beyond which a window contradicts whatever is held against it
STEP_AFTER, COMPONENT_AFTER = 2, 3  # windows that must agree
STEP_SURE, COMPONENT_SURE = 0.8, 0.95  # probabilities
SENSOR_SURE, SENSOR_LIKELY = 0.95, 0.5  # the same; the second one suffices where nothing else explains the windows
SHORTEST = 60  # records of what has begun within a window, that tell anything
PATIENCE = 8  # windows for which a component is not adopted while another one explains everything as well


class Lesson(StrEnum):
    """What was made of a window."""

    LEARNED = "learned"
    SUSPECTED = "it contradicts what was known: a sudden change or a wrong window; further windows decide"
    STEPPED = "two windows agree on a sudden change"
    DISCOVERED = "several windows agree on a new component"
    FADED = "a component is no longer there"
    SENSOR = "a sensor is wrong: nothing is learned from the window"
    BAD = "the window is not good enough: nothing is learned from it"
    REFUSED = "nothing explains the window, neither parameters nor components: nothing is learned from it"


TEACHING = frozenset({Lesson.LEARNED, Lesson.STEPPED, Lesson.DISCOVERED, Lesson.FADED})


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """What is carried from window to window. Plain: it pickles."""

    belief: Belief
    turned: Turned | None = None
    """How far the sources of components have come."""
    case: Case | None = None
    """What could have happened, while it is not decided."""
    contradictions: int = 0
    """Windows in a row that taught nothing because they contradict twin or belief."""


def begin_memory(problem: Problem) -> Memory:
    """Before the first window."""
    return Memory(begin_belief(problem))


def limit(problem: Problem) -> float:
    """The surprise (χ² of 2 free degrees) that healthy windows do not reach (E. B. Wilson, M. M. Hilferty, 1931)."""
    degrees = 2.0 * len(problem.free)
    return float(degrees * (1.0 - 2.0 / (9.0 * degrees) + DEVIATE * np.sqrt(2.0 / (9.0 * degrees))) ** 3)


def is_surprising(expected: Belief, evidence: Evidence, problem: Problem) -> bool:
    """Whether no model of change foretold the window; ``expected`` is the belief carried to its end."""
    return surprise(expected, evidence, problem) > limit(problem)


def learn(memory: Memory, expected: Belief, evidence: Evidence, problem: Problem, now: Turned) -> Memory:
    """After a window that was to be expected."""
    belief = expected
    if memory.case is not None:  # the window before was wrong, and nobody knows why
        belief = contradicted(belief, memory.case.surprise)
    return Memory(updated(belief, evidence, problem), now)


def refuse(memory: Memory, case: Case | None = None) -> Memory:
    """After a window that teaches nothing, with what could have happened."""
    return replace(memory, case=case, contradictions=memory.contradictions + 1)


def considered(memory: Memory, problem: Problem, window: Window, expected: Belief, known: tuple[Prior, Glance]) -> Case:
    """What could have happened, after ``window``; ``known`` is the prior and a glance at what components would gain.

    Where the explanations of a case do not foretell the window, new ones are sought: something may have begun since.
    """
    prior, seen = known
    if memory.case is None:
        begun = onset(problem, window, prior)
        if begun:
            late = window.records - begun < SHORTEST
            begun = max(min(begun, window.records - SHORTEST), 0)
            expected = _cut(problem, window, expected, begun)
            prior, window = overall(expected, problem), window.since(begun)
            if late:  # what has begun in the last moments is for the next window to tell
                return opened([explanation(Claim(Reason.NOTHING), problem, window, prior)], problem, expected, window)
            seen = glance(problem, window, prior, prior.mean)
        return opened(search(problem, window, prior, seen), problem, expected, window)
    case = followed(memory.case, window)
    if case.best.silent and case.best.cost <= EXPLAINED:
        return case
    return joined(case, opened(search(problem, window, prior, seen), problem, expected, window))


def _cut(problem: Problem, window: Window, expected: Belief, begun: int) -> Belief:
    """What is expected of the window from the record ``begun`` on: phases have run on until then."""
    if not begun or not problem.components:
        return expected
    before = window.until(begun)
    tried = explanation(Claim(Reason.NOTHING), problem, before, overall(expected, problem))
    now = turned(problem, before, tried.informed.last_state(tried.fit))
    return moved_on(expected, problem, now, window.since(begun))


def is_sure_of_some(case: Case) -> bool:
    """Whether there is a component, whichever it is."""
    return case.windows >= COMPONENT_AFTER and case.probability(Reason.COMPONENT) >= COMPONENT_SURE


def decided(case: Case, problem: Problem) -> tuple[Lesson, Hypothesis]:
    """What a case comes to by now for a machine of ``problem``, and the hypothesis that it rests on."""
    best = case.best
    if best.reason is Reason.NOTHING:
        return Lesson.LEARNED, best
    if best.cost > REFUSED:
        return Lesson.REFUSED, best
    own, known = ({entry.label for entry in each.free} for each in (best.problem, problem))
    agreed = case.leading >= STEP_AFTER and case.probability(best.reason) >= STEP_SURE
    if best.reason is Reason.PARAMETER and agreed and own <= known:  # fewer if a component has moved down to nothing
        return Lesson.STEPPED if own == known else Lesson.FADED, best
    if case.probability(Reason.SENSOR) >= (SENSOR_SURE if case.open else SENSOR_LIKELY):
        return Lesson.SENSOR, next(entry for entry in case.hypotheses if entry.reason is Reason.SENSOR)
    sure = case.leading >= COMPONENT_AFTER and case.probability(Reason.COMPONENT) >= COMPONENT_SURE
    if best.reason is Reason.COMPONENT and sure and (case.windows >= PATIENCE or not case.alternatives(best)):
        return Lesson.DISCOVERED, best
    return Lesson.SUSPECTED, best
