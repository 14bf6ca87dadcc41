"""All that a component could be: families, sites and sources that a window can tell anything of.

What a window would gain by a component: the residual against the twin's linearised response, in innovation form.

What parameters, their trends and the initial state can explain is taken out of both first, with all that is known of
them, so that a gain is over "parameters only".
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.arrival_cost import MapObjective, Prior
from otolith.estimation.augmented import base_model, input_matrix
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem, key_of
from otolith.twin.augmentation import ComponentSource, augmented_model, sites, sources
from otolith.twin.component_families import COMPONENT_FAMILIES, ComponentFamily, SourceKind, family_code
from otolith.twin.definition import Definition
from otolith.twin.kernel import Excitation, Indices, InnovationModel, LinearisedModel, kernel_of

SENSOR_FAMILIES = frozenset({"constant", "linear"})  # an offset and a gain


@dataclass(frozen=True, slots=True)
class CandidateForm:
    """A component without its numbers."""

    site: int
    """Number of the site."""
    model: ComponentFamily
    source: int
    """Number of the source."""
    bounds: tuple[float, float] = (0.0, 0.0)
    """Of the inner number."""


@dataclass(frozen=True, slots=True, eq=False)
class BasisFunctions:
    """Curves of components of unit amplitude; those of one guess follow each other."""

    families: Array
    """(curves,)."""
    sources: Indices
    """(curves,)."""
    sites: Indices
    """(curves,)."""
    inner: Array
    """(curves,)."""
    phases: Array
    """(curves,)."""


def candidate_library(twin: Definition, x: Array, taken: frozenset[str] = frozenset()) -> list[CandidateForm]:
    """All that can be told from each other where the sources are ``x`` (sources, records); ``twin`` is the author's.

    Those whose keys are ``taken`` are left out.
    """
    known = [
        (model, number, source, _bounds(model, x[number]))
        for model in COMPONENT_FAMILIES
        for number, source in enumerate(sources(twin))
        if source.kind in model.inputs and model.valid(x[number])
    ]
    own = len(twin.sites)
    return [
        CandidateForm(index, model, number, bounds)
        for index, site in enumerate(sites(twin))
        for model, number, source, bounds in known
        if (index < own or _lies_so(model, source, site.into))
        and key_of(site.name, model.name, source.name) not in taken
    ]


def _bounds(model: ComponentFamily, x: Array) -> tuple[float, float]:
    if model.fixed_inner is not None:
        return model.fixed_inner(x), model.fixed_inner(x)
    return (0.0, 0.0) if model.inner is None else model.inner.bounds(x)


def _lies_so(model: ComponentFamily, source: ComponentSource, signal: str) -> bool:
    """A sensor has an offset, or a gain that is off."""
    if model.name not in SENSOR_FAMILIES:
        return False
    return source.kind is SourceKind.NOTHING or source.name == signal


def grid(structure: CandidateForm, x: Array, fineness: float) -> Array:
    """(points,) of the inner number from which a search begins; ``x`` (sources, records)."""
    inner = structure.model.inner
    low, high = structure.bounds
    if inner is None:
        return np.array([low])
    if inner.points:
        points = max(round(inner.points / fineness**2), 2)
        return np.exp(np.linspace(np.log(low), np.log(high), points))
    width = fineness * 2.0 * np.pi / max(float(np.ptp(x[structure.source])), 1e-9)  # a line of the spectrum
    return np.arange(low, high, width)


def basis_functions(guesses: Iterator[tuple[CandidateForm, float]]) -> BasisFunctions:
    """One curve for each guess, or two where the phase is free."""
    rows = [
        (family_code(entry.model.name), entry.source, entry.site, inner, phase)
        for entry, inner in guesses
        for phase in entry.model.phases
    ]
    columns = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    families, numbers, places, inner, phases = columns
    return BasisFunctions(families, numbers.astype(np.int64), places.astype(np.int64), inner, phases)


FEW = 6  # records by which the size of a nudge is found
SLIGHT = 1e-4  # of a state: what a nudge may do to it
UNTOLD = 10.0  # of χ²: what a component must differ from a parameter by, to be told from it in a window
SAME = 1.0 - 1e-5  # cosine between what a component and what a parameter does, from which on they are the same
RUSTLE = 5.0  # times the noise of an input: what it must vary by to be more than noise
GONE = 1e-6  # of a response that is left beside what parameters do: it is one of them


@dataclass(frozen=True, slots=True, eq=False)
class ScoreStatistics:
    """What each guess would gain."""

    gain: Array
    """(guesses,) by which χ² falls."""
    amplitudes: Array
    """(guesses, 2): of each of its curves; zero for a second one that it does not have."""


class LinearResponse:
    """One window's residual and responses, around what was known of the parameters."""

    def __init__(self, problem: Problem, window: Window, prior: Prior, start: Array) -> None:
        """``start`` (free parameters,) is what the twin is linearised around."""
        begin = np.clip(start, *problem.bounds)
        self.objective = Objective(problem, window, begin)
        informed = MapObjective(self.objective, problem, prior)
        guess = informed.guess(begin, self.objective.guess(begin)[len(begin) :])
        residuals, jacobian = informed.linearised(guess)
        own = len(residuals) - len(prior.mean)  # the rest is what the prior says
        size = np.linalg.norm(jacobian, axis=0)
        alive = size > 0.0
        basis, singular, _ = np.linalg.svd(jacobian[:, alive] / size[alive], full_matrices=False)
        basis = basis[:, singular > 1e-10 * singular[0]]
        left = residuals - basis @ (basis.T @ residuals)
        self.chi_square = float(left @ left)
        """Of parameters only, with what their prior says."""
        self._left, self._basis = left[:own], basis[:own]
        self._problem, self._window, self._guess = problem, window, guess
        self._linear, self._correction = self._linearise(guess)

    def _linearise(self, guess: Array) -> tuple[LinearisedModel, InnovationModel]:
        twin, objective, free = base_model(self._problem), self.objective, len(self._problem.free)
        slotted = augmented_model(twin)
        self._kernel = kernel_of(slotted)
        parameters = np.zeros(len(slotted.parameters))
        values = objective.parameters(guess[None, :free])[0]
        parameters[: len(values)] = values
        states = guess[2 * free :]
        initial = np.zeros(len(slotted.states))
        initial[: len(states)] = states
        extra = len(slotted.states) - len(states)
        gain = np.pad(objective.correction.gain, ((0, 0), (0, extra), (0, 0)))
        excitation = replace(objective.excitation, inputs=input_matrix(slotted, self._window), gain=gain)
        linear = self._kernel.linearise(parameters, initial, excitation, self._nudge(parameters, initial, excitation))
        inputs = [self._window.column(entry.name) for entry in twin.inputs]
        shown = [entry.name for entry in twin.outputs]
        states_of = [entry.name for entry in slotted.states]
        predicted = objective.predict(np.concatenate([guess[:free], states])[None])[0]
        rows = []
        for source in sources(twin):
            if not source.symbol:
                rows.append(np.zeros(self._window.records))
            elif source.symbol in states_of:
                rows.append(linear.trajectory[:, states_of.index(source.symbol)])
            elif source.name == "t":
                rows.append(self._window.sample_period * np.arange(self._window.records, dtype=np.float64))
            elif source.name in shown:
                rows.append(predicted[:, shown.index(source.name)])
            else:
                rows.append(self._heard(inputs, [entry.name for entry in twin.inputs].index(source.name)))
        self.x = np.array(rows)
        """(sources, records)."""
        if extra:  # angles that no component depends on do nothing
            count = len(states)
            linear = linear._replace(
                transition=np.ascontiguousarray(linear.transition[:, :count, :count]),
                input_now=np.ascontiguousarray(linear.input_now[:, :count]),
                input_next=np.ascontiguousarray(linear.input_next[:, :count]),
                output=np.ascontiguousarray(linear.output[:, :, :count]),
            )
        return linear, objective.correction

    def _heard(self, inputs: list[Array], index: int) -> Array:
        """An input; one that does nothing but rustle stands still, else its noise would be taken for its action."""
        noise = self.objective.noise.inputs[index]
        values = inputs[index]
        return values if values.std() > RUSTLE * noise else np.full(len(values), values.mean())

    def _nudge(self, parameters: Array, initial: Array, excitation: Excitation) -> Array:
        """(sites,) large enough against rounding, and small enough for what is not linear."""
        count = len(sites(base_model(self._problem)))
        few = replace(
            excitation,
            inputs=excitation.inputs[:FEW],
            measured=None if excitation.measured is None else excitation.measured[:FEW],
            gain=None if excitation.gain is None else excitation.gain[:FEW],
        )
        tried = self._kernel.linearise(parameters, initial, few, np.full(count, 1e-3))
        size = np.maximum(np.abs(tried.trajectory).max(axis=0), 1e-3)[:, None]
        effect = (np.abs(tried.input_now + tried.input_next).max(axis=0) / size).max(axis=0)
        noise = self.objective.noise.outputs[:, None]
        effect = np.maximum(effect, (np.abs(tried.feedthrough).max(axis=0) * SLIGHT / noise).max(axis=0))
        return np.asarray(SLIGHT / np.maximum(effect, 1e-12))

    def responses(self, shapes: BasisFunctions) -> Array:
        """(residuals, curves)."""
        curves = self._kernel.curves(shapes.families, self.x, shapes.sources, shapes.inner, shapes.phases)
        return self._kernel.respond(self._linear, self._correction, self.objective.present, curves, shapes.sites)

    def parameter_gains(self, names: list[str]) -> Array:
        """What moving each of these parameters, one at a time, would gain."""
        one = np.arange(len(names))
        return self.gains(self._of_parameters(names), np.column_stack([one, one])).gain

    def _of_parameters(self, names: list[str]) -> Array:
        """(residuals, parameters) how moving each of them changes the whitened innovations."""
        objective, order = self.objective, [entry.name for entry in self._problem.twin.parameters]
        free = len(self._problem.free)
        parameters = objective.parameters(self._guess[None, :free])[0]
        slopes = objective.kernel.sensitivities(parameters, self._guess[2 * free :], objective.excitation).slopes
        columns = np.where(objective.present[..., None], slopes[:, :, [order.index(name) for name in names]], 0.0)
        return np.asarray(np.matmul(objective.whitening, columns).reshape(-1, len(names)))

    def is_parameter(self, shapes: BasisFunctions, amplitudes: Array) -> Mask:
        """(curves,) which of them, ``amplitudes`` (curves,) high, do just what a parameter within its bounds would do.

        They are none but that.
        """
        entries = base_model(self._problem).parameters
        names = [entry.name for entry in entries]
        parameters, curves = self._of_parameters(names), self.responses(shapes)
        sizes = np.outer(np.linalg.norm(parameters, axis=0), np.linalg.norm(curves, axis=0))
        with np.errstate(divide="ignore", invalid="ignore"):
            alike = np.abs(parameters.T @ curves) / sizes
            step = (parameters.T @ curves) * amplitudes / (np.linalg.norm(parameters, axis=0) ** 2)[:, None]
            apart = (1.0 - alike**2) * (np.linalg.norm(curves, axis=0) * amplitudes) ** 2
        order = [entry.name for entry in self._problem.twin.parameters]
        values = self.objective.parameters(self._guess[None, : len(self._problem.free)])[0]
        now = values[[order.index(name) for name in names]][:, None]
        low, high = (np.array([[getattr(entry, side)] for entry in entries]) for side in ("low", "high"))
        reached = (low <= now + step) & (now + step <= high)
        return np.asarray(((alike > SAME) & (apart < UNTOLD) & reached).any(axis=0))

    def gains(self, responses: Array, pairs: Array) -> ScoreStatistics:
        """Of ``responses`` (residuals, curves), where ``pairs`` (guesses, 2) says which curves belong together.

        A guess of one curve has it twice.
        """
        with np.errstate(all="ignore"):
            along = self._left @ responses
            shared = self._basis.T @ responses
            whole = np.einsum("rc,rc->c", responses, responses)
            own = whole - np.einsum("bc,bc->c", shared, shared)
            own = np.where(own > GONE * whole, own, np.inf)
            first, second = pairs.T
            single = first == second
            cross = np.zeros(len(pairs))
            one, two = first[~single], second[~single]
            cross[~single] = np.einsum("rg,rg->g", responses[:, one], responses[:, two])
            cross[~single] -= np.einsum("bg,bg->g", shared[:, one], shared[:, two])
            other = np.where(single, np.inf, own[second])
            inverse = 1.0 - cross**2 / (own[first] * other)
            one = (along[first] - cross / other * along[second]) / (own[first] * inverse)
            two = np.where(single, 0.0, (along[second] - cross / own[first] * along[first]) / (other * inverse))
            gain = one * along[first] + two * along[second]
        fine = np.isfinite(gain) & np.isfinite(one) & np.isfinite(two) & (inverse > 1e-9)
        found = np.where(fine, gain, 0.0)
        return ScoreStatistics(found, np.where(fine[:, None], np.column_stack([one, two]), 0.0))
