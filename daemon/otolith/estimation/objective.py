"""The objective of one window: the whitened innovations of the twin, for any guess of parameters and initial state.

The cost is the RMSE of section 3.2 of the paper, with each innovation divided by its standard deviation. A cost of one
means that the twin explains the window up to the noise.

The predictor works in innovation form (L. Ljung, System Identification, 2nd ed., sections 4.3 and 7.4): after each
record a Kalman gain corrects the state. The gain weighs process noise, which comes from noisy inputs and disturbed
states, against sensor noise. Without process noise the gain is zero, and the twin runs in open loop: the paper's cost.
"""

from collections.abc import Iterator
from copy import copy
from dataclasses import replace
from functools import cached_property, lru_cache
from itertools import count

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.problem import Problem
from otolith.twin.components import ELAPSED, shift_setting
from otolith.twin.definition import Definition
from otolith.twin.kernel import MAX_SUBSTEPS, Excitation, Indices, InnovationModel, NoiseModel, kernel_of

INITIAL_STATE_REACH = 10.0  # standard deviations around the first record: least width of the bounds of a start
TRUNCATION = 1e-3  # share of the noise: largest truncation error of the integrator
PENALTY = 1e30  # cost of a guess whose prediction is not finite
MAX_HALVINGS = 20  # of start amplitudes with which the twin diverges
MAX_SUBSTEPS_WITH_COMPONENTS = 8  # no number of sub-steps makes the step of dry friction smooth
ADC_TOLERANCE = 0.01  # share of a step: how far level differences may be from whole multiples of it
WHITE_ROUNDING = 2.0  # standard deviations of the noise: rounding to steps up to this size is white noise
# Standard deviations of the noise: what differs by more are wrong values, no levels of a converter.
MAX_ADC_STEP = 1000.0
SHARED_WINDOWS = 4  # of which the noise and a predictor are kept, for other problems of the same window
MIN_ADC_LEVELS = 4  # levels in a window that show the step of a converter


