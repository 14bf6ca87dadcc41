"""The objective of one window: how far a guess of parameters and initial state is from what was measured.

What disturbs a real machine between records, and the predictor that knows it.

Process noise comes from noisy inputs and from what strays in the states themselves. The Kalman gain weighs it against
the sensors' noise; with it the twin predicts in innovation form (L. Ljung, System Identification, 2nd ed., sections 4.3
and 7.4). Without process noise the gain is zero and the twin runs in open loop, the paper's cost.
"""

from dataclasses import replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.estimation.augmented import input_matrix, time_offsets
from otolith.estimation.problem import Problem
from otolith.twin.definition import Definition
from otolith.twin.kernel import MAX_SUBSTEPS, Excitation, InnovationModel, Kernel, NoiseModel, kernel_of


def predictor(
    kernel: Kernel, parameters: Array, initial: Array, excitation: Excitation, noise: NoiseModel
) -> InnovationModel:
    """Along the window, around ``parameters`` (parameters,) and the initial state (states,).

    A twin that diverges there, or that nothing disturbs, runs in open loop.
    """
    if noise.inputs.any() or noise.states.any():
        found = kernel.innovation_model(parameters, initial, excitation, noise)
        if np.isfinite(found.gain).all() and np.isfinite(found.whitening).all():
            return found
    return open_loop(kernel, excitation, noise)


def open_loop(kernel: Kernel, excitation: Excitation, noise: NoiseModel) -> InnovationModel:
    """Nothing is corrected, and each innovation is as uncertain as its sensor."""
    if excitation.measured is None:
        raise ValueError("a predictor needs measurements")
    present = np.isfinite(excitation.measured)
    scales = np.where(present, 1.0 / noise.outputs, 1.0)
    whitening = scales[:, :, None] * np.eye(len(noise.outputs))
    gain = np.zeros((len(excitation.inputs), len(kernel.definition.states), len(noise.outputs)))
    return InnovationModel(gain, whitening, float(-2.0 * np.log(scales).sum()))


EXPLAINED = 1.5  # cost up to which the residual counts as noise: an explanation that leaves more explains too little
INITIAL_STATE_REACH = 10.0  # standard deviations around the first record, in which the twin may start at least
TRUNCATION = 1e-3  # of the noise: how large the integrator's error may be
PENALTY = 1e30  # the cost of a guess whose prediction is not finite: worse than any other, and finite
MOST_WITH_COMPONENTS = 8  # substeps: no number of them makes the step of dry friction smooth
WHOLE = 0.01  # of a quantum: how far the steps between values may be from whole multiples of it
FEWEST_LEVELS = 4  # that tell a converter's steps from a signal's own


