"""The values of a machine's parameters from a healthy record, where only those of the twin's example are known.

All windows are fitted together: parameters are the same in all, initial states and unknown loads are those of each
window. The example may be far from the machine. So the first fits let the measurements correct the twin at each record,
by process noise as large as the signals move: then the residuals are nearly linear in the parameters. The next ones
have less, until only what the signals show of it is left.

What the data determine only in combination is not guessed: a parameter that the weakest direction moves most keeps its
stated value, or is taken as equal to one that the twin's example has with the same value, bounds and dimension, as the
two constants of a DC motor are. Then the others are fitted again.

A signal that is late biases the values. So delays of all signals are fitted with the values, and taken off the samples
where that makes the record decisively more likely.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Array, Window
from otolith.commissioning.identification import sample_noise, usable_windows, with_initial_noise
from otolith.commissioning.likelihood import Progress, with_levels
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.information import QUANTILE
from otolith.estimation.minimisers import FitResult, gauss_newton
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.timing import delay_response, delayable, largest_delay, shifted
from otolith.twin.definition import Definition, Parameter
from otolith_drivers.units import to_base

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
WIDER = 1000.0  # times the example's values: how far a machine may be from it
FITTED_WINDOWS = 12  # in which the outputs move most
STAGES = (1.0, 0.1, 0.01)  # of the process noise with which the signals would be a random walk
MAX_ROUNDS = 4  # of values and delays in turn
STAGE_STEPS, LAST_STEPS = 12, 40  # of Gauss-Newton
DETERMINED = 0.1  # share of a value that its 95 % interval may have, so that it is taken
FOLLOWED = 30.0  # cost up to which the twin describes the machine; the noise of a fit with less is not known yet


@dataclass(frozen=True, slots=True)
class OwnValue:
    """A parameter of the machine."""

    name: str
    value: float  # In the unit of the twin
    sd: float | None = None  # None if it is not determined
    remark: str = ""  # Why it is not determined, or what it is taken from
    is_taken: bool = False  # Whether it is taken from another parameter


@dataclass(frozen=True, slots=True)
class OwnValues:
    """What a record shows of the parameters that were free."""

    values: tuple[OwnValue, ...]
    loads: Mapping[str, tuple[float, float]]  # Smallest and largest value of each unknown that windows do not share
    cost: float  # Root mean square of the residuals in units of the noise
    windows: int

    @property
    def is_followed(self) -> bool:
        """Whether the twin describes the machine with these values."""
        return self.windows > 0 and self.cost <= FOLLOWED


def widened(parameter: Parameter) -> Parameter:
    """Return a parameter with bounds for any machine of the kind."""
    low, high = parameter.low, parameter.high
    return replace(parameter, low=low / WIDER if low > 0.0 else WIDER * low, high=high * WIDER if high > 0.0 else high)


def own_values(
    problem: Problem, windows: Sequence[Window], free: Sequence[Parameter], loads: Collection[str], progress: Progress
) -> OwnValues:
    """Return the values of the ``free`` parameters; ``loads`` are those of them that windows do not share.

    Other parameters are as in ``problem``.
    """
    names = {parameter.name for parameter in free}
    known = [pair for pair in problem.known if pair[0] not in names]
    known += [(parameter.name, parameter.nominal) for parameter in problem.free if parameter.name not in names]
    wide = replace(problem, known=tuple(known), free=tuple(map(widened, free)), open_loop=False)
    usable = sorted(usable_windows(problem, windows), key=lambda window: -_movement(problem.base_model, window))
    chosen = usable[:FITTED_WINDOWS]
    if not chosen:
        return OwnValues((), {}, np.inf, 0)
    late = np.zeros(len(delayable(wide.base_model)))
    search = _ValueSearch(wide, sorted(chosen, key=lambda window: window.start), frozenset(loads), progress)
    best = search.run()
    for _ in range(MAX_ROUNDS if best.is_followed else 0):  # a late signal biases the values, and they the delays
        more = search.delays()
        if not more.any():
            break
        late += more
        given = dict(zip(delayable(wide.base_model), late.tolist(), strict=True))
        moved = [shifted(wide.twin, window, given) for window in chosen]
        search = _ValueSearch(wide, sorted(moved, key=lambda window: window.start), frozenset(loads), progress)
        found = search.run()
        if search.gain(best.cost, found.cost) <= DECISIVE:
            break
        best = found
    return best


def _movement(twin: Definition, window: Window) -> float:
    """Return how much the outputs move in a window, in units of their changes from sample to sample."""
    total = 0.0
    for output in twin.outputs:
        values = window.column(output.name)[~window.missing_in(output.name)]
        noise = sample_noise(output.name, [window]) or output.noise
        total += min(float(np.ptp(values)) / noise, 1e4) if len(values) and noise > 0.0 else 0.0
    return total


@dataclass(frozen=True, slots=True, eq=False)
class _Scale:
    """How a shared parameter is searched: by its logarithm if it is above zero."""

    parameter: Parameter

    @property
    def is_log(self) -> bool:
        return self.parameter.low > 0.0

    def inside(self, value: float) -> float:
        return float(np.log(value)) if self.is_log else value

    def outside(self, number: float) -> float:
        return float(np.exp(number)) if self.is_log else number

    def slope(self, number: float) -> float:
        """Return the derivative of the value by the number that is searched."""
        return float(np.exp(number)) if self.is_log else 1.0


class _Together:
    """Residuals of all windows by shared parameters, then by what each window has of its own, then by delays."""

    def __init__(
        self,
        objectives: Sequence[Objective],
        shared: Mapping[str, Sequence[int]],
        problem: Problem,
        largest_delay: float = 0.0,
    ) -> None:
        """``shared`` has the places of each searched parameter among the free ones: two if one is equal to it.

        Delays of the signals up to ``largest_delay`` (s) are fitted as well; that is also their standard deviation, as
        only their differences show. Without it there are none.
        """
        self._objectives, self._places = objectives, [list(places) for places in shared.values()]
        self.scales = [_Scale(problem.free[places[0]]) for places in self._places]
        taken = {place for places in self._places for place in places}
        width = len(objectives[0].low)
        self._own = [place for place in range(width) if place not in taken]
        low = [scale.inside(scale.parameter.low) for scale in self.scales]
        high = [scale.inside(scale.parameter.high) for scale in self.scales]
        self._limits = np.full(len(delayable(problem.base_model)) if largest_delay else 0, largest_delay)
        self.low = np.concatenate([low, *(objective.low[self._own] for objective in objectives), -self._limits])
        self.high = np.concatenate([high, *(objective.high[self._own] for objective in objectives), self._limits])

    def joined(self, guesses: Sequence[Array]) -> Array:
        """Return the common guess of guesses of the windows, whose shared values are those of the first."""
        first = [
            scale.inside(float(guesses[0][places[0]])) for scale, places in zip(self.scales, self._places, strict=True)
        ]
        return np.concatenate([first, *(guess[self._own] for guess in guesses), np.zeros(len(self._limits))])

    def delays(self, guess: Array) -> Array:
        """Return those of the signals, s, as outputs and then inputs."""
        return guess[len(guess) - len(self._limits) :]

    def split(self, guess: Array) -> list[Array]:
        """Return the guess of each window."""
        count, guesses = len(self.scales), []
        values = [scale.outside(float(number)) for scale, number in zip(self.scales, guess, strict=False)]
        for number, objective in enumerate(self._objectives):
            own = np.empty(len(objective.low))
            for places, value in zip(self._places, values, strict=True):
                own[places] = value
            begin = count + number * len(self._own)
            own[self._own] = guess[begin : begin + len(self._own)]
            guesses.append(own)
        return guesses

    def linearise(self, guess: Array) -> tuple[Array, Array]:
        """See :class:`otolith.estimation.minimisers.LeastSquares`."""
        count, residuals, rows, delays = len(self.scales), list[Array](), list[Array](), self.delays(guess)
        slopes = [scale.slope(float(number)) for scale, number in zip(self.scales, guess, strict=False)]
        for number, (objective, own) in enumerate(zip(self._objectives, self.split(guess), strict=True)):
            errors, jacobian = objective.linearise(own)
            whole = np.zeros((len(errors), len(guess)))
            for column, (places, slope) in enumerate(zip(self._places, slopes, strict=True)):
                whole[:, column] = slope * jacobian[:, places].sum(axis=1)
            begin = count + number * len(self._own)
            whole[:, begin : begin + len(self._own)] = jacobian[:, self._own]
            if len(delays):
                whole[:, len(guess) - len(delays) :] = response = delay_response(objective, own)
                errors = errors + response @ delays
            residuals.append(errors)
            rows.append(whole)
        if len(delays):
            residuals.append(delays / self._limits)
            rows.append(np.hstack([np.zeros((len(delays), len(guess) - len(delays))), np.diag(1.0 / self._limits)]))
        return np.concatenate(residuals), np.concatenate(rows)


@dataclass(frozen=True, slots=True, eq=False)
class _Stage:
    """What all windows are fitted with, and where the fit begins."""

    problem: Problem
    shared: Mapping[str, Sequence[int]]  # See _Together
    parameters: Array  # (free,)
    guesses: Sequence[Array]  # Of the windows; none before the first stage


class _ValueSearch:
    def __init__(self, problem: Problem, windows: Sequence[Window], loads: frozenset[str], progress: Progress) -> None:
        self._problem, self._windows, self._loads, self._progress = problem, windows, loads, progress
        self._places = {parameter.name: at for at, parameter in enumerate(problem.free)}
        self._fixed: dict[str, str] = {}  # Not determined, and why
        self._equal: dict[str, str] = {}  # Taken as equal to another one
        self._last: tuple[_Stage, float] | None = None  # with its cost

    def run(self) -> OwnValues:
        """Fit, and hold what is not determined, until all others are."""
        while True:
            shared = self._shared()
            if not shared:
                return OwnValues(self._values({}, {}), {}, np.inf, len(self._windows))
            values, sd, weakest, cost, guesses = self._fitted(shared)
            if weakest is None:
                break
            self._hold(weakest, values, sd)
        loads = {
            name: (min(own), max(own))
            for name in self._loads & self._places.keys()
            if (own := [float(guess[self._places[name]]) for guess in guesses])
        }
        return OwnValues(self._values(values, sd), loads, cost, len(self._windows))

    def delays(self) -> Array:
        """Return by how much the signals are late (s) where that shows beside the values; zeros where it does not."""
        none = np.zeros(len(delayable(self._problem.base_model)))
        if self._last is None:
            return none
        stage, cost = self._last
        self._progress("delays of the signals")
        largest = min(largest_delay(window.grid.length, window.sample_period) for window in self._windows)
        _, result, together = self._fit(stage, LAST_STEPS, largest)
        late = together.delays(result.guess)
        is_shown = np.abs(late).max() < largest and self.gain(cost, _cost(result)) > DECISIVE
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
        """Take one of the parameters that only together are determined as equal to another one, or as stated."""
        parameters = self._problem.free
        for name in weakest:
            mine = parameters[self._places[name]]
            for other in (item for item in values if item not in weakest):
                is_determined = QUANTILE * sd[other] <= DETERMINED * abs(values[other])
                if is_determined and _are_alike(mine, parameters[self._places[other]]):
                    self._equal[name] = other
                    return
        first, *others = weakest
        remark = f"not determined beside {', '.join(others)}" if others else "the data do not show it"
        self._fixed[first] = remark
        for name in [name for name, other in self._equal.items() if other == first]:
            del self._equal[name]
            self._fixed[name] = remark

    def _fitted(
        self, shared: Mapping[str, Sequence[int]]
    ) -> tuple[dict[str, float], dict[str, float], list[str] | None, float, list[Array]]:
        """Return values, deviations, the parameters of the weakest direction if it is not determined, cost, guesses."""
        problem = replace(
            self._problem,
            known=(*self._problem.known, *((name, self._nominal(name)) for name in self._fixed)),
            free=tuple(row for row in self._problem.free if row.name not in self._fixed),
        )
        places = {row.name: at for at, row in enumerate(problem.free)}
        moved = {name: [places[self._problem.free[at].name] for at in ats] for name, ats in shared.items()}
        parameters = np.array([row.nominal for row in problem.free])
        guesses: list[Array] = []
        noise, walk = self._levels()
        for share in STAGES:
            self._progress(f"values of {len(shared)} parameters, stage {STAGES.index(share) + 1} of {len(STAGES) + 1}")
            staged = with_levels(problem, np.concatenate([noise, share * walk]))
            guesses, _, _ = self._fit(_Stage(staged, moved, parameters, guesses), STAGE_STEPS)
            parameters = guesses[0][: len(parameters)]
        self._progress(f"values of {len(shared)} parameters, last stage")
        there = replace(problem, free=tuple(
            replace(row, nominal=float(value)) for row, value in zip(problem.free, parameters, strict=True)
        ))  # fmt: skip
        there = with_initial_noise(there, self._windows)
        guesses, result, together = self._fit(_Stage(there, moved, parameters, guesses), LAST_STEPS)
        cost = _cost(result)
        self._last = _Stage(there, moved, parameters, guesses), cost
        values = {name: float(guesses[0][ats[0]]) for name, ats in moved.items()}
        sd, weakest = _deviations(result, together, values, cost)
        restored = [self._whole(guess, problem) for guess in guesses]
        return values, sd, weakest, cost, restored

    def _fit(self, stage: _Stage, steps: int, largest: float = 0.0) -> tuple[list[Array], FitResult, _Together]:
        """Fit all windows; the predictor is made around the guesses.

        Delays of the signals up to the ``largest`` (s) are fitted as well.
        """
        objectives, free = [], len(stage.parameters)
        for number, window in enumerate(self._windows):
            before = stage.guesses[number] if stage.guesses else None
            start = stage.parameters if before is None else before[:free]
            objectives.append(Objective(stage.problem, window, start, None if before is None else before[free:]))
        together = _Together(objectives, stage.shared, stage.problem, largest)
        begin = list(stage.guesses) or [objective.guess(stage.parameters) for objective in objectives]
        result = gauss_newton(together, together.joined(begin), steps)
        return together.split(result.guess), result, together

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

    def _nominal(self, name: str) -> float:
        return self._problem.free[self._places[name]].nominal

    def _values(self, values: Mapping[str, float], sd: Mapping[str, float]) -> tuple[OwnValue, ...]:
        rows = []
        for name in self._places:
            if name in self._loads:
                continue
            if name in self._equal:
                other = self._equal[name]
                rows.append(OwnValue(name, values[other], None, f"taken as equal to {other}", is_taken=True))
            elif name in self._fixed:
                rows.append(OwnValue(name, self._nominal(name), None, self._fixed[name]))
            else:
                rows.append(OwnValue(name, values[name], sd[name]))
        return tuple(rows)


def _cost(result: FitResult) -> float:
    return float(np.sqrt(result.chi_square / max(len(result.residuals), 1)))


def _are_alike(one: Parameter, other: Parameter) -> bool:
    """Whether the example of the twin has both with the same value, bounds and dimension."""
    numbers = [(row.nominal, row.low, row.high) for row in (one, other)]
    return numbers[0] == numbers[1] and to_base(one.unit) == to_base(other.unit)


def _deviations(
    result: FitResult, together: _Together, values: Mapping[str, float], cost: float
) -> tuple[dict[str, float], list[str] | None]:
    """Return the deviation of each shared parameter; and those of the weakest direction, if one is not determined.

    The residuals are inflated by ``cost``. The one that the direction moves most comes first.
    """
    count = len(together.scales)
    slopes = np.array(
        [scale.slope(float(number)) for scale, number in zip(together.scales, result.guess, strict=False)]
    )
    sizes = np.array([_size(scale, value) for scale, value in zip(together.scales, values.values(), strict=True)])
    # Per share of a value, so that directions can be compared.
    jacobian = result.jacobian[:, :count] / slopes * sizes / max(cost, 1.0)
    own = result.jacobian[:, count:]
    scale = np.maximum(np.linalg.norm(own, axis=0), np.finfo(float).tiny)
    left = _projected(own / scale, jacobian)
    normal = left.T @ left
    eigenvalues, directions = np.linalg.eigh(normal)
    variances = 1.0 / np.maximum(eigenvalues, 1e-12 * max(float(eigenvalues.max()), 1e-300))
    share = np.sqrt((directions**2) @ variances)
    sd = {name: float(own_share * size) for name, own_share, size in zip(values, share, sizes, strict=True)}
    if QUANTILE * share.max() <= DETERMINED:
        return sd, None
    weights = np.abs(directions[:, 0])
    names = list(values)
    order = np.argsort(-weights, kind="stable")
    return sd, [names[at] for at in order if weights[at] > 0.1 * weights.max()]


def _projected(own: Array, columns: Array) -> Array:
    """Return what no combination of the columns ``own`` explains of ``columns``."""
    basis, sizes, _ = np.linalg.svd(own, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes.max(initial=0.0)]
    return np.asarray(columns - basis @ (basis.T @ columns))


def _size(scale: _Scale, value: float) -> float:
    """Return what an interval is compared with: the value; if it may be zero, also the example's."""
    return abs(value) if scale.is_log else max(abs(value), abs(scale.parameter.nominal))