class Objective:
    """Whitened innovations and cost of guesses over one window.

    A guess (free + states,) holds the free parameters, then the initial state. The first record is as noisy as any
    other, so the initial state is a nuisance parameter, estimated along with the rest. A guess with trends
    (2 free + states,) holds parameters at the end of the window, their trends per second, and the initial state.
    """

    def __init__(
        self, problem: Problem, window: Window, start: Array, initial: Array | None = None, substeps: int = 1
    ) -> None:
        """Build the predictor around ``start`` (free,) and ``initial`` (states,), with at least so many sub-steps.

        States that are NaN, by default all, start at the first record.
        """
        twin = problem.twin
        self.kernel = kernel_of(twin)
        self._window, self._base = window, problem.base_model
        self.measured, self.present, measured = _measurements(window, self._base)
        counts = self.present.sum(axis=0)
        self._counts, self.count = np.maximum(counts, 1.0), max(float(counts.sum()), 1.0)  # Measured values
        self._seed = problem.seed + window.index
        self._noisier_inputs: list[Array] = []  # Drawn when they are first needed
        self._noisy_inputs = [
            (column, level, np.flatnonzero(~window.missing_in(self._base.inputs[column].name)))
            for column, level in enumerate(problem.input_noise)
            if level
        ]
        levels = problem.noise, problem.steps, problem.input_noise, problem.process_noise
        self.noise = _noise_model(window, self._base, *levels, problem.window.sample_period)
        lowest, self._first, highest = _initial_state(twin, self.measured, self.present, self.noise.outputs)
        if problem.components:  # a faulty sensor shows the first state far from where it is
            wider = np.where(highest > lowest, np.abs(self._first) + highest - lowest, 0.0)
            lowest, highest = lowest - wider, highest + wider
        given = dict(problem.known) | time_offsets(problem, window.start)
        self._template = np.array([given.get(parameter.name, parameter.nominal) for parameter in twin.parameters])
        self.free, self._states = len(problem.free), len(twin.states)
        self._choose_columns(problem)
        low, high = problem.bounds
        self.low, self.high = np.concatenate([low, lowest]), np.concatenate([high, highest])
        states = (f"initial {state.name}" for state in twin.states)
        self.names = (*(parameter.label for parameter in problem.free), *states)
        self._open_loop = problem.open_loop
        limit = MAX_SUBSTEPS if twin.base is None else MAX_SUBSTEPS_WITH_COMPONENTS
        self._limits = TRUNCATION * self.noise.outputs, limit
        self.excitation = Excitation(input_matrix(twin, window), window.grid, measured=measured)
        """Inputs, measurements, gain and sub-steps of the predictor."""
        self.initial = self._first if initial is None else np.where(np.isnan(initial), self._first, initial)
        """(states,) around which the predictor was built."""
        self.set_predictor(start, self.initial, substeps)

    def _choose_columns(self, problem: Problem) -> None:
        """Set the columns of :meth:`Kernel.sensitivities`: of the guess alone, of the trends, and of both."""
        twin = problem.twin
        names = [parameter.name for parameter in twin.parameters[: len(twin.parameters) - twin.settings]]
        self._free_columns = np.array([names.index(parameter.name) for parameter in problem.free], dtype=np.int64)
        state_columns = len(names) + np.arange(self._states)
        self._trend_columns = len(names) + self._states + self._free_columns
        self._columns = np.concatenate([self._free_columns, state_columns])
        self._columns_with_trends = np.concatenate([self._free_columns, self._trend_columns, state_columns])

    def set_predictor(self, parameters: Array, initial: Array, substeps: int = 1) -> None:
        """Compute at least ``substeps`` sub-steps, gain and whitening around ``parameters`` (free,) and ``initial``."""
        full = self.parameters(parameters[None])[0]
        drive = self.excitation.inputs, self.excitation.grid
        measured, uncorrected = self.excitation.measured, replace(self.excitation, gain=None, substeps=substeps)
        while True:
            model = self._innovation_model(full, initial, uncorrected.substeps)
            corrected = Excitation(*drive, uncorrected.substeps, measured, model.gain)
            needed = self.kernel.substeps(full, initial, corrected, *self._limits)
            if needed <= uncorrected.substeps:  # otherwise the gain comes from too coarse an integrator
                break
            uncorrected = replace(uncorrected, substeps=needed)
        self.innovation_model, self.excitation = model, corrected

    def is_resolved(self, parameters: Array, initial: Array) -> bool:
        """Whether the sub-steps of the predictor suffice at ``parameters`` (free,) and ``initial`` (states,)."""
        full = self.parameters(parameters[None])[0]
        return self.kernel.substeps(full, initial, self.excitation, *self._limits) <= self.excitation.substeps

    def _innovation_model(self, parameters: Array, initial: Array, substeps: int) -> InnovationModel:
        """Return gain and whitening of the base model: components hardly change the prediction error covariance."""
        twin = self._base
        around = parameters[: len(twin.parameters)].tobytes(), initial[: len(twin.states)].tobytes()
        model = _predictor(self._window, twin, self.noise, substeps, *around, open_loop=self._open_loop)
        extra = self._states - len(twin.states)
        return model._replace(gain=np.pad(model.gain, ((0, 0), (0, extra), (0, 0)))) if extra else model

    @cached_property
    def _random(self) -> np.random.Generator:
        return np.random.default_rng(self._seed)

    @property
    def whitening(self) -> Array:
        """(records, outputs, outputs) matrices that make each innovation's covariance the identity."""
        return self.innovation_model.whitening

    @property
    def spread(self) -> float:
        """Sum over the records of ln|covariance of the innovations|, before they are whitened."""
        return self.innovation_model.log_determinant

    @property
    def integrator_steps(self) -> int:
        """Steps of the integrator in one prediction."""
        return int(self.excitation.counts.sum())

    def guess(self, parameters: Array) -> Array:
        """Return the guess (free + states,) of ``parameters`` (free,) that starts at the first record."""
        return np.concatenate([parameters, self._first])

    def without_trends(self, guess: Array) -> Array:
        """Return the guess (..., free + states) that a ``guess`` with trends contains."""
        return np.concatenate([guess[..., : self.free], guess[..., 2 * self.free :]], axis=-1)

    def parameters(self, guesses: Array) -> Array:
        """Return all parameters of the twin (particles, parameters) for guesses (particles, free, ...)."""
        parameters = self._template[None].repeat(len(guesses), axis=0)
        parameters[:, self._free_columns] = guesses[:, : self.free]
        return parameters

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        """Return whitened residuals (residuals,) and their derivatives (residuals, guess) at ``guess`` (guess,).

        A prediction that diverges gives very large residuals and zero derivatives.
        """
        return self._linearise(guess, self._columns)

    def linearise_with_trends(self, guess: Array) -> tuple[Array, Array]:
        """Return the same for a guess with trends, which enter to first order: they move a parameter by little."""
        trends = slice(self.free, 2 * self.free)
        residuals, jacobian = self._linearise(self.without_trends(guess), self._columns_with_trends)
        return residuals + jacobian[:, trends] @ guess[trends], jacobian

    def with_noisier_inputs(self) -> Iterator["Objective"]:
        """Yield the same with further noise of the inputs, as large as that of the samples; nothing if none is noisy.

        The predictor stays. Each has other noise, and there is no end.
        """
        drawn, random = self._noisier_inputs, self._random
        for number in count() if self._noisy_inputs else ():
            if number == len(drawn):
                drawn.append(self.excitation.inputs.copy())
                for column, level, sampled in self._noisy_inputs:
                    hold, errors = self._base.inputs[column].hold, level * random.standard_normal(len(sampled))
                    drawn[-1][:, column] += _held(errors, sampled, self.excitation.grid.offsets, hold)
            noisier = copy(self)
            noisier.excitation = replace(self.excitation, inputs=drawn[number])
            yield noisier

    def changes_by_input_noise(self, guess: Array, residuals: Array, jacobian: Array) -> Iterator[Array]:
        """Yield changes (residuals, guess + 1) of ``jacobian`` and ``residuals`` by further noise of the inputs.

        Both are those at ``guess``, with or without trends. It ends where the prediction diverges.
        """
        has_trends = len(guess) > self.free + self._states
        for noisier in self.with_noisier_inputs():
            moved, slopes = noisier.linearise_with_trends(guess) if has_trends else noisier.linearise(guess)
            if not slopes.any():
                return
            yield np.concatenate([slopes - jacobian, (moved - residuals)[:, None]], axis=1)

    def _linearise(self, guess: Array, columns: Indices) -> tuple[Array, Array]:
        parameters, initial = self._template.copy(), guess[self.free :]
        parameters[self._free_columns] = guess[: self.free]
        prediction = self.kernel.sensitivities(parameters, initial, self.excitation, columns)
        with np.errstate(over="ignore", invalid="ignore"):
            errors = (prediction.outputs - self.measured)[..., None]
            residuals = self.kernel.whiten(self.innovation_model, errors, self.present).ravel()
        jacobian = self.kernel.whiten(self.innovation_model, prediction.slopes, self.present)
        limit = PENALTY**2
        if np.vdot(residuals, residuals) <= limit and np.vdot(jacobian, jacobian) <= limit:  # false for NaN
            return residuals, jacobian
        return np.full(len(residuals), PENALTY / len(residuals)), np.zeros(jacobian.shape)

    def predict(self, guesses: Array) -> Array:
        """Return one-step predictions (particles, records, outputs), in the units of the twin."""
        initial = guesses[:, self.free :]
        return self.kernel.simulate(self.parameters(guesses), initial, self.excitation)

    def predict_with_trends(self, guess: Array) -> tuple[Array, Array]:
        """Return prediction (records, outputs) and last state (states,) for a guess with trends."""
        free = self.free
        parameters = self.parameters(guess[None])[0]
        prediction = self.kernel.sensitivities(parameters, guess[2 * free :], self.excitation, self._trend_columns)
        with np.errstate(over="ignore", invalid="ignore"):  # where the twin diverges
            trends = prediction.slopes @ guess[free : 2 * free]
            return prediction.outputs + trends, prediction.last

    def simulate(self, guess: Array) -> Array:
        """Return the open-loop simulation (records, outputs) from the initial state of ``guess`` (guess,)."""
        uncorrected = replace(self.excitation, gain=None)
        simulated: Array = self.kernel.simulate(self.parameters(guess[None]), guess[None, self.free :], uncorrected)[0]
        return simulated

    def residuals(self, predicted: Array) -> Array:
        """Return whitened innovations (particles, records, outputs), zero where nothing was measured."""
        innovations = np.where(self.present, self.measured - predicted, 0.0)
        of_outputs = np.ascontiguousarray(innovations.transpose(2, 0, 1))  # sums along records are many times faster
        whitened = np.einsum("opr,pnr->onr", np.ascontiguousarray(self.whitening.transpose(1, 2, 0)), of_outputs)
        return np.ascontiguousarray(whitened.transpose(1, 2, 0))

    def cost(self, guesses: Array) -> Array:
        """Return the cost (particles,) of guesses (particles, guess); PENALTY where a prediction is not finite."""
        with np.errstate(over="ignore", invalid="ignore"):
            errors = self.residuals(self.predict(guesses))
            cost = np.sqrt(np.einsum("pro,pro->p", errors, errors) / self.count)
        return np.where(np.isfinite(cost), np.minimum(cost, PENALTY), PENALTY)

    def with_bounded(self, start: Array, amplitudes: list[int]) -> Array:
        """Return ``start`` (free,), with smaller ``amplitudes`` if the twin diverges at those of the screening test."""
        start = start.copy()
        for _ in range(MAX_HALVINGS):
            if self.cost(np.concatenate([start, self.initial])[None])[0] < PENALTY:
                break
            start[amplitudes] *= 0.5
        return start

    def cost_of_parameters(self, parameters: Array) -> Array:
        """Return the cost (particles,) of parameters (particles, free), each started at the first record."""
        starts = np.repeat(self._first[None, :], len(parameters), axis=0)
        return self.cost(np.hstack([parameters, starts]))

    def rmse(self, predicted: Array) -> Array:
        """Return the RMSE (outputs,) of a prediction (records, outputs), each in its unit, over measured records."""
        errors = np.where(self.present, self.measured - predicted, 0.0)
        return np.asarray(np.sqrt((errors**2).sum(axis=0) / self._counts))


