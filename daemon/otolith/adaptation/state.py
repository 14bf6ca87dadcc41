"""The state that is carried from window to window, and what operator decisions change in it. Plain: it pickles."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from otolith.adaptation.fingerprints import fingerprint_of
from otolith.adaptation.frozen_sensors import FrozenReading
from otolith.commissioning.input_noise import InputNoiseSums
from otolith.commissioning.structure import PooledWindows, Structure
from otolith.discovery.decision import AdoptedComponent, Approval, keep_present
from otolith.discovery.sequential_test import SequentialTest
from otolith.estimation.imm_filter import TREND_MEMORY, ParameterCusum
from otolith.estimation.posterior import UNKNOWN_PHASE_SD, Posterior
from otolith.estimation.problem import Component, Problem, WindowOptions, augment, indices, slot_of, without
from otolith.health.diagnosis import MonitoringPlan
from otolith.health.events import HealthState
from otolith.health.labels import TimeLabels
from otolith.health.notes import OperatorNote
from otolith.health.prognosis import Baseline, with_baselines
from otolith.health.schema import Status
from otolith.health.status import PreviousStatus

MIN_COARSE_RECORDS = 50  # records of a window on a coarser grid: fewer determine little, however long the sample period
RESTART_FACTOR = 3.0  # on the standard deviations of a component whose filter was not saved: nothing was observed since
PHASE = 2  # position of the phase among the values of a component
EVERYTHING = "*"  # Stands for all parameters, components and noise levels among the names of OperatorDecisions.resets


@dataclass(frozen=True, slots=True)
class Ledger:
    """What windows show only together; beside it, posterior and test are what they have shown."""

    cusum: ParameterCusum = field(default_factory=ParameterCusum)
    """By how much the estimates of windows have differed from their predictions, all the same way."""
    pooled: PooledWindows = field(default_factory=PooledWindows)
    """The last windows that the twin explained, which are searched together."""
    input_noise: InputNoiseSums = field(default_factory=InputNoiseSums)
    """What windows show of the noise of inputs for which none is stated."""


@dataclass(frozen=True, slots=True, eq=False)
class AdaptationState:
    """Everything that is carried from window to window."""

    machine: str
    site: str
    posterior: Posterior
    previous: dict[str, PreviousStatus]  # Status of each free parameter in the report before, by its label
    records: int  # Of the next window
    test: SequentialTest | None = None  # The competing hypotheses, while they are undecided
    learned: int = 0  # Windows that updated the posterior
    contradictions: int = 0
    """Consecutive windows that did not update the posterior; windows with bad data are not counted."""
    restricted: frozenset[str] = frozenset()  # Keys of components that the machine file excludes
    approved: frozenset[str] = frozenset()  # Keys of components that the operator approved
    adopted: tuple[AdoptedComponent, ...] = ()  # The components in the twin
    ledger: Ledger = field(default_factory=Ledger)
    noisier_since: float | None = None
    """Service time in s from which on more noise than stated is accepted; None if none is."""
    plan: MonitoringPlan = field(default_factory=MonitoringPlan)
    """Limits and rules by which states and events follow from the reports."""
    health: HealthState = field(default_factory=HealthState)
    resets: Mapping[str, float] = field(default_factory=dict)  # The OperatorDecisions.resets that have been applied
    baselines: Mapping[str, Baseline] = field(default_factory=dict)
    """The OperatorDecisions.baselines that limits refer to."""
    frozen: Mapping[str, FrozenReading] = field(default_factory=dict)  # Sensors that keep one value
    sizes: Mapping[str, float] = field(default_factory=dict)
    """Largest root mean square of each signal in the windows that updated the posterior, in the units of the twin."""

    @property
    def is_valid(self) -> bool:
        """Whether no window contradicts the twin or the bounds of a parameter."""
        return all(before.status is not Status.INVALID for before in self.previous.values())

    @property
    def problem(self) -> Problem:
        """The estimation problem, with the components in the twin."""
        return self.posterior.problem


def initial_state(machine: str, site: str, problem: Problem, plan: MonitoringPlan | None = None) -> AdaptationState:
    """Return the state before the first window; without ``plan`` no parameter has limits."""
    previous = {parameter.label: PreviousStatus() for parameter in problem.free}
    return AdaptationState(
        machine,
        site,
        Posterior.initial(problem),
        previous,
        problem.window.records,
        restricted=problem.excluded,
        plan=plan or MonitoringPlan(),
    )


def cleared(state: AdaptationState) -> AdaptationState:
    """Return the state before the first window of the same machine, with the restrictions that hold now."""
    problem = state.problem
    for component in problem.components:
        problem = without(problem, component)
    problem = replace(problem.with_levels(problem.stated_levels), steps=(), changing=())
    initial = initial_state(state.machine, state.site, problem, state.plan)
    return replace(initial, restricted=state.restricted, approved=state.approved, baselines=state.baselines)


def with_problem(state: AdaptationState, problem: Problem) -> AdaptationState:
    """Return the state with other options of the problem; its free parameters must be the same."""
    return replace(state, posterior=replace(state.posterior, problem=problem))


def with_sample_grid(state: AdaptationState, configured: WindowOptions, ratio: float) -> AdaptationState:
    """Return the state for ``ratio`` times the configured sample period; windows keep their length in seconds."""

    def scaled(records: int) -> int:
        return max(round(records / ratio), min(records, MIN_COARSE_RECORDS))

    period = None if configured.sample_period is None else ratio * configured.sample_period
    window = WindowOptions(scaled(configured.records), scaled(configured.shortest), scaled(configured.longest), period)
    return replace(with_problem(state, replace(state.problem, window=window)), records=window.records)


def with_converter_steps(state: AdaptationState, problem: Problem) -> AdaptationState:
    """Return the state with the steps of converters that ``problem`` has, also in an open test."""
    test = None if state.test is None else state.test.with_steps(problem.steps)
    return replace(state, posterior=replace(state.posterior, problem=problem), test=test)


def with_posterior(state: AdaptationState, posterior: Posterior) -> AdaptationState:
    """Return the state with a posterior of fewer components; an open test was about another twin and is dropped."""
    if posterior is state.posterior:
        return state
    return replace(
        state, posterior=posterior, test=None, adopted=keep_present(state.adopted, posterior.problem.components)
    )


def without_component(state: AdaptationState, component: Component) -> AdaptationState:
    """Return the state without a component."""
    slot = slot_of(state.problem, component)
    if slot is None:
        rest = tuple(item for item in state.adopted if item.component.key != component.key)
        return replace(state, adopted=rest)
    return with_posterior(state, state.posterior.without_slot(slot))


@dataclass(frozen=True, slots=True)
class OperatorDecisions:
    """What the operator decided, by the keys of components."""

    approved: frozenset[str] = frozenset()  # They belong to the healthy machine
    rejected: frozenset[str] = frozenset()  # They are no components, and discovery leaves them out
    forgotten: Mapping[str, float] = field(default_factory=dict)
    """Unix seconds, or :meth:`in_service_time`: a component discovered before then has to be discovered again."""
    resets: Mapping[str, float] = field(default_factory=dict)
    """Unix seconds at which the operator reset a parameter, a component or everything, by name. Each is applied once.
    """
    baselines: Mapping[str, Baseline] = field(default_factory=dict)
    """Of the parameters; relative limits refer to those that :meth:`holding` returns."""
    notes: tuple[OperatorNote, ...] = ()  # What persons did with events

    def without(self, component: str) -> "OperatorDecisions":
        """Return the decisions without what was decided about a component."""
        return replace(self, approved=self.approved - {component}, rejected=self.rejected - {component})

    def holding(self, problem: Problem, before: Mapping[str, Baseline] | None = None) -> dict[str, Baseline]:
        """Return the baselines that were found with the twin and the known values of ``problem``.

        A parameter whose baseline was found with others has the one ``before``, if there is one.
        """
        model, kept = fingerprint_of(problem), before or {}
        found = {name: item if item.holds_with(model) else kept.get(name) for name, item in self.baselines.items()}
        return {name: item for name, item in found.items() if item is not None}

    def waiting(self, problem: Problem) -> tuple[str, ...]:
        """Return the parameters whose baselines were found with another twin or other known values."""
        model = fingerprint_of(problem)
        return tuple(sorted(name for name, item in self.baselines.items() if not item.holds_with(model)))

    def in_service_time(self, labels: TimeLabels, now: float) -> "OperatorDecisions":
        """Return the decisions with ``forgotten`` and ``notes`` on the clock of the windows, which shows ``now``.

        Times of resets are only compared. A note from the future is of a wrong clock: it was made now at the latest.
        """
        forgotten = {key: labels.last(time) for key, time in self.forgotten.items()}
        notes = tuple(note.at_time(min(labels.last(note.at), now)) for note in self.notes)
        return replace(self, forgotten=forgotten, notes=notes)


def apply_decisions(state: AdaptationState, decisions: OperatorDecisions) -> AdaptationState:
    """Return the state after the operator's decisions, whose times are on the clock of the windows."""
    for name in sorted(decisions.resets):  # EVERYTHING comes first
        if state.resets.get(name) != decisions.resets[name]:
            state = _reset(state, name)
    for item in state.adopted:
        key = item.component.key
        if key in decisions.rejected or decisions.forgotten.get(key, -np.inf) > item.onset:
            state = _removed(state, item.component, "the operator removed the component")
    adopted = tuple(
        replace(item, approval=Approval.APPROVED if item.component.key in decisions.approved else Approval.OPEN)
        for item in state.adopted
    )
    excluded = state.restricted | decisions.rejected
    if excluded != state.problem.excluded:  # an open test was searched with other exclusions
        state = replace(with_problem(state, replace(state.problem, excluded=excluded)), test=None)
    baselines = decisions.holding(state.problem, state.baselines)
    plan = with_baselines(state.plan, baselines)
    if plan.parameters != state.plan.parameters:  # the forecasts are about other limits
        state = replace(state, plan=plan, health=replace(state.health, forecasts={}))
    state = replace(state, baselines=baselines, health=state.health.with_notes(decisions.notes))
    return replace(state, adopted=adopted, approved=decisions.approved, resets=dict(decisions.resets))


