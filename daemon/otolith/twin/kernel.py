"""A twin that computes: simulation of whole swarms, exact sensitivities, innovation form.

The classical Runge-Kutta method with substeps; between records an input is held (``zoh``) or runs straight to its next
value (``foh``). With a gain the state is corrected after each record by ``gain @ (measured - predicted)``, which makes
the outputs one-step-ahead predictions (innovation form; L. Ljung, System Identification, 2nd ed., section 4.3).
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

MOST_SUBSTEPS = 1024

Numbers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Excitation:
    """What drives a twin through a window, and what corrects it on the way."""

    inputs: Array
    """(records, inputs)."""
    sample_period: float
    """s."""
    substeps: int = 1
    """Steps of the integrator per record."""
    measured: Array | None = None
    """(records, outputs); a measurement that is not a number corrects nothing."""
    gain: Array | None = None
    """(records, states, outputs); without it, or all zero, the twin runs in open loop."""


@dataclass(frozen=True, slots=True, eq=False)
class NoiseModel:
    """Standard deviations, each in the unit of its signal or state."""

    outputs: Array
    """(outputs,) of the sensors."""
    inputs: Array
    """(inputs,) of what the twin is told to be driven by; independent from record to record."""
    states: Array
    """(states,) per square root of a second, of what strays in the machine itself."""


class InnovationModel(NamedTuple):
    """How a disturbed twin is corrected on its way, and how far off each prediction may then be."""

    gain: Array
    """(records, states, outputs)."""
    whitening: Array
    """(records, outputs, outputs): makes each innovation's covariance the identity."""
    log_determinant: float
    """Sum over the records, of the innovations' covariances."""


class Sensitivities(NamedTuple):
    """A prediction and its exact derivatives, by each parameter, each initial state, and each parameter's drift.

    A drift is one unit per second, about the value at the last record.
    """

    outputs: Array
    """(records, outputs)."""
    slopes: Array
    """(records, outputs, parameters + states [+ parameters])."""
    last: Array
    """(states,) at the last record, corrected by it."""
    last_slopes: Array
    """(states, parameters + states [+ parameters])."""


class Linear(NamedTuple):
    """A twin with slots, linearised along a window (see :mod:`otolith.twin.kernel_sources`)."""

    trajectory: Array
    """(records, states) as predicted."""
    moves: Array
    """(records, states, states)."""
    early: Array
    """(records, states, sites)."""
    late: Array
    """(records, states, sites)."""
    output: Array
    """(records, outputs, states)."""
    through: Array
    """(records, outputs, sites)."""