@lru_cache(maxsize=SHARED_WINDOWS)
def _measurements(window: Window, twin: Definition) -> tuple[Array, Mask, Array]:
    """Return the outputs (records, outputs), which of them are measured, and the outputs with NaN where not."""
    outputs = [window.signals.index(output.name) for output in twin.outputs]
    values, present = window.values.take(outputs, axis=1), ~window.missing.take(outputs, axis=1)
    return values, present, np.where(present, values, np.nan)


@lru_cache(maxsize=SHARED_WINDOWS)
def _noise_model(  # noqa: PLR0913, PLR0917 - the levels of a problem, by which it is found again
    window: Window,
    twin: Definition,
    noise: tuple[float, ...],
    steps: tuple[float, ...],
    input_noise: tuple[float, ...],
    process_noise: tuple[float, ...],
    period: float | None,
) -> NoiseModel:
    measured, present, _ = _measurements(window, twin)
    samples = zip(measured.T, present.T, noise, steps or (0.0,) * len(noise), strict=True)
    rounding = [rounding_variance(values[own], level, step) for values, own, level, step in samples]
    outputs = np.sqrt(np.array(noise) ** 2 + np.array(rounding))
    states = np.array(process_noise or [0.0] * len(twin.states))
    inputs = np.array(input_noise or [0.0] * len(twin.inputs))
    error = window.bridge_error
    at_records = held = np.full((window.records, len(inputs)), inputs)
    if error is not None:
        columns = [window.signals.index(driven.name) for driven in twin.inputs]
        at_records = np.sqrt(inputs**2 + error.variance[:, columns])
        held = np.sqrt(inputs**2 * error.noise_ratio[:, columns] + error.held_variance[:, columns])
    return NoiseModel(outputs, at_records, held, states, period)


