"""Step 2 of the method: from one window to parameters with their uncertainty.

:func:`fit` is the one fit of a window under a prior; hypotheses use it as well. :func:`estimate` adds the fit
of the window alone, and searches all of the bounds where the prediction does not lead to an explanation.
"""

from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from otolith.acquisition.quality import Gap, longest_gap, time_text
from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.evidence import CERTAIN_DEVIATE, CHANCE_DEVIATE, discount, is_explained
from otolith.estimation.global_search import search_window
from otolith.estimation.information import (
    MIN_SINGULAR,
    QUANTILE,
    AccuracyTarget,
    Evidence,
    Identifiability,
    Information,
    MapObjective,
    Outcome,
    ParameterEstimate,
    Prior,
    classify,
    inflation_of,
    information,
    partners,
    required_half_widths,
    without_input_noise,
)
from otolith.estimation.minimisers import MAX_STEPS, FitResult, continued, gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.posterior import PhaseAdvance, Posterior, phase_advance
from otolith.estimation.problem import Problem, amplitude_indices
from otolith.estimation.timing import shifted, with_changes_between

AT_BOUND = 1e-4  # share of the width of the bounds
UNINFORMATIVE = 0.25  # share of the width of the bounds: standard deviation of a parameter that a window leaves open
ALONE_STEPS = 12  # of Gauss-Newton for the window alone, which starts at the fit under the prior
LOCAL_MINIMUM = 0.5  # ratio of χ² between two fits under one prior below which the worse one is a local minimum
MIN_GAP_SHARE = 0.05  # of a window: a shorter gap is not named


@dataclass(frozen=True, eq=False)  # no slots: its χ² is computed once
class Fit:
    """The maximum a-posteriori fit of a window under a prior."""

    problem: Problem
    prior: Prior
    window: Window
    objective: Objective
    map_objective: MapObjective
    result: FitResult

    @property
    def chi_square(self) -> float:
        """χ² of window and prior."""
        return self.result.chi_square

    @cached_property
    def window_chi_square(self) -> float:
        """χ² of the window alone."""
        residuals = self.result.residuals[: -len(self.prior.mean)]
        return float(residuals @ residuals)

    @property
    def innovations(self) -> Array:
        """(records, outputs) whitened: the residuals without those of the prior."""
        return self.result.residuals[: -len(self.prior.mean)].reshape(self.objective.measured.shape)

    @property
    def count(self) -> float:
        """Measured values of all outputs."""
        return self.objective.count

    @property
    def cost(self) -> float:
        """RMSE of the window in units of the noise."""
        return float(np.sqrt(self.window_chi_square / self.count))

    @property
    def discount(self) -> float:
        """Factor on the variance of the noise for a residual larger than that; at least one."""
        return discount(self.window_chi_square, self.count)

    @property
    def is_explained(self) -> bool:
        """Whether the fit leaves nothing but noise of the window."""
        return is_explained(self.window_chi_square, self.count)

    @property
    def parameters(self) -> Array:
        """(free,) at the end of the window."""
        return self.result.guess[: len(self.problem.free)]

    @property
    def initial(self) -> Array:
        """(states,) at the first record."""
        return self.result.guess[2 * len(self.problem.free) :]

    @property
    def guess(self) -> Array:
        """(free + states,) without trends, for :attr:`objective`."""
        return self.objective.without_trends(self.result.guess)

    @cached_property
    def inflation(self) -> float:
        """Factor on standard deviations for a residual larger than the noise; see :func:`inflation_of`."""
        return inflation_of(self.innovations, self.objective.present, self.cost)

    def evidence(self) -> Evidence:
        """Return the evidence of the window; standard deviations are inflated by the unexplained residual."""
        return self.map_objective.evidence(self.result, self.inflation)

    def linearised_at_end(self) -> "Fit":
        """Return the window linearised at the end of this fit, with a predictor made there."""
        return _fit(self.problem, self.window, self.prior, self.parameters, max_steps=0, initial=self.initial)

    def continued(self, max_steps: int) -> "Fit":
        """Return the fit after further steps, unless it has converged."""
        if self.result.converged:
            return self
        return replace(self, result=continued(self.map_objective, self.result, max_steps))

    def resolved(self, max_steps: int) -> "Fit":
        """Return the fit; if the integrator needs smaller steps at its end, after ``max_steps`` more of those at most.

        Otherwise the error of the integrator would pass for evidence: as where dry friction changes its sign.
        """
        if self.objective.is_resolved(self.parameters, self.initial):
            return self
        return _fit(self.problem, self.window, self.prior, self.parameters, max_steps, initial=self.initial)

    def set_predictor_at_end(self) -> None:
        """Make the predictor at the end of this fit: in the objective, which other fits of the window may share."""
        self.objective.set_predictor(self.parameters, self.initial)

    def restarted(self) -> "Fit":
        """Return a new fit from the end of this one, with the predictor that the objective has now."""
        return replace(self, result=gauss_newton(self.map_objective, self.result.guess))

    def predict(self) -> tuple[Array, Array]:
        """Return the prediction (records, outputs) and the state (states,) at the last record."""
        return self.objective.predict_with_trends(self.result.guess)

    def without_prior(self) -> FitResult:
        """Return the same without prior and trends, as :attr:`objective` linearises it at :attr:`guess`."""
        free, rows = len(self.problem.free), len(self.prior.mean)
        jacobian, trends = self.result.jacobian[:-rows], slice(free, 2 * free)
        residuals = self.result.residuals[:-rows] - jacobian[:, trends] @ self.result.guess[trends]
        there = self.guess, residuals, self.objective.without_trends(jacobian)
        return FitResult(*there, float(residuals @ residuals), 0, False, there)

    def advance(self) -> PhaseAdvance:
        """Return the advance of the components' phases to the next window."""
        return phase_advance(self.problem, self.window, self.predict()[1])


