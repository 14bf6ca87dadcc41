"""The adapted twin along given inputs: ``simulate(state, window, seed) -> prediction``.

The draws are simulated record by record with the compiled kernel of the twin. Between two records their parameters
follow their trends, and process noise and the noise of measured inputs disturb their states. Bands are of readings, so
they contain the noise of the sensors.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.estimation.objective import MAX_SUBSTEPS_WITH_COMPONENTS, TRUNCATION, input_matrix, time_offsets
from otolith.estimation.posterior import Posterior
from otolith.estimation.problem import Problem
from otolith.simulation.draws import PAIRS, ParameterDraws, chosen, opposite, root_of
from otolith.simulation.initial_state import last_state, state_covariance
from otolith.simulation.orders import with_whole_orders
from otolith.simulation.plan import planned_window
from otolith.simulation.prediction import Prediction, bands
from otolith.twin.kernel import Excitation, kernel_of

CHUNK = 256  # records whose draws are kept until their bands are known: bounds the memory
MAX_MAGNITUDE = 1e30  # of a draw: a larger one has diverged
# Thresholds: docs/reference/thresholds-simulation.md has the origin of each.
MAX_STEPS = 64  # substeps of a record, at most
STEP_RECORDS, TRIED_STEPS = 20, 6  # length and number of the steps of inputs
TRIED_RECORDS = 2000  # from which the number of substeps is found


Possible = Sequence[tuple[float, Posterior]]
"""What may be known of a machine, each with its probability."""


def simulate(state: Posterior | Possible, window: Window, seed: int = 1) -> Prediction:
    """Return what the twin predicts along the inputs of ``window``, which begins at the last record of ``state``.

    Where several causes are possible, ``state`` has a posterior for each; the first one gives the noise of the sensors.

    Of measured inputs the noise disturbs the twin, others are exact: those that ``window`` marks as missing, and that
    are not bridged. Its outputs, if any, are returned beside the prediction, which does not use them. The same
    arguments give the same numbers, bit for bit.

    Raises:
        ValueError: no window has been learned from yet, or the twin diverges at once.
    """
    possible = ((1.0, state),) if isinstance(state, Posterior) else state
    drawn = np.bincount(chosen(np.array([share for share, _ in possible]), PAIRS), minlength=len(possible))
    parts = []
    for index, ((_, posterior), pairs) in enumerate(zip(possible, drawn.tolist(), strict=True)):
        if pairs:
            known = with_whole_orders(posterior.with_constants()).at_last_record()
            random = np.random.default_rng((seed, index) if index else seed)
            parts.append(_Simulation.of(known, window, random, pairs))
    return _prediction(parts, window, seed)


def substeps_of(state: Posterior) -> int:
    """Return the substeps of a sample period that resolve steps of all inputs over their ranges; raises as simulate."""
    twin, period = state.problem.base_model, state.problem.window.sample_period or 0.0
    ends = np.array([(item.low, item.high) for item in twin.inputs]).reshape(-1, 2)
    times, columns = period * np.arange(TRIED_STEPS * STEP_RECORDS, dtype=np.float64), {}
    for item, (low, high) in zip(twin.inputs, ends, strict=True):
        columns[item.name] = np.where(np.arange(len(times)) // STEP_RECORDS % 2, high, low)
    window = planned_window(twin, times, columns, period, 0.0)
    return _Simulation.of(state.at_last_record(), window, np.random.default_rng(0)).substeps


@dataclass(slots=True, eq=False)
class _Simulation:
    """The draws at one record after the other."""

    problem: Problem
    window: Window
    random: np.random.Generator
    parameters: ParameterDraws
    states: Array  # (draws, states)
    driving: Array  # (records, inputs)
    template: Array  # (parameters,) where free parameters have any value
    free: list[int]  # Where the free parameters stand among all
    substeps: int

    @classmethod
    def of(cls, posterior: Posterior, window: Window, random: np.random.Generator, pairs: int = PAIRS) -> "_Simulation":
        """Draw parameters and states at the first record, so many ``pairs``; raises as :func:`simulate`."""
        problem = posterior.problem
        twin = problem.twin
        given = dict(problem.known) | time_offsets(problem, window.start)
        template = np.array([given.get(item.name, item.nominal) for item in twin.parameters])
        names = [item.name for item in twin.parameters]
        free = [names.index(item.name) for item in problem.free]
        template[free] = posterior.start()
        driving, initial, kernel = input_matrix(twin, window), last_state(posterior), kernel_of(twin)
        tried = Excitation(driving, window.grid).until(TRIED_RECORDS)
        limit = MAX_STEPS if twin.base is None else MAX_SUBSTEPS_WITH_COMPONENTS
        with np.errstate(over="ignore", invalid="ignore"):
            substeps = kernel.substeps(template, initial, tried, TRUNCATION * np.array(problem.noise), limit)
            covariance = state_covariance(posterior, kernel, template, driving[0], substeps)
        deviations = random.standard_normal((pairs, len(initial))) @ root_of(covariance).T
        draws = ParameterDraws.of(posterior, random, pairs)
        return cls(problem, window, random, draws, initial + opposite(deviations), driving, template, free, substeps)

    def outputs(self) -> Iterator[Array]:
        """Yield the outputs (draws, outputs) at each record, up to the first one at which one is not finite."""
        grid, kernel, random = self.window.grid, kernel_of(self.problem.twin), self.random
        counts = Excitation(self.driving, grid, self.substeps).counts
        disturbance = np.array(self.problem.process_noise or [0.0] * len(self.problem.base_model.states))
        disturbed, noise = np.flatnonzero(disturbance), self._input_noise()
        rows, following = np.tile(self.template, (len(self.states), 1)), self._inputs(0, noise)
        for record in range(grid.records):
            inputs = following
            if record + 1 < grid.records:
                following = self._inputs(record + 1, noise)
            length = float(grid.steps[record])
            rows[:, self.free] = self.parameters.values
            outputs, self.states = kernel.ensemble(rows, self.states, inputs, following, length, counts[record])
            if not np.abs(outputs).max() <= MAX_MAGNITUDE:  # true for NaN
                return
            yield outputs
            if len(disturbed):
                deviates = opposite(random.standard_normal((len(self.states) // 2, len(disturbed))))
                self.states[:, disturbed] += disturbance[disturbed] * np.sqrt(length) * deviates
            self.parameters.advance(length, random)

    def _inputs(self, record: int, noise: Array) -> Array:
        """Return the inputs (draws, inputs) of each draw at a record."""
        inputs = np.tile(self.driving[record], (len(self.states), 1))
        noisy = np.flatnonzero(noise[record])
        if len(noisy):
            deviates = opposite(self.random.standard_normal((len(inputs) // 2, len(noisy))))
            inputs[:, noisy] += noise[record, noisy] * deviates
        return inputs

    def _input_noise(self) -> Array:
        """Return the noise (records, inputs) of measured inputs; where they are bridged, that with the same effect."""
        twin, window = self.problem.base_model, self.window
        names = [item.name for item in twin.inputs]
        columns = [window.signals.index(name) for name in names]
        level = np.array(self.problem.input_noise or [0.0] * len(names))
        if window.bridge_error is None:
            return np.where(window.missing[:, columns], 0.0, level)
        error = window.bridge_error
        return np.sqrt(level**2 * error.noise_ratio[:, columns] + error.held_variance[:, columns])


def _prediction(parts: Sequence[_Simulation], window: Window, seed: int) -> Prediction:
    """Return the draws of all ``parts``, simulated to the end or until one diverges; raises as :func:`simulate`."""
    problem = parts[0].problem
    twin, steps = problem.base_model, problem.steps or (0.0,) * len(problem.base_model.outputs)
    noise = np.sqrt(np.array(problem.noise) ** 2 + np.array(steps) ** 2 / 12.0)
    known, waiting, of_line = [], [], np.concatenate([part.parameters.lasts for part in parts])
    for outputs in zip(*(part.outputs() for part in parts), strict=False):  # until the first one ends
        waiting.append(np.concatenate(outputs))
        if len(waiting) == CHUNK:
            known.append(bands(np.array(waiting), noise, of_line))
            waiting = []
    if waiting:
        known.append(bands(np.array(waiting), noise, of_line))
    if not known:
        raise ValueError("the twin diverges at once")
    middle, low, high = (np.concatenate(column) for column in zip(*known, strict=True))
    count, names = len(middle), tuple(output.name for output in twin.outputs)
    return Prediction(
        outputs=names,
        units=tuple(output.unit for output in twin.outputs),
        start=window.start,
        offsets=window.grid.offsets[:count],
        values=middle,
        low=low,
        high=high,
        driving=parts[0].driving[:count, : len(twin.inputs)],
        measured=window.measured(names)[:count],
        draws=2 * PAIRS,
        seed=seed,
        diverges=None if count == window.records else float(window.grid.offsets[count]),
    )