@lru_cache(maxsize=SHARED_WINDOWS)
def _predictor(  # noqa: PLR0913, PLR0917 - all that it depends on, by which it is found again
    window: Window,
    twin: Definition,
    noise: NoiseModel,
    substeps: int,
    parameters: bytes,
    initial: bytes,
    *,
    open_loop: bool,
) -> InnovationModel:
    """Return gain and whitening of a ``twin`` without slots; the hypotheses of a search share them.

    ``parameters`` (parameters,) and ``initial`` (states,) are the bytes of arrays.
    """
    drive = Excitation(input_matrix(twin, window), window.grid, substeps, _measurements(window, twin)[2])
    around = np.frombuffer(parameters), np.frombuffer(initial)
    return kernel_of(twin).predictor(*around, drive, noise, open_loop=open_loop)


def _held(values: Array, sampled: Indices, offsets: Array, hold: str) -> Array:
    """Return ``values`` of the ``sampled`` records at all ``offsets`` (records,), as an input is held between them."""
    if hold == "foh":
        return np.asarray(np.interp(offsets, offsets[sampled], values))
    last = np.searchsorted(sampled, np.arange(len(offsets)), side="right") - 1
    return np.asarray(values[np.maximum(last, 0)])


def time_offsets(problem: Problem, start: float) -> dict[str, float]:
    """Return the settings that count time from the origins of components; the first record is at ``start`` s."""
    return {
        shift_setting(slot): start - component.origin
        for slot, component in enumerate(problem.components)
        if component.source == "t" and not component.periodic
    }


def input_matrix(twin: Definition, window: Window) -> Array:
    """Return the inputs (records, inputs) of a twin with or without slots."""
    inputs = np.zeros((window.records, len(twin.inputs)))
    for column, source in enumerate(twin.inputs):
        if source.name == ELAPSED:
            inputs[:, column] = window.grid.offsets
        elif not source.name.startswith("_"):
            inputs[:, column] = window.column(source.name)
    return inputs


