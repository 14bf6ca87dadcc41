"""``adapt(state, window) -> (state, report)``: the one entry to the core, a pure function.

    predict → check → fit → score → decide → update → sum up → report

Time arrives with the window and randomness with the seed. Every run is therefore reproducible bit for bit, and the work
can move between processes. ``docs/explanation/evidence.md`` has the quantities that are compared.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window, larger_sizes
from otolith.adaptation.frozen_sensors import frozen_readings, with_still_frozen
from otolith.adaptation.operating_states import part_in_operation, running_part
from otolith.adaptation.reporting import OPEN, WindowResult, make_report
from otolith.adaptation.state import (
    AdaptationState,
    ComponentRecord,
    Ledger,
    with_converter_steps,
    with_posterior,
    with_records,
)
from otolith.commissioning.input_noise import SUMMED_EVERY, SUMMED_RATIO
from otolith.discovery.alternatives import DATA_FAULTS, UPDATES, PosteriorUpdate, WindowDecision
from otolith.discovery.decision import (
    MAX_COST,
    AdoptedComponent,
    WindowOutcome,
    adopt,
    count_fading,
    decide,
    keep_present,
    with_approvals,
)
from otolith.discovery.hypotheses import FaultType
from otolith.discovery.noise_hypothesis import likelier_levels_of, prior_inflation
from otolith.discovery.screening import ScreeningResult, screen_window
from otolith.discovery.search import with_threshold_test
from otolith.discovery.sequential_test import SequentialTest, continue_test, mixture, open_test
from otolith.estimation.data_checks import CheckedWindow, FaultySensor, check_window, last_records, without_saturated
from otolith.estimation.imm_filter import Innovation, ParameterCusum
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem, WindowExcitation, next_records, slot_of
from otolith.estimation.timing import with_changes_between
from otolith.estimation.window_fit import (
    SwarmSearch,
    WindowEstimate,
    estimate,
    estimate_window,
    fit_predicted,
    unbridged_gap,
)
from otolith.health.events import HealthState, assess
from otolith.health.schema import Report, window_document
from otolith.health.status import PreviousStatus, some_parameter_is_determined

UNUSED = "nothing is estimated from this window: "


def adapt(state: AdaptationState, window: Window) -> tuple[AdaptationState, Report]:
    """Return the state after ``window``, and the report of it.

    - **Predict** what the filter knows at the end of the window, and **check** the data against it.
    - **Fit** the parameters under the prediction. The window is expected if their innovation is.
    - **Score** alternatives: does the window show a component, or windows together a moved parameter? If one shows, or
      the window is not expected, all types of hypotheses are fitted and compared, in further windows as well.
    - **Decide** what has happened, and **update** the posterior: by the filter, by the hypothesis that is accepted, or
      not at all while it is open.
    - **Sum up** what windows show only together: a weak component, the noise of an input.
    - **Report** estimates, findings and events.
    """
    used, shortened = last_records(window)
    problem = state.posterior.problem
    part = part_in_operation(problem, used) if problem.base_model.operation else None
    if part is None:
        state, predicted, checked = _predict_and_check(state, used)
        tested, checked = _fit(state, predicted, checked)
        part = None if tested is None or tested.is_expected else running_part(predicted.problem, used)
    if part is not None:
        shortened = (*shortened, part.note)
        used = part.window or used
        state, predicted, checked = _predict_and_check(state, used)
        tested, checked = (None, checked) if part.window is None else _fit(state, predicted, checked)
    if part is not None and part.window is None:
        result, ledger = _switched_off(state, predicted, part.note), state.ledger
    elif tested is None:
        result, ledger = _reject(state, predicted, checked), state.ledger
    else:
        scores = _score(state, tested)
        result = _decide_and_update(scores)
        result, ledger = _search_together(scores.state, scores.tested, result, scores.ledger)
        result, ledger = _find_input_noise(scores.state, scores.tested, result, ledger)
    faulty = checked.faulty_sensors
    notes = (*shortened, *checked.notes, *(own.text for own in faulty))
    result = replace(result, faulty_sensors=faulty, notes=notes, sizes=state.sizes)
    if result.adopted:
        result = replace(result, adopted=with_approvals(result.adopted, state.approved))
    previous, report = make_report(state, used, result)
    document = report.document
    if shortened:  # reports come as often as whole windows
        document = document.model_copy(update={"window": window_document(window)})
    health, document = assess(state.plan, state.health, document)
    ledger = _kept(ledger, result.decision, state.ledger)
    if state.frozen or faulty:  # without samples it is as before
        state = replace(state, frozen=state.frozen if checked.bad else frozen_readings(faulty, used))
    return _next_state(state, result, ledger, previous, health), replace(report, document=document)


def _kept(ledger: Ledger, decision: WindowDecision, before: Ledger) -> Ledger:
    """Return what remains of the ledger after a window that led to ``decision``; ``before`` is without the window.

    A posterior that replaces the filter's contains what earlier windows have shown. The sums of the noise of inputs end
    only with accepted noise. The error of a sensor shifts no parameter.
    """
    if UPDATES[decision] is PosteriorUpdate.HYPOTHESIS:
        return Ledger() if decision is WindowDecision.NOISIER else Ledger(input_noise=ledger.input_noise)
    return replace(ledger, cusum=before.cusum) if decision in DATA_FAULTS else ledger


def _predict_and_check(state: AdaptationState, window: Window) -> tuple[AdaptationState, Posterior, CheckedWindow]:
    """Return the state with the converter steps that ``window`` shows, its prediction, and the checked window.

    If the data are faulty, the state keeps its steps: differences between faulty values are none of a converter.
    """
    posterior = state.posterior.without_expired(window.start)
    if posterior is not state.posterior:
        state = with_posterior(state, posterior)
    problem = posterior.problem
    if problem.changing:
        window = with_changes_between(window, problem.changing)
    predicted = posterior.with_steps(window).predict(window)
    checked = check_window(window, predicted)
    if state.frozen:
        checked = with_still_frozen(checked, state.frozen, window)
    if predicted.problem is problem:
        return state, predicted, checked
    if not checked.is_usable:
        return state, replace(predicted, problem=problem), checked
    return with_converter_steps(state, predicted.problem), predicted, checked


@dataclass(frozen=True, slots=True, eq=False)
class _TestedEstimate:
    """The estimate of a window, tested against its prediction."""

    predicted: Posterior
    estimated: WindowEstimate
    innovation: Innovation

    @classmethod
    def of(cls, predicted: Posterior, window: Window, search: SwarmSearch = SwarmSearch.NEVER) -> "_TestedEstimate":
        """Estimate from ``window`` under its prediction, and compare the two."""
        estimated = estimate_window(predicted, window, search)
        return cls(predicted, estimated, predicted.innovation(estimated.evidence))

    @property
    def is_expected(self) -> bool:
        """Whether the twin explains the window, and its prediction agrees with it."""
        return self.estimated.is_explained and self.innovation.is_expected


def _fit(
    state: AdaptationState, predicted: Posterior, checked: CheckedWindow
) -> tuple[_TestedEstimate | None, CheckedWindow]:
    """Return the estimate of a window and what was checked; None if its data are faulty, or a gap leaves nothing.

    If the window is not expected because a sensor is saturated, the other samples are estimated from.
    """
    if not checked.is_usable:
        return None, checked
    search = SwarmSearch.NEVER if some_parameter_is_determined(state.previous) else SwarmSearch.FROM_BOUNDS
    tested, saturated = _TestedEstimate.of(predicted, checked.window, search), tuple[FaultySensor, ...]()
    if not tested.is_expected and (rest := without_saturated(predicted, checked.window)) is not None:
        window, sensor = rest
        tested, saturated = _TestedEstimate.of(predicted, window, search), (sensor,)
    if checked.window.bridge_error is not None and (gap := unbridged_gap(tested.estimated)):
        return None, replace(checked, bad=(gap,))
    return tested, replace(checked, faulty_sensors=saturated)


def _reject(state: AdaptationState, predicted: Posterior, checked: CheckedWindow) -> WindowResult:
    """Return the result of a window whose data are faulty: it does not update the posterior."""
    decision = WindowDecision.BAD if checked.bad else WindowDecision.SENSOR
    reason = UNUSED + "; ".join(checked.bad or (sensor.text for sensor in checked.faulty_sensors))
    return WindowResult.unchanged(state, predicted, decision, reason=reason)


def _switched_off(state: AdaptationState, predicted: Posterior, note: str) -> WindowResult:
    """Return the result of a window in which the drive is off: it does not update the posterior."""
    return WindowResult.unchanged(state, predicted, WindowDecision.OFF, reason=UNUSED + note)


@dataclass(frozen=True, slots=True, eq=False)
class _Scores:
    """What speaks for alternatives to the prediction after a window."""

    state: AdaptationState  # Before the window, without a test that has ended
    tested: _TestedEstimate  # From what was known before the window: a test that has fallen adds to it
    ledger: Ledger  # With the shifts of the parameters in this window
    is_calm: bool  # Whether the window is expected, and shows nothing that the twin lacks
    test: SequentialTest | None  # Of the hypotheses, after this window; None if none is open
    is_new: bool  # Whether this window opened the test


def _score(state: AdaptationState, tested: _TestedEstimate) -> _Scores:
    """Screen the window, add the shifts of its parameters, and compare the hypotheses if it gives reason to.

    If it excludes a hypothesis on which windows agreed, it is scored again from the mixture of all that was open.
    """
    screening, cusum = _screen(state, tested), _parameter_cusum(state, tested)
    is_calm = tested.is_expected and not screening.is_positive
    test = _continued_test(state, tested, screening)
    if test is not None and _has_fallen(state.test, test):
        return _score(*_restarted(state, tested))
    if test is not None and test.best.type is FaultType.NOTHING and not tested.is_expected:
        test = None
    is_new = test is None and not is_calm
    if is_new:
        state, test = replace(state, test=None), open_test(tested.predicted, screening)
    return _Scores(state, tested, replace(state.ledger, cusum=cusum), is_calm, test, is_new)


def _decide_and_update(scores: _Scores) -> WindowResult:
    """Return the result of a window whose data are usable. The first of these cases that applies decides.

    - No test is open, and the window shows nothing that the twin lacks: the filter is updated. Parameters that this
      window and those before show to have moved are estimated anew.
    - The window opens a test although it is expected, and the null hypothesis is possible: the filter is updated.
    - The window shows nothing of what opened the test: the filter is updated; the test stays open.
    - Otherwise the decision of the test is applied.
    """
    state, tested, test, moved = scores.state, scores.tested, scores.test, scores.ledger.cusum.moved
    if test is None:
        return _reset_moved(state, tested, moved) if moved else _update_filter(state, tested)
    if scores.is_new and tested.is_expected and test.is_null_possible:
        result = _update_filter(state, tested)
    elif not scores.is_new and scores.is_calm and not moved and not test.filter_evidence.is_against:
        result = _update_filter_beside(state, tested, test)
    else:
        result = _apply_decision(state, tested, test, is_new=scores.is_new)
    return replace(result, searched=True)


def _screen(state: AdaptationState, tested: _TestedEstimate) -> ScreeningResult:
    """Return the screening test of the window; it is positive only if it is so at likelier levels of noise as well."""
    determined = some_parameter_is_determined(state.previous)

    def screened(predicted: Posterior, estimated: WindowEstimate) -> ScreeningResult:
        screening = screen_window(predicted, estimated, determined=determined)
        return with_threshold_test(screening) if screening.needs_threshold_test else screening

    predicted, estimated = tested.predicted, tested.estimated
    screening = screened(predicted, estimated)
    if not screening.is_positive or (quieter := likelier_levels_of(estimated.fit)) == predicted.problem:
        return screening
    fitted = fit_predicted(predicted, quieter, estimated.fit.window, estimated.fit.parameters)
    again = screened(replace(predicted, problem=quieter), replace(estimated, fit=fitted))
    return screening if again.is_positive else replace(screening, gain=again.gain)


def _continued_test(
    state: AdaptationState, tested: _TestedEstimate, screening: ScreeningResult
) -> SequentialTest | None:
    """Return the open test after the window; None if there is none."""
    if state.test is None:
        return None
    return continue_test(state.test, tested.predicted, screening).with_filter(tested.estimated.fit)


def _has_fallen(before: SequentialTest | None, after: SequentialTest) -> bool:
    """Whether windows agreed on a hypothesis that the last one excludes: the null or one of a new search leads."""
    if before is None or before.best.type is FaultType.NOTHING or before.counts.leading == 1:
        return False
    own, is_found_anew = before.best.hypothesis.name, after.counts.since_search == 1
    is_kept = own in [item.hypothesis.name for item in after.hypotheses]
    if after.best.hypothesis.name == own:  # a new search states the same again, with other values
        return is_found_anew
    return not is_kept and (is_found_anew or after.best.type is FaultType.NOTHING)


def _restarted(state: AdaptationState, tested: _TestedEstimate) -> tuple[AdaptationState, _TestedEstimate]:
    """Return the state without its test, with the mixture of all that was open before the window, and its estimate.

    The hypotheses have learned from windows that the filter has not, so that it begins where they are.
    """
    test, filtered = state.test, state.posterior
    null = next((item for item in test.hypotheses if item.type is FaultType.NOTHING), None) if test else None
    if test is None or null is None or null.problem.free != filtered.problem.free:
        return replace(state, test=None), tested
    known = filtered.held(tested.predicted)
    mixed = mixture(test.hypotheses, test.probabilities, state.problem, known, test.wrong_probability)
    posterior = replace(null.posterior, problem=filtered.problem).set_prior(mixed)
    window = tested.estimated.fit.window
    return replace(state, posterior=posterior, test=None), _TestedEstimate.of(posterior.predict(window), window)


def _parameter_cusum(state: AdaptationState, tested: _TestedEstimate) -> ParameterCusum:
    """Return the sums after a window; estimates without trends are biased where a parameter drifts fast."""
    estimated = tested.estimated
    if estimated.drifts:
        return state.ledger.cusum
    values = np.array([own.value for own in estimated.parameters])
    sd = np.array([own.sd for own in estimated.parameters])
    length = estimated.fit.window.grid.length
    return state.ledger.cusum.after(tested.predicted.shifts(values, sd, estimated.trend_response, length))


def _apply_decision(
    state: AdaptationState, tested: _TestedEstimate, test: SequentialTest, *, is_new: bool
) -> WindowResult:
    """Return the result of a window that the filter does not expect, or that shows what the twin lacks.

    ``is_new`` says whether this window opened the test.
    """
    predicted, estimated, test = tested.predicted, tested.estimated, test.after_unexpected()
    outcome = decide(test, state.learned)
    match outcome.update:
        case PosteriorUpdate.HYPOTHESIS:
            return _adopt_hypothesis(state, estimated, test, outcome)
        case PosteriorUpdate.NONE:
            result = WindowResult.unchanged(state, predicted, outcome.decision, estimate=estimated, test=test)
            return _with_mixture(result, state.problem) if outcome.decision in OPEN else result
        case PosteriorUpdate.FILTER if estimated.cost > MAX_COST:  # the null hypothesis does not explain all of it
            return WindowResult.unchanged(state, predicted, WindowDecision.REFUSED, estimate=estimated)
        case PosteriorUpdate.FILTER if is_new:  # a change in the last records shows in the next window
            return WindowResult.unchanged(state, predicted, WindowDecision.SUSPECTED, estimate=estimated)
        case PosteriorUpdate.FILTER:
            return _update_filter(state, tested)


def _update_filter_beside(state: AdaptationState, tested: _TestedEstimate, test: SequentialTest) -> WindowResult:
    """Update the filter with a window that shows nothing of what opened the test.

    The window that opened it may have been wrong, so that the filter goes on. But windows of a machine at rest are no
    evidence against its hypotheses: it is closed only when windows are decisive evidence for the filter. Until then the
    filter is one of the hypotheses. Hypotheses that explain no window have none to weigh against it.
    """
    result = _update_filter(state, tested)
    if test.filter_evidence.is_for or test.best.type is FaultType.NOTHING or not test.has_explained_unexpected:
        return result
    return _with_mixture(replace(result, test=test.after_expected()), state.problem)


def _update_filter(state: AdaptationState, tested: _TestedEstimate) -> WindowResult:
    """Return the result of a window that updates the filter; a faded component that it does not need is removed."""
    innovation, estimated = tested.innovation, tested.estimated
    if state.test is not None and not state.test.counts.expected:  # the window before contradicted the filter
        innovation = innovation.inflate_variance(state.test.null_reduced_chi_square)
    posterior, before = tested.predicted.update(innovation, estimated.advance), estimated.fit.prior
    result = WindowResult(WindowDecision.LEARNED, posterior, before, posterior.prior(), (), estimate=estimated)
    return _without_faded(state, result, estimated) if state.adopted else result


def _search_together(
    state: AdaptationState, tested: _TestedEstimate, result: WindowResult, ledger: Ledger
) -> tuple[WindowResult, Ledger]:
    """Return result and ledger of a window; if the twin explains it, it is searched together with those before."""
    fitted = tested.estimated.fit
    is_undecided = result.decision is not WindowDecision.LEARNED or result.test is not None
    if is_undecided or not fitted.is_explained or tested.estimated.drifts:
        return result, ledger
    ledger = replace(ledger, pooled=ledger.pooled.after(fitted, result.after.mean[: len(fitted.problem.free)]))
    if ledger.pooled.confirmed is None:
        return result, ledger
    record = ComponentRecord.of(ledger.pooled.confirmed)
    again = _TestedEstimate.of(with_records(tested.predicted, (record,), forget_phases=False), fitted.window)
    discovered = _update_filter(replace(state, adopted=(*state.adopted, record.adopted)), again)
    return replace(discovered, decision=WindowDecision.DISCOVERED, before=discovered.after), ledger


def _find_input_noise(
    state: AdaptationState, tested: _TestedEstimate, result: WindowResult, ledger: Ledger
) -> tuple[WindowResult, Ledger]:
    """Return result and ledger; if windows together show the noise of an input, the window is estimated with it.

    A test that is open then ends. While a late signal leads it, or a sensor is faulty, its windows are not summed: such
    errors correlate with fast changes as noise does.
    """
    fitted = tested.estimated.fit
    has_disagreed = tested.predicted.belief.variance_ratio > SUMMED_RATIO
    is_due = result.searched or has_disagreed or fitted.window.index % SUMMED_EVERY == 0
    is_late = result.test is not None and result.test.best.type is FaultType.TIMING
    if is_late or result.decision in DATA_FAULTS or not is_due:
        return result, ledger
    ledger = replace(ledger, input_noise=ledger.input_noise.after(fitted))
    levels = None if result.update is PosteriorUpdate.HYPOTHESIS else ledger.input_noise.levels(fitted)
    if levels is None:
        return result, ledger
    problem = fitted.problem.with_levels(levels)
    stated, noisier = (replace(fitted, problem=own).linearised_at_end() for own in (fitted.problem, problem))
    inflation = prior_inflation(stated, noisier)
    again = _TestedEstimate.of(tested.predicted.with_noise(problem, inflation), fitted.window)
    accepted = _update_filter(replace(state, test=None), again)
    if not again.is_expected or accepted.decision is not WindowDecision.LEARNED:
        return result, ledger
    if result.is_mixture:  # what the hypotheses differ in stays uncertain: one of them may hold beside the noise
        posterior = accepted.posterior.set_prior(result.after).with_noise(problem, inflation)
        accepted = replace(accepted, posterior=posterior, after=posterior.prior())
    accepted = replace(accepted, decision=WindowDecision.NOISIER, before=accepted.after, searched=result.searched)
    return accepted, ledger


def _reset_moved(state: AdaptationState, tested: _TestedEstimate, moved: list[int]) -> WindowResult:
    """Return the result of a window that, with those before, shows a change of the parameters at ``moved``.

    What was known of them is replaced by the initial prior, and the window gives their values.
    """
    again = _TestedEstimate.of(tested.predicted.reset_parameters(moved), tested.estimated.fit.window)
    result = _update_filter(state, again)
    if result.decision is WindowDecision.FADED:
        return result
    return replace(result, decision=WindowDecision.STEPPED, before=result.after)


def _without_faded(state: AdaptationState, result: WindowResult, estimated: WindowEstimate) -> WindowResult:
    """Return the result without a component that has faded; it stays if the window is not explained without it."""
    adopted = count_fading(state.adopted, result.posterior)
    result = replace(result, adopted=adopted)
    faded = next((item for item in adopted if item.has_faded), None)
    slot = None if faded is None else slot_of(state.problem, faded.component)
    if slot is None:
        return result
    fewer = _replace_posterior(WindowDecision.FADED, result.posterior.without_slot(slot), estimated, adopted)
    without = fewer.estimate
    is_needed = without is None or not (without.is_explained or without.cost <= estimated.cost)
    return result if is_needed else fewer


def _adopt_hypothesis(
    state: AdaptationState, estimated: WindowEstimate, test: SequentialTest, outcome: WindowOutcome
) -> WindowResult:
    """Return the result of windows that agree on a hypothesis: its posterior replaces the filter's."""
    accepted, adopted = outcome.hypothesis, state.adopted
    if outcome.decision is WindowDecision.DISCOVERED:
        adopted = adopt(adopted, test, accepted)
    problem = replace(accepted.problem, excluded=state.problem.excluded)
    posterior = replace(accepted.posterior, problem=problem)
    return replace(_replace_posterior(outcome.decision, posterior, estimated, adopted), test=test)


