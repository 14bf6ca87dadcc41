"""The heart: one pure function from a state and a window to the next state and a report.

Time comes in with the window and randomness with the seed, so that every run can be reproduced bit for bit, and the
work can move between processes without loss.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation.estimate import WindowEstimate, estimate
from otolith.adaptation.fusion import Belief, carried, overall
from otolith.adaptation.gate import REFUSED, Lesson, Memory, confirm_or_suspect, is_surprising, learn, refuse
from otolith.adaptation.length import Need, next_records
from otolith.adaptation.objective import EXPLAINED
from otolith.adaptation.prior import Prior
from otolith.adaptation.problem import Problem
from otolith.adaptation.sensors import stuck, wrong_scale
from otolith.adaptation.spikes import without_spikes
from otolith.health.report import Report
from otolith.reporting import Learned, document_of, traces_of
from otolith.state import State

FEWEST_RECORDS = 5
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
    learned = _judge(state, window)
    standing, document = document_of(state, window, learned)
    after = replace(state, memory=learned.memory, standing=standing, records=_next_records(state, window, learned))
    return after, Report(document, traces_of(state, window, learned))


def _judge(state: State, window: Window) -> Learned:
    """Sampling and sensors are looked at first: what lies must not teach."""
    problem, memory = state.problem, state.memory
    expected = carried(memory.belief, window.end)
    before = overall(expected, problem)
    untaught = Learned(memory, before, before)
    reasons = window.quality.reasons if window.quality.verdict is Verdict.BAD else _senseless(window)
    if reasons:
        return replace(untaught, reason=UNUSED + "; ".join(reasons))
    window, notes, vetoes = without_spikes(window, problem.twin, problem.noise)
    if not vetoes:
        vetoes = stuck(problem, window, _start(before, problem))
    if vetoes:
        return replace(untaught, memory=refuse(memory), lesson=Lesson.SENSOR, reason=UNUSED + "; ".join(vetoes))
    learned = _learn(state, window, expected, untaught)
    return replace(learned, reason="; ".join(filter(None, (*notes, learned.reason))))


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
    warm = any(entry.known for entry in state.standing)
    found = estimate(problem, window, _start(prior, problem), prior, warm=warm)
    refused = found.cost > REFUSED
    expectable = not refused and not is_surprising(expected, found.evidence, problem)
    if expectable and found.cost <= EXPLAINED:
        return _learned(untaught, problem, learn(memory, expected, found.evidence, problem), found, Lesson.LEARNED)
    fault = wrong_scale(problem, window, prior, found.chi_square, memory.lying) if warm else None
    if fault is not None:
        lying = refuse(memory, fault.output)
        return replace(untaught, memory=lying, found=found, lesson=Lesson.SENSOR, reason=str(fault))
    if expectable:
        return _learned(untaught, problem, learn(memory, expected, found.evidence, problem), found, Lesson.LEARNED)
    if refused:
        learned = _learned(untaught, problem, refuse(memory), found, Lesson.REFUSED)
        return learned if warm else replace(learned, reason=f"{learned.reason}; {NEVER}")
    alone = estimate(problem, window, np.array([entry.value for entry in found.parameters]), warm=True)
    after, lesson = confirm_or_suspect(memory, expected, alone.evidence, problem)
    return _learned(untaught, problem, after, alone, lesson)


def _learned(untaught: Learned, problem: Problem, memory: Memory, found: WindowEstimate, lesson: Lesson) -> Learned:
    """With what there is to say of the window as a whole."""
    before = untaught.before
    after = before if memory.belief is untaught.memory.belief else overall(memory.belief, problem)
    reasons = [] if lesson is Lesson.LEARNED else [lesson.value]
    if found.cost > EXPLAINED and lesson is not Lesson.REFUSED:
        reasons.append(UNEXPLAINED)
    if memory.belief.scatter > SCATTERED:
        reasons.append(CONTRADICTORY.format(memory.belief.scatter**0.5))
    return Learned(memory, before, after, found, lesson, "; ".join(reasons))


def _start(prior: Prior, problem: Problem) -> Array:
    """(free,) where the search begins."""
    return np.clip(prior.mean[: len(problem.free)], *problem.bounds)


def _next_records(state: State, window: Window, learned: Learned) -> int:
    problem, found, known = state.problem, learned.found, learned.after
    if found is None:
        return state.records
    free = len(problem.free)
    trend: Array = np.sqrt(known.mean[free:] ** 2 + np.diag(known.covariance)[free:])
    need = Need(np.array([entry.sd for entry in found.parameters]), trend, found.cost <= EXPLAINED)
    return next_records(problem.window, window.records, window.sample_period, need)
