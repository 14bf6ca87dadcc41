"""The screening test: whether a window is worth a search for what the twin lacks.

All allowed forms are scored by the linear response, on a grid of their inner parameters.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.discovery.candidate_forms import CandidateForm, candidate_table
from otolith.discovery.linear_response import Guess, LinearResponse, ProjectedResponse
from otolith.estimation.evidence import DECISIVE, discount, penalty
from otolith.estimation.information import Prior
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Component, Problem
from otolith.estimation.window_fit import Fit, WindowEstimate, fit
from otolith.twin.components import (
    MAX_COMPONENTS,
    MIN_HUMP,
    ComponentFamily,
    SourceKind,
    SourceRange,
    family_code,
    sites,
    sources,
)
from otolith.twin.definition import Definition

FRICTION_OF_INPUT = 100.0  # how much less probable than of a state: 9.2 in -2 log evidence, just below DECISIVE
COARSE = 1.5  # spectral lines between two frequencies
ESTIMATE_SHARE = 0.3  # of the required gain: least estimated gain of a spectral line whose gain is computed
MAX_LINES = 64  # of largest estimated gain, whose gain is computed
PEAKS_OF_SPECTRUM = 8  # of largest estimated gain, whose gain a search computes
MAX_AMPLITUDE = 1e9  # in the unit of the site
SAME_SIGN = 0.8  # mean product of the signs of two sources that change their signs together
THRESHOLD_TEST_EVERY = 4  # windows: in one of them, families that the linear response underrates are fitted


@dataclass(frozen=True, slots=True)
class CompetingForms:
    """How many forms compete, by kind."""

    first_sensor: int
    """Index of the first site that is a sensor."""
    of_machine: float
    of_constants: float
    """Of constants at sites of the machine: a family has one share at each site, of which each source gets a part."""
    of_sensors: float
    states: frozenset[int]
    """Indices of the sources that are states."""

    @classmethod
    def among(cls, problem: Problem, forms: list[CandidateForm]) -> "CompetingForms":
        """Count ``forms``."""
        twin = problem.base_model
        first = len(twin.sites)
        sensors = sum(form.site >= first for form in forms)
        names = {state.name for state in twin.states}
        states = frozenset(index for index, source in enumerate(sources(twin)) if source.name in names)
        of_machine = float(max(len(forms) - sensors, 1))
        of_constants = min(of_machine, float(first * len({form.model.name for form in forms})))
        return cls(first, of_machine, max(of_constants, 1.0), float(max(sensors, 1)), states)

    def of(self, form: CandidateForm) -> float:
        """Return the number of forms of the same kind.

        Dry friction acts on what moves. The sign of an input, which mostly has the sign of a speed, is a noisy measure
        of it, and must explain the window clearly better.
        """
        if self.is_sensor(form):
            return self.of_sensors
        if form.model.name == "constant":
            return self.of_constants
        of_input = form.model.threshold_like and form.source not in self.states
        return self.of_machine * (FRICTION_OF_INPUT if of_input else 1.0)

    def is_sensor(self, form: CandidateForm) -> bool:
        """Whether the form is the error of a sensor."""
        return form.site >= self.first_sensor


@dataclass(frozen=True, slots=True)
class ScoredGuess:
    """A guess with the score of the linear response."""

    form: CandidateForm
    inner: float
    amplitudes: Array
    """(2,)."""
    score: float
    """Gain in -2 log evidence over parameters only."""

    @property
    def is_readable(self) -> bool:
        """Whether the amplitude is neither zero nor beyond any equation that a person could use."""
        return bool(0.0 < np.abs(self.amplitudes).max() < MAX_AMPLITUDE)


def inner_grid(form: CandidateForm, x: Array, fineness: float) -> Array:
    """Return values (points,) of the inner parameter; ``x`` (sources, records), ``fineness`` in spectral lines."""
    inner = form.model.inner
    low, high = form.bounds
    if inner is None:
        return np.array([low])
    if inner.points:
        return np.asarray(geometric_grids([form.bounds], inner.points, fineness)[0])
    width = fineness * 2.0 * np.pi / max(float(np.ptp(x[form.source])), 1e-9)  # of a spectral line
    return np.arange(low, high, width)


def geometric_grids(bounds: list[tuple[float, float]], points: int, fineness: float) -> Array:
    """Return values (forms, points) between the ``bounds`` of inner parameters with grids of so many ``points``."""
    low, high = np.log(np.array(bounds)).T[..., None]
    return np.asarray(np.exp(low + (high - low) * _shares(max(round(points / fineness**2), 2))))


@cache
def _shares(points: int) -> Array:
    return np.linspace(0.0, 1.0, points)


def candidate_library(twin: Definition, x: Array, taken: frozenset[str] = frozenset()) -> list[CandidateForm]:
    """Return all forms that can be distinguished where the sources are ``x`` (sources, records).

    ``twin`` is the base model. Forms whose keys are ``taken`` are left out.
    """
    ranges, table = SourceRange.of_each(x), candidate_table(twin, taken)
    bounds = [_inner_bounds(model, ranges[source]) for model, source in table.shapes]
    return [
        CandidateForm(site, model, source, within)
        for site, model, source, shape in table.rows
        if (within := bounds[shape]) is not None
    ]


def _inner_bounds(model: ComponentFamily, x: SourceRange) -> tuple[float, float] | None:
    """Return the bounds of the inner parameter, or None if ``x`` does not single out the family."""
    if not model.valid(x):
        return None
    if model.inner is None:
        return 0.0, 0.0
    low, high = model.inner.bounds(x)
    return (low, high) if low < high else None


def allowed_forms(problem: Problem, x: Array) -> list[CandidateForm]:
    """Return the forms that may be searched where the sources are ``x`` (sources, records).

    Components in the twin and excluded ones are left out, and all if the twin has no free slot. If discovery is off,
    only errors of sensors remain.
    """
    twin = problem.base_model
    if len(problem.components) >= MAX_COMPONENTS:
        return []
    taken = problem.excluded | {component.key for component in problem.components}
    forms = candidate_library(twin, x, taken)
    if not problem.discover:
        forms = [form for form in forms if form.site >= len(twin.sites)]
    friction = [component for component in problem.components if component.model.threshold_like]
    if not friction:
        return forms
    return [bounded for form in forms if (bounded := _beside_friction(twin, form, x, friction)) is not None]


def _beside_friction(
    twin: Definition, form: CandidateForm, x: Array, friction: list[Component]
) -> CandidateForm | None:
    """Return the form, or None if it would only correct dry friction that the twin has at the same site.

    That is a hump no wider than the transition of the friction, and a threshold of a source that changes its sign with
    the friction's source, of which it is a measure.
    """
    if not (form.model.threshold_like or form.model.threshold_at_rest):
        return form
    names = [source.name for source in sources(twin)]
    low, high = form.bounds
    for component in friction:
        if sites(twin)[form.site].name != component.site:
            continue
        source = names.index(component.source)
        if source == form.source:
            low = max(low, MIN_HUMP * component.inner)
        elif abs(float((np.sign(x[source]) * np.sign(x[form.source])).mean())) > SAME_SIGN:
            return None
    return form._replace(bounds=(low, high)) if low <= high else None


def grid_guesses(response: ProjectedResponse, forms: list[CandidateForm], fineness: float) -> list[Guess]:
    """Return all forms with all inner parameters of their grids, which the sites of a machine share."""
    grids = _grids(response, forms, fineness)
    return [(form, inner) for form in forms for inner in grids[form.model.name, form.source]]


def _grids(
    response: ProjectedResponse, forms: list[CandidateForm], fineness: float
) -> dict[tuple[str, int], list[float]]:
    """Return the inner parameters of the grid of each family and source."""
    shapes = {(form.model.name, form.source): form for form in reversed(forms)}
    grids: dict[tuple[str, int], list[float]] = {}
    geometric: defaultdict[int, list[tuple[str, int]]] = defaultdict(list)
    for shape, form in shapes.items():
        if form.model.inner is not None and form.model.inner.points:
            geometric[form.model.inner.points].append(shape)
        else:
            grids[shape] = inner_grid(form, response.x, fineness).tolist()
    for points, alike in geometric.items():
        rows = geometric_grids([shapes[shape].bounds for shape in alike], points, fineness)
        grids.update(zip(alike, rows.tolist(), strict=True))
    return grids


@dataclass(frozen=True, slots=True, eq=False)
class ScoredGuesses:
    """Many guesses and their scores."""

    guesses: list[Guess]
    amplitudes: Array
    """(guesses, 2)."""
    scores: Array
    """(guesses,) gains in -2 log evidence over parameters only."""

    @classmethod
    def of(cls, response: ProjectedResponse, guesses: list[Guess], competing: CompetingForms) -> "ScoredGuesses":
        """Score ``guesses`` by the linear response."""
        statistics, count = response.score(guesses), response.count
        forms = {id(form): form for form, _ in guesses}  # there are far fewer than guesses, and to compare them is slow
        of_form = {key: (float(_parameter_count(form)), competing.of(form)) for key, form in forms.items()}
        parameters, competitors = np.array([of_form[id(form)] for form, _ in guesses]).reshape(-1, 2).T
        divisor = discount(response.chi_square - float(statistics.gain.max(initial=0.0)), count)
        scores = statistics.gain / divisor - penalty(parameters, count, competitors)
        return cls(guesses, statistics.amplitudes, np.asarray(scores))

    def __getitem__(self, index: int) -> ScoredGuess:
        form, inner = self.guesses[index]
        return ScoredGuess(form, inner, self.amplitudes[index], float(self.scores[index]))


def _parameter_count(form: CandidateForm) -> int:
    return len(form.model.phases) + (form.model.inner is not None)


@dataclass(frozen=True, slots=True, eq=False)
class ScreeningResult:
    """Whether a search of a window is worth its time."""

    gain: float
    """Largest gain in -2 log evidence over parameters only, minus what is decisive; positive if worth a search."""
    fitted: Fit
    """Its start is the linearisation point."""
    response: LinearResponse
    always_lacking: bool = False
    """Whether only a component with a threshold, fitted under the initial prior, gains enough."""
    always_late: bool = False
    """Whether a late signal would gain enough while no parameter is determined: it has no onset."""

    @property
    def is_positive(self) -> bool:
        """Whether a search is worth its time."""
        return self.gain > 0.0

    @property
    def needs_threshold_test(self) -> bool:
        """Whether families that the linear response underrates are to be fitted; this takes long, so not always."""
        is_due = self.fitted.window.index % THRESHOLD_TEST_EVERY == 0
        return is_due and not self.is_positive and self.fitted.problem.discover


def screen_window(predicted: Posterior, estimated: WindowEstimate, *, determined: bool) -> ScreeningResult:
    """Screen the window of an estimate, around the prediction.

    While no parameter is determined or a phase is unknown, it is screened around the estimate instead. While no
    parameter is determined, it is also screened for late signals: later a delay contradicts the prediction.
    """
    if determined and not predicted.unknown_phases():
        return screen_fit(estimated.fit)
    start = np.array([parameter.value for parameter in estimated.parameters])
    screening = screen_fit(linearised(predicted.problem, estimated.fit.window, predicted.prior(), start))
    if determined or (gain := _delay_gain(screening.response)) <= 0.0:
        return screening
    return replace(screening, gain=max(screening.gain, gain), always_late=True)


def _delay_gain(response: LinearResponse) -> float:
    """Return what a late signal would gain at most, minus what is decisive; parameters would absorb a part of it."""
    gains = response.score_delays().gain
    best, count = float(gains.max(initial=0.0)), response.objective.count
    return best / discount(response.chi_square - best, count) - float(penalty(1.0, count, len(gains))) - DECISIVE


def linearised(problem: Problem, window: Window, prior: Prior, start: Array) -> Fit:
    """Return a fit of no steps: the window, linearised at ``start`` (free, ...)."""
    return fit(problem, window, prior, start, max_steps=0)


def _linear_response(fitted: Fit) -> LinearResponse:
    """Return the linear response around the start of ``fitted``, or around its end if the start is too far from it.

    The start is far from the window where a state is not measured. The error of the linearisation would then pass for a
    component.
    """
    response = LinearResponse(fitted)
    error = response.chi_square - fitted.chi_square
    is_linear = error <= DECISIVE * discount(fitted.chi_square, fitted.count)
    return response if is_linear else LinearResponse(fitted.linearised_at_end())


def screen_fit(fitted: Fit) -> ScreeningResult:
    """Return what a component would gain at most, around ``fitted``, on a coarse grid.

    Spectra cost most: those over time are tested in one window, those over angles in the next.
    """
    problem, index = fitted.problem, fitted.window.index
    response = _linear_response(fitted)
    kind = (SourceKind.TIME, SourceKind.PLACE)[index % 2]
    source_kinds = [source.kind for source in sources(problem.base_model)]
    forms = [
        form
        for form in (allowed_forms(problem, response.x) if problem.discover else [])
        if len(form.model.phases) == 1 or source_kinds[form.source] is kind
    ]
    competing = CompetingForms.among(problem, forms)
    guesses = promising_guesses(response, forms, competing)
    gain = float(ScoredGuesses.of(response, guesses, competing).scores.max(initial=-np.inf)) - DECISIVE
    return ScreeningResult(gain, fitted, response)


def promising_guesses(response: LinearResponse, forms: list[CandidateForm], competing: CompetingForms) -> list[Guess]:
    """Return the guesses on a coarse grid whose estimated gain is not far below what a search requires.

    Of spectral lines, those of largest gain. A guess that gains enough is left out with probability 7e-6
    (:meth:`LinearResponse.estimated_gains_of`), a line with 4e-6 (:meth:`LinearResponse.estimated_gains`).
    """

    @cache
    def required(parameters: int, alternatives: float) -> float:
        return ESTIMATE_SHARE * (DECISIVE + float(penalty(parameters, response.objective.count, alternatives)))

    def least(form: CandidateForm) -> float:
        return required(_parameter_count(form), competing.of(form))

    lines: list[tuple[float, Guess]] = []
    shapes, waves = list[CandidateForm](), list[CandidateForm]()
    for form in forms:
        (shapes if len(form.model.phases) == 1 else waves).append(form)
    for form, grid, gains in _spectra(response, waves, COARSE):
        lines += [(gains[at], (form, float(grid[at]))) for at in np.flatnonzero(gains > least(form))]
    lines.sort(key=lambda line: -line[0])
    return [*_promising_shapes(response, shapes, least), *(guess for _, guess in lines[:MAX_LINES])]


def _promising_shapes(
    response: LinearResponse, forms: list[CandidateForm], least: Callable[[CandidateForm], float]
) -> list[Guess]:
    """Return the guesses of ``forms`` of one curve on a coarse grid whose estimated gain is at ``least`` theirs."""
    at_site = {(form.site, form.model.name, form.source): form for form in forms}
    grids = _grids(response, forms, COARSE)
    shapes = [(name, source, inner) for (name, source), values in grids.items() for inner in values]
    gains = response.estimated_gains_of([(family_code(name), source, inner, 0.0) for name, source, inner in shapes])
    guesses = []
    for shape, site in np.argwhere(gains > ESTIMATE_SHARE * DECISIVE).tolist():
        name, source, inner = shapes[shape]
        form = at_site.get((site, name, source))
        if form is not None and gains[shape, site] > least(form):
            guesses.append((form, inner))
    return guesses


def highest_lines(response: ProjectedResponse, forms: list[CandidateForm], fineness: float) -> list[Guess]:
    """Return the PEAKS_OF_SPECTRUM highest peaks of the spectrum of each form, by estimated gain."""
    guesses: list[Guess] = []
    for form, grid, gains in _spectra(response, forms, fineness):
        walled = np.concatenate([[-np.inf], gains, [-np.inf]])
        peaks = np.flatnonzero((gains >= walled[:-2]) & (gains > walled[2:]))
        highest = peaks[np.argsort(-gains[peaks], kind="stable")[:PEAKS_OF_SPECTRUM]]
        guesses += [(form, inner) for inner in grid[highest].tolist()]
    return guesses


def _spectra(
    response: ProjectedResponse, forms: list[CandidateForm], fineness: float
) -> Iterator[tuple[CandidateForm, Array, Array]]:
    """Yield each of the periodic ``forms`` with its frequencies (lines,) and the estimated gains there (lines,)."""
    for source in dict.fromkeys(form.source for form in forms):
        of_source = [form for form in forms if form.source == source]
        grid = inner_grid(of_source[0], response.x, fineness)
        gains = response.estimated_gains(source, grid)
        yield from ((form, grid, gains[form.site]) for form in of_source)