def _replace_posterior(
    decision: WindowDecision, posterior: Posterior, estimated: WindowEstimate, adopted: tuple[AdoptedComponent, ...]
) -> WindowResult:
    """Return the result with another posterior, and the window estimated again under it."""
    problem, prior = posterior.problem, posterior.prior()
    again = estimate(problem, estimated.fit.window, prior, posterior.start())
    return WindowResult(decision, posterior, prior, prior, keep_present(adopted, problem.components), estimate=again)


def _with_mixture(result: WindowResult, problem: Problem) -> WindowResult:
    """Return the result with the mixture of the hypotheses of its test and of the filter as what is known."""
    test = result.test
    if test is None or result.posterior.problem.free != problem.free:
        return result
    mixed = mixture(test.hypotheses, test.probabilities, problem, result.after, test.wrong_probability)
    return replace(result, before=mixed, after=mixed, is_mixture=True)


def _next_state(
    state: AdaptationState,
    result: WindowResult,
    ledger: Ledger,
    previous: dict[str, PreviousStatus],
    health: HealthState,
) -> AdaptationState:
    """Return the state for the next window; a posterior that replaces the filter's ends the test."""
    test = None if result.update is PosteriorUpdate.HYPOTHESIS else result.test
    if result.estimate is None:  # data that are not used are evidence neither for a hypothesis nor against one
        test = state.test
    return replace(
        state,
        posterior=result.posterior,
        test=test,
        learned=state.learned + result.is_accepted,
        contradictions=result.contradictions(state),
        adopted=result.adopted,
        ledger=ledger,
        noisier_since=result.noisier_since(state),
        previous=previous,
        health=health,
        records=_next_records(state, result),
        sizes=_next_sizes(state, result),
    )


def _next_sizes(state: AdaptationState, result: WindowResult) -> Mapping[str, float]:
    """Return the sizes of signals; windows that do not update the posterior may be of wrong data."""
    if result.estimate is None or not result.is_accepted:
        return state.sizes
    return larger_sizes(state.sizes, result.estimate.fit.window)


def _next_records(state: AdaptationState, result: WindowResult) -> int:
    """Return the length of the next window in records."""
    problem, known, estimated = result.posterior.problem, result.after, result.estimate
    if estimated is None:
        return state.records
    if problem.window.shortest >= problem.window.longest:
        return problem.window.records
    free, window = len(problem.free), estimated.fit.window
    trend: Array = np.sqrt(known.mean[free:] ** 2 + np.diag(known.covariance)[free:])
    sd = np.array([parameter.sd for parameter in estimated.parameters])
    excitation = WindowExcitation(sd, trend, estimated.is_explained)
    period = window.grid.period or problem.window.sample_period or window.sample_period
    return next_records(problem.window, window.grid.length, period, excitation)
