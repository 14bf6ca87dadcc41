"""The table of alternatives: what is particular to each type of hypothesis, a row for each.

How a person reads it, where a person would inspect, what a further window changes, and how many windows must agree with
which probability until which decision follows. Search, sequential test, decision and report read the table.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum, StrEnum

import numpy as np

from otolith.discovery.hypotheses import FaultType, TrackedHypothesis, delay_score
from otolith.estimation.evidence import CERTAIN_DEVIATE
from otolith.estimation.information import QUANTILE
from otolith.estimation.problem import Problem, equation, indices, site_of
from otolith.estimation.timing import largest_delay
from otolith.estimation.window_fit import Fit
from otolith_drivers.units import equation_text, unit_text

AGREEING_WINDOWS, PROBABLE = 2, 0.8  # windows that must agree on a cause, and its probability
COMPONENT_WINDOWS, COMPONENT_PROBABILITY = 3, 0.95  # the same of a component, which stays in the twin
MAX_DELAY_SDS = 100  # windows whose delays count for the parameters
MS = 1e3  # ms in a second
CHANGING, POLLED = "{} changes between its samples", 'write times = "polled" under [signals] {}'


class WindowDecision(StrEnum):
    """What a window led to."""

    LEARNED = "learned"
    SUSPECTED = "it contradicts the prediction: a sudden change or a wrong window; further windows decide"
    STEPPED = "two windows agree on a sudden change"
    DISCOVERED = "several windows agree on a new component"
    FADED = "a component is no longer there"
    NOISIER = "several windows agree that a signal is less certain than stated"
    AMBIGUOUS = "several hypotheses explain the windows equally well: what they agree on is estimated"
    SENSOR = "a sensor is wrong: its error does not count as a change of a parameter"
    TIMING = "a signal is late: its delay does not count as a change of a parameter"
    BAD = "the window is not good enough: it does not update the estimates"
    OFF = "the equations of the twin do not hold in this state of the machine: it does not update the estimates"
    REFUSED = "nothing explains the window, neither parameters nor components: it does not update the estimates"

    @property
    def in_words(self) -> str:
        """What a person reads; the value is what programs read."""
        return IN_WORDS.get(self, self.value)


IN_WORDS = {
    WindowDecision.SUSPECTED: (
        "this window differs from the prediction: it may be a sudden change or an outlier, and the next windows decide"
    ),
    WindowDecision.STEPPED: "two windows show the same sudden change",
    WindowDecision.DISCOVERED: "several windows show the same new component",
    WindowDecision.NOISIER: "several windows show other noise than is stated",
    WindowDecision.AMBIGUOUS: (
        "several hypotheses explain the windows equally well: estimated is what they have in common"
    ),
}
"""What people read where the value, which programs read, has to be read twice."""


class PosteriorUpdate(Enum):
    """How a window changes the posterior."""

    NONE = "the posterior of the window before stays"
    FILTER = "the filter is updated with the window"
    HYPOTHESIS = "the posterior of the accepted hypothesis replaces the filter's"


UPDATES = dict.fromkeys(WindowDecision, PosteriorUpdate.NONE) | {
    WindowDecision.LEARNED: PosteriorUpdate.FILTER,
    WindowDecision.STEPPED: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.DISCOVERED: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.FADED: PosteriorUpdate.HYPOTHESIS,
    WindowDecision.NOISIER: PosteriorUpdate.HYPOTHESIS,
}
ACCEPTED = frozenset(decision for decision, update in UPDATES.items() if update is not PosteriorUpdate.NONE)


@dataclass(frozen=True, slots=True)
class AlternativeRow:
    """What is particular to one type of hypothesis."""

    describe: Callable[[TrackedHypothesis], str]  # What it states, with its values
    places: Callable[[TrackedHypothesis], tuple[str, ...]]
    """What a person would inspect; hypotheses of a type about the same place are variants of one cause."""
    decision: WindowDecision  # What follows if enough windows agree on it
    windows: int = AGREEING_WINDOWS  # In a row with the same best hypothesis, that must agree
    windows_while_young: int = 0
    """The same at least while few windows have updated the filter: sensors are then as little known as components."""
    probability: float = PROBABLE  # That all hypotheses of the type must have together
    is_of_data: bool = False  # Whether data are wrong, not the machine; it need not be the best
    names_components: bool = False  # Whether its name is the keys of its components
    is_always_tracked: bool = False  # However improbable it is
    after_window: Callable[[TrackedHypothesis, Fit], TrackedHypothesis | None] = lambda tracked, _: tracked
    """What a further window changes of it beside its posterior; None if the window contradicts it."""


def describe_hypothesis(tracked: TrackedHypothesis) -> str:
    """Return what the hypothesis states, with its values."""
    return ALTERNATIVES[tracked.type].describe(tracked)


def _states_names(tracked: TrackedHypothesis) -> str:
    return tracked.hypothesis.name or str(tracked.type)


def _states_components(tracked: TrackedHypothesis) -> str:
    problem, values = tracked.problem, tracked.posterior.prior().mean
    rows = [(item, values[indices(problem, slot)].tolist()) for slot, item in enumerate(problem.components)]
    return "; ".join(f"{item.site}: {equation_text(equation(problem.base_model, item, own))}" for item, own in rows)


def _states_sensor_error(tracked: TrackedHypothesis) -> str:
    problem, twin, slot = tracked.problem, tracked.problem.base_model, len(tracked.problem.components) - 1
    if slot < 0:
        return ""
    component, values = problem.components[slot], tracked.posterior.prior().mean[indices(problem, slot)].tolist()
    site, error = site_of(twin, component.site), values[0]
    if component.periodic:
        off = equation_text(equation(twin, component, values))
    else:
        off = f"{error:+.1%}" if component.family == "linear" else f"{error:+.2g} {unit_text(site.unit)}".rstrip()
    return f"{site.into} reads wrong by {off}: check the sensor and its scale"


def _states_delay(tracked: TrackedHypothesis) -> str:
    ((signal, delay),) = tracked.problem.delays
    value, low, high = _delay_numbers(tracked)
    return f"{signal} is {value} {'ms late' if delay > 0.0 else 'ms early'} ({low} to {high})"


def _states_noise(tracked: TrackedHypothesis) -> str:
    return describe_noise(tracked.problem)


def describe_noise(problem: Problem) -> str:
    """Return which levels of noise are not as stated, and which commands change between their samples."""
    return "; ".join([*describe_levels(problem), *map(CHANGING.format, problem.changing)])


def is_noisier_than_stated(problem: Problem) -> bool:
    """Whether the noise of something is larger than the machine file states; stating none is no statement."""
    return any(noise > stated > 0.0 for noise, stated in zip(problem.levels, problem.stated_levels, strict=True))


def describe_levels(problem: Problem) -> list[str]:
    """Return a text for each input, output and state whose noise is not as stated, with both levels."""
    twin = problem.base_model
    units = {name: "" if unit == "1" else f" {unit_text(unit)}" for name, unit in twin.units().items()}
    rows = [(f"{own} is less noisy than stated", f"{own} is noisier than stated", units[own]) for own in twin.signals]
    rows += [
        (f"{name} is disturbed less than stated", f"{name} is disturbed more than stated", f"{units[name]}/√s")
        for name in (state.name for state in twin.states)
    ]
    return [
        f"{more if noise > stated else less}: {noise:.2g}{unit} instead of {stated:.2g}"
        for (less, more, unit), noise, stated in zip(rows, problem.levels, problem.stated_levels, strict=True)
        if noise != stated
    ]


def _delay_numbers(tracked: TrackedHypothesis) -> tuple[str, str, str]:
    """Return the size of a delay and the ends of its 95 % interval, ms."""
    ((_, delay),) = tracked.problem.delays
    reach = QUANTILE / np.sqrt(tracked.delay_information) if tracked.delay_information > 0.0 else np.inf
    digits, size = max(0, int(np.ceil(-np.log10(MS * reach)))) if 0.0 < reach < np.inf else 1, abs(delay)
    value, low, high = (f"{MS * number:.{digits}f}" for number in (size, size - reach, size + reach))
    return value, low, high


def describe_setting(tracked: TrackedHypothesis) -> str:
    """Return the delay of a late or early signal, as it is written into the machine file; empty without one."""
    if not tracked.problem.delays:
        return ""
    ((signal, delay),) = tracked.problem.delays
    place = f"[signals] {signal}" if delay > 0.0 else f"every other signal in [signals], as {signal} is the first"
    return f'write delay = "{_delay_numbers(tracked)[0]} ms" under {place}'


def _names(tracked: TrackedHypothesis) -> tuple[str, ...]:
    return (tracked.hypothesis.name,)


def _sites(tracked: TrackedHypothesis) -> tuple[str, ...]:
    own = [item.site for item in tracked.problem.components]
    return (*own, *(signal for signal, _ in tracked.problem.delays))


def _read_signals(tracked: TrackedHypothesis) -> tuple[str, ...]:
    return tuple(site_of(tracked.problem.base_model, item.site).into for item in tracked.problem.components)


def _with_delay(tracked: TrackedHypothesis, fitted: Fit) -> TrackedHypothesis | None:
    """Return the hypothesis with what the window of ``fitted`` adds to the estimate of its delay.

    None if the window contradicts the delay, or if it may be zero, is beyond those that are searched, or has changed
    its sign: that another signal is late is another statement.
    """
    ((signal, delay),) = tracked.problem.delays
    own = delay_score(fitted, signal)
    before = tracked.delay_information
    information = before + own.information
    if not information > 0.0 or own.step**2 * before * own.information > CERTAIN_DEVIATE**2 * information:
        return None
    moved = delay + own.information * own.step / information
    limit = largest_delay(fitted.window.grid.length, fitted.window.sample_period)
    if not QUANTILE / np.sqrt(information) < moved * np.sign(delay) <= limit:
        return None
    problem = replace(tracked.problem, delays=((signal, moved),))
    posterior = replace(tracked.posterior.moved((moved - delay) * np.array(own.shift)), problem=problem)
    sds = (*tracked.delay_sds, (before or own.information) ** -0.5)[-MAX_DELAY_SDS:]
    return replace(
        tracked,
        posterior=posterior,
        delay_information=information,
        delay_sds=sds,
        shift_by_delay=tuple(zip((free.label for free in problem.free), own.shift, strict=False)),
    )


ALTERNATIVES: Mapping[FaultType, AlternativeRow] = {
    FaultType.NOTHING: AlternativeRow(_states_names, _sites, WindowDecision.LEARNED, is_always_tracked=True),
    FaultType.NOISE: AlternativeRow(_states_noise, _sites, WindowDecision.NOISIER),
    FaultType.PARAMETER: AlternativeRow(_states_names, _names, WindowDecision.STEPPED, is_always_tracked=True),
    FaultType.SENSOR: AlternativeRow(
        _states_sensor_error,
        _read_signals,
        WindowDecision.SENSOR,
        windows=0,
        windows_while_young=COMPONENT_WINDOWS,
        is_of_data=True,
        names_components=True,
    ),
    FaultType.TIMING: AlternativeRow(
        _states_delay, _sites, WindowDecision.TIMING, is_of_data=True, after_window=_with_delay
    ),
    FaultType.COMPONENT: AlternativeRow(
        _states_components,
        _sites,
        WindowDecision.DISCOVERED,
        windows=COMPONENT_WINDOWS,
        probability=COMPONENT_PROBABILITY,
        names_components=True,
    ),
}
"""In the order in which they are decided."""
NO_EVIDENCE = frozenset({WindowDecision.BAD, WindowDecision.OFF})  # Of windows that are evidence of nothing
DATA_FAULTS = frozenset(row.decision for row in ALTERNATIVES.values() if row.is_of_data)
"""Decisions that data are wrong."""