class Kernel:
    """The compiled kernels of one definition, loaded from the cache or compiled on first use."""

    def __init__(self, definition: Definition) -> None:
        self.definition = definition
        self._open_loop = np.zeros((0, len(definition.states), len(definition.outputs)))
        self._unmeasured = np.zeros((0, len(definition.outputs)))
        self._compiled: set[str] = set()

    def simulate(self, parameters: Array, initial: Array, excitation: Excitation) -> Array:
        """Predict: ``outputs[:, 0]`` belongs to the initial state.

        Shapes (particles, parameters), (particles, states) -> (particles, records, outputs). A particle that diverges
        gets values that are not finite.
        """
        found: Array = self._call("simulate", parameters, initial, *self._drive(excitation))
        return found

    def sensitivities(
        self, parameters: Array, initial: Array, excitation: Excitation, *, drifts: bool = False
    ) -> "Sensitivities":
        """One prediction and its exact derivatives, also by the parameters' ``drifts`` if asked for.

        Shapes (parameters,), (states,).
        """
        name = "drifting_sensitivities" if drifts else "sensitivities"
        return Sensitivities(*self._call(name, parameters, initial, *self._drive(excitation)))

    def euler(self, parameters: Array, initial: Array, excitation: Excitation, step: float) -> Array:
        """As :meth:`simulate` in open loop, by explicit Euler with ``step`` (s): the paper's difference equations.

        States are updated in the order of the page, each with the new values of those before it (Eq. 11-12).
        """
        period = excitation.sample_period
        inputs = np.ascontiguousarray(excitation.inputs, dtype=np.float64)
        found: Array = self._call("euler", parameters, initial, inputs, period, max(1, round(period / step)))
        return found

    def correction(
        self, parameters: Array, initial: Array, excitation: Excitation, noise: NoiseModel
    ) -> InnovationModel:
        """The extended Kalman filter along ``excitation.measured``; shapes (parameters,), (states,).

        Entries are not finite where the filter diverges.
        """
        inputs, period, substeps, measured, _ = self._drive(replace(excitation, gain=self._open_loop))
        noises = (noise.outputs**2, noise.states**2, noise.inputs)
        found = self._call("kalman", parameters, initial, inputs, period, substeps, measured, *noises)
        return InnovationModel(*found)

    def along(self, parameters: Array, initial: Array, excitation: Excitation, nudge: Array) -> Linear:
        """The linear system along a window, by differences of ``nudge`` (sites,) in the units of the sites."""
        return Linear(*self._call("along", parameters, initial, *self._drive(excitation), nudge))

    def curves(self, families: Array, x: Array, sources: Numbers, inner: Array, phases: Array) -> Array:
        """Shapes of components of unit amplitude: (curves,), (sources, records), (curves,), (curves,), (curves,).

        ``sources`` are the rows of ``x`` that they depend on. Returns (records, curves).
        """
        found: Array = self._call("curves", families, x, sources, inner, phases)
        return found

    def respond(
        self, linear: Linear, correction: InnovationModel, present: Mask, curves: Array, sites: Numbers
    ) -> Array:
        """(records * outputs, curves) whitened innovations, as each of ``curves`` (records, curves) changes them.

        ``sites`` (curves,) are the numbers of the sites at which they enter.
        """
        rest = (linear.through, correction.gain, correction.whitening, present, curves, sites)
        found: Array = self._call("respond", linear.moves, linear.early, linear.late, linear.output, *rest)
        return found

    def substeps(
        self, parameters: Array, initial: Array, excitation: Excitation, tolerance: Array, most: int = MOST_SUBSTEPS
    ) -> int:
        """The fewest substeps (a power of two up to ``most``) with a truncation error under ``tolerance`` (outputs,).

        Shapes (parameters,), (states,). The error is told by halving the step (Richardson; Hairer, Norsett, Wanner,
        Solving Ordinary Differential Equations I, section II.4).
        """
        count = 1
        coarse = self.simulate(parameters[None], initial[None], replace(excitation, substeps=count))
        while count < most:
            fine = self.simulate(parameters[None], initial[None], replace(excitation, substeps=2 * count))
            with np.errstate(invalid="ignore"):
                error = np.abs(coarse - fine).max(axis=(0, 1), initial=0.0) * 16.0 / 15.0
            if np.all(error <= tolerance):
                break
            count, coarse = 2 * count, fine
        return count

    def _drive(self, excitation: Excitation) -> tuple[Array, float, int, Array, Array]:
        inputs = np.ascontiguousarray(excitation.inputs, dtype=np.float64)
        measured, gain = self._unmeasured, self._open_loop
        if excitation.measured is not None and excitation.gain is not None:
            measured = np.ascontiguousarray(excitation.measured, dtype=np.float64)
            gain = np.ascontiguousarray(excitation.gain, dtype=np.float64)
        return inputs, excitation.sample_period, excitation.substeps, measured, gain

    @cached_property
    def _module(self) -> Any:
        return kernel_cache.load(identity_of(self.definition), lambda: _source(self.definition))

    def _call(self, name: str, parameters: Array, initial: Array, *rest: Any) -> Any:
        function: Callable[..., Any] = getattr(self._module, name)
        arguments = (np.ascontiguousarray(parameters), np.ascontiguousarray(initial), *rest)
        if name in self._compiled:
            return function(*arguments)
        with kernel_cache.compiling(self._module):
            try:
                found = function(*arguments)
            except Exception:  # noqa: BLE001 - whatever unpickling half a file raises; a real fault comes again
                kernel_cache.discard(self._module)
                found = function(*arguments)
        self._compiled.add(name)
        return found


@lru_cache(maxsize=64)
def kernel_of(definition: Definition) -> Kernel:
    """The kernel of a definition, one per process."""
    return Kernel(definition)


def identity_of(definition: Definition) -> str:
    """What tells one twin's kernels from another's: everything on the page that enters them."""
    mathematical = (
        definition.name,
        [(entry.name, entry.unit) for entry in definition.states],
        [(entry.name, entry.unit, entry.hold) for entry in definition.inputs],
        [(entry.name, entry.unit) for entry in definition.outputs],
        [(entry.name, entry.unit) for entry in definition.parameters],
        [astuple(entry)[:3] for entry in definition.constants],
        [(name, expression) for name, expression, _ in definition.definitions],
        definition.equations,
        None if definition.plain is None else [astuple(entry) for entry in definition.sites],
    )
    return hashlib.sha256(repr(mathematical).encode()).hexdigest()


def _source(definition: Definition) -> str:
    from otolith.twin.kernel_sources import kernel_source  # noqa: PLC0415 - loads SymPy, which a cached kernel does not need

    try:
        return kernel_source(definition)
    except Exception as error:
        text = f"twin {definition.name!r}: its equations cannot be turned into code: {type(error).__name__}: {error}"
        raise ConfigurationError(text) from error