def fit(  # noqa: PLR0913 - the two parts of a start
    problem: Problem,
    window: Window,
    prior: Prior,
    start: Array,
    max_steps: int = MAX_STEPS,
    *,
    state: tuple[float, ...] = (),
) -> Fit:
    """Fit the free parameters to ``window`` under ``prior``; Gauss-Newton starts at ``start`` (free,).

    States of the twin that are not measured start at ``state`` (states,), if it is given. The window of the fit is
    without the delays of the problem.
    """
    if problem.changing:
        window = with_changes_between(window, problem.changing)
    if problem.delays:
        window = shifted(problem.base_model, window, dict(problem.delays))
    initial = None
    if state:
        reached = {own.name: value for own, value in zip(problem.base_model.states, state, strict=True)}
        reached |= {output.name: np.nan for output in problem.base_model.outputs}
        initial = np.array([reached.get(own.name, np.nan) for own in problem.twin.states])
    return _fit(problem, window, prior, start, max_steps, initial=initial)


def fit_predicted(predicted: Posterior, problem: Problem, window: Window, start: Array | None = None) -> Fit:
    """Fit ``window`` under its prediction, with a ``problem`` of the same parameters."""
    return fit(problem, window, predicted.prior(), predicted.start() if start is None else start)


def _fit(  # noqa: PLR0913 - the two parts of a start
    problem: Problem, window: Window, prior: Prior, start: Array, max_steps: int, *, initial: Array | None = None
) -> Fit:
    """Fit a window without delays from ``start`` (free,) and ``initial`` (states,), by default the first record."""
    start = np.clip(start[: len(problem.free)], *problem.bounds)
    objective = Objective(problem, window, start, initial)
    if problem.components:
        start = objective.with_bounded(start, amplitude_indices(problem))
    map_objective = MapObjective(objective, problem, prior)
    result = gauss_newton(map_objective, map_objective.guess(start, objective.initial), max_steps)
    return Fit(problem, prior, window, objective, map_objective, result)


@dataclass(frozen=True, slots=True)
class WindowEstimate:
    """The estimate from one window. Curves are (records, outputs) in the units of the twin."""

    fit: Fit
    parameters: tuple[ParameterEstimate, ...]
    """Of this window alone; about its middle, if they drift."""
    evidence: Evidence
    """Of parameters at the end of the window and their trends, for the filter."""
    outcome: Outcome
    cost: float
    """RMSE in units of the noise."""
    is_explained: bool
    """Whether the twin leaves nothing but noise."""
    rmse_configured: tuple[float, ...]
    rmse_estimated: tuple[float, ...]
    rmse_completed: tuple[float, ...]
    """With the components; the same as estimated if there are none."""
    predicted: Array
    last_state: Array
    """(states,) at the last record."""
    advance: PhaseAdvance
    """Of the components, to the next window."""
    generations: int
    evaluations: int
    trend_response: Array
    """(free, free) by how many seconds of the trend of each parameter those of the window alone move."""
    drifts: bool = False
    """Whether parameters that stay constant leave more of the window than those with trends."""


class SwarmSearch(Enum):
    """When all of the bounds are searched."""

    NEVER = "Gauss-Newton starts at the prediction; no search"
    IF_UNEXPLAINED = "a search follows if Gauss-Newton does not explain the window"
    FROM_BOUNDS = "a search follows, unless the window is explained and determines no parameter"