def rounding_variance(values: Array, noise: float, known_step: float) -> float:
    """Return the variance that rounding to the steps of a converter adds to ``values`` (n,), in their unit squared.

    Beside normal ``noise`` of at least half a step the errors are white, with a twelfth of the squared step (B. Widrow,
    I. Kollar, Quantization Noise, section 4.4). With less noise the errors of a run of equal values are one error, so
    that the variance of a mean is larger by the mean length of the runs. Values on too few levels to show a step have
    the ``known_step`` of the windows before, or 0.
    """
    if len(values) == 0:
        return 0.0
    step = _plausible_step(values, noise)
    if not step and known_step and len(np.unique(values)) < MIN_ADC_LEVELS:
        step = known_step
    alike = 1.0 if step <= WHITE_ROUNDING * noise else len(values) / _runs(values)
    return step**2 / 12.0 * alike


def unmodelled_rounding(values: Array, noise: float, known_step: float) -> tuple[float, float]:
    """Return the step of the converter behind ``values`` (n,), which two or three levels show here; 0 if none do.

    And the variance that rounding to it adds beyond that of :func:`rounding_variance`, which needs more levels.
    """
    levels = np.unique(values)
    step = float(np.diff(levels).min()) if 1 < len(levels) < MIN_ADC_LEVELS else adc_step(values)
    return step, max(step**2 / 12.0 - rounding_variance(values, noise, known_step), 0.0)


def converter_steps(problem: Problem, window: Window) -> tuple[float, ...]:
    """Return the steps of converters that ``window`` or those before show, per output; empty if there are none.

    A step replaces the one before if it is smaller by more than rounding.
    """
    outputs = [output.name for output in problem.base_model.outputs]
    values = (window.column(name)[~window.missing_in(name)] for name in outputs)
    shown = list(map(_plausible_step, values, problem.noise))
    stated = {name: sensor.resolution for name, sensor in problem.sensors}
    earlier = problem.steps or (0.0,) * len(outputs)
    before = (old or stated.get(name, 0.0) for name, old in zip(outputs, earlier, strict=True))
    steps = tuple(
        new if new and (not old or new < old * (1.0 - ADC_TOLERANCE)) else old
        for old, new in zip(before, shown, strict=True)
    )
    return steps if any(steps) else ()


def _plausible_step(values: Array, noise: float) -> float:
    """Return the step of the converter behind ``values`` (n,); 0 if they show none, or one that no converter has."""
    step = adc_step(values)
    return step if step <= MAX_ADC_STEP * noise else 0.0


def adc_step(values: Array) -> float:
    """Return the step of the converter behind ``values`` (n,), or 0 if the values show none.

    Two visits to the same level also indicate a converter: a failing sensor changes its level once.
    """
    ordered = np.sort(values)
    rises = ordered[1:] != ordered[:-1]
    steps = ordered[1:][rises] - ordered[:-1][rises]
    levels = len(steps) + 1
    if levels < 2 or (levels < MIN_ADC_LEVELS and _runs(values) <= levels):
        return 0.0
    least = float(steps.min())
    multiples = steps / least
    return least if np.abs(multiples - np.rint(multiples)).max() <= ADC_TOLERANCE else 0.0


def _runs(values: Array) -> int:
    """Return in how many runs of equal values ``values`` (n,) come."""
    return 1 + int(np.count_nonzero(np.diff(values)))


def _initial_state(twin: Definition, measured: Array, present: Mask, noise: Array) -> tuple[Array, Array, Array]:
    """Return lower bound, start and upper bound of the initial state, each (states,).

    A state that is an output starts at its first measurement. Its bounds are as wide as the signal moves, because the
    first record may be missing or wrong.
    """
    outputs = [output.name for output in twin.outputs]
    rows = []
    for state in twin.states:
        index = outputs.index(state.name) if state.name in outputs else None
        if index is not None and present[:, index].any():
            values = measured[present[:, index], index]
            first = float(values[0])
            reach = max(INITIAL_STATE_REACH * noise[index], float(values.max() - values.min()))
            low, high = first - reach, first + reach
            if not present[0, index]:  # the state may have moved before its first measurement
                low, high = min(low, state.low), max(high, state.high)
            rows.append((low, first, high))
        else:
            rows.append((state.low, state.initial, state.high))
    low, start, high = np.array(rows).T
    return low, start, high