def _reset(state: AdaptationState, name: str) -> AdaptationState:
    """Return the state without what was learned of a parameter, a component or everything; an open test is dropped."""
    if name == EVERYTHING:
        return replace(cleared(state), health=state.health.without_learned("the operator reset what was learned"))
    for index, parameter in enumerate(state.problem.free):
        if parameter.name == name:
            previous = {**state.previous, parameter.label: PreviousStatus()}
            return replace(
                state,
                posterior=state.posterior.reset_parameters([index]),
                previous=previous,
                test=None,
                ledger=replace(state.ledger, cusum=ParameterCusum()),
                health=state.health.without_history(name).without_events(
                    {f"{kind}/{name}" for kind in ("limit", "trend", "lost")}, f"the operator reset {name}"
                ),
            )
    for component in state.problem.components:
        if component.key == name:
            return _removed(state, component, f"the operator reset {name}")
    return state


def event_key(component: Component) -> str:
    """Return the key of the condition that a component is; see :func:`otolith.health.observations.observe`."""
    return f"component/{component.site}/{component.family}"


def _removed(state: AdaptationState, component: Component, reason: str) -> AdaptationState:
    """Return the state without a component, whose event is dropped unless another one is at the same place."""
    state = without_component(state, component)
    if any(
        (item.component.site, item.component.family) == (component.site, component.family) for item in state.adopted
    ):
        return state
    return replace(state, health=state.health.without_events({event_key(component)}, reason))


