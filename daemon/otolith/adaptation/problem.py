"""What is to be estimated from a window, and the objective that says how good a guess is."""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Mask, Window
from otolith.adaptation.disturbance import Noise, predictor
from otolith.twin.definition import Definition, Parameter
from otolith.twin.kernel import Excitation, kernel_of

INITIAL_STATE_REACH = 10.0  # standard deviations around the first record, in which the twin may start at least
TRUNCATION = 1e-3  # of the noise: how large the integrator's error may be
HOPELESS = 1e30  # the cost of a guess whose prediction is not finite: worse than any other, and finite


@dataclass(frozen=True, slots=True)
class SwarmOptions:
    """Particle swarm settings, Table 2 of the paper."""

    size: int = 15
    generations: int = 1000
    inertia: float = 0.9
    cognitive: float = 2.0
    social: float = 2.0
    tolerance: float = 0.1
    """The swarm is done when the best guesses of its particles lie within this share of χ²: all are in one valley then,
    and the polish finds its floor."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A machine's estimation problem, the same for every window. Plain: it pickles."""

    twin: Definition
    known: tuple[tuple[str, float], ...]
    """Parameters that are given: name and value."""
    free: tuple[Parameter, ...]
    """Parameters to be estimated, with the nominal values and bounds of this machine."""
    noise: tuple[float, ...]
    """Standard deviation of each output's sensor."""
    input_noise: tuple[float, ...] = ()
    """Standard deviation of each input; empty for none."""
    process_noise: tuple[float, ...] = ()
    """Of each state, per square root of a second; empty for none."""
    determined_within: float = 0.1
    """A window determines a parameter when the half of its 95 % interval is at most this share of the nominal value."""
    swarm: SwarmOptions = SwarmOptions()
    seed: int = 1


class Objective:
    """The cost of guesses over one window: RMSE as in paper.txt section 3.2, of whitened innovations.

    A guess is the free parameters, then the initial state: the first record is as noisy as any other, so the state it
    shows is a nuisance parameter, estimated along with the rest. Innovations are divided by what they may be, so that
    outputs of different units add up, and a cost of one means that the twin explains the window up to the noise.
    """

    def __init__(self, problem: Problem, window: Window, start: Array) -> None:
        """``start`` (free parameters,): around it the predictor is made."""
        twin = problem.twin
        self.kernel = kernel_of(twin)
        self.measured = np.column_stack([window.column(entry.name) for entry in twin.outputs])
        self._present = ~np.column_stack([window.missing_in(entry.name) for entry in twin.outputs])
        self.count = max(float(self._present.sum()), 1.0)
        self.noise = _noise(problem)
        lowest, self._first, highest = _initial_state(twin, self.measured, self._present, self.noise.outputs)
        self._template = np.array([dict(problem.known).get(entry.name, entry.nominal) for entry in twin.parameters])
        order = [entry.name for entry in twin.parameters]
        self._places = [order.index(entry.name) for entry in problem.free]
        self.free = len(self._places)
        self._columns = [*self._places, *(len(order) + index for index in range(len(twin.states)))]
        self.low = np.concatenate([[entry.low for entry in problem.free], lowest])
        self.high = np.concatenate([[entry.high for entry in problem.free], highest])
        self.names = (*(entry.name for entry in problem.free), *(f"initial {state.name}" for state in twin.states))
        parameters = self._template.copy()
        parameters[self._places] = start
        inputs = np.column_stack([np.zeros((window.records, 0)), *(window.column(e.name) for e in twin.inputs)])
        coarse = Excitation(inputs, window.sample_period)
        substeps = self.kernel.substeps(parameters, self._first, coarse, TRUNCATION * self.noise.outputs)
        fine = replace(coarse, substeps=substeps)
        made = predictor(self.kernel, parameters, self._first, fine, self.noise)
        self._whitening = made.whitening
        seen = np.where(self._present, self.measured, np.nan)
        self.excitation = replace(fine, measured=seen, gain=made.gain)

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
        found[:, self._places] = guesses[:, : len(self._places)]
        return found

    def linearised(self, guess: Array) -> tuple[Array, Array]:
        """(guess,) -> whitened residuals (residuals,) and their derivatives (residuals, guess).

        A prediction that is not finite gives residuals beyond hope, and no direction.
        """
        parameters, initial = self.parameters(guess[None])[0], guess[len(self._places) :]
        with np.errstate(over="ignore", invalid="ignore"):
            found = self.kernel.sensitivities(parameters, initial, self.excitation)
            residuals = self.residuals(found.outputs[None])[0].ravel()
            slopes = np.where(self._present[..., None], found.slopes[:, :, self._columns], 0.0)
            jacobian = -np.einsum("op,rpc->roc", self._whitening, slopes).reshape(len(residuals), -1)
        if np.isfinite(residuals).all() and np.isfinite(jacobian).all():
            return residuals, jacobian
        return np.full(len(residuals), HOPELESS / len(residuals)), np.zeros(jacobian.shape)

    def predict(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles, records, outputs), one step ahead, in the units of the twin."""
        initial = guesses[:, len(self._places) :]
        return self.kernel.simulate(self.parameters(guesses), initial, self.excitation)

    def residuals(self, predicted: Array) -> Array:
        """(particles, records, outputs): whitened innovations, zero where not measured."""
        innovations = np.where(self._present, self.measured - predicted, 0.0)
        found: Array = np.einsum("op,nrp->nro", self._whitening, innovations)
        return found

    def cost(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles,); a prediction that is not finite never wins."""
        with np.errstate(over="ignore", invalid="ignore"):
            errors = self.residuals(self.predict(guesses))
            cost = np.sqrt(np.einsum("pro,pro->p", errors, errors) / self.count)
        return np.where(np.isfinite(cost), np.minimum(cost, HOPELESS), HOPELESS)

    def rmse(self, predicted: Array) -> Array:
        """(records, outputs) -> (outputs,), each in its own unit, over the records that were measured."""
        errors = np.where(self._present, self.measured - predicted, 0.0)
        counts = np.maximum(self._present.sum(axis=0), 1.0)
        return np.asarray(np.sqrt((errors**2).sum(axis=0) / counts))


def _noise(problem: Problem) -> Noise:
    twin = problem.twin
    return Noise(
        outputs=np.array(problem.noise),
        inputs=np.array(problem.input_noise or [0.0] * len(twin.inputs)),
        states=np.array(problem.process_noise or [0.0] * len(twin.states)),
    )


def _initial_state(twin: Definition, measured: Array, present: Mask, noise: Array) -> tuple[Array, Array, Array]:
    """(states,) lower bound, start and upper bound: around the first measurement where an output shows the state.

    The bounds are as wide as the signal moves, as the first record may be missing or wrong.
    """
    outputs = [entry.name for entry in twin.outputs]
    rows = []
    for state in twin.states:
        if state.name in outputs:
            index = outputs.index(state.name)
            seen = measured[present[:, index], index]
            first = float(seen[0]) if len(seen) else state.initial
            reach = max(INITIAL_STATE_REACH * noise[index], float(np.ptp(seen)) if len(seen) else 0.0)
            rows.append((first - reach, first, first + reach))
        else:
            rows.append((state.low, state.initial, state.high))
    low, start, high = np.array(rows).T
    return low, start, high