def estimate_window(predicted: Posterior, window: Window, search: SwarmSearch = SwarmSearch.NEVER) -> WindowEstimate:
    """Estimate from ``window`` under its prediction.

    If no search may follow and a phase is unknown, the fit of least cost from four starting phases is returned.
    """
    problem, prior = predicted.problem, predicted.prior()
    start = np.clip(prior.mean[: len(problem.free)], *problem.bounds)
    starts = predicted.with_phases(start) if search is SwarmSearch.NEVER else [start]
    return min((estimate(problem, window, prior, start, search) for start in starts), key=lambda item: item.cost)


def estimate(
    problem: Problem, window: Window, prior: Prior, start: Array, search: SwarmSearch = SwarmSearch.NEVER
) -> WindowEstimate:
    """Estimate the free parameters from ``window``; ``start`` (free,) is where the fit starts.

    The same problem, window, prior and start give the same estimate, bit for bit. First Gauss-Newton fits the window
    under the prior, and from there the window alone. The global search follows as ``search`` says.
    """
    fitted = fit(problem, window, prior, start)
    both = _fit_alone(fitted, fitted.result.evaluations)
    if both.is_explained and not fitted.is_explained:
        both = _leave_local_minimum(both)
    outcome, generations = Outcome.CONTINUED, 0
    is_unexplained = not both.is_explained and search is not SwarmSearch.NEVER
    if is_unexplained or (search is SwarmSearch.FROM_BOUNDS and both.is_informative):
        both, outcome, generations = _search(both)
    elif search is SwarmSearch.FROM_BOUNDS:
        outcome = Outcome.NOTHING_TO_FIND
    if not both.fit.result.converged and not both.alone.converged:
        outcome = Outcome.UNFINISHED
    return _summary(both, outcome, generations)


@dataclass(frozen=True, slots=True, eq=False)
class _BothFits:
    """The fit under the prior, and the fit of the window alone that starts there.

    ``docs/explanation/filter.md`` says what each is used for.
    """

    fit: Fit
    alone: FitResult
    inflation: float
    information: Information
    """Of the window alone."""
    factors: tuple[Array, Array]
    """Of the window alone: orthonormal basis and triangular factor of its Jacobian."""
    values: Array
    """(guess,) of the window alone, without the bias by the noise of inputs."""
    evaluations: int

    @property
    def has_noisy_inputs(self) -> bool:
        """Whether the noise of inputs biases the window by more than a negligible amount."""
        return self.values is not self.alone.guess

    @property
    def chi_square(self) -> float:
        """The lower χ² of the window of the two."""
        return min(self.alone.chi_square, self.fit.window_chi_square)

    @property
    def cost(self) -> float:
        """The lower cost of the two."""
        return float(np.sqrt(self.chi_square / self.fit.count))

    @property
    def discount(self) -> float:
        """Factor on the variance of the noise for a residual larger than that; at least one."""
        return discount(self.chi_square, self.fit.count)

    @property
    def is_explained(self) -> bool:
        """Whether the better fit leaves nothing but noise."""
        return is_explained(self.chi_square, self.fit.count)

    @property
    def is_informative(self) -> bool:
        """Whether the window determines any parameter better than its bounds do."""
        objective = self.fit.objective
        sd = self.information.sd[: objective.free]
        return bool((sd < UNINFORMATIVE * (objective.high - objective.low)[: len(sd)]).any())


def _fit_alone(fitted: Fit, evaluations: int) -> _BothFits:
    objective = fitted.objective
    alone = continued(objective, fitted.without_prior(), ALONE_STEPS)
    residuals = alone.residuals.reshape(objective.measured.shape)
    inflation = inflation_of(residuals, objective.present, float(np.sqrt(alone.chi_square / objective.count)))
    basis, factor = np.linalg.qr(alone.jacobian)
    root, values = _without_input_noise(objective, alone, factor)
    uncertainty = information(root, objective.high - objective.low, inflation)
    evaluations += alone.evaluations
    return _BothFits(fitted, alone, inflation, uncertainty, (basis, factor), values, evaluations)


def _without_input_noise(objective: Objective, alone: FitResult, root: Array) -> tuple[Array, Array]:
    """Return square-root information and values (guess,) of the window alone, without the bias by noisy inputs."""
    changes = objective.changes_by_input_noise(alone.guess, alone.residuals, alone.jacobian)
    unbiased, moved = without_input_noise(root, np.zeros(len(root)), changes)
    if unbiased is root:
        return root, alone.guess
    width = objective.high - objective.low
    step = -width * np.linalg.lstsq(unbiased * width, moved, rcond=MIN_SINGULAR)[0]
    return unbiased, np.clip(alone.guess + step, objective.low, objective.high)


