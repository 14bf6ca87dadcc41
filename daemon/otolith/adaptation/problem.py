"""What is to be estimated from a window, and the objective that says how good a guess is."""

from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.twin.definition import Definition, Parameter
from otolith.twin.kernel import Excitation, kernel_of

INITIAL_STATE_REACH = 6.0  # standard deviations of the noise around the first record, in which the twin may start
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
    tolerance: float = 0.01
    """The swarm has converged when its particles' best guesses differ by no more than this in χ²: a tenth of a
    standard deviation, so that what is left of the search is far under what the noise leaves open."""


@dataclass(frozen=True, slots=True)
class Problem:
    """A machine's estimation problem, the same for every window. Plain: it pickles."""

    twin: Definition
    known: tuple[tuple[str, float], ...]
    """Parameters that are given: name and value."""
    free: tuple[Parameter, ...]
    """Parameters to be estimated, with the nominal values and bounds of this machine."""
    noise: tuple[float, ...]
    """Standard deviation of each output of the twin."""
    determined_within: float = 0.1
    """A window determines a parameter when the half of its 95 % interval is at most this share of the nominal value."""
    swarm: SwarmOptions = SwarmOptions()
    seed: int = 1


class Objective:
    """The cost of guesses over one window: RMSE as in paper.txt section 3.2.

    A guess is the free parameters, then the initial state: the first record is as noisy as any other, so the state it
    shows is a nuisance parameter, searched for along with the rest. The errors of each output are divided by its
    noise, so that outputs of different units add up, and a cost of one means that the twin explains the window up to
    the noise.
    """

    def __init__(self, problem: Problem, window: Window) -> None:
        twin = problem.twin
        self._kernel = kernel_of(twin)
        inputs = np.column_stack([np.zeros((window.records, 0)), *(window.column(e.name) for e in twin.inputs)])
        self.measured = np.column_stack([window.column(entry.name) for entry in twin.outputs])
        noise = np.asarray(problem.noise)
        self._weights = 1.0 / noise
        absent = np.column_stack([window.missing_in(entry.name) for entry in twin.outputs])
        self._present = np.where(absent, 0.0, 1.0)
        self.count = max(float(self._present.sum()), 1.0)
        lowest, self._first, highest = _initial_state(twin, self.measured[0], noise)
        self._template = np.array([dict(problem.known).get(entry.name, entry.nominal) for entry in twin.parameters])
        order = [entry.name for entry in twin.parameters]
        self._places = [order.index(entry.name) for entry in problem.free]
        self.low = np.concatenate([[entry.low for entry in problem.free], lowest])
        self.high = np.concatenate([[entry.high for entry in problem.free], highest])
        self.names = (*(entry.name for entry in problem.free), *(f"initial {state.name}" for state in twin.states))
        coarse = Excitation(inputs, window.sample_period)
        substeps = self._kernel.substeps(self._template, self._first, coarse, TRUNCATION * noise)
        self._excitation = replace(coarse, substeps=substeps)

    def guess(self, parameters: Array) -> Array:
        """(free parameters,) -> a guess that starts at the first record."""
        return np.concatenate([parameters, self._first])

    def predict(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles, records, outputs), in the units of the twin."""
        parameters = np.repeat(self._template[None, :], len(guesses), axis=0)
        parameters[:, self._places] = guesses[:, : len(self._places)]
        initial = np.ascontiguousarray(guesses[:, len(self._places) :])
        return self._kernel.simulate(parameters, initial, self._excitation)

    def residuals(self, predicted: Array) -> Array:
        """(particles, records, outputs): measured minus predicted in units of the noise, zero where not measured."""
        return (self.measured - predicted) * self._weights * self._present

    def cost(self, guesses: Array) -> Array:
        """(particles, guess) -> (particles,); a prediction that is not finite never wins."""
        with np.errstate(over="ignore", invalid="ignore"):
            errors = self.residuals(self.predict(guesses))
            cost = np.sqrt(np.einsum("pro,pro->p", errors, errors) / self.count)
        return np.where(np.isfinite(cost), np.minimum(cost, HOPELESS), HOPELESS)

    def rmse(self, predicted: Array) -> Array:
        """(records, outputs) -> (outputs,), each in its own unit, over the records that were measured."""
        errors = (self.measured - predicted) * self._present
        counts = np.maximum(self._present.sum(axis=0), 1.0)
        return np.asarray(np.sqrt((errors**2).sum(axis=0) / counts))


def _initial_state(twin: Definition, first: Array, noise: Array) -> tuple[Array, Array, Array]:
    """(states,) lower bound, start and upper bound: around the first record where an output shows the state."""
    outputs = [entry.name for entry in twin.outputs]
    rows = []
    for state in twin.states:
        if state.name in outputs:
            index = outputs.index(state.name)
            reach = INITIAL_STATE_REACH * noise[index]
            rows.append((first[index] - reach, first[index], first[index] + reach))
        else:
            rows.append((state.low, state.initial, state.high))
    low, start, high = np.array(rows).T
    return low, start, high
