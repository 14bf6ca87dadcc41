"""Compiled twins: simulation of whole swarms, exact sensitivities, the innovation form and its Kalman gains.

The integrator is the classical Runge-Kutta method with substeps; between records an input is held (``zoh``) or
interpolated linearly (``foh``). With a gain the state is corrected after each record by ``gain @ (measured -
predicted)``, so the outputs are one-step-ahead predictions (innovation form; L. Ljung, System Identification, 2nd ed.,
section 4.3). docs/explanation has the equations.
"""

import hashlib
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith import kernel_cache
from otolith.acquisition.window import Array, Mask
from otolith.twin.definition import Definition
from otolith_drivers.errors import ConfigurationError

MAX_SUBSTEPS = 1024
"""Engineering choice: ends the search for substeps where the equations are too stiff for any number of them."""

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """What drives a twin through a window, and what corrects it."""

    inputs: Array
    """(records, inputs)."""
    sample_period: float
    """s."""
    substeps: int = 1
    """Steps of the integrator per record."""
    measured: Array | None = None
    """(records, outputs); a measurement that is NaN corrects nothing."""
    gain: Array | None = None
    """(records, states, outputs); None or all zero for open loop."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseModel:
    """Standard deviations, each in the unit of its signal or state."""

    outputs: Array
    """(outputs,) of the sensors."""
    inputs: Array
    """(inputs,) of the measured or commanded inputs; independent from record to record."""
    states: Array
    """(states,) process noise per square root of a second."""


class InnovationModel(NamedTuple):
    """The gains of the innovation form and the covariances of its innovations."""

    gain: Array
    """(records, states, outputs)."""
    whitening: Array
    """(records, outputs, outputs), lower triangular: whitened innovations have the identity as covariance."""
    log_determinant: float
    """Sum over the records of the log determinants of the innovations' covariances."""


class Sensitivities(NamedTuple):
    """A prediction and its exact derivatives by each parameter, each initial state and each parameter's drift.

    A drift is a change by one unit per second that leaves the parameter's value at the last record.
    """

    outputs: Array
    """(records, outputs)."""
    slopes: Array
    """(records, outputs, parameters + states [+ parameters])."""
    last: Array
    """(states,) at the last record, corrected by its measurement."""
    last_slopes: Array
    """(states, parameters + states [+ parameters])."""


class LinearisedModel(NamedTuple):
    """The linear time-varying system of an augmented twin along a trajectory; its inputs are those of the sites.

    ``x[k + 1] = transition x[k] + input_now u[k] + input_next u[k + 1]``, ``y[k] = output x[k] + feedthrough u[k]``.
    """

    trajectory: Array
    """(records, states) as predicted."""
    transition: Array
    """(records, states, states)."""
    input_now: Array
    """(records, states, sites)."""
    input_next: Array
    """(records, states, sites)."""
    output: Array
    """(records, outputs, states)."""
    feedthrough: Array
    """(records, outputs, sites)."""


