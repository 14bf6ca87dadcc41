"""Whether a window may teach: the gate between what a window says and what is known.

A window that no healthy change explains is either wrong or the first after a sudden fault. So it is only remembered; if
the next one agrees with it and not with what was known, a step has happened, and the new values are taken over.
"""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from otolith.adaptation.fusion import Belief, begin_belief, carried, contradicted, surprise, updated
from otolith.adaptation.prior import Evidence
from otolith.adaptation.problem import Problem

DEVIATE = 6.0  # of the standard normal distribution: once in a thousand million windows
REFUSED = 4.0  # cost beyond which the window contradicts the twin, whatever its parameters


class Lesson(StrEnum):
    """What was made of a window."""

    LEARNED = "learned"
    SUSPECTED = "it contradicts what was known: a sudden change or a wrong window; the next one decides"
    STEPPED = "two windows agree on a sudden change"
    SENSOR = "a sensor is wrong: nothing is learned from the window"
    BAD = "the window is not good enough: nothing is learned from it"
    REFUSED = "the twin cannot explain the window, whatever its parameters: nothing is learned from it"


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """What is carried from window to window. Plain: it pickles."""

    belief: Belief
    suspect: Belief | None = None
    """What the last window alone says, if it contradicts the belief."""
    surprise: float = 0.0
    """Of the last window if it contradicts the belief, per degree of freedom."""
    lying: str = ""
    """The output whose scale has been found wrong; empty as soon as a window is as expected."""
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


def learn(memory: Memory, expected: Belief, evidence: Evidence, problem: Problem) -> Memory:
    """After a window that was to be expected."""
    belief = expected
    if memory.suspect is not None:  # the window before was wrong, and nobody knows why
        belief = contradicted(belief, memory.surprise)
    return Memory(updated(belief, evidence, problem))


def confirm_or_suspect(memory: Memory, expected: Belief, evidence: Evidence, problem: Problem) -> tuple[Memory, Lesson]:
    """After a surprising window; ``evidence`` is of that window alone."""
    end = expected.end
    if memory.suspect is not None:
        fresh = carried(memory.suspect, end)
        if surprise(fresh, evidence, problem) <= limit(problem):
            return Memory(updated(fresh, evidence, problem)), Lesson.STEPPED
    suspect = updated(carried(begin_belief(problem), end), evidence, problem)
    found = surprise(expected, evidence, problem) / (2.0 * len(problem.free))
    after = replace(memory, suspect=suspect, surprise=max(found, memory.surprise))
    return replace(after, contradictions=memory.contradictions + 1), Lesson.SUSPECTED


def refuse(memory: Memory, lying: str = "") -> Memory:
    """After a window that nothing explains, or only a wrong scale of the output ``lying``."""
    return replace(memory, suspect=None, lying=lying or memory.lying, contradictions=memory.contradictions + 1)
