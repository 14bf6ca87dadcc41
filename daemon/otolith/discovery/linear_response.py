"""The linear response of a twin to components: what each candidate would gain, before it is fitted.

A component of unit amplitude at a site changes the whitened innovations of the window; to first order in its amplitude
this change is the response of the linearised twin in innovation form. What parameters, trends and initial state can
explain, with all that is known of them, is projected out of residual and responses first. Score statistics are
therefore gains over "parameters only". ``docs/explanation/discovery.md`` has the equations.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.discovery.candidate_forms import CandidateForm
from otolith.estimation.data_checks import median
from otolith.estimation.evidence import CERTAIN_DEVIATE, DECISIVE, MIN_EXPLAINED, Elimination, chi_square_left
from otolith.estimation.objective import Objective, input_matrix
from otolith.estimation.problem import Problem
from otolith.estimation.timing import delay_response
from otolith.estimation.window_fit import Fit
from otolith.twin.components import augmented_model, family_code, sensor_site, sites, sources
from otolith.twin.kernel import Indices, LinearisedModel, kernel_of

SAME_DIRECTION = 1.0 - 1e-5  # cosine between the effects of a component and of a parameter that are the same
MIN_REMAINDER = 1e-6  # share of a response that is left beside the effects of parameters; less is a parameter
MAX_BLOCK = 1 << 21  # residuals times curves that are computed at once: 16 MB
PROBES = 16  # random vectors by which the length of a projected response is estimated
PROBE_SETS = 4  # windows in turn have others: what one set underestimates, the next ones do not


Guess = tuple[CandidateForm, float]  # A form and its inner parameter
Shape = tuple[float, int, float, float]
"""Family code, source, inner parameter and phase of a component of unit amplitude."""


@dataclass(frozen=True, slots=True, eq=False)
class BasisFunctions:
    """Curves of components of unit amplitude; the curves of one guess are neighbours, and sites share their shapes."""

    families: Array  # (shapes,) codes
    sources: Indices  # (shapes,) indices
    inner: Array  # (shapes,)
    phases: Array  # (shapes,) rad
    shapes: Indices  # (curves,) indices
    sites: Indices  # (curves,) indices


def basis_functions(guesses: Iterable[Guess]) -> BasisFunctions:
    """Return one curve for each guess, or two a quarter turn apart where the phase is free."""
    shapes: dict[Shape, int] = {}
    curves = []
    for (site, model, source, _), inner in guesses:
        code = family_code(model.name)
        curves += [(shapes.setdefault((code, source, inner, phase), len(shapes)), site) for phase in model.phases]
    of_curves, site_indices = np.array(curves, dtype=np.int64).reshape(-1, 2).T
    return BasisFunctions(*_columns(shapes), of_curves, site_indices)


def _columns(shapes: Iterable[Shape]) -> tuple[Array, Indices, Array, Array]:
    """Return family codes, sources, inner parameters and phases, each (shapes,)."""
    families, source_indices, inners, phases = np.array(list(shapes), dtype=np.float64).reshape(-1, 4).T
    return families, source_indices.astype(np.int64), inners, phases


@dataclass(frozen=True, slots=True, eq=False)
class ScoreStatistics:
    """What each guess would gain."""

    gain: Array  # (guesses,) by which χ² falls
    amplitudes: Array  # (guesses, 2) of its curves; zero for a second curve that it does not have


class ProjectedResponse(ABC):
    """A residual and its responses to components, both without what parameters, trends and initial states explain."""

    problem: Problem
    window: Window
    objective: Objective  # Of the window, or of the first of several
    count: float  # Measured values of all outputs
    x: Array  # (sources, records)
    chi_square: float  # Of parameters only, with the prior
    _remainder: Array  # (residuals,) what is left of the residual
    _basis: Array  # (residuals, columns) orthonormal: what is projected out

    @abstractmethod
    def responses(self, curves: BasisFunctions) -> Array:
        """Return the responses (residuals, curves) of the whitened innovations."""

    @abstractmethod
    def estimated_gains(self, source: int, frequencies: Array) -> Array:
        """Return about by how much χ² falls (sites, frequencies) by a sine of a source at each site of the machine."""

    def score(self, guesses: list[Guess]) -> ScoreStatistics:
        """Return the score statistics of all guesses."""
        block = max(MAX_BLOCK // max(2 * len(self._remainder), 1), 1)
        parts = [self._score_block(guesses[first : first + block]) for first in range(0, len(guesses), block)]
        if not parts:
            return ScoreStatistics(np.zeros(0), np.zeros((0, 2)))
        gain = np.concatenate([part.gain for part in parts])
        return ScoreStatistics(gain, np.concatenate([part.amplitudes for part in parts]))

    def _score_block(self, guesses: list[Guess]) -> ScoreStatistics:
        counts = np.array([len(form.model.phases) for form, _ in guesses], dtype=np.int64)
        first = np.cumsum(counts) - counts
        pairs = np.array([first, first + counts - 1]).T
        return self.score_responses(self.responses(basis_functions(guesses)), pairs)

    def score_responses(self, responses: Array, pairs: Array | None = None) -> ScoreStatistics:
        """Return the statistics of ``responses`` (residuals, curves): those of all first-order scores.

        ``pairs`` (guesses, 2) holds the two curves of each guess, or its one curve twice; by default, each curve is a
        guess. The amplitudes a solve the
        normal equations N a = b of one or two curves after projection, and the gain is bᵀ a.
        """
        own = np.arange(responses.shape[1])
        first, second = np.array([own, own]) if pairs is None else pairs.T
        with np.errstate(all="ignore"):
            products = self._remainder @ responses  # b of each curve
            in_basis = self._basis.T @ responses
            whole = np.einsum("rc,rc->c", responses, responses)
            squares = whole - np.einsum("bc,bc->c", in_basis, in_basis)  # diagonal of N
            squares = np.where(squares > MIN_REMAINDER * whole, squares, np.inf)
            single = first == second
            one, two = first[~single], second[~single]
            cross = np.zeros(len(first))  # off the diagonal of N
            cross[~single] = np.einsum("rg,rg->g", responses[:, one], responses[:, two])
            cross[~single] -= np.einsum("bg,bg->g", in_basis[:, one], in_basis[:, two])
            n_11, n_22 = squares[first], np.where(single, np.inf, squares[second])
            b_1, b_2 = products[first], products[second]
            independence = 1.0 - cross**2 / (n_11 * n_22)
            a_1 = (b_1 - cross / n_22 * b_2) / (n_11 * independence)
            a_2 = np.where(single, 0.0, (b_2 - cross / n_11 * b_1) / (n_22 * independence))
            gain = a_1 * b_1 + a_2 * b_2
        valid = np.isfinite(gain) & np.isfinite(a_1) & np.isfinite(a_2) & (independence > MIN_EXPLAINED)
        amplitudes = np.where(valid, [a_1, a_2], 0.0).T
        return ScoreStatistics(np.where(valid, gain, 0.0), amplitudes)


class LinearResponse(ProjectedResponse):
    """Residual and responses of one window, around the start of a fit."""

    def __init__(self, fitted: Fit) -> None:
        """Linearise where ``fitted`` started."""
        self.problem, self.window, self.objective = fitted.problem, fitted.window, fitted.objective
        self.count = self.objective.count
        start, residuals, jacobian = fitted.result.first
        self._guess = self.objective.without_trends(start)
        self._unknowns, rows = Elimination.of(jacobian), len(residuals) - len(fitted.prior.mean)  # below is the prior
        remainder = self._unknowns.left(residuals)
        self.chi_square = float(remainder @ remainder)
        self._remainder, self._basis = remainder[:rows], self._unknowns.basis[:rows]
        self._linearise_slots()

    def _linearise_slots(self) -> None:
        """Linearise the twin with slots along the predicted trajectory, and evaluate the sources there."""
        free, objective = len(self.problem.free), self.objective
        slotted = augmented_model(self.problem.base_model)
        self._kernel = kernel_of(slotted)
        values, states = objective.parameters(self._guess[None])[0], self._guess[free:]
        parameters, initial = np.zeros(len(slotted.parameters)), np.zeros(len(slotted.states))
        parameters[: len(values)], initial[: len(states)] = values, states
        gain = np.zeros((self.window.records, len(initial), len(self.problem.base_model.outputs)))
        gain[:, : len(states)] = objective.innovation_model.gain
        excitation = replace(objective.excitation, inputs=input_matrix(slotted, self.window), gain=gain)
        linear = self._kernel.linearise(parameters, initial, excitation)
        self.x = self._sources([state.name for state in slotted.states], linear.trajectory)
        self._linear = _without_angles(linear, len(states))

    def _sources(self, state_names: list[str], trajectory: Array) -> Array:
        """Return the sources (sources, records): nothing, states, time, predicted outputs, or inputs."""
        twin, window = self.problem.base_model, self.window
        outputs, inputs = [output.name for output in twin.outputs], [source.name for source in twin.inputs]
        rows = []
        for source in sources(twin):
            if not source.symbol:
                rows.append(np.zeros(window.records))
            elif source.symbol in state_names:
                rows.append(trajectory[:, state_names.index(source.symbol)])
            elif source.name == "t":
                rows.append(window.grid.offsets)
            elif source.name in outputs:
                rows.append(self._predicted[:, outputs.index(source.name)])
            else:
                rows.append(self._input(inputs.index(source.name), window.column(source.name)))
        return np.array(rows)

    @cached_property
    def _predicted(self) -> Array:
        """(records, outputs): the prediction at the guess."""
        predicted: Array = self.objective.predict(self._guess[None])[0]
        return predicted

    def _input(self, index: int, values: Array) -> Array:
        """Return an input (records,); a constant where it varies by no more than its noise."""
        levels, mean = self.objective.noise.inputs[:, index], float(values.mean())
        noise = float(levels[0]) if self.window.bridge_error is None else median(levels)  # then all are the same
        deviations = values - mean
        varies = float(deviations @ deviations) > (CERTAIN_DEVIATE * noise) ** 2 * len(values)
        return values if varies else np.full(len(values), mean)

    def estimated_gains(self, source: int, frequencies: Array) -> Array:
        """Return about by how much χ² falls (sites, frequencies) by a sine of a source at each site of the machine.

        ``frequencies`` (frequencies,) are equidistant. The cost is linear in records plus frequencies, because no
        response is computed. The true gain over the estimate is χ² distributed with PROBES - 1 degrees of freedom,
        divided by PROBES; ``docs/explanation/discovery.md`` derives it.
        """
        signals = self._adjoint_signals[:, : len(self.problem.base_model.sites)]
        records, machine_sites, count = signals.shape
        width = float(frequencies[1] - frequencies[0]) if len(frequencies) > 1 else 1.0
        columns = signals.reshape(records, -1)
        with np.errstate(all="ignore"):
            sums = self._kernel.fourier_sums(self.x[source], columns, float(frequencies[0]), width, len(frequencies))
            sums = sums.reshape(-1, machine_sites, count)  # the real part is that of a cosine, the imaginary of a sine
            magnitudes = np.abs(sums.view(np.float64))
            sums /= magnitudes.max(initial=0.0, where=np.isfinite(magnitudes))  # gains stay; no square overflows
            b, probes = sums[:, :, 0], sums[:, :, 1:]
            size = np.einsum("lsp,lsp->ls", probes, probes.conj()).real / PROBES  # trace of S
            skew = np.einsum("lsp,lsp->ls", probes, probes) / PROBES  # S₁₁ - S₂₂ + 2i·S₁₂
            gains = 2.0 * (size * np.abs(b) ** 2 - (skew.conj() * b**2).real) / (size**2 - np.abs(skew) ** 2)  # bᵀS⁻¹b
        return np.where(np.isfinite(gains), gains, 0.0).T

    def estimated_gains_of(self, shapes: list[Shape]) -> Array:
        """Return about by how much χ² falls (shapes, sites) by each of the ``shapes`` at each site, sensors included.

        The true gain over the estimate is χ² distributed with PROBES degrees of freedom, divided by PROBES.
        """
        signals = self._adjoint_signals
        with np.errstate(all="ignore"):
            families, source_indices, inners, phases = _columns(shapes)
            curves = self._kernel.curves(families, self.x, source_indices, inners, phases)
            products = (curves.T @ signals.reshape(len(signals), -1)).reshape(-1, *signals.shape[1:])
            b, probes = products[..., 0], products[..., 1:]
            gains = PROBES * b**2 / np.einsum("csp,csp->cs", probes, probes)
        return np.where(np.isfinite(gains), gains, 0.0)

    @cached_property
    def _adjoint_signals(self) -> Array:
        """(records, sites, 1 + probes): inner products with a curve give those of its response.

        The first is with the remainder. The others are with random vectors after projection, whose covariance is the
        projector: their mean square is the squared length of the projected response.
        """
        return self._adjoint(self._linear, self._vectors)

    @cached_property
    def _vectors(self) -> Array:
        """(residuals, 1 + PROBES): the remainder, and probes. If the noise is as stated, all are distributed alike."""
        vectors = _probes(self.problem.seed + self.window.index % PROBE_SETS, len(self._unknowns.basis))
        probes = self._unknowns.left(vectors)[: len(self._basis)]
        return np.concatenate([self._remainder[:, None], probes], axis=1)

    def _adjoint(self, linear: LinearisedModel, vectors: Array) -> Array:
        return self._kernel.adjoint(linear, self.objective.innovation_model, self.objective.present, vectors)

    def squares_of_noise(self, vectors: Array | None = None) -> Array:
        """(signals + states, vectors) of squares: of the inner product with white noise of level one at each place.

        Places are those of :attr:`Problem.levels`. By default, ``vectors`` (residuals, vectors) are the remainder and
        the probes. A square may be infinite where the twin diverges.
        """
        twin, linear, own = self.problem.base_model, self._linear, self._vectors if vectors is None else vectors
        signals = self._adjoint_signals if vectors is None else self._adjoint(linear, own)
        names = [site.name for site in sites(twin)]
        records, size, count = len(linear.transition), linear.transition.shape[1], len(twin.states)
        each = np.ascontiguousarray(np.broadcast_to(np.eye(size, count), (records, size, count)))
        nothing = np.zeros((records, len(twin.outputs), count))
        disturbed = linear._replace(input_now=each, input_next=np.zeros(each.shape), feedthrough=nothing)
        with np.errstate(over="ignore", invalid="ignore"):  # where the twin diverges
            of_sites, of_states = (signals**2).sum(axis=0), self._adjoint(disturbed, own) ** 2
            of_states = np.tensordot(self.window.grid.steps, of_states, axes=(0, 0))
        of_signals = of_sites[[names.index(sensor_site(signal)) for signal in twin.signals]]
        return np.concatenate([of_signals, of_states])

    def score_parameters(self, names: list[str]) -> Array:
        """Return by how much χ² falls (parameters,) if each parameter moves alone."""
        return self.score_responses(self._parameter_responses(names)).gain

    def score_delays(self) -> ScoreStatistics:
        """Return by how much χ² falls if each output, then each input, is late alone; amplitudes are in seconds."""
        twin = self.problem.base_model
        responses = -delay_response(self.objective, self._guess)
        return self.score_responses(responses[:, : len(twin.outputs) + len(twin.inputs)])

    def is_parameter(self, curves: BasisFunctions, amplitudes: Array) -> Mask:
        """Return which curves (curves,) of these ``amplitudes`` a parameter within its bounds would produce as well."""
        parameters_of_twin = self.problem.base_model.parameters
        names = [parameter.name for parameter in parameters_of_twin]
        parameters, responses = self._parameter_responses(names), self.responses(curves)
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
            size, response_size = np.linalg.norm(parameters, axis=0), np.linalg.norm(responses, axis=0)
            cosine = np.abs(parameters.T @ responses) / np.outer(size, response_size)
            step = (parameters.T @ responses) * amplitudes / (size**2)[:, None]
            difference = (1.0 - cosine**2) * (response_size * amplitudes) ** 2
        order = [parameter.name for parameter in self.problem.twin.parameters]
        values = self.objective.parameters(self._guess[None])[0]
        now = values[[order.index(name) for name in names]][:, None]
        low = np.array([[parameter.low] for parameter in parameters_of_twin])
        high = np.array([[parameter.high] for parameter in parameters_of_twin])
        within = (low <= now + step) & (now + step <= high)
        return np.asarray(((cosine > SAME_DIRECTION) & (difference < DECISIVE) & within).any(axis=0))

    @property
    def parameters(self) -> dict[str, float]:
        """The values of the twin's parameters around which it is linearised."""
        values = self.objective.parameters(self._guess[None])[0]
        return dict(zip((parameter.name for parameter in self.problem.twin.parameters), values.tolist(), strict=True))

    def responses(self, curves: BasisFunctions) -> Array:
        """See :meth:`ProjectedResponse.responses`."""
        shapes = self._kernel.curves(curves.families, self.x, curves.sources, curves.inner, curves.phases)
        model, present = self.objective.innovation_model, self.objective.present
        return self._kernel.respond(self._linear, model, present, shapes.take(curves.shapes, axis=1), curves.sites)

    def _parameter_responses(self, names: list[str]) -> Array:
        """Return how each parameter changes the whitened innovations (residuals, parameters)."""
        objective, order = self.objective, [parameter.name for parameter in self.problem.twin.parameters]
        parameters = objective.parameters(self._guess[None])[0]
        wanted, initial = [order.index(name) for name in names], self._guess[objective.free :]
        slopes = objective.kernel.sensitivities(parameters, initial, objective.excitation, wanted).slopes
        return -objective.kernel.whiten(objective.innovation_model, slopes, objective.present)


@lru_cache(maxsize=PROBE_SETS)
def _probes(seed: int, rows: int) -> Array:
    """Return random vectors (rows, PROBES), which windows of as many records share."""
    vectors = np.random.default_rng(seed).standard_normal((rows, PROBES))
    vectors.flags.writeable = False
    return vectors


def chi_square_of_parameters(fitted: Fit) -> float:
    """Return χ² that parameters, trends and initial state leave, with the prior, linearised where ``fitted`` began."""
    _, residuals, jacobian = fitted.result.first
    return chi_square_left(jacobian, residuals)


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