def _leave_local_minimum(both: _BothFits) -> _BothFits:
    """Return both fits, the one under the prior begun where the other explains the window, if that is far better.

    Where a state is not measured, the first record may lead to a local minimum, which the fit of the window alone left.
    """
    fitted, free = both.fit, both.fit.objective.free
    start = fitted.map_objective.guess(both.alone.guess[:free], both.alone.guess[free:])
    again = replace(fitted, result=gauss_newton(fitted.map_objective, start))
    if again.chi_square > LOCAL_MINIMUM * fitted.chi_square:
        return both
    again.set_predictor_at_end()
    again = again.restarted()
    return _fit_alone(again, both.evaluations + again.result.evaluations)


def _search(both: _BothFits) -> tuple[_BothFits, Outcome, int]:
    """Search all of the bounds; return the better fit, how the search ended, and its generations."""
    fitted, problem = both.fit, both.fit.problem
    random = np.random.default_rng(problem.seed + fitted.window.index)
    minimum = search_window(problem, fitted.window, fitted.parameters, random)
    start = fitted.map_objective.guess(minimum.parameters, minimum.initial)
    searched = replace(fitted, result=gauss_newton(fitted.map_objective, start))
    min(searched, fitted, key=lambda item: item.chi_square).set_predictor_at_end()  # the present one was made far away
    from_search, from_prediction = searched.restarted(), fitted.restarted()
    chosen = min(from_prediction, from_search, key=lambda item: item.chi_square)
    evaluations = both.evaluations + minimum.evaluations + searched.result.evaluations
    evaluations += from_search.result.evaluations + from_prediction.result.evaluations
    after = _fit_alone(chosen, evaluations)
    distance = np.abs(from_search.parameters - from_prediction.parameters)
    if not (distance > CERTAIN_DEVIATE * both.information.sd[: len(distance)]).any():
        outcome = Outcome.AGREED
    elif abs(from_search.chi_square - from_prediction.chi_square) <= CHANCE_DEVIATE**2 * after.discount:
        outcome = Outcome.AMBIGUOUS
    else:
        found = Outcome.SEARCH_WAS_BETTER if minimum.has_repeated else Outcome.UNREPEATED
        outcome = found if chosen is from_search else Outcome.PREDICTION_WAS_BETTER
    return after, outcome, minimum.generations


def _summary(both: _BothFits, outcome: Outcome, generations: int) -> WindowEstimate:
    objective, problem, result = both.fit.objective, both.fit.problem, both.fit.result
    configured = objective.predict(objective.guess(_without_amplitudes(problem, problem.nominal))[None])[0]
    predicted, last_state = both.fit.predict()
    rmse_completed = rmse_estimated = tuple(map(float, objective.rmse(predicted)))
    if problem.components:
        bare = objective.predict_with_trends(_without_amplitudes(problem, result.guess))[0]
        rmse_estimated = tuple(map(float, objective.rmse(bare)))
    return WindowEstimate(
        fit=both.fit,
        parameters=_parameter_estimates(both, outcome),
        evidence=both.fit.map_objective.evidence(result, both.inflation, has_noisy_inputs=both.has_noisy_inputs),
        outcome=outcome,
        cost=both.cost,
        is_explained=both.is_explained,
        rmse_configured=tuple(map(float, objective.rmse(configured))),
        rmse_estimated=rmse_estimated,
        rmse_completed=rmse_completed,
        predicted=predicted,
        last_state=last_state,
        advance=phase_advance(problem, both.fit.window, last_state),
        generations=generations,
        evaluations=both.evaluations,
        trend_response=_trend_response(both),
        drifts=both.alone.chi_square > both.fit.window_chi_square + CHANCE_DEVIATE**2 * both.discount,
    )


def _trend_response(both: _BothFits) -> Array:
    """Return the least squares fit (free, free), in s, of constant parameters to what trends change in the window."""
    objective, free, rows = both.fit.objective, both.fit.objective.free, len(both.fit.prior.mean)
    width, of_trends = objective.high - objective.low, both.fit.result.jacobian[:-rows, free : 2 * free]
    basis, factor = both.factors
    response = np.linalg.lstsq(factor * width, basis.T @ of_trends, rcond=MIN_SINGULAR)[0]
    return np.asarray((width[:, None] * response)[:free])