class Kernel:
    """The compiled kernels of one definition, loaded from the cache or compiled on first use."""

    def __init__(self, definition: Definition) -> None:
        self.definition = definition
        self._open_loop = np.zeros((0, len(definition.states), len(definition.outputs)))
        self._unmeasured = np.zeros((0, len(definition.outputs)))
        self._compiled: set[str] = set()

    def simulate(self, parameters: Array, initial: Array, excitation: Excitation) -> Array:
        """(particles, records, outputs) predicted for (particles, parameters) and (particles, states).

        The first record belongs to the initial state. A particle that diverges gets values that are not finite.
        """
        predicted: Array = self._call("simulate", parameters, initial, *self._arguments(excitation))
        return predicted

    def sensitivities(
        self, parameters: Array, initial: Array, excitation: Excitation, *, drifts: bool = False
    ) -> Sensitivities:
        """One prediction and its exact derivatives, with ``drifts`` also by those; (parameters,), (states,)."""
        name = "drifting_sensitivities" if drifts else "sensitivities"
        return Sensitivities(*self._call(name, parameters, initial, *self._arguments(excitation)))

    def euler(self, parameters: Array, initial: Array, excitation: Excitation, step: float) -> Array:
        """As :meth:`simulate` in open loop, by explicit Euler with ``step`` (s): the paper's difference equations.

        States are updated in the author's order, each with the new values of those before it (Eq. 11-12).
        """
        inputs, period, *_ = self._arguments(excitation)
        predicted: Array = self._call("euler", parameters, initial, inputs, period, max(1, round(period / step)))
        return predicted

    def innovation_model(
        self, parameters: Array, initial: Array, excitation: Excitation, noise: NoiseModel
    ) -> InnovationModel:
        """The extended Kalman filter along ``excitation.measured``; (parameters,), (states,).

        Elements are not finite where the filter diverges.
        """
        inputs, period, substeps, measured, _ = self._arguments(replace(excitation, gain=self._open_loop))
        variances = (noise.outputs**2, noise.states**2)
        return InnovationModel(
            *self._call("kalman", parameters, initial, inputs, period, substeps, measured, *variances, noise.inputs)
        )

    def linearise(self, parameters: Array, initial: Array, excitation: Excitation, nudge: Array) -> LinearisedModel:
        """The linear system along a window, by differences of ``nudge`` (sites,) in the units of the sites."""
        return LinearisedModel(*self._call("linearise", parameters, initial, *self._arguments(excitation), nudge))

    def curves(self, families: Array, x: Array, sources: Indices, inner: Array, phases: Array) -> Array:
        """(records, curves) of components of unit amplitude; ``x`` is (sources, records), all else (curves,)."""
        shapes: Array = self._call("curves", families, x, sources, inner, phases)
        return shapes

    def respond(
        self, linear: LinearisedModel, innovation: InnovationModel, present: Mask, curves: Array, sites: Indices
    ) -> Array:
        """(records * outputs, curves): change of the whitened innovations by each of ``curves`` (records, curves).

        ``sites`` (curves,) are the numbers of the sites that the curves enter; group curves by site for speed.
        """
        rest = (linear.feedthrough, innovation.gain, innovation.whitening, present, curves, sites)
        matrices = (linear.transition, linear.input_now, linear.input_next, linear.output)
        response: Array = self._call("respond", *matrices, *rest)
        return response

    def substeps(
        self, parameters: Array, initial: Array, excitation: Excitation, tolerance: Array, limit: int = MAX_SUBSTEPS
    ) -> int:
        """The fewest substeps, a power of two up to ``limit``, with truncation errors below ``tolerance`` (outputs,).

        Shapes (parameters,), (states,). The error is estimated by halving the step (Richardson; Hairer, Norsett,
        Wanner, Solving Ordinary Differential Equations I, section II.4).
        """
        count = 1
        coarse = self.simulate(parameters[None], initial[None], replace(excitation, substeps=count))
        while count < limit:
            fine = self.simulate(parameters[None], initial[None], replace(excitation, substeps=2 * count))
            with np.errstate(invalid="ignore"):
                error = np.abs(coarse - fine).max(axis=(0, 1), initial=0.0) * 16.0 / 15.0  # of an order-4 method
            if np.all(error <= tolerance):
                break
            count, coarse = 2 * count, fine
        return count

    def _arguments(self, excitation: Excitation) -> tuple[Array, float, int, Array, Array]:
        inputs = np.ascontiguousarray(excitation.inputs, dtype=np.float64)
        measured, gain = self._unmeasured, self._open_loop
        if excitation.measured is not None and excitation.gain is not None:
            measured = np.ascontiguousarray(excitation.measured, dtype=np.float64)
            gain = np.ascontiguousarray(excitation.gain, dtype=np.float64)
        return inputs, excitation.sample_period, excitation.substeps, measured, gain

    @cached_property
    def _module(self) -> Any:
        return kernel_cache.load(identity_of(self.definition), lambda: _source(self.definition))

    def _call(self, name: str, first: Array, second: Array, *rest: Any) -> Any:
        function: Callable[..., Any] = getattr(self._module, name)
        arguments = (np.ascontiguousarray(first), np.ascontiguousarray(second), *rest)
        if name in self._compiled:
            return function(*arguments)
        with kernel_cache.compiling(self._module):
            try:
                result = function(*arguments)
            except Exception:  # noqa: BLE001 - a truncated cache file raises any type; a fault of the equations is raised again below
                kernel_cache.discard(self._module)
                result = function(*arguments)
        self._compiled.add(name)
        return result


@lru_cache(maxsize=64)
def kernel_of(definition: Definition) -> Kernel:
    """The kernel of a definition, one per process."""
    return Kernel(definition)


def identity_of(definition: Definition) -> str:
    """A hash of everything in a definition that its kernels depend on."""
    mathematical = (
        definition.name,
        [(state.name, state.unit) for state in definition.states],
        [(driven.name, driven.unit, driven.hold) for driven in definition.inputs],
        [(output.name, output.unit) for output in definition.outputs],
        [(parameter.name, parameter.unit) for parameter in definition.parameters],
        [(fixed.name, fixed.unit, fixed.value) for fixed in definition.constants],
        [(name, expression) for name, expression, _ in definition.definitions],
        definition.equations,
        None if definition.base is None else [astuple(site) for site in definition.sites],
    )
    return hashlib.sha256(repr(mathematical).encode()).hexdigest()


def _source(definition: Definition) -> str:
    from otolith.twin.kernel_sources import kernel_source  # noqa: PLC0415 - loads SymPy; a cached kernel needs none

    try:
        return kernel_source(definition)
    except Exception as error:  # SymPy raises errors of many types: each becomes one that names the twin
        text = f"twin {definition.name!r}: its equations cannot be turned into code: {type(error).__name__}: {error}"
        raise ConfigurationError(text) from error
