"""Candidates for components: all allowed forms, screened by the linear response, then their inner parameters refined.

Amplitudes enter linearly and need no search, so each form has one dimension to search. The forms are refined together,
so that a round costs one call of a compiled kernel.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.discovery.candidate_forms import CandidateForm, PhysicalRange, scales_a_sum
from otolith.discovery.linear_response import Guess, LinearResponse, ProjectedResponse, basis_functions
from otolith.discovery.screening import (
    CompetingForms,
    ScoredGuess,
    ScoredGuesses,
    allowed_forms,
    grid_guesses,
    highest_lines,
    inner_grid,
)
from otolith.estimation.evidence import DECISIVE, prior_deviance
from otolith.estimation.problem import Component, Problem, key_of
from otolith.twin.components import measured_speeds, sites, sources

FINE = 0.5  # spectral lines between two frequencies
PEAKS = 3  # best grid points whose neighbourhood is searched
OFFSETS = (0.0, -2.0 / 3.0, -1.0 / 3.0, 1.0 / 3.0, 2.0 / 3.0)  # steps of the grid: points around the best one
REFINEMENTS, NARROWER = 4, 1.0 / 3.0  # of refining, and the ratio of the steps of two rounds
MAX_REFINED = 16  # forms whose inner parameters are refined
MAX_CANDIDATES, MIN_CANDIDATES = 10, 4  # candidates that are fitted
AFFORDABLE_STEPS = 500  # integrator steps of a window up to which the largest number of candidates is fitted
SENSOR_MARGIN, MAX_SENSORS = 3.0, 2  # times that error below the best: errors of sensors that are fitted; how many
SCORE_MARGIN, SCORE_SHARE = 23.0, 0.3  # absolute (-2 log evidence) and relative error of the linear approximation


@dataclass(frozen=True, slots=True)
class Candidate:
    """A component worth a fit."""

    component: Component
    competing: float  # Number of forms of its kind
    of_sensor: bool


def find_candidates(response: LinearResponse) -> list[Candidate]:
    """Return the components worth a fit, the best first."""
    problem = response.problem
    forms = allowed_forms(problem, response.x)
    competing = CompetingForms.among(problem, forms)
    guesses = best_guesses(response, forms, competing)
    if not guesses:
        return []
    best, guesses = guesses[0].score, _without_parameters(response, guesses, competing)
    error = SCORE_MARGIN + SCORE_SHARE * abs(best)
    # Scores are of a linear response, which is wrong for a large change. An inner parameter fits its error as well,
    # which a simpler form cannot: forms with one are kept up to one error from the best, the others up to two.
    kept = [own for own in guesses if own.score > max(best - error * (2 - bool(own.form.model.inner)), -DECISIVE)]
    kept = kept[: _affordable(response)]
    chosen = {own.form for own in kept}
    rest = [own for own in guesses if own.form not in chosen]
    if kept:  # errors of sensors are few, and nothing else is as simple
        sensors = [own for own in rest if competing.is_sensor(own.form) and own.score > best - SENSOR_MARGIN * error]
        kept += sensors[:MAX_SENSORS] + threshold_like(problem, rest)
    rows = ((guess.form, component) for guess, component in components_of(response, kept))
    return [Candidate(component, competing.of(form), competing.is_sensor(form)) for form, component in rows]


def periodic_errors(response: LinearResponse, beside: Iterable[Component], taken: Iterable[str]) -> list[Candidate]:
    """Return each component ``beside`` that is a sine of an angle or position, as the error of a sensor.

    The sensor is that of its source or of the speed of it. Errors whose keys are ``taken`` are left out.
    """
    problem, twin, starts = response.problem, response.problem.base_model, dict[CandidateForm, list[float]]()
    source_names = [source.name for source in sources(twin)]
    components, signals = {own.key: own for own in beside}, {output.name for output in twin.outputs}
    excluded = {*problem.excluded, *taken}
    for sine in components.values():
        read = signals & {sine.source, measured_speeds(twin).get(sine.source)}
        for at, site in enumerate(sites(twin)):
            error = key_of(site.name, sine.family, sine.source)
            is_error = sine.periodic and at >= len(twin.sites) and site.into in read
            if is_error and error not in excluded:
                form = CandidateForm(at, sine.model, source_names.index(sine.source), (sine.low, sine.high))
                starts.setdefault(form, []).append(sine.inner)
    if not starts:
        return []
    competing = CompetingForms.among(problem, list(starts))
    scored = ScoredGuesses.of(response, refine_inner_parameters(response, list(starts.items())), competing)
    guesses = [scored[at] for at in range(len(starts))]
    return [Candidate(error, competing.of(guess.form), True) for guess, error in components_of(response, guesses)]


def best_guesses(
    response: ProjectedResponse, forms: list[CandidateForm], competing: CompetingForms
) -> list[ScoredGuess]:
    """Return each form with its best inner parameter, the best form first; only those of leading forms are refined."""
    spectral = [form for form in forms if len(form.model.phases) > 1]
    others = [form for form in forms if len(form.model.phases) == 1]
    guesses = grid_guesses(response, others, FINE) + highest_lines(response, spectral, FINE)
    scored = ScoredGuesses.of(response, guesses, competing)
    by_form: dict[CandidateForm, list[int]] = {}
    for index in np.argsort(-scored.scores, kind="stable").tolist():
        by_form.setdefault(scored.guesses[index][0], []).append(index)
    best = [scored[order[0]] for form, order in by_form.items() if form.model.inner is None]
    searched = [(form, order) for form, order in by_form.items() if form.model.inner is not None][:MAX_REFINED]
    if searched:
        starts = [(form, [scored.guesses[at][1] for at in order[:PEAKS]]) for form, order in searched]
        settled = ScoredGuesses.of(response, refine_inner_parameters(response, starts), competing)
        best += [settled[index] for index in range(len(searched))]
    return sorted(best, key=lambda guess: -guess.score)


def refine_inner_parameters(
    response: ProjectedResponse, starts: list[tuple[CandidateForm, list[float]]]
) -> list[Guess]:
    """Return each form with the inner parameter of largest gain around its ``starts``, which are points of its grid.

    Each round tries points on both sides of the best one so far, at shares of the distance to the next grid point, and
    divides that distance. In the first round there are several best ones.
    """
    forms = [form for form, _ in starts]
    grids = [inner_grid(form, response.x, FINE) for form in forms]
    best, scale = [np.array(inner) for _, inner in starts], 1.0
    for _ in range(REFINEMENTS):
        around = [_around(*row, scale) for row in zip(forms, grids, best, strict=True)]
        guesses = [(form, value) for form, values in zip(forms, around, strict=True) for value in values]
        ends = np.cumsum([len(values) for values in around])
        gains = np.split(response.score(guesses).gain, ends[:-1])
        best = [np.array(values[own.argmax()]) for values, own in zip(around, gains, strict=True)]
        scale *= NARROWER
    return [(form, float(inner)) for form, inner in zip(forms, best, strict=True)]


def _around(form: CandidateForm, points: Array, inner: Array, scale: float) -> list[float]:
    """Return ``inner`` (starts,) and points beside each; the grid ``points`` of a fixed number are geometric."""
    offsets = scale * np.array(OFFSETS)[:, None]
    if form.model.inner is not None and form.model.inner.points:
        around: Array = inner * (points[1] / points[0]) ** offsets
    else:
        around = inner + (points[1] - points[0] if len(points) > 1 else np.ptp(form.bounds)) * offsets
    values: list[float] = np.clip(around, *form.bounds).ravel().tolist()
    return values


def _without_parameters(
    response: LinearResponse, guesses: list[ScoredGuess], competing: CompetingForms
) -> list[ScoredGuess]:
    """Return the guesses that no parameter would produce as well; errors of sensors stay, and causes of their own.

    A constant stays beside an offset of a sensor that scores as much: if windows refute the parameter, both remain.
    """
    twin = response.problem.base_model
    curves = [len(guess.form.model.phases) for guess in guesses]
    amplitudes = np.concatenate([guess.amplitudes[:count] for guess, count in zip(guesses, curves, strict=True)])
    same = response.is_parameter(basis_functions((guess.form, guess.inner) for guess in guesses), amplitudes)
    first = np.cumsum([0, *curves[:-1]]).tolist()
    constants = [guess for guess in guesses if guess.form.model.name == "constant"]
    gains = {own.form: own.score + float(prior_deviance(competing.of(own.form))) for own in constants}  # without prior
    offsets = [gain for form, gain in gains.items() if competing.is_sensor(form)]
    causes = {
        form
        for form, gain in gains.items()
        if scales_a_sum(twin, form.site) or any(abs(gain - offset) < DECISIVE for offset in offsets)
    }
    return [
        guess
        for guess, at in zip(guesses, first, strict=True)
        if competing.is_sensor(guess.form) or guess.form in causes or not same[at]
    ]


def _affordable(response: ProjectedResponse) -> int:
    """Return how many candidates are fitted: fewer in large windows, so that a search ends before the next window."""
    share = MAX_CANDIDATES * AFFORDABLE_STEPS / max(response.objective.integrator_steps, 1)
    return int(np.clip(share, MIN_CANDIDATES, MAX_CANDIDATES))


def threshold_like(problem: Problem, guesses: list[ScoredGuess]) -> list[ScoredGuess]:
    """Return for each site the best threshold-like family of a state: the linear response underrates dry friction."""
    twin = problem.base_model
    states = {state.name for state in twin.states}
    best: dict[int, ScoredGuess] = {}
    for guess in guesses:
        if guess.form.model.threshold_like and sources(twin)[guess.form.source].name in states:
            best.setdefault(guess.form.site, guess)
    return list(best.values())


def components_of(response: LinearResponse, guesses: list[ScoredGuess]) -> list[tuple[ScoredGuess, Component]]:
    """Return the guesses that are readable and physically possible, each with its component."""
    times, parameters = response.window.grid.offsets, response.parameters
    possible = PhysicalRange(response.problem.base_model, response.x, times, parameters)
    pairs = ((guess, _component_of(response, guess, possible)) for guess in guesses if guess.is_readable)
    return [(guess, component) for guess, component in pairs if component is not None]


def _component_of(response: LinearResponse, guess: ScoredGuess, possible: PhysicalRange) -> Component | None:
    """Return the component of a guess with the amplitude of the linear response, within its physical range.

    None if the physical range excludes even the sign.
    """
    twin, form = response.problem.base_model, guess.form
    first, second = map(float, guess.amplitudes)
    periodic = len(form.model.phases) > 1
    amplitude = float(np.hypot(first, second)) if periodic else first
    low, high = possible.amplitudes(form, guess.inner)
    limited = min(max(amplitude, low), high)
    if limited * amplitude <= 0.0:
        return None
    return Component(
        site=sites(twin)[form.site].name,
        family=form.model.name,
        source=sources(twin)[form.source].name,
        amplitude=limited,
        inner=guess.inner,
        phase=float(np.arctan2(second, first)) if periodic else 0.0,
        low=form.bounds[0],
        high=form.bounds[1],
        amplitude_low=low,
        amplitude_high=high,
        origin=response.window.start,
    )