def _without_amplitudes(problem: Problem, guess: Array) -> Array:
    """Return a guess whose components have amplitude zero."""
    if not problem.components:
        return guess
    bare = guess.copy()
    bare[amplitude_indices(problem)] = 0.0
    return bare


def _parameter_estimates(both: _BothFits, outcome: Outcome) -> tuple[ParameterEstimate, ...]:
    objective, problem, guess = both.fit.objective, both.fit.problem, both.alone.guess
    width = objective.high - objective.low
    at_bound = (guess <= objective.low + AT_BOUND * width) | (guess >= objective.high - AT_BOUND * width)
    required = required_half_widths(problem, both.values[: len(problem.free)])
    pressure = _pressure(both, at_bound)
    estimates = []
    for index, parameter in enumerate(problem.free):
        value, bounded = float(both.values[index]), bool(at_bound[index])
        target = AccuracyTarget(float(required[index]), parameter.unit, bounded, value, float(pressure[index]))
        identifiability, reason = classify(both.information, index, objective.names, target)
        if outcome is Outcome.AMBIGUOUS and identifiability is Identifiability.DETERMINED:
            identifiability, reason = Identifiability.WEAK, outcome.value
        sd = float(both.information.sd[index])
        traded_with = partners(both.information, index, [free.name for free in problem.free])
        estimates.append(ParameterEstimate(parameter.name, value, sd, identifiability, reason, traded_with))
    return tuple(estimates)


def _pressure(both: _BothFits, at_bound: Mask) -> Array:
    """Return how far beyond its bound a step without bounds would lead each value (guess,), in standard deviations.

    The step is that of Gauss-Newton. Standard deviations are inflated by the residual that it would leave: what the
    bound causes is no noise. Values that are not at a bound have zero.
    """
    objective, alone = both.fit.objective, both.alone
    pressure = np.zeros(len(alone.guess))
    if not at_bound.any():
        return pressure
    width, residuals = objective.high - objective.low, alone.residuals.ravel()
    step = -width * np.linalg.lstsq(alone.jacobian * width, residuals, rcond=MIN_SINGULAR)[0]
    cost_after = np.linalg.norm(residuals + alone.jacobian @ step) / np.sqrt(objective.count)
    sd = both.information.sd / both.inflation * max(float(cost_after), 1.0)
    is_at_low = alone.guess - objective.low < objective.high - alone.guess
    outward = np.maximum(np.where(is_at_low, -step, step), 0.0)
    pressure[at_bound] = outward[at_bound] / sd[at_bound]
    return pressure


def unbridged_gap(estimated: WindowEstimate) -> str:
    """Return which gap makes the window of an estimate useless, and the remedy; empty if none does.

    Outputs that are missing cost information, and the intervals show it. An input that is missing drives the twin in an
    unknown way; the variance of its bridge becomes process noise. If that noise is the only reason why a window
    determines no parameter, the window is refused and the gap is named.
    """
    window, problem = estimated.fit.window, estimated.fit.problem
    error = window.bridge_error
    if error is None or not error.held_variance.any():
        return ""
    if any(item.identifiability is Identifiability.DETERMINED for item in estimated.parameters):
        return ""
    gaps = {
        source.name: _longest_uncertain_gap(window, source.name)
        for source in problem.twin.inputs
        if source.name in window.signals
    }
    name = max(gaps, key=lambda name: gaps[name].length, default="")
    if not name or gaps[name].length < MIN_GAP_SHARE * window.grid.length or not _determines_without(estimated):
        return ""
    where = f"{name} has no sample for {gaps[name].length:.4g} s from {time_text(gaps[name].start + window.ahead)}"
    remedy = "look at its source, or accept less with [estimation] determined_within"
    return f"{where}, and no parameter can be determined within what is asked for: {remedy}"


def _longest_uncertain_gap(window: Window, name: str) -> Gap:
    """Return the longest time without a sample in which the input is uncertain."""
    uncertain = window.missing_in(name)
    if window.bridge_error is not None:
        uncertain = uncertain & (window.bridge_error.held_variance[:, window.signals.index(name)] > 0.0)
    return longest_gap(~uncertain, window.grid, window.start, window.sample_period)


def _determines_without(estimated: WindowEstimate) -> bool:
    """Whether the window would determine a parameter if all inputs were known."""
    problem, parameters = estimated.fit.problem, estimated.fit.parameters
    known = replace(estimated.fit.window, bridge_error=None)
    objective = Objective(problem, known, parameters)
    _, jacobian = objective.linearise(objective.guess(parameters))
    sd = information(jacobian, objective.high - objective.low, 1.0).sd[: objective.free]
    return bool((QUANTILE * sd <= required_half_widths(problem, parameters)).any())
