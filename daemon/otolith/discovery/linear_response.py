"""The linear response of a twin to components: what each candidate would gain, before it is fitted.

A component of unit amplitude at a site changes the whitened innovations of the window; to first order in its amplitude
this change is the response of the linearised twin in innovation form. What parameters, trends and initial state can
explain, with all that is known of them, is projected out of residual and responses first. Score statistics are
therefore gains over "parameters only". ``docs/explanation/discovery.md`` has the equations.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Mask
from otolith.estimation.augmented import base_model, input_matrix
from otolith.estimation.problem import key_of
from otolith.estimation.window_fit import Fit
from otolith.twin.augmentation import ComponentSource, augmented_model, sites, sources
from otolith.twin.component_families import COMPONENT_FAMILIES, ComponentFamily, SourceKind, family_code
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation, Indices, LinearisedModel, kernel_of

SENSOR_FAMILIES = frozenset({"constant", "linear"})  # the errors of a sensor: an offset and a gain
PROBE_RECORDS = 6  # from which the size of the finite difference is found
PROBE_EFFECT = 1e-4  # relative effect of the finite difference on a state
MAX_DIFFERENCE = (
    10.0  # of χ²: a component that differs less from a parameter cannot be distinguished from it in a window
)
SAME_DIRECTION = 1.0 - 1e-5  # cosine between the effects of a component and of a parameter that are the same
MIN_INPUT_VARIATION = 5.0  # times the noise of an input: less variation is noise
MIN_REMAINDER = 1e-6  # share of a response that is left beside the effects of parameters; less is a parameter
MIN_BASIS_SINGULAR = 1e-10  # relative singular value of the directions that are projected out
MIN_INDEPENDENCE = 1e-9  # of the two curves of a periodic component


@dataclass(frozen=True, slots=True)
class CandidateForm:
    """A component without amplitude, inner parameter and phase."""

    site: int
    """Index of the site."""
    model: ComponentFamily
    source: int
    """Index of the source."""
    bounds: tuple[float, float] = (0.0, 0.0)
    """Of the inner parameter."""


Guess = tuple[CandidateForm, float]
"""A form and its inner parameter."""


def candidate_library(twin: Definition, x: Array, taken: frozenset[str] = frozenset()) -> list[CandidateForm]:
    """Return all forms that can be distinguished where the sources are ``x`` (sources, records).

    ``twin`` is the base model. Forms whose keys are ``taken`` are left out.
    """
    valid = [
        (model, number, source, _inner_bounds(model, x[number]))
        for model in COMPONENT_FAMILIES
        for number, source in enumerate(sources(twin))
        if source.kind in model.inputs and model.valid(x[number])
    ]
    machine_sites = len(twin.sites)
    return [
        CandidateForm(index, model, number, bounds)
        for index, site in enumerate(sites(twin))
        for model, number, source, bounds in valid
        if (index < machine_sites or _is_sensor_error(model, source, site.into))
        and key_of(site.name, model.name, source.name) not in taken
    ]


def _inner_bounds(model: ComponentFamily, x: Array) -> tuple[float, float]:
    if model.fixed_inner is not None:
        return model.fixed_inner(x), model.fixed_inner(x)
    return (0.0, 0.0) if model.inner is None else model.inner.bounds(x)


def _is_sensor_error(model: ComponentFamily, source: ComponentSource, signal: str) -> bool:
    """Whether the form is an offset, or a gain error, of the sensor of ``signal``."""
    if model.name not in SENSOR_FAMILIES:
        return False
    return source.kind is SourceKind.NOTHING or source.name == signal


def inner_grid(form: CandidateForm, x: Array, fineness: float) -> Array:
    """Return values (points,) of the inner parameter; ``x`` (sources, records), ``fineness`` in spectral lines."""
    inner = form.model.inner
    low, high = form.bounds
    if inner is None:
        return np.array([low])
    if inner.points:
        points = max(round(inner.points / fineness**2), 2)
        return np.exp(np.linspace(np.log(low), np.log(high), points))
    width = fineness * 2.0 * np.pi / max(float(np.ptp(x[form.source])), 1e-9)  # of a spectral line
    return np.arange(low, high, width)


@dataclass(frozen=True, slots=True, eq=False)
class BasisFunctions:
    """Curves of components of unit amplitude; the curves of one guess are neighbours."""

    families: Array
    """(curves,) codes."""
    sources: Indices
    """(curves,) indices."""
    sites: Indices
    """(curves,) indices."""
    inner: Array
    """(curves,)."""
    phases: Array
    """(curves,) rad."""


def basis_functions(guesses: Iterator[Guess]) -> BasisFunctions:
    """Return one curve for each guess, or two a quarter turn apart where the phase is free."""
    rows = [
        (family_code(form.model.name), form.source, form.site, inner, phase)
        for form, inner in guesses
        for phase in form.model.phases
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    families, source_indices, site_indices, inner, phases = columns
    return BasisFunctions(families, source_indices.astype(np.int64), site_indices.astype(np.int64), inner, phases)


@dataclass(frozen=True, slots=True, eq=False)
class ScoreStatistics:
    """What each guess would gain."""

    gain: Array
    """(guesses,) by which χ² falls."""
    amplitudes: Array
    """(guesses, 2) of its curves; zero for a second curve that it does not have."""


class LinearResponse:
    """Residual and responses of one window, around the start of a fit."""

    def __init__(self, fitted: Fit) -> None:
        """Linearise where ``fitted`` started."""
        self.problem, self.window, self.objective = fitted.problem, fitted.window, fitted.objective
        self._guess, residuals, jacobian = fitted.result.first
        self._project(residuals, jacobian, len(residuals) - len(fitted.prior.mean))
        self._linearise_slots()

    def _project(self, residuals: Array, jacobian: Array, window_rows: int) -> None:
        """Project out what parameters, trends and initial state explain; the last rows are those of the prior."""
        size = np.linalg.norm(jacobian, axis=0)
        alive = size > 0.0
        basis, singular, _ = np.linalg.svd(jacobian[:, alive] / size[alive], full_matrices=False)
        basis = basis[:, singular > MIN_BASIS_SINGULAR * singular[0]]
        remainder = residuals - basis @ (basis.T @ residuals)
        self.chi_square = float(remainder @ remainder)
        """Of parameters only, with the prior."""
        self._remainder, self._basis = remainder[:window_rows], basis[:window_rows]

    def _linearise_slots(self) -> None:
        """Linearise the twin with slots along the predicted trajectory, and evaluate the sources there."""
        free, objective = len(self.problem.free), self.objective
        slotted = augmented_model(base_model(self.problem))
        self._kernel = kernel_of(slotted)
        values, states = objective.parameters(self._guess[None, :free])[0], self._guess[2 * free :]
        parameters, initial = _padded(values, len(slotted.parameters)), _padded(states, len(slotted.states))
        gain = np.pad(objective.innovation_model.gain, ((0, 0), (0, len(initial) - len(states)), (0, 0)))
        excitation = replace(objective.excitation, inputs=input_matrix(slotted, self.window), gain=gain)
        differences = self._difference_sizes(parameters, initial, excitation)
        linear = self._kernel.linearise(parameters, initial, excitation, differences)
        self.x = self._sources([state.name for state in slotted.states], linear.trajectory, states)
        """(sources, records)."""
        self._linear = _without_angles(linear, len(states))

    def _difference_sizes(self, parameters: Array, initial: Array, excitation: Excitation) -> Array:
        """Return the size (sites,) of each finite difference: above rounding, and within what is linear."""
        count = len(sites(base_model(self.problem)))
        few = replace(
            excitation,
            inputs=excitation.inputs[:PROBE_RECORDS],
            measured=None if excitation.measured is None else excitation.measured[:PROBE_RECORDS],
            gain=None if excitation.gain is None else excitation.gain[:PROBE_RECORDS],
        )
        trial = self._kernel.linearise(parameters, initial, few, np.full(count, 1e-3))
        size = np.maximum(np.abs(trial.trajectory).max(axis=0), 1e-3)[:, None]
        effect = (np.abs(trial.input_now + trial.input_next).max(axis=0) / size).max(axis=0)
        noise = self.objective.noise.outputs[:, None]
        effect = np.maximum(effect, (np.abs(trial.feedthrough).max(axis=0) * PROBE_EFFECT / noise).max(axis=0))
        return np.asarray(PROBE_EFFECT / np.maximum(effect, 1e-12))

    def _sources(self, state_names: list[str], trajectory: Array, initial: Array) -> Array:
        """Return the sources (sources, records): nothing, states, time, predicted outputs, or inputs."""
        twin, free, window = base_model(self.problem), len(self.problem.free), self.window
        outputs, inputs = [output.name for output in twin.outputs], [source.name for source in twin.inputs]
        predicted = self.objective.predict(np.concatenate([self._guess[:free], initial])[None])[0]
        rows = []
        for source in sources(twin):
            if not source.symbol:
                rows.append(np.zeros(window.records))
            elif source.symbol in state_names:
                rows.append(trajectory[:, state_names.index(source.symbol)])
            elif source.name == "t":
                rows.append(window.sample_period * np.arange(window.records, dtype=np.float64))
            elif source.name in outputs:
                rows.append(predicted[:, outputs.index(source.name)])
            else:
                rows.append(self._input(inputs.index(source.name), window.column(source.name)))
        return np.array(rows)

    def _input(self, index: int, values: Array) -> Array:
        """Return an input (records,); a constant where it varies by no more than its noise."""
        noise = self.objective.noise.inputs[index]
        return values if values.std() > MIN_INPUT_VARIATION * noise else np.full(len(values), values.mean())

    def score(self, guesses: list[Guess]) -> ScoreStatistics:
        """Return the score statistics of all guesses."""
        if not guesses:
            return ScoreStatistics(np.zeros(0), np.zeros((0, 2)))
        counts = np.array([len(form.model.phases) for form, _ in guesses], dtype=np.int64)
        first = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        pairs = np.column_stack([first, first + counts - 1])
        return self.score_responses(self.responses(basis_functions(iter(guesses))), pairs)

    def score_parameters(self, names: list[str]) -> Array:
        """Return by how much χ² falls (parameters,) if each parameter moves alone."""
        one = np.arange(len(names))
        return self.score_responses(self._parameter_responses(names), np.column_stack([one, one])).gain

    def is_parameter(self, curves: BasisFunctions, amplitudes: Array) -> Mask:
        """Return which curves (curves,) of these ``amplitudes`` a parameter within its bounds would produce as well."""
        parameters_of_twin = base_model(self.problem).parameters
        names = [parameter.name for parameter in parameters_of_twin]
        parameters, responses = self._parameter_responses(names), self.responses(curves)
        size, response_size = np.linalg.norm(parameters, axis=0), np.linalg.norm(responses, axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            cosine = np.abs(parameters.T @ responses) / np.outer(size, response_size)
            step = (parameters.T @ responses) * amplitudes / (size**2)[:, None]
            difference = (1.0 - cosine**2) * (response_size * amplitudes) ** 2
        order = [parameter.name for parameter in self.problem.twin.parameters]
        values = self.objective.parameters(self._guess[None, : len(self.problem.free)])[0]
        now = values[[order.index(name) for name in names]][:, None]
        low = np.array([[parameter.low] for parameter in parameters_of_twin])
        high = np.array([[parameter.high] for parameter in parameters_of_twin])
        within = (low <= now + step) & (now + step <= high)
        return np.asarray(((cosine > SAME_DIRECTION) & (difference < MAX_DIFFERENCE) & within).any(axis=0))

    def responses(self, curves: BasisFunctions) -> Array:
        """Return the responses (residuals, curves) of the whitened innovations."""
        values = self._kernel.curves(curves.families, self.x, curves.sources, curves.inner, curves.phases)
        model, present = self.objective.innovation_model, self.objective.present
        return self._kernel.respond(self._linear, model, present, values, curves.sites)

    def _parameter_responses(self, names: list[str]) -> Array:
        """Return how each parameter changes the whitened innovations (residuals, parameters)."""
        objective, order = self.objective, [parameter.name for parameter in self.problem.twin.parameters]
        free = len(self.problem.free)
        parameters = objective.parameters(self._guess[None, :free])[0]
        slopes = objective.kernel.sensitivities(parameters, self._guess[2 * free :], objective.excitation).slopes
        columns = np.where(objective.present[..., None], slopes[:, :, [order.index(name) for name in names]], 0.0)
        return np.asarray(np.matmul(objective.whitening, columns).reshape(-1, len(names)))

    def score_responses(self, responses: Array, pairs: Array) -> ScoreStatistics:
        """Return the statistics of ``responses`` (residuals, curves).

        ``pairs`` (guesses, 2) holds the two curves of each guess, or its one curve twice. The amplitudes solve the
        normal equations of one or two curves after projection.
        """
        with np.errstate(all="ignore"):
            along = self._remainder @ responses
            shared = self._basis.T @ responses
            whole = np.einsum("rc,rc->c", responses, responses)
            own = whole - np.einsum("bc,bc->c", shared, shared)
            own = np.where(own > MIN_REMAINDER * whole, own, np.inf)
            first, second = pairs.T
            single = first == second
            cross = np.zeros(len(pairs))
            one, two = first[~single], second[~single]
            cross[~single] = np.einsum("rg,rg->g", responses[:, one], responses[:, two])
            cross[~single] -= np.einsum("bg,bg->g", shared[:, one], shared[:, two])
            other = np.where(single, np.inf, own[second])
            independence = 1.0 - cross**2 / (own[first] * other)
            one = (along[first] - cross / other * along[second]) / (own[first] * independence)
            two = np.where(single, 0.0, (along[second] - cross / own[first] * along[first]) / (other * independence))
            gain = one * along[first] + two * along[second]
        valid = np.isfinite(gain) & np.isfinite(one) & np.isfinite(two) & (independence > MIN_INDEPENDENCE)
        amplitudes = np.where(valid[:, None], np.column_stack([one, two]), 0.0)
        return ScoreStatistics(np.where(valid, gain, 0.0), amplitudes)


def _padded(values: Array, length: int) -> Array:
    padded = np.zeros(length)
    padded[: len(values)] = values
    return padded


def _without_angles(linear: LinearisedModel, states: int) -> LinearisedModel:
    """Return the linearisation without the angles that no component depends on: they change nothing."""
    if linear.trajectory.shape[1] == states:
        return linear
    return linear._replace(
        transition=np.ascontiguousarray(linear.transition[:, :states, :states]),
        input_now=np.ascontiguousarray(linear.input_now[:, :states]),
        input_next=np.ascontiguousarray(linear.input_next[:, :states]),
        output=np.ascontiguousarray(linear.output[:, :, :states]),
    )
