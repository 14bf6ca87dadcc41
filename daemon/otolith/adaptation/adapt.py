"""The heart: one pure function from a state and a window to the next state and a report.

Time comes in with the window and randomness with the seed, so that every run can be reproduced bit for bit, and the
work can move between processes without loss.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Verdict, Window
from otolith.adaptation.reporting import WindowResult, document_of, traces_of
from otolith.adaptation.state import AdaptationState, without_component
from otolith.discovery.adopted import (
    FADES_AFTER,
    adopt,
    alternatives,
    count_fading,
    describe_hypothesis,
    slot_of,
    with_approvals,
)
from otolith.discovery.hypotheses import FaultType, TrackedHypothesis
from otolith.discovery.phase_tracking import expired, phase_advance, propagate_phases, unknown_phases, without_slot
from otolith.discovery.search import screening_test
from otolith.discovery.sequential_test import (
    ACCEPTED,
    REFUSED,
    FilterState,
    SequentialTest,
    WindowDecision,
    considered,
    decided,
    is_sure_of_some,
    is_surprising,
    learn,
    refuse,
)
from otolith.estimation.arrival_cost import Prior
from otolith.estimation.augmented import base_model
from otolith.estimation.data_checks import drop_repeats, drop_spikes, frozen_channels
from otolith.estimation.imm_filter import ImmPosterior, moment_match, predict, remap_parameters
from otolith.estimation.objective import EXPLAINED
from otolith.estimation.problem import Problem
from otolith.estimation.window_fit import WindowEstimate, estimate, refine
from otolith.estimation.window_length import WindowExcitation, next_records
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


def adapt(state: AdaptationState, window: Window) -> tuple[AdaptationState, Report]:
    """Adapt the twin to ``window``; a bad window leaves what is known where it was and is reported."""
    for component in expired(state.problem, window):
        state = without_component(state, component)
    learned = _judge(state, window)
    learned = replace(learned, catalogue=with_approvals(learned.catalogue, state.approved))
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


def _judge(state: AdaptationState, window: Window) -> WindowResult:
    """Sampling and sensors are looked at first: what lies must not teach."""
    problem, memory = state.problem, state.memory
    expected = predict(propagate_phases(memory.belief, problem, memory.turned, window), window.end)
    before = moment_match(expected, problem)
    untaught = WindowResult(memory, before, before, problem, state.catalogue)
    reasons = window.quality.reasons if window.quality.verdict is Verdict.BAD else _senseless(window)
    if reasons:
        return replace(untaught, reason=UNUSED + "; ".join(reasons))
    window, notes, vetoes = drop_spikes(window, base_model(problem), problem.noise)
    if not vetoes:
        vetoes = frozen_channels(problem, window, _start(before, problem))
    if vetoes:
        return replace(
            untaught, memory=refuse(memory), decision=WindowDecision.SENSOR, reason=UNUSED + "; ".join(vetoes)
        )
    window, repeated = drop_repeats(window, base_model(problem))
    learned = _learn(state, window, expected, untaught)
    return replace(learned, reason="; ".join(filter(None, (*notes, *repeated, learned.reason))))


def _senseless(window: Window) -> tuple[str, ...]:
    """Why nothing can be estimated from a window, however well it was sampled."""
    if window.records < FEWEST_RECORDS:
        return (f"{window.records} records are too few",)
    if not (np.abs(window.values) < LARGEST).all():  # not a number is not smaller either
        return (f"a value is not finite or beyond {LARGEST:g}",)
    return ()


def _learn(state: AdaptationState, window: Window, expected: ImmPosterior, untaught: WindowResult) -> WindowResult:
    """What the window says, weighed with what was ``expected`` at its end."""
    problem, memory, prior = state.problem, state.memory, untaught.before
    warm = any(entry.known for entry in state.standing.values())
    lost = unknown_phases(expected, problem)
    found = _refined(problem, window, prior, lost) if warm else estimate(problem, window, _start(prior, problem), prior)
    start = prior.mean if warm and not lost else np.array([entry.value for entry in found.parameters])
    recent = window if problem.components else window.since(max(window.records - SEARCHED, 0))
    seen = screening_test(problem, recent, prior, start)
    expectable = found.cost <= REFUSED and not is_surprising(expected, found.evidence, problem)
    if memory.case is None and expectable and found.cost <= EXPLAINED and seen.gain <= 0.0:
        return _expected(untaught, window, expected, found)
    untaught = replace(untaught, searched=True)
    considering = considered(memory, problem, recent, expected, (prior, seen))
    case: SequentialTest | None = considering
    decision, best = decided(considering, problem)
    if decision is WindowDecision.LEARNED and found.cost <= REFUSED:
        return _expected(untaught, window, expected, found)
    if decision is WindowDecision.LEARNED:  # what came is gone again within the window
        case, decision = None, WindowDecision.REFUSED
    if case is not None and decision in ACCEPTED:
        return _changed(untaught, window, case, decision, best)
    if case is not None and best.reason is FaultType.COMPONENT and is_sure_of_some(case):
        # Which component it is may be open, but each of them leaves the parameters where the best one has them.
        after = moment_match(remap_parameters(best.belief, best.problem, problem), problem)
        untaught = replace(untaught, before=after, after=after)
    learned = _said(replace(untaught, memory=refuse(memory, case), found=found, decision=decision, case=case))
    return (
        learned
        if warm or decision is not WindowDecision.REFUSED
        else replace(learned, reason=f"{learned.reason}; {NEVER}")
    )


def _refined(problem: Problem, window: Window, prior: Prior, lost: list[int]) -> WindowEstimate:
    """In the valley that was known; of phases that nobody has followed, several are tried."""
    start = _start(prior, problem)
    tried = []
    for turn in PHASES if lost else (0.0,):
        begin = start.copy()
        begin[lost] += turn
        tried.append(refine(problem, window, begin, prior))
    return min(tried, key=lambda found: found.cost)


def _expected(untaught: WindowResult, window: Window, expected: ImmPosterior, found: WindowEstimate) -> WindowResult:
    """After a window that healthy change explains; a component that is no longer seen leaves the twin."""
    problem, now = untaught.problem, phase_advance(untaught.problem, window, found.last_state)
    memory = learn(untaught.memory, expected, found.evidence, problem, now)
    after = moment_match(memory.belief, problem)
    catalogue = count_fading(untaught.catalogue, problem, after)
    gone = next((entry for entry in catalogue if entry.fading >= FADES_AFTER), None)
    learned = replace(
        untaught, memory=memory, after=after, found=found, decision=WindowDecision.LEARNED, catalogue=catalogue
    )
    slot = None if gone is None else slot_of(problem, gone.component)
    if gone is None or slot is None:
        return _said(learned)
    fewer, bare, turn = without_slot(problem, memory.belief, memory.turned, slot)
    if refine(fewer, window, _start(moment_match(bare, fewer), fewer), moment_match(bare, fewer)).cost > max(
        EXPLAINED, found.cost
    ):
        return _said(learned)  # it is still needed, however little is known of it
    rest = tuple(entry for entry in catalogue if entry is not gone)
    learned = replace(learned, decision=WindowDecision.FADED, catalogue=rest)
    return _rebased(learned, window, fewer, replace(memory, belief=bare, turned=turn))


def _changed(
    untaught: WindowResult, window: Window, case: SequentialTest, decision: WindowDecision, best: TrackedHypothesis
) -> WindowResult:
    """After windows that agree on a sudden change, on a component, or that one is gone."""
    catalogue = adopt(case, best, untaught.catalogue) if decision is WindowDecision.DISCOVERED else untaught.catalogue
    if decision is WindowDecision.FADED:
        catalogue = tuple(entry for entry in catalogue if slot_of(best.problem, entry.component) is not None)
    memory = FilterState(best.belief, best.turned)
    learned = replace(untaught, decision=decision, catalogue=catalogue, case=case)
    return _rebased(learned, window, replace(best.problem, excluded=untaught.problem.excluded), memory)


def _rebased(learned: WindowResult, window: Window, problem: Problem, memory: FilterState) -> WindowResult:
    """With another twin, of which ``memory`` is, or knowledge begun anew."""
    after = moment_match(memory.belief, problem)
    found = refine(problem, window, _start(after, problem), after)
    return _said(replace(learned, memory=memory, before=after, after=after, problem=problem, found=found))


def _said(learned: WindowResult) -> WindowResult:
    """With what there is to say of the window as a whole."""
    reasons = [] if learned.decision is WindowDecision.LEARNED else [learned.decision.value]
    case = learned.case
    if case is not None and learned.decision in (WindowDecision.SENSOR, WindowDecision.SUSPECTED):
        others = [f"or {entry.text} ({entry.probability:.0%})" for entry in alternatives(case, case.best)[:2]]
        reasons += ["; ".join([f"{describe_hypothesis(case.best)} ({case.probabilities[0]:.0%})", *others])]
    if learned.found is not None and learned.found.cost > EXPLAINED and learned.decision is not WindowDecision.REFUSED:
        reasons.append(UNEXPLAINED)
    variance_ratio = learned.memory.belief.variance_ratio
    if variance_ratio > SCATTERED:
        reasons.append(CONTRADICTORY.format(variance_ratio**0.5))
    return replace(learned, reason="; ".join(reasons))


def _start(prior: Prior, problem: Problem) -> Array:
    """(free,) where the search begins."""
    return np.clip(prior.mean[: len(problem.free)], *problem.bounds)


def _next_records(state: AdaptationState, window: Window, learned: WindowResult) -> int:
    problem, found, known = learned.problem, learned.found, learned.after
    if found is None:
        return state.records
    free = len(problem.free)
    trend: Array = np.sqrt(known.mean[free:] ** 2 + np.diag(known.covariance)[free:])
    need = WindowExcitation(np.array([entry.sd for entry in found.parameters]), trend, found.cost <= EXPLAINED)
    return next_records(problem.window, window.records, window.sample_period, need)
