"""The search for values of parameters that several windows show together."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.commissioning.constancy import ValueChange
from otolith.commissioning.dependence import Dependence, dependences, is_count, responses
from otolith.commissioning.identification import sample_noise, with_initial_noise
from otolith.commissioning.likelihood import Progress, with_levels
from otolith.commissioning.shared_fit import DETERMINED, SharedFit, SharedScale, deviations, size_of
from otolith.estimation.evidence import DECISIVE, SIGNIFICANT_DEVIATE, STRUCTURE
from otolith.estimation.global_search import LEVELS
from otolith.estimation.information import QUANTILE
from otolith.estimation.minimisers import MAX_STEPS, FitResult, gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.timing import delayable, largest_delay
from otolith.estimation.window_fit import ALONE_STEPS
from otolith.twin.definition import Parameter, Role
from otolith_drivers.units import is_one_in_si

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
QUIETER = 0.03  # times the process noise: a second fit, whose values are the same if the twin lacks nothing
MIN_SHARE = 0.9  # of the variance of an output that the twin explains without being corrected
MOVING = 10.0  # standard deviations of its noise by which an output moves, so that its variance can be explained
WIDER_INTERVAL = 1.5  # times the interval of a parameter that is less than determined: accepted in the next fits
PHASES = 8  # of a sine that are tried in each window


@dataclass(frozen=True, slots=True)
class OwnValue:
    """A parameter of the machine."""

    name: str
    value: float  # In the unit of the twin
    sd: float | None = None  # None if it is not determined
    remark: str = ""  # Why it is not determined, or what it is taken from
    is_taken: bool = False  # Whether it is taken from another parameter
    only_with: tuple[Dependence, ...] = ()  # Held parameters: where one of them is wrong, so is this one


@dataclass(frozen=True, slots=True)
class OwnValues:
    """What a record shows of the parameters that were free."""

    values: tuple[OwnValue, ...]
    loads: Mapping[str, tuple[float, float]]  # Smallest and largest value of each unknown that windows do not share
    cost: float  # Root mean square of the residuals in units of the noise
    windows: int
    shares: Mapping[str, float] = field(default_factory=dict)
    """Of the variance of each output that moves: what the twin explains without being corrected."""
    quiet_cost: float = np.inf  # As ``cost``, of a fit with less process noise
    misfits: tuple[float, ...] = ()  # (windows,) mean square of what the twin leaves without being corrected
    faults: tuple[str, ...] = ()  # Why no value may be written
    beside: tuple[str, ...] = ()  # Components that were fitted with the values
    changes: tuple[ValueChange, ...] = ()  # Values that differ between both ends of the record

    @property
    def is_followed(self) -> bool:
        """Whether the twin describes the machine with these values."""
        return self.windows > 0 and bool(np.isfinite(self.cost)) and min(self.shares.values(), default=0.0) >= MIN_SHARE

    @property
    def is_explained(self) -> bool:
        """Whether the twin leaves no more than noise where it is hardly corrected."""
        return self.is_followed and self.quiet_cost <= STRUCTURE


@dataclass(frozen=True, slots=True, eq=False)
class _Stage:
    """What all windows are fitted with, and where the fit begins."""

    problem: Problem
    shared: Mapping[str, Sequence[int]]  # See SharedFit
    parameters: Array  # (free,)
    guesses: Sequence[Array]  # Of the windows; none before the first stage


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """What the last stage reached."""

    values: dict[str, float]
    sd: dict[str, float]
    weakest: list[str] | None  # Parameters of the weakest direction, if it is not determined
    cost: float
    guesses: list[Array]  # Of the windows, with the parameters that were held
    stage: _Stage


class ValueSearch:
    """A search for the values that all windows have in common."""

    def __init__(  # noqa: PLR0913 - what is known beside the windows
        self,
        problem: Problem,
        windows: Sequence[Window],
        loads: frozenset[str],
        progress: Progress,
        start: Mapping[str, float] | None = None,
        *,
        stated: Collection[str] = (),
    ) -> None:
        """The search begins at the values ``start``, else at those of ``problem``, at which parameters are held.

        Those that are ``stated`` are of this machine, other known ones of the twin's example.
        """
        self._start, self._stated = start or {}, frozenset(stated)
        self._problem, self._windows, self._loads, self._progress = problem, windows, loads, progress
        self._places = {parameter.name: at for at, parameter in enumerate(problem.free)}
        self._fixed: dict[str, str] = {}  # Not determined, and why
        self._equal: dict[str, str] = {}  # Taken as equal to another one
        self._rough: dict[str, float] = {}  # What the interval of one is compared with where the example is excluded
        self._beside: dict[str, float] = {}  # Standard deviations of values before others were held
        self._last: _Fitted | None = None

    def run(self) -> OwnValues:
        """Fit, and hold what is not determined, until all others are."""
        while True:
            shared = self._shared()
            if not shared:
                return OwnValues(self._values({}, {}, None), {}, np.inf, len(self._windows))
            self._last = fitted = self._fitted(shared)
            if fitted.weakest is None:
                break
            self._hold(fitted.weakest, fitted.values, fitted.sd)
        values, sd = fitted.values, fitted.sd
        loads = {
            name: (min(own), max(own))
            for name in self._loads & self._places.keys()
            if (own := [float(guess[self._places[name]]) for guess in fitted.guesses])
        }
        quiet, quiet_cost = self._quieter(fitted.stage)
        others = {name: float(quiet.guesses[0][ats[0]]) for name, ats in quiet.shared.items()}
        spread = {name: float(np.hypot(sd[name], others[name] - value)) for name, value in values.items()}
        shares, misfits = self._simulated(fitted.stage)
        found = OwnValues((), loads, fitted.cost, len(self._windows), shares, quiet_cost, misfits)
        wide = [name for name in values if QUANTILE * spread[name] > DETERMINED * self._size(name, values[name])]
        spread = {name: max(own, self._beside.get(name, 0.0)) for name, own in spread.items()}
        differ = [name for name in values if abs(others[name] - values[name]) > SIGNIFICANT_DEVIATE * sd[name]]
        if found.is_explained and not differ:  # the fit that trusts the twin more is right, and more precise
            return replace(found, values=self._values(others, spread, quiet))
        faults = tuple(self._contradictions([name for name in wide if name[0] != "_"], values, others))
        return replace(found, values=self._values(values, spread, fitted.stage), faults=faults)

    def _quieter(self, stage: _Stage) -> tuple[_Stage, float]:
        """Return what a fit reaches that trusts the twin more, and its cost.

        Both fits have the same values but for noise if the twin lacks nothing (J. A. Hausman, Econometrica 46, 1978).
        """
        noise = tuple(QUIETER * level for level in stage.problem.process_noise)
        quieter = replace(stage, problem=replace(stage.problem, process_noise=noise))
        guesses, result, together = self._fit(quieter, MAX_STEPS)
        return replace(quieter, guesses=guesses), together.cost(result)

    def _simulated(self, stage: _Stage) -> tuple[dict[str, float], tuple[float, ...]]:
        """Return the explained share of the variance of each output that moves, and the mean square left by window.

        Measurements do not correct the twin; the initial state of each window is the best one.
        """
        problem, free = replace(stage.problem, open_loop=True), len(stage.parameters)
        names = [output.name for output in problem.base_model.outputs]
        (squares, variance, counts), misfits = np.zeros((3, len(names))), list[float]()
        for window, guess in zip(self._windows, stage.guesses, strict=True):
            objective = Objective(problem, window, guess[:free], guess[free:])
            errors, jacobian = objective.linearise(guess)
            states = jacobian[:, free:]
            errors = errors + states @ np.linalg.lstsq(states, -errors, rcond=None)[0]
            by_output = errors.reshape(objective.measured.shape) ** 2
            squares += by_output.sum(axis=0)
            misfits.append(float(by_output.sum() / objective.count))
            for at, (name, level) in enumerate(zip(names, problem.noise, strict=True)):
                values = window.column(name)[~window.missing_in(name)]
                variance[at] += float(((values - values.mean()) ** 2).sum()) / level**2 if len(values) else 0.0
                counts[at] += len(values)
        moves = variance > MOVING**2 * counts
        shares = {name: float(1.0 - squares[at] / variance[at]) for at, name in enumerate(names) if moves[at]}
        return shares, tuple(misfits)

    def _contradictions(
        self, names: Sequence[str], values: Mapping[str, float], others: Mapping[str, float]
    ) -> Iterator[str]:
        """Yield how the values ``names`` depend on how far the measurements correct the twin."""
        for name in names:
            unit = self._problem.free[self._places[name]].unit
            yield f"{name} is {values[name]:.3g} {unit}, but {others[name]:.3g} {unit} where measurements correct less"

    def delays(self) -> Array:
        """Return by how much the signals are late (s) where that shows beside the values; zeros where it does not."""
        none = np.zeros(len(delayable(self._problem.base_model)))
        if self._last is None:
            return none
        stage, cost = self._last.stage, self._last.cost
        self._progress("delays of the signals")
        largest = min(largest_delay(window.grid.length, window.sample_period) for window in self._windows)
        _, result, together = self._fit(stage, MAX_STEPS, largest)
        late = together.delays(result.guess)
        is_shown = np.abs(late).max() < largest and self.gain(cost, together.cost(result)) > DECISIVE
        return late - np.median(late) if is_shown else none

    def gain(self, before: float, after: float) -> float:
        """Return by how much -2 log likelihood falls where the cost does; the level of the noise is free."""
        count = sum(int(np.count_nonzero(~window.missing)) for window in self._windows)
        return 2.0 * count * float(np.log(before / after)) if 0.0 < after < before else 0.0

    def _shared(self) -> dict[str, list[int]]:
        """Return the places of each parameter that is searched and the windows share."""
        shared = {
            name: [place]
            for name, place in self._places.items()
            if not ({name} & (self._loads | self._fixed.keys() | self._equal.keys()))
        }
        for name, other in self._equal.items():
            shared[other].append(self._places[name])
        return shared

    def _hold(self, weakest: Sequence[str], values: Mapping[str, float], sd: Mapping[str, float]) -> None:
        """Take one of the parameters that only together are determined as equal to another one, or as stated.

        A value that is determined beside it keeps the interval that it has before: held at a wrong value, it moves the
        others by as much as they were uncertain together. A single one that is certainly not as stated keeps its wider
        interval: held there, it would bias all others. How far it is off does not show beside others that are held.
        """
        parameters = self._problem.free
        for name in weakest:
            mine = parameters[self._places[name]]
            for other in (item for item in values if item not in weakest):
                is_determined = QUANTILE * sd[other] <= DETERMINED * abs(values[other])
                if is_determined and are_one_constant(mine, parameters[self._places[other]]):
                    self._equal[name] = other
                    return
        first, *others = weakest
        is_alone = not others and not self._fixed and first not in self._rough
        if is_alone and self._excludes_example(first, values[first], sd[first]):
            self._rough[first] = WIDER_INTERVAL * QUANTILE * sd[first] / DETERMINED
            return
        self._beside |= {
            name: max(own, self._beside.get(name, 0.0))
            for name, own in sd.items()
            if name != weakest[0] and QUANTILE * own <= DETERMINED * self._size(name, values[name])
        }
        remark = f"not determined beside {', '.join(others)}" if others else "the data do not show it"
        self._fixed[first] = remark
        for name in [name for name, other in self._equal.items() if other == first]:
            del self._equal[name]
            self._fixed[name] = remark

    def _fitted(self, shared: Mapping[str, Sequence[int]]) -> _Fitted:
        """Return what is reached through all stages with the ``shared`` parameters."""
        problem = replace(
            self._problem,
            known=(*self._problem.known, *((name, self._nominal(name)) for name in self._fixed)),
            free=tuple(row for row in self._problem.free if row.name not in self._fixed),
        )
        places = {row.name: at for at, row in enumerate(problem.free)}
        moved = {name: [places[self._problem.free[at].name] for at in ats] for name, ats in shared.items()}
        parameters = np.array([self._start.get(row.name, row.nominal) for row in problem.free])
        guesses: list[Array] = []
        noise, walk = self._levels()
        for share in LEVELS:
            self._progress(f"values of {len(shared)} parameters, stage {LEVELS.index(share) + 1} of {len(LEVELS) + 1}")
            staged = with_levels(problem, np.concatenate([noise, share * walk]))
            guesses, _, _ = self._fit(_Stage(staged, moved, parameters, guesses), ALONE_STEPS)
            parameters = guesses[0][: len(parameters)]
        self._progress(f"values of {len(shared)} parameters, last stage")
        there = replace(problem, free=tuple(
            replace(row, nominal=float(value)) for row, value in zip(problem.free, parameters, strict=True)
        ))  # fmt: skip
        there = with_initial_noise(there, self._windows)
        guesses, result, together = self._fit(_Stage(there, moved, parameters, guesses), MAX_STEPS)
        cost = together.cost(result)
        values = {name: float(guesses[0][ats[0]]) for name, ats in moved.items()}
        sizes = {name: self._size(name, value) for name, value in values.items()}
        sd, weakest = deviations(result, together, sizes, cost)
        restored = [self._whole(guess, problem) for guess in guesses]
        return _Fitted(values, sd, weakest, cost, restored, _Stage(there, moved, parameters, guesses))

    def _fit(self, stage: _Stage, steps: int, largest: float = 0.0) -> tuple[list[Array], FitResult, SharedFit]:
        """Fit all windows; the predictor is made around the guesses.

        Delays of the signals up to the ``largest`` (s) are fitted as well.
        """
        objectives, free = [], len(stage.parameters)
        for number, window in enumerate(self._windows):
            before = stage.guesses[number] if stage.guesses else None
            start = stage.parameters if before is None else before[:free]
            objectives.append(Objective(stage.problem, window, start, None if before is None else before[free:]))
        together = SharedFit(objectives, stage.shared, stage.problem, largest)
        begin = list(stage.guesses) or [self._first_guess(objective, stage) for objective in objectives]
        result = gauss_newton(together, together.joined(begin), steps)
        return together.split(result.guess), result, together

    def _first_guess(self, objective: Objective, stage: _Stage) -> Array:
        """Return the guess of a window from the parameters; of each phase of its own, the best one that is tried."""
        guess = objective.guess(stage.parameters)
        names = [parameter.name for parameter in stage.problem.free]
        for phase in (name for name in self._loads if name.startswith("_phase_")):
            trials = np.repeat(guess[None], PHASES, axis=0)
            trials[:, names.index(phase)] = 2.0 * np.pi * np.arange(PHASES) / PHASES - np.pi
            left = [float((objective.linearise(trial)[0] ** 2).sum()) for trial in trials]
            guess = trials[int(np.argmin(left))]
        return guess

    def _levels(self) -> tuple[Array, Array]:
        """Return the noise of the outputs, and per square root of a second that of states which walk as they move."""
        twin, period = self._problem.base_model, self._windows[0].sample_period
        noise = [sample_noise(output.name, self._windows) or output.noise for output in twin.outputs]
        noise = [
            level if np.isfinite(level) else output.noise for level, output in zip(noise, twin.outputs, strict=True)
        ]
        stated = self._problem.process_noise or (0.0,) * len(twin.states)
        outputs = {output.name for output in twin.outputs}
        walk = []
        for state, level in zip(twin.states, stated, strict=True):
            if state.name in outputs:
                steps = [np.diff(window.column(state.name)[~window.missing_in(state.name)]) for window in self._windows]
                walk.append(float(np.sqrt(np.mean(np.concatenate(steps) ** 2) / period)))
            else:
                walk.append(level)
        return np.array(noise), np.array(walk)

    def _whole(self, guess: Array, problem: Problem) -> Array:
        """Return the guess with the parameters that were held, at the places of all free ones."""
        values = {row.name: float(value) for row, value in zip(problem.free, guess, strict=False)}
        return np.array([values.get(row.name, row.nominal) for row in self._problem.free])

    def _excludes_example(self, name: str, value: float, sd: float) -> bool:
        """Whether the data show that a parameter does not have the value of the example, by whatever scale."""
        row = self._problem.free[self._places[name]]
        scale, far = SharedScale(row), SIGNIFICANT_DEVIATE * sd
        number = scale.inside(value)
        return abs(value - row.nominal) > far and abs(number - scale.inside(row.nominal)) > far / scale.slope(number)

    def _size(self, name: str, value: float) -> float:
        return max(size_of(self._problem.free[self._places[name]], value), self._rough.get(name, 0.0))

    def _nominal(self, name: str) -> float:
        return self._problem.free[self._places[name]].nominal

    def _responses(self, stage: _Stage) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
        """Return the values of the held parameters; and by how much a unit of each moves those that were fitted."""
        twin, count = stage.problem.base_model, len(stage.parameters)
        own = {row.name: row for row in twin.parameters if row.role is not Role.SETTING}
        held = {
            name: value
            for name, value in stage.problem.known
            if name in own and not (name in self._stated and is_count(own[name], value))
        }
        rows = [replace(own[name], nominal=value) for name, value in held.items()]
        known = tuple(pair for pair in stage.problem.known if pair[0] not in held)
        problem = replace(stage.problem, known=known, free=(*stage.problem.free, *rows))
        guesses = [np.concatenate([guess[:count], [*held.values()], guess[count:]]) for guess in stage.guesses]
        wider = count + len(held)
        shared = {**stage.shared, **{name: [count + at] for at, name in enumerate(held)}}
        together = SharedFit(
            [
                Objective(problem, window, guess[:wider], guess[wider:])
                for window, guess in zip(self._windows, guesses, strict=True)
            ],
            shared,
            problem,
        )
        names = list(stage.shared)
        moved = responses(together, together.joined(guesses), list(held), names)
        by_value = {
            name: {item: float(numbers[at]) for item, numbers in moved.items()} for at, name in enumerate(names)
        }
        return held, by_value

    def _values(
        self, values: Mapping[str, float], sd: Mapping[str, float], stage: _Stage | None
    ) -> tuple[OwnValue, ...]:
        """Return the rows of all parameters; ``stage`` has what the ``values`` were reached with."""
        held, moved = self._responses(stage) if stage else ({}, {})
        rows = dict[str, OwnValue]()
        for name, value in values.items():
            size, half = self._size(name, value), QUANTILE * sd[name]
            depends, wider = dependences(size, half, moved[name], held, self._stated)
            rows[name] = OwnValue(name, value, sd[name] + wider / QUANTILE, only_with=depends)
        for name, other in self._equal.items():
            rows[name] = replace(rows[other], name=name, remark=f"taken as equal to {other}", is_taken=True)
        for name, remark in self._fixed.items():
            rows[name] = OwnValue(name, self._nominal(name), None, remark)
        return tuple(rows[name] for name in self._places if name not in self._loads)


def are_one_constant(one: Parameter, other: Parameter) -> bool:
    """Whether a twin states one constant twice, as that of a motor by its voltage in V*s/rad and its torque in N*m/A.

    Both have the same example and bounds, in units of other quantities that are the same in SI. Two of one unit are two
    of a kind, as the frictions of two directions, and may differ.
    """
    numbers = [(row.nominal, row.low, row.high) for row in (one, other)]
    return numbers[0] == numbers[1] and is_one_in_si(one.unit, other.unit)