@dataclass(frozen=True, slots=True)
class ComponentRecord:
    """A component as it was known before a restart."""

    adopted: AdoptedComponent
    values: tuple[float, ...]  # Amplitude, inner parameter and phase, as far as it has them
    deviations: tuple[float, ...]

    @classmethod
    def of(cls, structure: Structure) -> "ComponentRecord":
        """Return what a state is given of a structure that several windows show together."""
        component = structure.component
        values, deviations = [component.amplitude], [structure.sd]
        if component.model.inner is not None:
            values, deviations = [*values, component.inner], [*deviations, structure.inner_sd]
        if component.periodic:
            values, deviations = [*values, component.phase], [*deviations, structure.phase_sd]
        probability = float(1.0 / (1.0 + np.exp(-0.5 * structure.evidence)))
        return cls(AdoptedComponent(component, component.origin, probability), tuple(values), tuple(deviations))


def component_records(state: AdaptationState) -> tuple[ComponentRecord, ...]:
    """Return what is stored of the components in the twin, in the order of their slots."""
    prior, histories = state.posterior.prior(), {item.component.key: item for item in state.adopted}
    deviations, records = np.sqrt(np.maximum(np.diag(prior.covariance), 0.0)), []
    for slot, component in enumerate(state.problem.components):
        item = histories.get(component.key, AdoptedComponent(component, component.origin))
        at = indices(state.problem, slot)
        values, sds = tuple(prior.mean[at].tolist()), tuple(deviations[at].tolist())
        records.append(ComponentRecord(replace(item, component=component), values, sds))
    return tuple(records)


def restore_components(state: AdaptationState, records: tuple[ComponentRecord, ...]) -> AdaptationState:
    """Return the state with stored components; their phases are unknown."""
    if not records:
        return state
    posterior = with_records(state.posterior, records, forget_phases=True)
    return replace(state, posterior=posterior, adopted=tuple(record.adopted for record in records))


def with_records(posterior: Posterior, records: tuple[ComponentRecord, ...], *, forget_phases: bool) -> Posterior:
    """Return the posterior with recorded components."""
    first, problem = len(posterior.problem.components), posterior.problem
    problem = augment(problem, [record.adopted.component for record in records])
    posterior = posterior.remap_parameters(problem)
    for slot, record in enumerate(records, first):
        values = zip(indices(problem, slot), record.values, record.deviations, strict=True)
        for number, (index, value, sd) in enumerate(values):
            if number == PHASE and (forget_phases or RESTART_FACTOR * sd >= UNKNOWN_PHASE_SD):
                posterior = posterior.forget_phase(index)
            else:
                posterior = posterior.reset_value(index, value, RESTART_FACTOR * sd)
                # A trend moves it by no more than that: otherwise a pitch drifts until windows determine its trend.
                posterior = posterior.reset_value(len(problem.free) + index, 0.0, RESTART_FACTOR * sd / TREND_MEMORY)
    return posterior
