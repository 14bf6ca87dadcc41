"""Components that no window shows alone, but several together: of a healthy record, or the last ones of a running twin.

Process noise can be made so large that the windows fit, whatever the twin lacks. So the innovations at the likeliest
levels are searched for structure before any level is enlarged. The windows are pooled: all have the same parameters and
the same component, so that much weaker components show than in one window, and nothing that comes in a single window
does. The amplitudes of the windows must agree, which those of coloured noise do only by chance.
``docs/explanation/noise-identification.md`` has the equations.

A weak component gains too little in one window to be worth a search, however often it returns. So the last windows that
the twin explains are kept (:class:`PooledWindows`) and from time to time searched together: same component, and
parameters that differ from what was known by the same amount in all windows. It is adopted when two such searches find
it. The second one contains a window that the first one has not seen. ``docs/explanation/discovery.md`` has the rules.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.commissioning.consistency import CHANGE_SIGNIFICANCE, MIN_REGIME, regimes, sqrt_information
from otolith.commissioning.identification import IdentifiedNoise, usable_windows
from otolith.commissioning.likelihood import Fits, FittedWindow, Likelihood, Progress, with_levels
from otolith.discovery.candidate_forms import CandidateForm
from otolith.discovery.candidates import best_guesses, components_of
from otolith.discovery.linear_response import (
    BasisFunctions,
    Guess,
    LinearResponse,
    ProjectedResponse,
    ScoreStatistics,
    basis_functions,
)
from otolith.discovery.noise_hypothesis import likelier_levels_of
from otolith.discovery.screening import CompetingForms, ScoredGuess, ScoredGuesses, allowed_forms
from otolith.estimation.evidence import CHANCE_DEVIATE, DECISIVE, Elimination
from otolith.estimation.information import initial_prior
from otolith.estimation.posterior import UNKNOWN_PHASE_SD
from otolith.estimation.problem import Component, Problem, key_of, source_of
from otolith.estimation.window_fit import Fit, fit
from otolith.twin.components import MAX_COMPONENTS, SourceKind, positions, sites, sources

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
SIGNIFICANCE = 1e-4  # probability that amplitudes of windows agree that much by chance, or that a sine stands out
UNCERTAIN_SHAPE = 0.1  # of an inner parameter that is no frequency: its standard deviation
MIN_CYCLES = 3.0  # of a sine in each window, if its phase is another in each
NEIGHBOURS = (2, 3, 4, 5)  # spectral lines beside a sine, with which its gain is compared
MIN_LINE = NEIGHBOURS[-1] + 1  # spectral lines: least frequency of a sine with one phase that has all neighbours
MIN_SHARE = 0.5  # of the best score: candidates with less are dropped, unless they are a line above the spectrum
SHORTEST = 1e-300  # of a source within a window: the frequency of a sine in it stays finite
MAX_CONCENTRATION = 0.5  # sum of the squared shares of information: one window alone would decide
ROUNDING = 1e-9  # of an amplitude: scatter between windows below which they agree to all digits
AT_BOUND = 1e-3  # of an inner parameter: distance from a bound of the search at which it lies there
MAX_WINDOWS, MAX_TOTAL_RECORDS = 8, 10_000  # of a running twin that are searched together, and records of all of them
MAX_PAUSE = 256  # windows between two searches, which take as long as that of a window
SAME_INNER = 0.02  # of an inner parameter: two searches that differ by more have not shown the same

Starts = tuple[tuple[Window, tuple[float, ...], tuple[float, ...]], ...]
"""Windows, each with its initial state and with what was known of the parameters after it: they may drift."""


@dataclass(frozen=True, slots=True)
class Structure:
    """A component that all windows show."""

    component: Component
    sd: float  # Standard deviation of its amplitude, from the scatter between windows
    inner_sd: float  # Standard deviation of its inner parameter
    evidence: float  # -2 log evidence of all windows against a twin without it
    is_restarted: bool
    """Whether its phase is another in each window: a sine of time, or of an angle that begins at zero there."""
    phase_sd: float = UNKNOWN_PHASE_SD
    """Standard deviation of its phase, where its source is zero."""
    chance: float = 1.0  # Probability that amplitudes of noise agree as those of the windows do
    is_at_bound: bool = False
    """Whether its inner parameter lies at a bound of the search: then no form that is searched has its shape."""

    @property
    def is_offered(self) -> bool:
        """Whether it can be in the twin from the first window on: its shape, and its phase there, are determined."""
        return not self.is_restarted and not self.is_at_bound


class PooledResponse(ProjectedResponse):
    """The linear response of several windows with the same parameters; each has its own initial state."""

    def __init__(self, fits: Sequence[Fit]) -> None:
        """``fits`` are linearised at the same parameters."""
        self.parts = [LinearResponse(fitted) for fitted in fits]
        first = self.parts[0]
        self.problem, self.window, self.objective = first.problem, first.window, first.objective
        self.x = np.hstack([part.x for part in self.parts])
        self.count = sum(part.count for part in self.parts)
        self.ends = np.cumsum([fitted.objective.measured.size for fitted in fits])
        """(windows,) rows of the residual at which the windows end."""
        free, rows = len(first.problem.free), list(map(_rows_of_window, fits))
        self._start = fits[0].parameters
        states = [Elimination.of(jacobian[:, 2 * free :]).basis for _, jacobian in rows]
        widest = max(basis.shape[1] for basis in states)
        self._states = self.by_window(
            np.vstack([np.pad(basis, ((0, 0), (0, widest - basis.shape[1]))) for basis in states])
        )
        self._innovations = self._without_states(np.concatenate([residuals for residuals, _ in rows]))
        by_parameters = np.vstack([jacobian[:, :free] for _, jacobian in rows])
        self._parameters = self._without_states(by_parameters)
        self._components = np.zeros((len(self._innovations), 0))
        self._basis, self._remainder = self._states, self._innovations
        self.explain(by_parameters)

    def _without_states(self, columns: Array) -> Array:
        """Return ``columns`` (residuals, ...) without what the initial states of the windows explain."""
        return columns - self._states @ (self._states.T @ columns)

    def is_within_bounds(self, guess: ScoredGuess) -> bool:
        """Whether the parameters beside a component may be within their bounds.

        A component that resembles what a parameter does may have any amplitude if the parameter makes up for it. A sine
        with a phase in each window resembles none.
        """
        if self.is_restarted(guess.form):
            return True
        free = len(self._start)
        columns = self.columns(guess)
        design = np.hstack([self._parameters, -self._components, -self._without_states(columns)])
        step = np.linalg.lstsq(design, -self._innovations, rcond=None)[0][:free]
        variances = np.diag(np.linalg.pinv(design.T @ design, hermitian=True))[:free]
        reach = CHANCE_DEVIATE * np.sqrt(np.maximum(variances, 0.0))
        low, high = self.problem.bounds
        return bool(((self._start + step + reach >= low) & (self._start + step - reach <= high)).all())

    def columns(self, guess: ScoredGuess) -> Array:
        """Return the responses to a component (residuals, columns)."""
        columns = self.responses(basis_functions([(guess.form, guess.inner)]))
        return self.by_window(columns) if self.is_restarted(guess.form) else columns

    def add_component(self, columns: Array) -> None:
        """Project out a component, and count it as one in what follows."""
        self._components = np.hstack([self._components, self._without_states(columns)])
        self.explain(columns)

    def explain(self, columns: Array) -> None:
        """Project out what ``columns`` (residuals, columns) explain."""
        columns = columns - self._basis @ (self._basis.T @ columns)
        further = Elimination.of(columns)
        self._basis = np.hstack([self._basis, further.basis])
        self._remainder = further.left(self._remainder)
        self.chi_square = float(self._remainder @ self._remainder)

    def by_window(self, columns: Array) -> Array:
        """Return ``columns`` (residuals, columns) as (residuals, windows * columns), each of one window alone."""
        apart = np.zeros((len(columns), len(self.parts), columns.shape[1]))
        for index, rows in enumerate(self.slices):
            apart[rows, index] = columns[rows]
        return apart.reshape(len(columns), -1)

    @property
    def slices(self) -> list[slice]:
        """The rows of each window."""
        return [slice(start, end) for start, end in zip([0, *self.ends[:-1].tolist()], self.ends.tolist(), strict=True)]

    def responses(self, curves: BasisFunctions) -> Array:
        """See :meth:`ProjectedResponse.responses`."""
        return np.vstack([part.responses(curves) for part in self.parts])

    def estimated_gains(self, source: int, frequencies: Array) -> Array:
        """Return about by how much χ² falls (sites, frequencies), with a phase for each window."""
        return np.asarray(sum(part.estimated_gains(source, frequencies) for part in self.parts))

    def score(self, guesses: list[Guess]) -> ScoreStatistics:
        """Return the score statistics; a sine whose phase is another in each window costs more values."""
        pooled = super().score(guesses)
        restarted = [at for at, (form, _) in enumerate(guesses) if self.is_restarted(form)]
        if restarted:
            own = [part.score([guesses[at] for at in restarted]) for part in self.parts]
            values = 2.0 * (len(own) - 1)
            chance = values + CHANCE_DEVIATE * np.sqrt(2.0 * values)
            pooled.gain[restarted] = np.maximum(sum(part.gain for part in own) - chance, 0.0)
            squares = np.mean([(part.amplitudes**2).sum(axis=1) for part in own], axis=0)
            pooled.amplitudes[restarted] = np.column_stack([np.sqrt(squares), np.zeros(len(restarted))])
        return pooled

    def is_restarted(self, form: CandidateForm) -> bool:
        """Whether the form is a sine of time or of an angle that begins at zero in each window."""
        source = sources(self.problem.base_model)[form.source]
        return len(form.model.phases) > 1 and source.symbol.startswith("_")

    def with_cycles(self, form: CandidateForm) -> CandidateForm:
        """Return the form; a restarted one has several cycles in each window, as less is any slow curve."""
        if not self.is_restarted(form):
            return form
        low, high = form.bounds
        shortest = min(float(np.ptp(part.x[form.source])) for part in self.parts)
        return form._replace(bounds=(max(low, MIN_CYCLES * 2.0 * np.pi / max(shortest, SHORTEST)), high))

    def stands_out(self, guess: Guess) -> bool:
        """Whether a sine gains more than its neighbours in the spectrum.

        The ratio of its gain to the mean of its neighbours' has an F distribution if it is coloured noise that is
        smooth over them (D. J. Thomson, Proceedings of the IEEE 70, 1982, section XIII). Amplitudes of a sine with a
        phase in each window are positive whatever the noise. One with the same phase in all windows is projected out,
        as it leaks into its neighbours; it has some cycles, as less is any slow curve.
        """
        form, frequency = guess
        if len(form.model.phases) == 1:
            return False
        spans, is_restarted = [float(np.ptp(part.x[form.source])) for part in self.parts], self.is_restarted(form)
        line = 2.0 * np.pi / (min(spans) if is_restarted else max(spans))
        if not is_restarted and frequency < MIN_LINE * line:
            return False
        around = frequency + line * np.array([step for step in NEIGHBOURS for step in (-step, step)])
        beside: list[Guess] = [(form, float(value)) for value in around if value >= line]
        if is_restarted:
            from scipy.special import fdtrc  # noqa: PLC0415 - only noise identification needs SciPy

            gains = np.sum([part.score([guess, *beside]).gain for part in self.parts], axis=0)
            values = 2.0 * len(self.parts)
            return bool(fdtrc(values, values * len(beside), gains[0] / gains[1:].mean()) < SIGNIFICANCE)
        rest = copy(self)
        rest.explain(self.responses(basis_functions([guess])))
        ratio = float(self.score([guess]).gain[0]) / max(float(rest.score(beside).gain.mean()), np.finfo(float).tiny)
        return (1.0 + ratio / len(beside)) ** -len(beside) < SIGNIFICANCE  # F distribution, 2 degrees of freedom

    def is_line(self, guess: ScoredGuess) -> bool:
        """Whether a sine has one phase in all windows, and stands out: then it imitates no smooth curve."""
        return not self.is_restarted(guess.form) and self.stands_out((guess.form, guess.inner))

    def amplitudes_of_windows(self, guess: Guess) -> tuple[Array, Array]:
        """Return the amplitudes (windows, phases) that each window gives, and the information on them.

        It is (windows, phases, phases). A sine has a cosine and a sine part; if its phase is another in each window,
        only the size of both together.
        """
        columns = self.responses(basis_functions([guess]))
        columns = columns - self._basis @ (self._basis.T @ columns)
        rows = self.slices
        values = np.array([np.linalg.lstsq(columns[own], self._remainder[own], rcond=None)[0] for own in rows])
        information = np.array([columns[own].T @ columns[own] for own in rows])
        if self.is_restarted(guess[0]):
            mean = np.trace(information, axis1=1, axis2=2) / values.shape[1]
            return np.linalg.norm(values, axis=1, keepdims=True), mean[:, None, None]
        return values, information


def _rows_of_window(fitted: Fit) -> tuple[Array, Array]:
    """Return residuals and Jacobian at the start of a fit, without the rows of the prior."""
    _, residuals, jacobian = fitted.result.first
    count = len(residuals) - len(fitted.prior.mean)
    return residuals[:count], jacobian[:count]


def remaining_structure(
    problem: Problem, noise: IdentifiedNoise, windows: Sequence[Window], progress: Progress = lambda _: None
) -> list[Structure]:
    """Return the components that ``windows`` show together, the strongest first; none if there are few windows.

    ``noise`` has been identified from these windows. If the machine changes in them, the longest part between changes
    is used, without the windows in which they may fall.
    """
    if noise.windows < MIN_REGIME or problem.components:
        return []
    likelihood, levels = Likelihood(problem), np.array(noise.before_inflation)
    fits: list[FittedWindow] = []
    for window in usable_windows(problem, windows):
        progress(f"structure of window {len(fits) + 1}")
        starts = [problem.nominal, *(one.guess[: len(problem.free)] for one in fits[-1:])]
        fits.append(likelihood.fit(levels, window, starts))
    parts = regimes([one for one in fits if one.is_explained], noise.changes)
    inner = [part[at > 0 : len(part) - (at < len(parts) - 1)] for at, part in enumerate(parts)]
    fits = max(inner, key=len, default=[])
    if len(fits) < MIN_REGIME:
        return []
    progress("structure of all windows")
    pooled = PooledResponse(_at_common_parameters(with_levels(problem, levels), fits, likelihood.width))
    return structures(pooled, pooled_forms(pooled))


def pooled_forms(pooled: PooledResponse) -> list[CandidateForm]:
    """Return the forms that windows at different times show alike."""
    # Not-a-number between two windows: no change of a source from record to record spans them.
    separated = np.hstack([np.pad(part.x, ((0, 0), (0, 1)), constant_values=np.nan) for part in pooled.parts])
    alike = (form for form in allowed_forms(pooled.problem, separated) if _is_alike(pooled.problem, form))
    return [form for form in map(pooled.with_cycles, alike) if form.bounds[0] <= form.bounds[1]]


def structures(pooled: PooledResponse, allowed: list[CandidateForm]) -> list[Structure]:
    """Return the structures, one at a time: each is projected out before the next one is searched for."""
    shown: list[Structure] = []
    while len(shown) < MAX_COMPONENTS:
        guesses = best_guesses(pooled, allowed, CompetingForms.among(pooled.problem, allowed))
        best = max((guess.score for guess in guesses), default=0.0)
        likely = [guess for guess in guesses if guess.score > DECISIVE and guess.is_readable]
        likely = [guess for guess in likely if guess.score > MIN_SHARE * best or pooled.is_line(guess)]
        impossible = [guess.form for guess in likely if not pooled.is_within_bounds(guess)]
        if impossible:
            allowed = [form for form in allowed if form not in impossible]
            continue
        structure = next(filter(None, (_structure(pooled, guess) for guess in likely)), None)
        if structure is None:
            break
        shown.append(structure[0])
        allowed = [form for form in allowed if _may_follow(structure[1], form)]
    return shown


def _may_follow(form: CandidateForm, other: CandidateForm) -> bool:
    """Whether ``other`` may be a structure beside that of ``form``.

    Levels that contain a sine are too large for anything smooth: what is left of that is the work of a controller.
    """
    is_same = (form.site, form.model, form.source) == (other.site, other.model, other.source)
    return not is_same and (len(form.model.phases) == 1 or len(other.model.phases) > 1)


def _at_common_parameters(problem: Problem, fits: Fits, width: Array) -> list[Fit]:
    """Return the windows, linearised at their weighted mean parameters and each at its own initial state."""
    free, prior = len(problem.free), initial_prior(problem)
    centre = np.median([one.guess[:free] for one in fits], axis=0)
    roots = [sqrt_information(one, width) for one in fits]
    deviations = [root @ ((one.guess[:free] - centre) / width[:free]) for root, one in zip(roots, fits, strict=True)]
    step = np.linalg.lstsq(np.vstack(roots), np.concatenate(deviations), rcond=None)[0] * width[:free]
    start = np.concatenate([np.clip(centre + step, *problem.bounds), np.zeros(free)])
    return [fit(problem, one.window, prior, start, 0, state=tuple(one.guess[free:].tolist())) for one in fits]


def _is_alike(problem: Problem, form: CandidateForm) -> bool:
    """Whether windows at different times show the same component: no error of a sensor, and no trend.

    Under a controller the inputs follow every disturbance, so that what depends on an input is no structure.
    """
    twin, source = problem.base_model, sources(problem.base_model)[form.source]
    is_trend = source.kind is SourceKind.TIME and len(form.model.phases) == 1
    is_input = source.name in {driven.name for driven in twin.inputs}
    return form.site < len(twin.sites) and not is_trend and not is_input


def _structure(pooled: PooledResponse, guess: ScoredGuess) -> tuple[Structure, CandidateForm] | None:
    """Return the structure of a guess, which is then projected out, or None if the windows do not agree on it."""
    form, inner = guess.form, guess.inner
    is_restarted, periodic = pooled.is_restarted(form), len(form.model.phases) > 1
    sd, chance = _amplitude_sd(*pooled.amplitudes_of_windows((form, inner)))
    if chance >= SIGNIFICANCE or (is_restarted and not pooled.stands_out((form, inner))):
        return None
    pooled.add_component(pooled.columns(guess))
    first, second = map(float, guess.amplitudes)
    twin = pooled.problem.base_model
    component = Component(
        sites(twin)[form.site].name,
        form.model.name,
        sources(twin)[form.source].name,
        float(np.hypot(first, second)) if periodic else first,
        inner,
        float(np.arctan2(second, first)) if periodic else 0.0,
        *form.bounds,
        origin=pooled.window.start,
    )
    span = float(np.ptp(pooled.parts[0].x[form.source] if is_restarted else pooled.x[form.source]))
    inner_sd = np.sqrt(12.0 / max(guess.score, 1.0)) / span if periodic else UNCERTAIN_SHAPE * inner
    centre = float(np.abs(pooled.x[form.source].mean()))
    phase_sd = UNKNOWN_PHASE_SD if is_restarted else float(np.hypot(sd / component.amplitude, inner_sd * centre))
    at_bound = not periodic and form.model.inner is not None and _is_at_bound(inner, form.bounds)
    return Structure(component, sd, float(inner_sd), guess.score, is_restarted, phase_sd, chance, at_bound), form


def _amplitude_sd(values: Array, information: Array) -> tuple[float, float]:
    """Return the standard deviation of the weighted mean of amplitudes (windows, phases), and its chance.

    The one is from their scatter, the other the probability that noise agrees as much on an amplitude. The covariance
    of each is inverse to its ``information`` (windows, phases, phases), times a common factor. The ratio of what the
    mean explains to the scatter has an F distribution, for one amplitude the square of Student's t. Both parts of a
    sine count, since noise of any phase has a positive mean in the phase of all windows together (J. D. Victor,
    J. Mast, Electroencephalography and Clinical Neurophysiology 78, 1991).
    """
    from scipy.special import fdtrc  # noqa: PLC0415 - only a component that would be significant needs SciPy

    windows, phases = values.shape
    weights = np.trace(information, axis1=1, axis2=2)
    if not values.any() or (weights**2).sum() >= MAX_CONCENTRATION * weights.sum() ** 2:
        return np.inf, 1.0
    inverse = np.linalg.pinv(information.sum(axis=0), hermitian=True)
    mean = inverse @ np.einsum("wpq,wq->p", information, values)
    explained = float(mean @ information.sum(axis=0) @ mean)
    left, degrees = values - mean, phases * (windows - 1.0)
    variance = float(np.einsum("wp,wpq,wq->", left, information, left)) / degrees
    variance = max(variance, ROUNDING**2 * explained)
    if not explained:
        return np.inf, 1.0
    chance = float(fdtrc(phases, degrees, explained / phases / variance))
    return float(np.sqrt(variance * (mean @ inverse @ mean) / (mean @ mean))), chance


def _is_at_bound(value: float, bounds: tuple[float, float]) -> bool:
    return any(abs(value - bound) <= AT_BOUND * abs(bound) for bound in bounds)


@dataclass(frozen=True, slots=True, eq=False)
class PooledWindows:
    """The last windows that updated the filter and showed nothing that the twin lacks."""

    windows: Starts = ()
    pause: int = MIN_REGIME  # Windows until the next search
    next_pause: int = MIN_REGIME  # The same after it
    shown: Structure | None = None  # By the last search
    confirmed: Structure | None = None  # By the last two: it is to be adopted

    def after(self, fitted: Fit, parameters: Array) -> "PooledWindows":
        """Return the windows with that of a fit; ``parameters`` (free,) are known after it.

        What two searches in a row show is confirmed if none of the inner parameters that were tried would agree as much
        by chance: the second search has a window that the first one has not seen, but its other windows as well.
        """
        pause, problem = self.pause - 1, fitted.problem
        if not positions(problem.base_model):
            return self
        in_twin = (source_of(problem.base_model, component.source) for component in problem.components)
        if not problem.discover or pause >= MAX_WINDOWS or any(source.symbol.startswith("_") for source in in_twin):
            return replace(self, windows=(), pause=pause)  # what is in the twin may have another phase in each window
        states = fitted.initial[: len(problem.base_model.states)]
        start = fitted.window, tuple(states.tolist()), tuple(parameters[: len(problem.free)].tolist())
        windows = (*self.windows, start)[-MAX_WINDOWS:]
        while sum(window.records for window, *_ in windows) > MAX_TOTAL_RECORDS:
            windows = windows[1:]
        if pause > 0 or len(windows) < MIN_REGIME:
            return replace(self, windows=windows, pause=pause)
        shown, before = lacking_component(problem, windows), self.shown
        if shown is not None and before is not None and shown.component.key == before.component.key:
            one, other = shown.component.inner, before.component.inner
            if abs(one - other) <= SAME_INNER * abs(one) and shown.chance < CHANGE_SIGNIFICANCE:
                return PooledWindows(confirmed=shown)
        longer = min(2 * self.next_pause, MAX_PAUSE)
        return PooledWindows(windows, self.next_pause if shown is None else 1, longer, shown)


def lacking_component(problem: Problem, windows: Starts) -> Structure | None:
    """Return the component that ``windows`` show together most clearly, within its physical range; None if none.

    Noise that was stated larger than it is hides structure, so likelier levels are searched at. But what the
    stated noise covers may be a part of it: only a sine that stands out in its spectrum needs no evidence beside that.
    """
    quieter = likelier_levels_of(_fits(problem, windows[-1:])[0])
    pooled = _pooled(quieter, windows)
    at_positions = positions(problem.base_model)
    forms = [form for form in pooled_forms(pooled) if form.source in at_positions]
    for shown in filter(lambda own: own.is_offered, structures(pooled, forms)):
        guess = next(form for form in forms if _key(pooled, form) == shown.component.key), shown.component.inner
        alone, stated = (_pooled(levels, windows) for levels in (quieter, problem))
        scored = ScoredGuesses.of(stated, [guess], CompetingForms.among(problem, forms))[0]
        is_shown = scored.score > DECISIVE or alone.is_line(scored)
        if (
            is_shown
            and not _may_be_of_sensor(alone, guess)
            and all(components_of(own, [scored]) for own in stated.parts)
        ):
            return shown
    return None


def _pooled(problem: Problem, windows: Starts) -> PooledResponse:
    return PooledResponse(_fits(problem, windows))


def _fits(problem: Problem, windows: Starts) -> list[Fit]:
    """Return the windows, each linearised at what was known of the parameters after it."""
    prior, trends = initial_prior(problem), np.zeros(len(problem.free))
    starts = ((window, state, np.concatenate([parameters, trends])) for window, state, parameters in windows)
    return [fit(problem, window, prior, start, 0, state=state) for window, state, start in starts]


def _key(pooled: PooledResponse, form: CandidateForm) -> str:
    twin = pooled.problem.base_model
    return key_of(sites(twin)[form.site].name, form.model.name, sources(twin)[form.source].name)


def _may_be_of_sensor(pooled: PooledResponse, guess: Guess) -> bool:
    """Whether the error of an output's sensor would explain the windows as well, as that of an encoder."""
    (form, inner), twin = guess, pooled.problem.base_model
    outputs = {output.name for output in twin.outputs}
    read = [at for at, site in enumerate(sites(twin)) if at >= len(twin.sites) and site.into in outputs]
    of_sensors = [(form._replace(site=at), inner) for at in read]
    gains = pooled.score([guess, *of_sensors]).gain
    return bool((gains[1:] > gains[0] - DECISIVE).any())