class Objective:
    """The cost of guesses over one window: RMSE as in paper.txt section 3.2, of whitened innovations.

    A guess is the free parameters, then the initial state: the first record is as noisy as any other, so the state it
    shows is a nuisance parameter, estimated along with the rest. Innovations are divided by what they may be, so that
    outputs of different units add up, and a cost of one means that the twin explains the window up to the noise.
    """

    def __init__(self, problem: Problem, window: Window, start: Array, initial: Array | None = None) -> None:
        """``start`` (free parameters,): around it the predictor is made, and around ``initial`` (states,) if given."""
        twin = problem.twin
        self.kernel = kernel_of(twin)
        self.measured = np.column_stack([window.column(entry.name) for entry in twin.outputs])
        self.present = ~np.column_stack([window.missing_in(entry.name) for entry in twin.outputs])
        self.count = max(float(self.present.sum()), 1.0)
        self.noise = self._noise(problem)
        lowest, self._first, highest = _initial_state(twin, self.measured, self.present, self.noise.outputs)
        if problem.components:  # where a sensor that lies would have shown it, had it been right
            wider = np.where(highest > lowest, np.abs(self._first) + highest - lowest, 0.0)
            lowest, highest = lowest - wider, highest + wider
        given = dict(problem.known) | time_offsets(problem, window)
        self._template = np.array([given.get(entry.name, entry.nominal) for entry in twin.parameters])
        order = [entry.name for entry in twin.parameters[: len(twin.parameters) - twin.settings]]
        self._places = [order.index(entry.name) for entry in problem.free]
        self.free = len(self._places)
        self._initial = [len(order) + index for index in range(len(twin.states))]
        self._drifts = [len(order) + len(twin.states) + place for place in self._places]
        low, high = problem.bounds
        self.low, self.high = np.concatenate([low, lowest]), np.concatenate([high, highest])
        self.names = (*(entry.label for entry in problem.free), *(f"initial {state.name}" for state in twin.states))
        self._open_loop, self._states = problem.open_loop, len(twin.states)
        self._most = MAX_SUBSTEPS if twin.base is None else MOST_WITH_COMPONENTS
        self._plain = twin.base or twin
        self._excitation = Excitation(input_matrix(twin, window), window.sample_period)
        self._excitation = replace(self._excitation, measured=np.where(self.present, self.measured, np.nan))
        self.centre(start, self._first if initial is None else initial)

    def centre(self, parameters: Array, initial: Array) -> None:
        """Make the predictor around these (free parameters,), (states,): substeps, gain, whitening."""
        full = self.parameters(parameters[None])[0]
        allowed = TRUNCATION * self.noise.outputs
        plain = replace(self._excitation, gain=None, substeps=1)
        while True:
            made = self._correction(full, initial, plain)
            corrected = replace(plain, gain=made.gain)
            substeps = self.kernel.substeps(full, initial, corrected, allowed, self._most)
            if substeps <= plain.substeps:  # else the gain was made by an integrator that is too coarse
                break
            plain = replace(plain, substeps=substeps)
        self.correction = made
        self._excitation = corrected

    def _correction(self, parameters: Array, initial: Array, free: Excitation) -> InnovationModel:
        """Of the plain twin: what components add hardly changes by how much a prediction may be off."""
        twin = self._plain
        made_for = replace(free, inputs=free.inputs[:, : len(twin.inputs)])
        parameters, initial = parameters[: len(twin.parameters)], initial[: len(twin.states)]
        kernel = kernel_of(twin)
        made = (
            open_loop(kernel, made_for, self.noise)
            if self._open_loop
            else predictor(kernel, parameters, initial, made_for, self.noise)
        )
        more = self._states - len(twin.states)
        return made._replace(gain=np.pad(made.gain, ((0, 0), (0, more), (0, 0)))) if more else made

    @property
    def excitation(self) -> Excitation:
        """What drives the twin, and what corrects it."""
        return self._excitation

    @property
    def whitening(self) -> Array:
        """(records, outputs, outputs) makes each innovation's covariance the identity."""
        return self.correction.whitening

    @property
    def work(self) -> int:
        """Steps of the integrator in one prediction."""
        return len(self.measured) * self._excitation.substeps

    def guess(self, parameters: Array) -> Array:
        """(free parameters,) -> a guess that starts at the first record."""
        return np.concatenate([parameters, self._first])

    def cost_of_parameters(self, parameters: Array) -> Array:
        """(particles, free parameters) -> (particles,), every one started at the first record."""
        starts = np.repeat(self._first[None, :], len(parameters), axis=0)
        return self.cost(np.hstack([parameters, starts]))

    def parameters(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles, parameters of the twin)."""
        found = np.repeat(self._template[None, :], len(guesses), axis=0)
        found[:, self._places] = guesses[:, : self.free]
        return found

    def linearised(self, guess: Array) -> tuple[Array, Array]:
        """(guess,) -> whitened residuals (residuals,) and their derivatives (residuals, guess).

        A prediction that is not finite gives residuals beyond hope, and no direction.
        """
        return self._linearised(guess, [*self._places, *self._initial])

    def drifting(self, guess: Array) -> tuple[Array, Array]:
        """The same with (free parameters at the end, their drifts per second, initial state) for a guess.

        A drift enters to first order, as what it moves within a window is small.
        """
        free = self.free
        still = np.concatenate([guess[:free], guess[2 * free :]])
        residuals, jacobian = self._linearised(still, [*self._places, *self._drifts, *self._initial])
        return residuals + jacobian[:, free : 2 * free] @ guess[free : 2 * free], jacobian

    def _linearised(self, guess: Array, columns: list[int]) -> tuple[Array, Array]:
        parameters, initial = self.parameters(guess[None])[0], guess[self.free :]
        with np.errstate(over="ignore", invalid="ignore"):
            drifts = len(columns) > len(guess)
            found = self.kernel.sensitivities(parameters, initial, self._excitation, drifts=drifts)
            residuals = self.residuals(found.outputs[None])[0].ravel()
            slopes = np.where(self.present[..., None], found.slopes[:, :, columns], 0.0)
            jacobian = -np.matmul(self.whitening, slopes).reshape(len(residuals), -1)
        if np.isfinite(residuals).all() and np.isfinite(jacobian).all():
            return residuals, jacobian
        return np.full(len(residuals), PENALTY / len(residuals)), np.zeros(jacobian.shape)

    def predict(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles, records, outputs), one step ahead, in the units of the twin."""
        initial = guesses[:, self.free :]
        return self.kernel.simulate(self.parameters(guesses), initial, self._excitation)

    def followed(self, guess: Array) -> tuple[Array, Array]:
        """(parameters at the end, drifts, initial state) -> prediction (records, outputs) and last state (states,)."""
        free = self.free
        parameters = self.parameters(guess[None])[0]
        found = self.kernel.sensitivities(parameters, guess[2 * free :], self._excitation, drifts=True)
        return found.outputs + found.slopes[:, :, self._drifts] @ guess[free : 2 * free], found.last

    def simulate(self, guess: Array) -> Array:
        """(guess,) -> (records, outputs) in open loop, from its initial state on."""
        free = replace(self._excitation, gain=None)
        found: Array = self.kernel.simulate(self.parameters(guess[None]), guess[None, self.free :], free)[0]
        return found

    def residuals(self, predicted: Array) -> Array:
        """(particles, records, outputs): whitened innovations, zero where not measured."""
        innovations = np.where(self.present, self.measured - predicted, 0.0)
        found: Array = np.einsum("rop,nrp->nro", self.whitening, innovations)
        return found

    def cost(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles,); a prediction that is not finite never wins."""
        with np.errstate(over="ignore", invalid="ignore"):
            errors = self.residuals(self.predict(guesses))
            cost = np.sqrt(np.einsum("pro,pro->p", errors, errors) / self.count)
        return np.where(np.isfinite(cost), np.minimum(cost, PENALTY), PENALTY)

    def rmse(self, predicted: Array) -> Array:
        """(records, outputs) -> (outputs,), each in its own unit, over the records that were measured."""
        errors = np.where(self.present, self.measured - predicted, 0.0)
        counts = np.maximum(self.present.sum(axis=0), 1.0)
        return np.asarray(np.sqrt((errors**2).sum(axis=0) / counts))

    def _noise(self, problem: Problem) -> NoiseModel:
        twin = problem.twin.base or problem.twin
        columns = zip(self.measured.T, self.present.T, strict=True)
        quanta = np.array([adc_step(values[there]) for values, there in columns])
        return NoiseModel(
            outputs=np.sqrt(np.array(problem.noise) ** 2 + quanta**2 / 12.0),
            inputs=np.array(problem.input_noise or [0.0] * len(twin.inputs)),
            states=np.array(problem.process_noise or [0.0] * len(twin.states)),
        )


def adc_step(values: Array) -> float:
    """The step of a converter behind ``values`` (n,), as its rounding adds a twelfth of its square; 0 if none is seen.

    (B. Widrow, I. Kollar, Quantization Noise, section 4.4.)
    """
    levels = np.unique(values)
    if len(levels) < FEWEST_LEVELS:
        return 0.0
    steps = np.diff(levels)
    multiples = steps / steps.min()
    return float(steps.min()) if np.abs(multiples - np.rint(multiples)).max() <= WHOLE else 0.0


def _initial_state(twin: Definition, measured: Array, present: Mask, noise: Array) -> tuple[Array, Array, Array]:
    """(states,) lower bound, start and upper bound: around the first measurement where an output shows the state.

    The bounds are as wide as the signal moves, as the first record may be missing or wrong.
    """
    outputs = [entry.name for entry in twin.outputs]
    rows = []
    for state in twin.states:
        index = outputs.index(state.name) if state.name in outputs else None
        if index is not None and present[:, index].any():
            seen = measured[present[:, index], index]
            first = float(seen[0])
            reach = max(INITIAL_STATE_REACH * noise[index], float(np.ptp(seen)))
            rows.append((first - reach, first, first + reach))
        else:
            rows.append((state.low, state.initial, state.high))
    low, start, high = np.array(rows).T
    return low, start, high
