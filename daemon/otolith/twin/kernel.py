"""Compiled twins: simulation of whole swarms, exact sensitivities, the innovation form and its Kalman gains.

The integrator is the classical Runge-Kutta method with substeps; between records, which may be at any times, an input
is held (``zoh``) or interpolated linearly (``foh``). With a gain the state is corrected after each record by
``gain @ (measured - predicted)``, so the outputs are one-step-ahead predictions (innovation form; L. Ljung, System
Identification, 2nd ed., section 4.3). docs/explanation has the equations.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cache, cached_property, lru_cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from otolith import kernel_cache
from otolith.acquisition.window import Array, Mask, TimeGrid
from otolith.twin.definition import Definition
from otolith_drivers.errors import ConfigurationError

MAX_SUBSTEPS = 1024
"""Engineering choice: ends the search for substeps where the equations are too stiff for any number of them."""
WHOLE = 1e-9  # Of a substep: a share that rounding leaves over a whole number, which needs no further substep
SPREAD_REACH = 12
"""Grid points on either side that a record reaches in a non-uniform Fourier sum: errors of 1e-12 of the largest sum."""
MIN_SHARE_OF_MEAN = 0.5
"""Of the mean step: least length of an ordinary one. Engineering choice: bounds the integrator's steps to twice as
many as with equal steps."""

RELATIVE_TOLERANCE = 1e-11
"""Of the largest value of an output: truncation error that is allowed in any case, as rounding errors are near it."""

SHARED = frozenset({"whiten", "curves", "respond", "adjoint", "spread"})
"""Kernels that are the same for all twins: compiled once for all of them."""

Indices = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)  # no slots: what the kernels take is prepared once
class Excitation:
    """What drives a twin through a window, and what corrects it."""

    inputs: Array  # (records, inputs)
    grid: TimeGrid  # Times of the records
    substeps: int = 1
    """Steps of the integrator on the longest step of the grid; a shorter one has as many as keep them no longer."""
    measured: Array | None = None  # (records, outputs); a measurement that is NaN corrects nothing
    gain: Array | None = None  # (records, states, outputs); None or all zero for open loop

    @classmethod
    def uniform(cls, inputs: Array, period: float, substeps: int = 1) -> "Excitation":
        """Return an open-loop excitation by ``inputs`` (records, inputs), ``period`` s apart."""
        return cls(inputs, TimeGrid.uniform(len(inputs), period), substeps)

    @cached_property
    def counts(self) -> Indices:
        """(records,) steps of the integrator to the next record."""
        if self.grid.period is not None:
            return np.full(self.grid.records, self.substeps)
        shares = self.substeps * self.grid.steps / _longest(self.grid)
        return np.maximum(np.ceil(shares - WHOLE), 1.0).astype(np.int64)

    @cached_property
    def arguments(self) -> tuple[Array, Array, Indices, Array, Array]:
        """Inputs, steps, counts, and in closed loop measurements and gain; raise ValueError if records differ."""
        inputs = np.ascontiguousarray(self.inputs, dtype=np.float64)
        if len(inputs) != self.grid.records:
            raise ValueError(f"{len(inputs)} records of inputs at {self.grid.records} times")
        measured, gain = np.zeros((0, 0)), np.zeros((0, 0, 0))
        if self.measured is not None and self.gain is not None:
            measured = np.ascontiguousarray(self.measured, dtype=np.float64)
            if self.gain.any():
                gain = np.ascontiguousarray(self.gain, dtype=np.float64)
        return inputs, np.ascontiguousarray(self.grid.steps), self.counts, measured, gain

    def until(self, record: int) -> "Excitation":
        """Return the same before ``record``; substeps keep their length."""
        record = min(record, self.grid.records)
        part, grid = slice(record), self.grid.until(record)
        measured = None if self.measured is None else self.measured[part]
        gain = None if self.gain is None else self.gain[part]
        substeps = self.substeps if grid.period is not None else int(self.counts[: max(record - 1, 1)].max())
        return Excitation(self.inputs[part], grid, substeps, measured, gain)


def _step_ratio(grid: TimeGrid) -> int:
    """How many times longer the longest step is than an ordinary one, as the next power of two.

    An ordinary one is the median, but no small share of the mean one: samples may come in pairs.
    """
    if grid.period is not None or grid.records < 2:
        return 1
    steps = grid.steps[:-1]
    ordinary = max(float(np.median(steps)), MIN_SHARE_OF_MEAN * float(np.mean(steps)))
    return 1 << int(np.ceil(np.log2(_longest(grid) / ordinary) - WHOLE))


def _refinement(count: int, grid: TimeGrid, own_step: float) -> float:
    """How many times more substeps come after ``count``; 1 if none do: substeps are whole numbers of ``own_step`` s."""
    if not own_step:
        return 2.0
    whole = round((grid.period or 0.0) / own_step)
    if abs(whole * own_step - (grid.period or 0.0)) > WHOLE * own_step * max(whole, 1):
        return 1.0  # between its own steps an FMU is interpolated, once from record to record
    return next((more / count for more in range(count + 1, whole + 1) if whole % more == 0), 1.0)


def _longest(grid: TimeGrid) -> float:
    """Return the longest step between two records, s; any number if there are no two."""
    return float(grid.steps[:-1].max(initial=0.0)) or 1.0


@dataclass(frozen=True, slots=True, eq=False)
class NoiseModel:
    """Standard deviations, each in the unit of its signal or state."""

    outputs: Array  # (outputs,) of the sensors
    inputs: Array  # (records, inputs) of the inputs' values at a record, which the outputs of that record depend on
    held_inputs: Array
    """(records, inputs) of the inputs over the step to the next record; independent from step to step."""
    states: Array  # (states,) process noise per square root of a second
    period: float | None = None
    """Time in which process noise disturbs the states once, s, where records are at times of their own. None for once
    in a step, as on a uniform grid."""

    @property
    def disturbs(self) -> bool:
        """Whether anything but sensor noise makes the measurements differ from the prediction."""
        return bool(self.inputs.any() or self.held_inputs.any() or self.states.any())

    def parts(self, grid: TimeGrid) -> Indices:
        """Return the parts (records,) of each step at whose ends process noise disturbs the states."""
        if self.period is None or grid.period is not None:
            return np.ones(grid.records, dtype=np.int64)
        return np.maximum(np.rint(grid.steps / self.period), 1.0).astype(np.int64)


class InnovationModel(NamedTuple):
    """The gains of the innovation form and the covariances of its innovations."""

    gain: Array  # (records, states, outputs)
    whitening: Array
    """(records, outputs, outputs), lower triangular: whitened innovations have the identity as covariance."""
    log_determinant: float  # Sum over the records of the log determinants of the innovations' covariances


class Sensitivities(NamedTuple):
    """A prediction and its exact derivatives by each parameter, each initial state and each parameter's drift.

    A drift is a change by one unit per second that leaves the parameter's value at the last record.
    """

    outputs: Array  # (records, outputs)
    slopes: Array  # (records, outputs, columns): parameters + states [+ parameters], or those of them that are wanted
    last: Array  # (states,) at the last record, corrected by its measurement
    last_slopes: Array  # (states, columns)


class LinearisedModel(NamedTuple):
    """The linear time-varying system of an augmented twin along a trajectory; its inputs are those of the sites.

    ``x[k + 1] = transition x[k] + input_now u[k] + input_next u[k + 1]``, ``y[k] = output x[k] + feedthrough u[k]``.
    """

    trajectory: Array  # (records, states) as predicted
    transition: Array  # (records, states, states)
    input_now: Array  # (records, states, sites)
    input_next: Array  # (records, states, sites)
    output: Array  # (records, outputs, states)
    feedthrough: Array  # (records, outputs, sites)


class Kernel:
    """The compiled kernels of one definition, loaded from the cache or compiled on first use."""

    def __init__(self, definition: Definition) -> None:
        self.definition = definition
        self._compiled: set[str] = set()

    def simulate(self, parameters: Array, initial: Array, excitation: Excitation) -> Array:
        """(particles, records, outputs) predicted for (particles, parameters) and (particles, states).

        The first record belongs to the initial state. A particle that diverges gets values that are not finite.
        """
        predicted: Array = self._call("simulate", parameters, initial, *excitation.arguments)
        return predicted

    def ensemble(  # noqa: PLR0913, PLR0917 - what a step of the integrator takes
        self, parameters: Array, states: Array, inputs: Array, following: Array, length: float, substeps: int
    ) -> tuple[Array, Array]:
        """Outputs (particles, outputs) at a record, and states (particles, states) at the next one, ``length`` s later.

        Shapes (particles, parameters), (particles, states), and (particles, inputs) at this record and at the next one.
        A particle that diverges gets values that are not finite.
        """
        own = (np.ascontiguousarray(inputs), np.ascontiguousarray(following))
        outputs, final = self._call("ensemble", parameters, states, *own, float(length), int(substeps))
        return outputs, final

    def sensitivities(
        self,
        parameters: Array,
        initial: Array,
        excitation: Excitation,
        columns: Sequence[int] | Indices | None = None,
        *,
        drifts: bool = False,
    ) -> Sensitivities:
        """One prediction and its exact derivatives; (parameters,), (states,).

        ``columns`` are the derivatives that are wanted, numbered as in :class:`Sensitivities`: by default all, those by
        drifts if ``drifts``.
        """
        if columns is None:
            of_parameters = len(self.definition.parameters) - self.definition.settings
            columns = range(of_parameters * (1 + drifts) + len(self.definition.states))
        if self._fmu is not None:
            first = len(self.definition.parameters) - self.definition.settings
            of_drifts = first + len(self.definition.states)
            self._fmu.want({column - of_drifts if column >= of_drifts else column for column in columns})
        drive = (*excitation.arguments, excitation.grid.before_last, np.array(columns, dtype=np.int64))
        return Sensitivities(*self._call("sensitivities", parameters, initial, *drive))

    def whiten(self, innovation: InnovationModel, slopes: Array, present: Mask) -> Array:
        """(records * outputs, columns): the derivatives of the whitened innovations, from those of the prediction."""
        derivatives: Array = self._call("whiten", innovation.whitening, slopes, present)
        return derivatives

    def euler(self, parameters: Array, initial: Array, excitation: Excitation, step: float) -> Array:
        """As :meth:`simulate` in open loop, by explicit Euler with ``step`` (s): the paper's difference equations.

        States are updated in the author's order, each with the new values of those before it (Eq. 11-12).

        Raises:
            ValueError: the grid is not uniform; a difference equation has one step.
        """
        period = excitation.grid.period
        if period is None:
            raise ValueError("the difference equations of the paper need a uniform grid")
        inputs, *_ = excitation.arguments
        predicted: Array = self._call("euler", parameters, initial, inputs, period, max(1, round(period / step)))
        return predicted

    def innovation_model(
        self, parameters: Array, initial: Array, excitation: Excitation, noise: NoiseModel
    ) -> InnovationModel:
        """The extended Kalman filter along ``excitation.measured``; (parameters,), (states,).

        Elements are not finite where the filter diverges.
        """
        inputs, steps, counts, *_ = excitation.arguments
        measured = np.ascontiguousarray(excitation.measured, dtype=np.float64)
        grid = (inputs, steps, counts, noise.parts(excitation.grid))
        variances = (noise.outputs**2, noise.states**2)
        of_inputs = (np.ascontiguousarray(noise.inputs), np.ascontiguousarray(noise.held_inputs))
        return InnovationModel(*self._call("kalman", parameters, initial, *grid, measured, *variances, *of_inputs))

    def predictor(
        self, parameters: Array, initial: Array, excitation: Excitation, noise: NoiseModel, *, open_loop: bool = False
    ) -> InnovationModel:
        """Gain and whitening along ``excitation.measured``; (parameters,), (states,).

        A twin that diverges there, or that has no process noise, runs in open loop as well: without a gain, and with
        the whitening of the sensor noise alone.
        """
        if noise.disturbs and not open_loop:
            model = self.innovation_model(parameters, initial, excitation, noise)
            if np.isfinite(model.gain).all() and np.isfinite(model.whitening).all():
                return model
        if excitation.measured is None:
            raise ValueError("a predictor needs measurements")
        scales = np.where(np.isfinite(excitation.measured), 1.0 / noise.outputs, 1.0)
        whitening = scales[:, :, None] * np.eye(len(noise.outputs))
        gain = np.zeros((len(excitation.inputs), len(self.definition.states), len(noise.outputs)))
        return InnovationModel(gain, whitening, float(-2.0 * np.log(scales).sum()))

    def linearise(self, parameters: Array, initial: Array, excitation: Excitation) -> LinearisedModel:
        """The linear system along a window, exact but for the error of the integrator; (parameters,), (states,)."""
        return LinearisedModel(*self._call("linearise", parameters, initial, *excitation.arguments))

    def curves(self, families: Array, x: Array, sources: Indices, inner: Array, phases: Array) -> Array:
        """(records, curves) of components of unit amplitude; ``x`` is (sources, records), all else (curves,)."""
        rest = (np.ascontiguousarray(part) for part in (sources, inner, phases))
        shapes: Array = self._call("curves", families, x, *rest)
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

    def adjoint(self, linear: LinearisedModel, innovation: InnovationModel, present: Mask, signals: Array) -> Array:
        """(records, sites, signals): the transpose of :meth:`respond`, for ``signals`` (records * outputs, signals).

        The inner product of a curve with the result for a signal is that of the curve's response with the signal.
        """
        rest = (linear.feedthrough, innovation.gain, innovation.whitening, present, np.ascontiguousarray(signals))
        matrices = (linear.transition, linear.input_now, linear.input_next, linear.output)
        transposed: Array = self._call("adjoint", *matrices, *rest)
        return transposed

    def fourier_sums(self, x: Array, signals: Array, first: float, width: float, count: int) -> ComplexArray:
        """(count, signals) sums over the records of ``signals`` (records, signals) times ``exp(i frequency x)``.

        The frequencies are ``first + width * k``; ``x`` (records,) need not be uniform. The sums are accurate to 1e-12
        of the largest (L. Greengard, J.-Y. Lee, Accelerating the nonuniform fast Fourier transform, SIAM Review 46,
        2004, section 3).
        """
        half = max(count, 2 * SPREAD_REACH) // 2 + 1
        points = 4 * half  # twice as many as there are frequencies
        variance = np.pi * SPREAD_REACH / ((2 * half) ** 2 * 3.0)
        middle = first + half * width
        grid = self._call("spread", x, np.ascontiguousarray(signals), middle, width, points, variance, SPREAD_REACH)
        harmonics = np.arange(count) - half
        weights = np.sqrt(np.pi / variance) * np.exp(harmonics**2 * variance)
        return np.asarray(weights[:, None] * np.fft.ifft(grid, axis=0)[harmonics % points])

    def substeps(
        self, parameters: Array, initial: Array, excitation: Excitation, tolerance: Array, limit: int = MAX_SUBSTEPS
    ) -> int:
        """The fewest substeps, a power of two up to ``limit``, with truncation errors below ``tolerance`` (outputs,).

        Shapes (parameters,), (states,). From those of ``excitation`` on, steps are halved, which estimates the error
        (Richardson; Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section II.4). ``limit`` is for
        an ordinary step: the longest may have as many more as it is longer, so that the cost is linear in the records.
        An FMU that is stepped has errors of order 1. If it makes steps of its own, a substep is a whole number of them.
        """
        grid, count = excitation.grid, excitation.substeps
        first, second = parameters[None], initial[None]
        coarse = self.simulate(first, second, excitation)
        fmu = self.definition.fmu
        order, own_step = (1, fmu.own_step) if fmu is not None and fmu.is_stepped else (4, 0.0)
        while count < limit or count < limit * _step_ratio(grid):
            ratio = _refinement(count, grid, own_step)
            if ratio == 1:
                break
            inputs, steps, counts, *correction = excitation.arguments
            more = np.rint(ratio * counts).astype(np.int64)
            fine = self._call("simulate", first, second, inputs, steps, more, *correction)
            with np.errstate(invalid="ignore"):
                share = ratio**order / (ratio**order - 1.0)
                error = np.abs(coarse - fine).max(axis=(0, 1), initial=0.0) * share
                allowed = np.maximum(tolerance, RELATIVE_TOLERANCE * np.abs(fine).max(axis=(0, 1), initial=0.0))
            if (error <= allowed).all():
                break
            count = round(ratio * count)
            excitation = replace(excitation, substeps=count)
            coarse = fine if grid.period is not None else self.simulate(first, second, excitation)
        return count

    @cached_property
    def _fmu(self) -> Any:
        if self.definition.fmu is None:
            return None
        from otolith.fmu.instance import instance_of  # noqa: PLC0415 - loads Numba, which the daemon does not need

        return instance_of(self.definition.fmu)

    @cached_property
    def _module(self) -> Any:
        return kernel_cache.load(identity_of(self.definition), lambda: _source(self.definition))

    def _call(self, name: str, first: Array, second: Array, *rest: Any) -> Any:
        if self._fmu is None or name in SHARED:
            return self._called(name, first, second, *rest)
        table = np.full((*first.shape[:-1], 1), self._fmu.address)
        result = self._called(name, np.concatenate([first, table], axis=-1), second, *rest)
        self._fmu.recover()
        return result

    def _called(self, name: str, first: Array, second: Array, *rest: Any) -> Any:
        module, compiled = (_shared_module(), _shared_compiled) if name in SHARED else (self._module, self._compiled)
        function: Callable[..., Any] = getattr(module, name)
        arguments = (np.ascontiguousarray(first), np.ascontiguousarray(second), *rest)
        if name in compiled:
            return function(*arguments)
        with kernel_cache.compiling(module, function, f"{self.definition.name}.{name}"):
            try:
                result = function(*arguments)
            except Exception:  # noqa: BLE001 - a truncated file of the cache raises any error; others come again
                kernel_cache.discard(module)
                result = function(*arguments)
        compiled.add(name)
        return result


_shared_compiled: set[str] = set()


@cache
def _shared_module() -> Any:
    return kernel_cache.load("kernels of all twins", lambda: _sources().shared_source())


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
        *(
            ()
            if definition.fmu is None
            else [
                [item.scale for item in (*definition.fmu.arguments, *definition.fmu.rows)],
                [item.size for item in definition.fmu.states] if definition.fmu.is_stepped else [],
            ]
        ),
    )
    return hashlib.sha256(repr(mathematical).encode()).hexdigest()


def _sources() -> ModuleType:
    from otolith.twin import kernel_sources  # noqa: PLC0415 - loads SymPy; a cached kernel needs none

    return kernel_sources


def _source(definition: Definition) -> str:
    try:
        text: str = _sources().kernel_source(definition)
    except Exception as error:  # SymPy raises errors of many types: each becomes one that names the twin
        text = f"twin {definition.name!r}: its equations cannot be turned into code: {type(error).__name__}: {error}"
        raise ConfigurationError(text) from error
    return text
