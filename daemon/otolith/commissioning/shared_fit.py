"""Windows that are fitted together: some parameters are the same in all, others and the initial states are not."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from otolith.acquisition.window import Array
from otolith.estimation.information import QUANTILE
from otolith.estimation.minimisers import FitResult
from otolith.estimation.objective import Objective
from otolith.estimation.problem import Problem
from otolith.estimation.timing import delay_response, delayable
from otolith.twin.definition import Parameter

DETERMINED = 0.1  # share of a value that its 95 % interval may have, so that it is taken


@dataclass(frozen=True, slots=True, eq=False)
class SharedScale:
    """How a shared parameter is searched: by its logarithm if it is above zero."""

    parameter: Parameter

    @property
    def is_log(self) -> bool:
        """Whether the logarithm is searched."""
        return self.parameter.low > 0.0

    def inside(self, value: float) -> float:
        """Return the number that is searched."""
        return float(np.log(value)) if self.is_log else value

    def outside(self, number: float) -> float:
        """Return the value."""
        return float(np.exp(number)) if self.is_log else number

    def slope(self, number: float) -> float:
        """Return the derivative of the value by the number that is searched."""
        return float(np.exp(number)) if self.is_log else 1.0


class SharedFit:
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
        self.scales = [SharedScale(problem.free[places[0]]) for places in self._places]
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

    def cost(self, result: FitResult) -> float:
        """Return the root mean square of a fit's residuals; a record without a measurement has none."""
        return float(np.sqrt(result.chi_square / max(sum(float(each.count) for each in self._objectives), 1.0)))

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


def deviations(
    result: FitResult, together: SharedFit, sizes: Mapping[str, float], cost: float
) -> tuple[dict[str, float], list[str] | None]:
    """Return the deviation of each shared parameter; and those of the weakest direction, if one is not determined.

    ``sizes`` are those of the shared parameters, with which intervals are compared. The residuals are inflated by
    ``cost``. The one that the direction moves most comes first.
    """
    count = len(together.scales)
    slopes = np.array(
        [scale.slope(float(number)) for scale, number in zip(together.scales, result.guess, strict=False)]
    )
    lengths = np.array(list(sizes.values()))
    # Per share of a value, so that directions can be compared.
    jacobian = result.jacobian[:, :count] / slopes * lengths / max(cost, 1.0)
    own = result.jacobian[:, count:]
    scale = np.maximum(np.linalg.norm(own, axis=0), np.finfo(float).tiny)
    left = projected(own / scale, jacobian)
    normal = left.T @ left
    eigenvalues, directions = np.linalg.eigh(normal)
    variances = 1.0 / np.maximum(eigenvalues, 1e-12 * max(float(eigenvalues.max()), 1e-300))
    share = np.sqrt((directions**2) @ variances)
    sd = {name: float(own_share * size) for (name, size), own_share in zip(sizes.items(), share, strict=True)}
    if QUANTILE * share.max() <= DETERMINED:
        return sd, None
    weights = np.abs(directions[:, 0])
    names = list(sizes)
    order = np.argsort(-weights, kind="stable")
    return sd, [names[at] for at in order if weights[at] > 0.1 * weights.max()]


def projected(own: Array, columns: Array) -> Array:
    """Return what no combination of the columns ``own`` explains of ``columns``."""
    basis, sizes, _ = np.linalg.svd(own, full_matrices=False)
    basis = basis[:, sizes > 1e-9 * sizes.max(initial=0.0)]
    return np.asarray(columns - basis @ (basis.T @ columns))


def size_of(parameter: Parameter, value: float) -> float:
    """Return what an interval is compared with: the value; if it may be zero, also that of the ``parameter`` before."""
    return abs(value) if SharedScale(parameter).is_log else max(abs(value), abs(parameter.nominal))
