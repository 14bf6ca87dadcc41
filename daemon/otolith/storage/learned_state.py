"""What was learned of a machine, as it is saved: schema, fingerprints, checks, and the way to a state and back.

Numbers are saved with all their digits, so that a restored filter is the same bit for bit. What is read is checked
before it is used: a file may be damaged, written by another version, or belong to another machine.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, field_validator, model_validator

from otolith.acquisition.window import Array
from otolith.adaptation.fingerprints import configuration_fingerprint, twin_fingerprint, values_fingerprint
from otolith.adaptation.state import (
    AdaptationState,
    ComponentRecord,
    cleared,
    component_records,
    event_key,
    restore_components,
)
from otolith.discovery.decision import Approval
from otolith.estimation.imm_filter import (
    HIGHEST_LEVEL,
    MAX_VARIANCE_RATIO,
    ImmPosterior,
    ParameterCusum,
    constant_mode,
    moment_match,
)
from otolith.estimation.information import MAX_TREND
from otolith.estimation.posterior import PhaseAdvance, Posterior
from otolith.estimation.problem import UNLIMITED, Problem, augment, indices
from otolith.health.events import HealthState
from otolith.health.labels import TimeLabels
from otolith.health.prognosis import is_plausible
from otolith.health.status import PreviousStatus
from otolith.twin.components import FAMILY_NAMES, MAX_COMPONENTS, sites, sources
from otolith.twin.definition import Definition
from otolith_drivers.config_files import StrictModel

VERSION = 2
SCALARS = ("records", "learned", "contradictions", "noisier_since")
"""What a state and its record have in common, beside the posterior."""
# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
MAX_MAGNITUDE = 1e12  # of any number but an amplitude's bound
MIN_SD, MAX_SD = 1e-12, 1e6  # relative to the size of a parameter
MAX_OUTSIDE = 1.0  # widths of the bounds by which a mean may lie outside of them
MAX_ROUNDING = 1e-9  # of a covariance with unit variances: asymmetry, and what is missing to positive semidefinite
MAX_NOISE_RATIO = 1e6  # noise that was accepted over stated noise


class _AnyVersion(BaseModel):
    version: int = VERSION


class ConstantRecord(StrictModel):
    """The mode of constants, without its trends."""

    mean: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]
    probability: Annotated[float, Field(gt=0.0, lt=1.0)]


class FilterRecord(StrictModel):
    """The filter across windows; numbers are relative to ``scale`` as in :class:`ImmPosterior`."""

    labels: tuple[str, ...]
    scale: tuple[float, ...]
    level: tuple[tuple[int, ...], ...]
    mean: tuple[tuple[float, ...], ...]
    covariance: tuple[tuple[tuple[float, ...], ...], ...]
    weight: tuple[float, ...]
    constant: ConstantRecord | None = None  # See Posterior.constant; older files lack it
    end: float
    variance_ratio: Annotated[float, Field(ge=1.0, le=MAX_VARIANCE_RATIO)]
    phase: PhaseAdvance | None
    noise: tuple[float, ...]
    """Levels of inputs, outputs and states; empty if as stated. Older files lack those of states, or inputs too."""
    steps: tuple[float, ...] = ()  # See otolith.estimation.problem.Problem.steps
    changing: tuple[str, ...] = ()  # See otolith.estimation.problem.Problem.changing
    shifts: tuple[tuple[float, ...], ...] = ()  # See ParameterCusum.sums; empty for none
    previous: tuple[PreviousStatus, ...]
    records: int
    learned: int
    contradictions: int
    noisier_since: float | None


class SavedClock(StrictModel):
    """The clock of a daemon: how its service time goes on in the next one, see :mod:`otolith.runtime.clock`."""

    boot: str  # Identifies the boot of the computer; empty if unknown
    offset: float  # Service time minus the time since that boot, s
    begin: float  # Service time from which on the wall clock is that of this boot
    labels: TimeLabels = Field(default_factory=TimeLabels)

    @field_validator("labels")
    @classmethod
    def _rise(cls, labels: TimeLabels) -> TimeLabels:
        if not labels.is_plausible:
            raise ValueError("the begins of the labels do not rise")
        return labels


class LearnedState(StrictModel):
    """What was learned of one machine. Times are service times."""

    version: int = VERSION
    machine: str = ""
    site: str = ""
    twin: str
    signal_fingerprint: str = ""  # See otolith.machine.LoadedMachine.signal_fingerprint
    twin_fingerprint: str = ""
    configuration_fingerprint: str = ""
    values_fingerprint: str = ""  # Empty in older files
    resets: dict[str, float] = Field(default_factory=dict)  # See otolith.adaptation.state.AdaptationState.resets
    components: Annotated[tuple[ComponentRecord, ...], Field(max_length=MAX_COMPONENTS)] = ()
    health: HealthState = Field(default_factory=HealthState)
    """Open events and states, so that a restart neither repeats nor drops them."""
    clock: SavedClock | None = None  # None in older files, whose times are Unix times
    filter: FilterRecord | None = None  # None in files of version 1, and where nothing but components is to be kept

    @model_validator(mode="before")
    @classmethod
    def _without_counts(cls, content: Any) -> Any:
        """Leave out the one count of windows as stated that older files have for all parameters together."""
        health = content.get("health") if isinstance(content, dict) else None
        if not isinstance(health, dict) or not isinstance(health.get("as_stated"), int):
            return content
        return {**content, "health": {key: item for key, item in health.items() if key != "as_stated"}}

    @model_validator(mode="before")
    @classmethod
    def _join_histories(cls, content: Any) -> Any:
        """Join the histories that older files kept apart from before their clock was set back."""
        health = content.get("health") if isinstance(content, dict) else None
        if not isinstance(health, dict) or not isinstance(earlier := health.get("earlier"), dict):
            return content
        kept = {name: item[-1] for name, item in earlier.items() if isinstance(item, list | tuple) and item}
        rest = {key: item for key, item in health.items() if key != "earlier"}
        return {**content, "health": {**rest, "histories": {**rest.get("histories", {}), **kept}}}


def check_version(text: str, newest: int) -> None:
    """Check that ``text`` is JSON of a version up to ``newest``; raise ValueError if it is not."""
    version = _AnyVersion.model_validate_json(text).version
    _require(1 <= version <= newest, f"version {version} of the format: this Otolith reads 1 to {newest}")


def without_found(learned: LearnedState, reason: str) -> LearnedState:
    """Return what was learned with other known values: without components that nobody approved, and without histories.

    Their events are dropped. Estimates with two values would be a trend, or a baseline between both.
    """
    kept = tuple(item for item in learned.components if item.adopted.approval is Approval.APPROVED)
    lost = {event_key(item.adopted.component) for item in learned.components}
    lost -= {event_key(item.adopted.component) for item in kept}
    health, lost = learned.health, lost | {f"trend/{name}" for name in learned.health.histories}
    for name in learned.health.histories:
        health = health.without_history(name)
    update = {"components": kept, "health": health.without_events(lost, reason)}
    return learned.model_copy(update=update)


def learned_state(state: AdaptationState, signal_fingerprint: str, clock: SavedClock | None = None) -> LearnedState:
    """Return what is to be saved of ``state``; raise ValueError if it would not be restored."""
    base = state.problem.base_model
    document = LearnedState(
        machine=state.machine,
        site=state.site,
        twin=base.name,
        signal_fingerprint=signal_fingerprint,
        twin_fingerprint=twin_fingerprint(base),
        configuration_fingerprint=configuration_fingerprint(state.problem),
        values_fingerprint=values_fingerprint(state.problem),
        resets=dict(state.resets),
        components=component_records(state),
        health=state.health,
        clock=clock,
        filter=_filter_record(state) if np.isfinite(state.posterior.belief.end) else None,
    )
    restored(document, cleared(state))
    return document


def _filter_record(state: AdaptationState) -> FilterRecord:
    problem, belief = state.problem, state.posterior.belief
    labels = tuple(parameter.label for parameter in problem.free)
    return FilterRecord(
        labels=labels,
        scale=tuple(problem.scale.tolist()),
        **{name: getattr(belief, name).tolist() for name in ("level", "mean", "covariance", "weight")},
        constant=_constant_record(state.posterior),
        end=belief.end,
        variance_ratio=belief.variance_ratio,
        phase=state.posterior.phase,
        noise=problem.levels if problem.stated_noise else (),
        steps=problem.steps,
        changing=problem.changing,
        shifts=_sums(state, len(labels)),
        previous=tuple(state.previous.get(label, PreviousStatus()) for label in labels),
        **{name: getattr(state, name) for name in SCALARS},
    )


def _constant_record(posterior: Posterior) -> ConstantRecord | None:
    mode, free = posterior.constant, len(posterior.problem.free)
    if mode is None:
        return None
    mean, covariance = mode.mean[0, :free].tolist(), mode.covariance[0, :free, :free].tolist()
    return ConstantRecord(mean=mean, covariance=covariance, probability=float(mode.weight[0]))


def _sums(state: AdaptationState, free: int) -> tuple[tuple[float, ...], ...]:
    """Return the cumulative shifts; those of other parameters than the present ones count no more."""
    sums = state.ledger.cusum.sums
    return () if sums is None or sums.shape[1] != free else tuple(map(tuple, sums.tolist()))


def restored(document: LearnedState, state: AdaptationState) -> AdaptationState:
    """Return the initial ``state`` with what was saved; its variance grows with the next window by the time since.

    Raises:
        ValueError: the document is not plausible.
    """
    _require(max(map(abs, _numbers(document.model_dump())), default=0.0) <= MAX_MAGNITUDE, "a number is too large")
    _require(all(map(is_plausible, document.health.histories.values())), "health: a history is not plausible")
    health = replace(document.health, forecasts={})  # their limits may have changed
    record, problem = document.filter, state.problem
    check_components(document.components, problem.base_model)
    adopted = tuple(component.adopted for component in document.components)
    if adopted:
        problem = augment(problem, [item.component for item in adopted])
    low, high = problem.bounds
    _require(bool((low < high).all()), "components: their bounds leave no value")
    for slot, component in enumerate(document.components):
        at = indices(problem, slot)
        _require_near(np.array(component.values), low[at], high[at], "components")
    if record is None:
        known = restore_components(state, document.components)
        return replace(known, resets=document.resets, health=health)
    problem = _with_steps(_with_noise(problem, record.noise), record.steps)
    _require(set(record.changing) <= {source.name for source in problem.base_model.inputs}, "changing: no inputs")
    problem = replace(problem, changing=record.changing)
    posterior, window = _posterior(record, problem), problem.window
    kept = {name: getattr(record, name) for name in SCALARS}
    if not window.shortest <= record.records <= window.longest:
        kept["records"] = state.records
    return replace(
        state,
        **kept,
        posterior=posterior,
        ledger=replace(state.ledger, cusum=_shifts(record)),
        previous=dict(zip(record.labels, record.previous, strict=True)),
        adopted=adopted,
        resets=document.resets,
        health=health,
    )


def _numbers(content: object) -> Iterator[float]:
    """All numbers in a document, without the bounds of amplitudes that nothing limits."""
    if isinstance(content, int | float):
        yield 0.0 if abs(content) == UNLIMITED else content
    elif isinstance(content, dict | tuple | list):
        for item in content.values() if isinstance(content, dict) else content:
            yield from _numbers(item)


def check_components(records: tuple[ComponentRecord, ...], twin: Definition) -> None:
    """Check that ``twin``, the base model, can have all components at once; raise ValueError if it cannot."""
    places, origins = {site.name for site in sites(twin)}, {source.name for source in sources(twin)}
    keys = {record.adopted.component.key for record in records}
    _require(len(keys) == len(records), "components: the same one twice")
    for record in records:
        item, component = record.adopted, record.adopted.component
        where = f"component {component.key}"
        is_known = component.family in FAMILY_NAMES and component.site in places and component.source in origins
        _require(is_known, f"{where}: this twin or version of Otolith does not have it")
        is_bounded = component.amplitude_low <= component.amplitude <= component.amplitude_high
        is_plausible = is_bounded and component.amplitude != 0.0 and 0.0 <= item.probability <= 1.0
        _require(is_plausible, f"{where}: not plausible")
        count = 1 + (component.model.inner is not None) + component.periodic
        is_complete = len(record.values) == len(record.deviations) == count and min(record.deviations) > 0.0
        _require(is_complete, f"{where}: values or deviations are missing")


def _with_noise(problem: Problem, noise: tuple[float, ...]) -> Problem:
    """Return the problem with the ``noise`` that was accepted; empty for that of the machine file."""
    if not noise:
        return problem
    stated, inputs, signals = problem.levels, len(problem.base_model.inputs), len(problem.base_model.signals)
    noise = (*stated[:inputs], *noise) if len(noise) == signals - inputs else noise
    noise = (*noise, *stated[signals:]) if len(noise) == signals else noise
    _require(len(noise) == len(stated), "noise: of other signals")
    ratios = [accepted / known for accepted, known in zip(noise[inputs:signals], problem.noise, strict=True)]
    is_plausible = 1.0 / MAX_NOISE_RATIO <= min(ratios) <= max(ratios) <= MAX_NOISE_RATIO  # of sensors
    _require(is_plausible and 0.0 <= min(noise) <= max(noise) < np.inf, "noise: not plausible")
    return problem.with_levels(noise)


def _with_steps(problem: Problem, steps: tuple[float, ...]) -> Problem:
    """Return the problem with the ``steps`` of converters that windows have shown; empty for none."""
    outputs = len(problem.base_model.outputs)
    _require(len(steps) in (0, outputs) and min(steps, default=0.0) >= 0.0, "steps: not plausible")
    return replace(problem, steps=steps)


def _posterior(record: FilterRecord, problem: Problem) -> Posterior:
    """Return the posterior of a record, checked."""
    free, modes, phase = len(problem.free), len(record.weight), record.phase
    _require(record.labels == tuple(parameter.label for parameter in problem.free), "labels: other parameters")
    _require(len(record.previous) == free and record.scale == tuple(problem.scale.tolist()), "scale: another problem")
    level = np.array(record.level, dtype=np.int64)
    mean, covariance, weight = np.array(record.mean), np.array(record.covariance), np.array(record.weight)
    shapes = level.shape, mean.shape, covariance.shape
    _require(shapes == ((modes, free), (modes, 2 * free), (modes, 2 * free, 2 * free)), "filter: wrong shape")
    _require(modes > 1 and len(np.unique(level, axis=0)) == modes, "level: modes are missing or repeated")
    _require(0 <= int(level.min()) <= int(level.max()) <= HIGHEST_LEVEL, "level: there is no such mode")
    _require(float(weight.min()) > 0.0 and abs(float(weight.sum()) - 1.0) < MAX_ROUNDING, "weight: no probabilities")
    belief = ImmPosterior(level, mean, covariance, weight, record.end, record.variance_ratio)
    together, matched = moment_match(belief)
    trend = np.full(free, MAX_TREND)
    low, high = problem.bounds[0] / problem.scale, problem.bounds[1] / problem.scale
    _require_near(together, np.concatenate([low, -trend]), np.concatenate([high, trend]), "mean")
    for each in (*covariance, matched):
        _check_covariance(each)
    sd = np.sqrt(np.diag(matched))
    np.linalg.cholesky(matched / np.outer(sd, sd))  # as the next window does; a ValueError if it is singular
    if phase is not None:
        states = len(problem.base_model.states)
        _require(len(phase.by) == len(problem.components) and len(phase.last_state) in (0, states), "phase: wrong size")
    return Posterior(problem, belief, phase, _constant_mode(record, belief, problem))


def _constant_mode(record: FilterRecord, bank: ImmPosterior, problem: Problem) -> ImmPosterior | None:
    """Return the mode of constants of a record, checked; ``bank`` has the other modes."""
    if (own := record.constant) is None:
        return None
    free, mode = len(problem.free), constant_mode(bank)
    mean, covariance = np.array(own.mean), np.array(own.covariance)
    _require(mean.shape == (free,) and covariance.shape == (free, free), "constant: wrong shape")
    low, high = problem.bounds[0] / problem.scale, problem.bounds[1] / problem.scale
    _require_near(mean, low, high, "constant: mean")
    _check_covariance(covariance)
    mode.mean[0, :free], mode.covariance[0, :free, :free] = mean, covariance
    return replace(mode, weight=np.array([own.probability]))


def _shifts(record: FilterRecord) -> ParameterCusum:
    """Return the cumulative shifts of a record, checked."""
    if not record.shifts:
        return ParameterCusum()
    sums = np.array(record.shifts)
    _require(sums.shape == (2, len(record.labels)) and float(sums.min()) >= 0.0, "shifts: not plausible")
    return ParameterCusum(sums)


def _check_covariance(covariance: Array) -> None:
    variances = np.diag(covariance)
    _require(variances.min() >= MIN_SD**2 and variances.max() <= MAX_SD**2, "covariance: a variance is not plausible")
    unit = covariance / np.sqrt(np.outer(variances, variances))
    _require(float(np.abs(unit - unit.T).max()) <= MAX_ROUNDING, "covariance: not symmetric")
    _require(float(np.linalg.eigvalsh(unit).min()) >= -MAX_ROUNDING, "covariance: not positive semidefinite")


def _require_near(values: Array, low: Array, high: Array, name: str) -> None:
    """Check that ``values`` are at most ``MAX_OUTSIDE`` widths outside of the bounds."""
    reach = MAX_OUTSIDE * (high - low)
    _require(bool(((values >= low - reach) & (values <= high + reach)).all()), f"{name}: far outside of the bounds")


def _require(condition: bool, reason: str) -> None:
    if not condition:
        raise ValueError(reason)
