"""The values of a machine's parameters from a healthy record, where only those of the twin's example are known.

All windows are fitted together: parameters are the same in all, initial states and unknown loads are those of each
window. The example may be far from the machine. So the first fits let the measurements correct the twin at each record,
by process noise as large as the signals move: then the residuals are nearly linear in the parameters. The next ones
have less, until only what the signals show of it is left.

What the data determine only in combination is not guessed: a parameter that the weakest direction moves most keeps its
stated value, or is taken as equal to one that is the same constant in SI units, as the two constants of a DC motor are.
Then the others are fitted again.

A signal that is late biases the values. So delays of all signals are fitted with the values, and taken off the samples
where that makes the record decisively more likely.

A component that the twin lacks biases the values as well. Where the twin leaves more than noise, the components that
all windows show are fitted with the values. What remains enters the intervals: two fits, of which one trusts the twin
more, differ by it. Where they differ by more than a value may be uncertain, no value is taken.
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from otolith.acquisition.window import Window
from otolith.commissioning.consistency import WHITE_SIGNIFICANCE
from otolith.commissioning.constancy import ValueChange, value_changes
from otolith.commissioning.identification import identify_noise, sample_noise, usable_windows
from otolith.commissioning.likelihood import Progress
from otolith.commissioning.structure import Structure, remaining_structure
from otolith.commissioning.value_search import OwnValues, ValueSearch, are_one_constant
from otolith.estimation.evidence import DECISIVE
from otolith.estimation.problem import Problem, augment
from otolith.estimation.timing import delayable, shifted
from otolith.twin.definition import Definition, Parameter

# Values, units, origins and guarding tests: docs/reference/thresholds-commissioning.md.
WIDER = 1000.0  # times the example's values: how far a machine may be from it
REACH = 4.0  # times a value: bounds of an estimate while components are searched
FITTED_WINDOWS = 12  # in which the outputs move most
MAX_ROUNDS = 4  # of values and delays in turn
UNIT_FACTORS = {  # between two constants that are the same in SI units
    "rpm in place of rad/s": 30.0 / np.pi,
    "degrees in place of radians": 180.0 / np.pi,
    "turns in place of radians": 2.0 * np.pi,
    "thousandths of a unit": 1000.0,
}
FACTOR_TOLERANCE = 0.03  # of a factor


def widened(parameter: Parameter) -> Parameter:
    """Return a parameter with bounds for any machine of the kind."""
    low, high = parameter.low, parameter.high
    return replace(parameter, low=low / WIDER if low > 0.0 else WIDER * low, high=high * WIDER if high > 0.0 else high)


def own_values(  # noqa: PLR0913 - what is known beside the windows
    problem: Problem,
    windows: Sequence[Window],
    free: Sequence[Parameter],
    loads: Collection[str],
    progress: Progress,
    *,
    stated: Collection[str] = (),
) -> OwnValues:
    """Return the values of the ``free`` parameters; ``loads`` are those of them that windows do not share.

    Other parameters are as in ``problem``; those that are ``stated`` are of this machine, not of the twin's example.
    """
    usable = sorted(usable_windows(problem, windows), key=lambda window: -_movement(problem.base_model, window))
    chosen = sorted(usable[:FITTED_WINDOWS], key=lambda window: window.start)
    if faults := tuple(_at_rest(problem.base_model, windows)):
        return OwnValues((), {}, np.inf, len(chosen), faults=faults)
    if not chosen:
        return OwnValues((), {}, np.inf, 0)
    record = _RecordSearch(problem, tuple(free), frozenset(loads), progress, frozenset(stated))
    best, punctual = record.punctual(chosen)
    changes = record.changes(best, sorted(usable, key=lambda window: window.start)) if best.is_followed else ()
    if best.is_followed and not best.is_explained:
        best = record.beside_components(best, punctual)
    best = replace(best, changes=changes)
    if not best.is_explained and (signs := tuple(record.reversed_signals(best, punctual))):
        return replace(best, faults=signs)
    return replace(best, faults=(*best.faults, *_mixed_units(free, best)))


def _at_rest(twin: Definition, windows: Sequence[Window]) -> Iterator[str]:
    """Yield the outputs without which, or without a change of which, the data show no value."""
    for output in twin.outputs:
        measured = [window.column(output.name)[~window.missing_in(output.name)] for window in windows]
        values = np.concatenate(measured) if measured else np.zeros(0)
        if windows and not len(values):
            yield f"{output.name} has no value in any window"
        elif len(values) and np.ptp(values) == 0.0:
            yield f"{output.name} is {values[0]:.4g} {output.unit} in every record: it shows nothing"


def _mixed_units(free: Sequence[Parameter], found: OwnValues) -> Iterator[str]:
    """Yield the constants that are the same in SI units, but differ by the factor of a usual mistake."""
    rows, values = (
        {row.name: row for row in free},
        [own for own in found.values if own.sd is not None and not own.is_taken],
    )
    for at, one in enumerate(values):
        for other in values[at + 1 :]:
            if not are_one_constant(rows[one.name], rows[other.name]) or not one.value or not other.value:
                continue
            larger, smaller = sorted((one, other), key=lambda item: -abs(item.value))
            ratio = larger.value / smaller.value
            for mistake, factor in UNIT_FACTORS.items():
                if abs(ratio / factor - 1.0) < FACTOR_TOLERANCE:
                    yield f"{larger.name} is {ratio:.3g} times {smaller.name}, as with {mistake} in a signal"


@dataclass(frozen=True, slots=True, eq=False)
class _RecordSearch:
    """What is searched in the windows of a record."""

    problem: Problem
    free: tuple[Parameter, ...]
    loads: frozenset[str]
    progress: Progress
    stated: frozenset[str]

    def search(
        self, windows: Sequence[Window], problem: Problem | None = None, start: Mapping[str, float] | None = None
    ) -> ValueSearch:
        """Return a search of all free parameters, and of those of the components of a ``problem``.

        It begins at the values ``start``, else at those of the twin's example.
        """
        base, added = problem or self.problem, problem.free if problem else ()
        rows = (*self.free, *(row for row in added if row.name.startswith("_")))
        names = {row.name for row in rows}
        known = [pair for pair in base.known if pair[0] not in names]
        known += [(row.name, row.nominal) for row in base.free if row.name not in names]
        wide = tuple(row if row.name.startswith("_") else widened(row) for row in rows)
        phases = {row.name for row in rows if row.name.startswith("_phase_")}
        searched = replace(base, known=tuple(known), free=wide, open_loop=False)
        return ValueSearch(searched, windows, self.loads | phases, self.progress, start, stated=self.stated)

    def punctual(self, windows: Sequence[Window]) -> tuple[OwnValues, list[Window]]:
        """Return the values, and the windows without the delays that show beside them."""
        twin = self.problem.base_model
        late, best_windows = np.zeros(len(delayable(twin))), list(windows)
        search = self.search(best_windows)
        best = search.run()
        for _ in range(MAX_ROUNDS if best.is_followed else 0):  # a late signal biases the values, and they the delays
            more = search.delays()
            if not more.any():
                break
            late += more
            given = dict(zip(delayable(twin), late.tolist(), strict=True))
            moved = sorted((shifted(twin, window, given) for window in windows), key=lambda window: window.start)
            search = self.search(moved)
            without_delays = search.run()
            if search.gain(best.cost, without_delays.cost) <= DECISIVE:
                break
            best, best_windows = without_delays, moved
        return best, best_windows

    def reversed_signals(self, best: OwnValues, windows: Sequence[Window]) -> Iterator[str]:
        """Yield the signals with whose other sign the twin explains the windows better.

        The windows are compared in pairs (Q. H. Vuong, Econometrica 57, 1989), so that coloured residuals, which are
        alike in a window, do not decide.
        """
        twin = self.problem.base_model
        for name in (*(row.name for row in twin.inputs), *(row.name for row in twin.outputs)):
            self.progress(f"values with the other sign of {name}")
            other = self.search([_negated(window, name) for window in windows]).run()
            are_followed = best.is_followed and other.is_followed
            if other.is_explained or (are_followed and _is_better(other.misfits, best.misfits)):
                yield f"the twin explains the data with the other sign of {name}"

    def beside_components(self, best: OwnValues, windows: Sequence[Window]) -> OwnValues:
        """Return the values, fitted with the components that all windows show, as far as these explain more."""
        self.progress("components that the twin lacks")
        there = self._at(best)
        noise = identify_noise(there, windows, self.progress)
        shown = [item for item in remaining_structure(there, noise, windows, self.progress) if not item.is_at_bound]
        for count in range(1, len(shown) + 1):
            wider = self._with_components(there, shown[:count], best, windows)
            if not wider.is_followed or wider.quiet_cost >= best.quiet_cost:
                break
            best = wider
            if best.is_explained:
                break
        return best

    def _with_components(
        self, there: Problem, shown: Sequence[Structure], best: OwnValues, windows: Sequence[Window]
    ) -> OwnValues:
        """Return the values beside components, whose amplitudes and inner parameters are the same in all windows."""
        wider = augment(there, [item.component for item in shown])
        found = self.search(windows, wider, {item.name: item.value for item in best.values}).run()
        own = tuple(item for item in found.values if not item.name.startswith("_"))
        loads = {name: ends for name, ends in found.loads.items() if not name.startswith("_")}
        return replace(found, values=own, loads=loads, beside=tuple(item.component.key for item in shown))

    def changes(self, found: OwnValues, windows: Sequence[Window]) -> tuple[ValueChange, ...]:
        """Return which of the values differ between both ends of the record, as each window shows them alone."""
        self.progress("whether the values are the same in all windows")
        values = {item.name: item.value for item in found.values}
        names = [item.name for item in found.values if item.sd is not None and not item.is_taken]
        rows = tuple(_around(row, values) for row in self.free if row.name in names or row.name in self.loads)
        taken = {row.name for row in rows}
        known = {**dict(self.problem.known), **{row.name: row.nominal for row in self.problem.free}, **values}
        held = tuple((name, value) for name, value in known.items() if name not in taken)
        return value_changes(replace(self.problem, known=held, free=rows), windows, names)

    def _at(self, found: OwnValues) -> Problem:
        """Return the problem with the values that were found."""
        values = {item.name: item.value for item in found.values}
        known = tuple((name, values.get(name, value)) for name, value in self.problem.known)
        return replace(self.problem, known=known, free=tuple(_around(row, values) for row in self.problem.free))


def _around(row: Parameter, values: Mapping[str, float]) -> Parameter:
    """Return a parameter at its value, with bounds around it."""
    if row.name not in values:
        return row
    value = values[row.name]
    if row.low > 0.0:
        return replace(row, nominal=value, low=value / REACH, high=REACH * value)
    return replace(row, nominal=value, low=min(row.low, REACH * value), high=max(row.high, REACH * value))


def _negated(window: Window, signal: str) -> Window:
    values = window.values.copy()
    values[:, window.signals.index(signal)] *= -1.0
    return replace(window, values=values)


def _is_better(misfits: Sequence[float], others: Sequence[float]) -> bool:
    """Whether windows have less misfit than with other values, by Student's t test of the logarithms' differences."""
    from scipy.special import stdtr  # noqa: PLC0415 - only commissioning needs SciPy

    gains = np.log(others) - np.log(misfits)
    if len(gains) < 2 or gains.mean() <= 0.0:
        return False
    deviation = float(gains.std(ddof=1) / np.sqrt(len(gains)))
    return deviation == 0.0 or bool(stdtr(len(gains) - 1.0, -gains.mean() / deviation) < WHITE_SIGNIFICANCE)


def _movement(twin: Definition, window: Window) -> float:
    """Return how much the outputs move in a window, in units of their changes from sample to sample."""
    total = 0.0
    for output in twin.outputs:
        values = window.column(output.name)[~window.missing_in(output.name)]
        noise = sample_noise(output.name, [window]) or output.noise
        total += min(float(np.ptp(values)) / noise, 1e4) if len(values) and noise > 0.0 else 0.0
    return total
