"""States and events: from the report of each window to the state of each part, with hysteresis and persistence.

    report → observations → levels (persistent) → events (raised, changed, cleared) → states of parts and machine

Times are those of the windows. A window that determines nothing about a condition leaves it as it was.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import takewhile
from typing import Any

from otolith.discovery.alternatives import ACCEPTED, NO_EVIDENCE, WindowDecision
from otolith.estimation.information import QUANTILE
from otolith.health.diagnosis import MonitoringPlan, diagnose
from otolith.health.limits import MACHINE, Coldness, Level, MonitoredQuantity
from otolith.health.notes import Deed, OperatorNote, Shelf, ended_events, lasting, noted, of_event, shelved_until
from otolith.health.observations import (
    BUS,
    COLDER,
    OUTPUT,
    PERSISTENT_WINDOWS,
    RELEASE_WINDOWS,
    SENSORS,
    UNDECIDED,
    Observation,
    Past,
    Persistence,
    coldness_of,
    is_determined,
    observe,
)
from otolith.health.prognosis import History, SeenTrend, forecast, is_due, seen_trend, span, with_point
from otolith.health.schema import (
    EventChange,
    EventDocument,
    EvidenceDocument,
    FindingKind,
    ForecastDocument,
    HealthDocument,
    PartDocument,
    ReportDocument,
    Status,
    WindowDocument,
)
from otolith.health.status import required_limits, with_lacks
from otolith.health.text import PARTS, duration_text, only_as_right_as, reasons_of

KNOWN_WINDOWS = 10  # that agree with the machine file, after which what contradicts it is a change of the machine
RETURN_WINDOWS = 60  # after the end of an event within which it may return as one that comes and goes
OF_DATA = ("data", "source/", "temperature/", OUTPUT)  # Begins of the keys of conditions that nothing was learned for
CONTRADICTED = "the last windows do not fit the estimates that a forecast is made from"
DECIDED = frozenset({WindowDecision.STEPPED, WindowDecision.DISCOVERED, WindowDecision.NOISIER})  # They end a test
NAMED = frozenset({WindowDecision.SENSOR, WindowDecision.TIMING})  # Of windows that are estimated: its cause is known


@dataclass(frozen=True, slots=True)
class ConditionRecord:
    """What is carried from window to window about one condition."""

    level: Level = Level.OK
    recent: tuple[tuple[Level, WindowDocument], ...] = ()  # The last observed levels with their windows
    event: EventDocument | None = None  # None at Level.OK
    persistence: Persistence = field(default_factory=Persistence)
    cleared: int = -RETURN_WINDOWS  # Index of the window that ended its last event
    others: tuple[str, ...] = ()  # Ids of the conditions by which the last windows describe the event otherwise
    limit: float | None = None  # Value of the limit that decided the level; None without one, and in older files

    @property
    def held(self) -> float | None:
        """The value of the limit that holds the level; in older files it is that of the last window that showed one."""
        return self.event.evidence.limit if self.limit is None and self.event is not None else self.limit

    def is_over(self, window: int) -> bool:
        """Whether nothing of it has to be carried on after the window with this index."""
        return self.event is None and not self.returns(window) and all(level is Level.OK for level, _ in self.recent)

    @property
    def quiet(self) -> tuple[WindowDocument, ...]:
        """The last windows without it that were judged, one after the other."""
        latest = takewhile(lambda item: item[0] is Level.OK, reversed(self.recent))
        return tuple(window for _, window in latest)[::-1]

    @property
    def is_absent(self) -> bool:
        """Whether its event is held open only because it may come again: an ordinary one would be over."""
        return self.event is not None and len(self.quiet) >= PERSISTENT_WINDOWS

    def returns(self, window: int) -> bool:
        """Whether an event of it that begins in the window with this index is one that comes and goes."""
        return 0 <= window - self.cleared < RETURN_WINDOWS


@dataclass(frozen=True, slots=True)
class HealthState:
    """Everything that the states of parts need from earlier windows. Plain: it pickles."""

    records: Mapping[str, ConditionRecord] = field(default_factory=dict)  # By the key of the condition
    values: Mapping[str, float] = field(default_factory=dict)
    """Of the parameters, after the last window that updated them."""
    steps: Mapping[str, float] = field(default_factory=dict)  # Last sudden change of each parameter
    histories: Mapping[str, History] = field(default_factory=dict)
    """Of the parameters with limits, since their last sudden change."""
    forecasts: Mapping[str, ForecastDocument] = field(default_factory=dict)
    trends: Mapping[str, SeenTrend] = field(default_factory=dict)
    """Of the parameters that were on their way to a limit, since their last sudden change."""
    undetermined: Mapping[str, float] = field(default_factory=dict)
    """Time for which the machine has moved since each parameter was determined, s; none of those that never were."""
    inside: frozenset[str] = frozenset()  # Keys of conditions that were at OK in some window
    doubtful: tuple[int, ...] = ()  # Indices of those of the last windows that contradicted what was known
    agreed: int = -1  # Index of the last window that agreed with it
    as_stated: Mapping[str, int] = field(default_factory=dict)
    """Windows in which the signals determined each parameter and were as the machine file says."""
    known_since: float | None = None
    """Service time, s, at which these were enough: what begins later is a change. None before."""
    coldness: Mapping[str, Coldness] = field(default_factory=dict)
    """What a lower temperature explains of the parameters that depend on one that is not measured."""
    document: HealthDocument | None = None  # The states in the report before
    dropped: tuple[EventDocument, ...] = ()
    """Events that nothing is known of any more, each with its ``reason``; the next report clears them."""
    notes: tuple[OperatorNote, ...] = ()  # Of persons, that the next report takes over
    taken: tuple[str, ...] = ()  # Ids of the notes that were taken over, as far as they may be given again
    shelves: Mapping[str, Shelf] = field(default_factory=dict)  # By the key of the condition

    @property
    def open_events(self) -> tuple[EventDocument, ...]:
        """The events that are not cleared."""
        return tuple(record.event for record in self.records.values() if record.event is not None)

    def without_history(self, name: str) -> "HealthState":
        """Return the state without history, forecast and trend of a parameter."""
        histories = {key: history for key, history in self.histories.items() if key != name}
        forecasts = {key: item for key, item in self.forecasts.items() if key != name}
        trends = {key: item for key, item in self.trends.items() if key != name}
        return replace(self, histories=histories, forecasts=forecasts, trends=trends)

    def without_learned(self, reason: str) -> "HealthState":
        """Return the state of a machine of which nothing was learned; events of what was learned are dropped."""
        own = {key: record for key, record in self.records.items() if key.startswith(OF_DATA)}
        lost = self.without_events(self.records.keys() - own.keys(), reason)
        kept = {key: shelf for key, shelf in self.shelves.items() if key in own}
        return HealthState(own, dropped=lost.dropped, notes=self.notes, taken=self.taken, shelves=kept)

    def without_events(self, keys: Collection[str], reason: str) -> "HealthState":
        """Return the state without these conditions; what was learned of them is dropped for the ``reason``."""
        records = {key: record for key, record in self.records.items() if key not in keys}
        events = [record.event for key, record in self.records.items() if key in keys and record.event is not None]
        shelves = {key: shelf for key, shelf in self.shelves.items() if key not in keys}
        return replace(self, records=records, shelves=shelves).with_dropped(events, reason)

    def without_hints(self, reason: str) -> "HealthState":
        """Return the state for another machine file, of which nothing is known to be wrong."""
        keys = [key for key, record in self.records.items() if record.event is not None and record.event.is_hint]
        return replace(self.without_events(keys, reason), as_stated={}, known_since=None)

    def agreeing(self, published: Mapping[str, EventDocument], reason: str) -> "HealthState":
        """Return the state with no other open events than were ``published``, by id the last change of each.

        One that was cleared is open no more. One that is open, but not in this state, is dropped for the ``reason``.
        """
        own = {event.id for event in (*self.open_events, *self.dropped)}
        cleared = {event.id for event in published.values() if event.end is not None}
        records = {key: row for key, row in self.records.items() if row.event is None or row.event.id not in cleared}
        lost = [event for event in published.values() if event.id not in own | cleared]
        return replace(self, records=records).with_dropped(lost, reason)

    def with_dropped(self, events: Iterable[EventDocument], reason: str) -> "HealthState":
        """Return the state with events of another state that nothing is known of any more."""
        dropped = tuple(event.model_copy(update={"reason": reason}) for event in events)
        return replace(self, dropped=self.dropped + dropped)

    def with_notes(self, given: Sequence[OperatorNote]) -> "HealthState":
        """Return the state with those of the ``given`` notes that it has not taken over yet; service times."""
        new = tuple(note for note in given if note.id not in self.taken)
        return replace(self, notes=self.notes + new, taken=tuple(note.id for note in given))


def missed_notes(state: HealthState, notes: Iterable[OperatorNote]) -> list[str]:
    """Return the ids of the events that ended before a note of a person about them came."""
    known = {event.id for event in state.open_events}
    new = (note for note in notes if note.id not in state.taken and note.ended is None)
    return [note.event for note in new if note.event not in known and note.deed is not Deed.UNSHELVE]


def assess(plan: MonitoringPlan, state: HealthState, report: ReportDocument) -> tuple[HealthState, ReportDocument]:
    """Return the state after ``report``, and the report with states and events."""
    report = _translated(plan, report)
    state = _with_doubts(_with_forecasts(plan, _with_steps(plan, state, report), report), report)
    parameters = {
        name: item.model_copy(
            update={"forecast": _current_forecast(state, report, name), **_judged(plan, report, name)}
        )
        for name, item in report.parameters.items()
    }
    report = with_lacks(report.model_copy(update={"parameters": parameters}))
    is_moving = any(item.status is Status.ESTIMATED for item in report.parameters.values())
    undetermined = _undetermined_times(state.undetermined, report, is_moving=is_moving)
    state = _with_agreement(replace(state, undetermined=undetermined), report)
    state = replace(state, coldness=coldness_of(plan, state.coldness, report))
    observations = _observations(plan, state, report, is_moving=is_moving)
    records, events, absent = {}, list[EventDocument](), set[str]()
    shelves = lasting(state.shelves, state.notes, report.window.end)
    for key, observed in observations.items():
        if key not in state.records and observed.level in (None, Level.OK):  # as most: nothing to carry on
            continue
        own = observed if key in state.inside else _from_start(observed)
        before = state.records.get(key, ConditionRecord())
        record = _advance(plan, before, own, report)
        if (event := record.event) is not None:
            notes = of_event(state.notes, event.id)
            event, shelf = noted(event, before.event, shelves.pop(key, None), notes, report.window.end)
            record, shelves = replace(record, event=event), shelves if shelf is None else {**shelves, key: shelf}
            events.append(_published(plan, record, report))
            # Of windows that are estimated it is not true that nothing is known.
            absent |= {event.id} if record.is_absent and event.state is Level.NO_DATA else set()
            if event.end is not None:
                record = replace(record, event=None, cleared=report.window.index)
        if not record.is_over(report.window.index):
            records[key] = record
    dropped, ended = ended_events(state.notes, state.dropped)
    events += [*(_ended(plan, event, report.window.start) for event in dropped), *ended]
    events.sort(key=lambda event: -event.state.rank)
    current = [event for event in events if event.end is None and not event.is_hint and event.id not in absent]
    document = _states(plan, state.document, report, current, state.undetermined)
    document = document.model_copy(update={"has_agreed": True if state.known_since is not None else None})
    inside = state.inside | {key for key, item in observations.items() if item.level is Level.OK}
    state = replace(state, records=records, shelves=shelves, document=document, inside=inside, dropped=(), notes=())
    return state, report.model_copy(update={"health": document, "events": tuple(events)})


def _published(plan: MonitoringPlan, record: ConditionRecord, report: ReportDocument) -> EventDocument:
    """Return the event of a record, which says for how long it was not seen if it is only held open."""
    event = record.event
    assert event is not None  # noqa: S101 - for mypy
    if event.end is not None or not record.is_absent:
        return event
    pause = plan.texts("absent", duration=duration_text(report.window.end - record.quiet[0].start))
    return event.model_copy(update={"text": PARTS.join(filter(None, (event.text, pause)))})


def _observations(
    plan: MonitoringPlan, state: HealthState, report: ReportDocument, *, is_moving: bool
) -> dict[str, Observation]:
    """Return what the window shows about each condition, by its key.

    A condition that earlier windows showed and this one does not is at OK if the window updated the estimates of a
    moving machine and no test is open; otherwise nothing is known of it.
    """
    is_open = any(finding.kind is FindingKind.OPEN for finding in report.findings)
    absent = Level.OK if report.decision in ACCEPTED and is_moving and not is_open else None
    is_named = report.decision in DECIDED or (report.decision in NAMED and report.fit is not None)
    earlier = {}
    for key, record in state.records.items():
        is_decided = is_named and record.persistence == UNDECIDED
        persistence = replace(UNDECIDED, fall=1) if is_decided else record.persistence
        earlier[key] = Observation(key, MACHINE, Level.OK if is_decided else absent, persistence=persistence)
    levels = {key: record.level for key, record in state.records.items()}
    spans = {name: span(history) for name, history in state.histories.items()}
    held = {key: record.held for key, record in state.records.items()}
    past = Past(state.steps, spans, state.trends, state.undetermined, held, state.doubtful, state.known_since)
    past = replace(past, coldness=state.coldness)
    shown = observe(plan, report, levels, past)
    return earlier | {item.key: item for item in shown}


def _undetermined_times(before: Mapping[str, float], report: ReportDocument, *, is_moving: bool) -> dict[str, float]:
    """Return for how long the machine has moved since each parameter was determined: rest does not count."""
    length = report.window.end - report.window.start if is_moving else 0.0
    now = {name for name, item in report.parameters.items() if is_determined(item)}
    return {name: 0.0 if name in now else before.get(name, 0.0) + length for name in (*before, *now)}


def _with_doubts(state: HealthState, report: ReportDocument) -> HealthState:
    """Return the state with whether the window contradicted what was known.

    Windows that were missed or have bad data end no doubt: between two doubtful windows they count as doubtful.
    """
    now, length = report.window.index, report.window.end - report.window.start
    memory = Persistence(within=RELEASE_WINDOWS).of_windows(length).within
    doubtful = tuple(index for index in state.doubtful if now - memory < index < now)
    if report.decision in ACCEPTED:
        return replace(state, doubtful=doubtful, agreed=now)
    if report.decision not in NO_EVIDENCE:
        agreed = state.agreed if state.agreed < now else -1  # of an earlier run
        first = doubtful[-1] + 1 if doubtful and agreed < doubtful[-1] else now
        doubtful += tuple(range(first, now + 1))
    return replace(state, doubtful=doubtful)


def _with_agreement(state: HealthState, report: ReportDocument) -> HealthState:
    """Return the state with whether the signals have been as the machine file says for long enough to know that.

    A window that does not determine a parameter may hide a delay, as one at a constant speed does. Not all parameters
    need to be determined at once.
    """
    is_as_stated = report.decision is WindowDecision.LEARNED and report.fit is not None and report.fit.explained
    if state.known_since is not None or not is_as_stated:
        return state
    shown = {name for name, item in report.parameters.items() if item.status is Status.ESTIMATED}
    counts = {name: state.as_stated.get(name, 0) + (name in shown) for name in report.parameters}
    is_known = min(counts.values(), default=KNOWN_WINDOWS) >= KNOWN_WINDOWS
    return replace(state, as_stated=counts, known_since=report.window.end if is_known else None)


def _from_start(observed: Observation) -> Observation:
    """Return the observation of a condition that was never at OK: a parameter that is beyond its limit is no wear."""
    if observed.features.finding is not FindingKind.LIMIT or observed.features.manner == COLDER:
        return observed
    return replace(observed, features=replace(observed.features, finding=FindingKind.LIMIT_FROM_START))


def _translated(plan: MonitoringPlan, report: ReportDocument) -> ReportDocument:
    """Return the report with the texts of the core in the language of the machine."""
    if plan.language == "en":
        return report
    local = plan.texts.translated

    def localised(item: Any, *keys: str) -> Any:
        return item.model_copy(update={key: local(text) for key in keys if (text := getattr(item, key))})

    quality = report.window.quality.model_copy(update={"reasons": tuple(map(local, report.window.quality.reasons))})
    absent = report.window.absent and {name: local(text) for name, text in report.window.absent.items()}
    changed = {
        "window": report.window.model_copy(update={"quality": quality, "absent": absent}),
        "findings": tuple(localised(item, "condition", "text", "advice", "setting") for item in report.findings),
        "parameters": {name: localised(item, "reason", "advice") for name, item in report.parameters.items()},
        "components": tuple(localised(item, "meaning", "conditions", "domain") for item in report.components),
    }
    return report.model_copy(update=changed)


def _with_steps(plan: MonitoringPlan, state: HealthState, report: ReportDocument) -> HealthState:
    """Return the state with the values of a window that updated them, and with their sudden changes.

    A change is also sudden after windows that contradicted what was known, whatever was decided. The history of a
    parameter begins again at a step. Where what changed most varies in operation, the windows before are no doubt.
    """
    is_accepted, rows = report.decision in ACCEPTED, report.parameters
    usable = {name: row.value for name, row in rows.items() if is_accepted or row.status is Status.ESTIMATED}
    known = {name: value for name, value in usable.items() if value is not None}
    changes = {name: value - state.values[name] for name, value in known.items() if name in state.values}
    values = known if is_accepted else {**state.values, **known}
    moved = {name for name, change in changes.items() if abs(change) > QUANTILE * (rows[name].sd or 0.0)}
    if report.decision is not WindowDecision.STEPPED:
        is_doubted = bool(state.doubtful) and state.agreed < state.doubtful[-1]
        larger = {name for name in moved if is_doubted and abs(changes[name]) > abs(state.steps.get(name, 0.0))}
        return replace(state, values=values, steps={**state.steps, **{name: changes[name] for name in larger}})
    for name in moved:
        state = state.without_history(name)
    if moved and max(moved, key=lambda name: abs(changes[name]) / (report.parameters[name].sd or 1.0)) in plan.varying:
        state = replace(state, doubtful=_before_the_last_run(state.doubtful, report.window.index))
    return replace(state, values=values, steps={**state.steps, **{name: changes[name] for name in moved}})


def _before_the_last_run(doubtful: tuple[int, ...], now: int) -> tuple[int, ...]:
    """Return the indices before those that lead without a gap to the window before ``now``."""
    rest = list(doubtful)
    while rest and rest[-1] == now - 1 - (len(doubtful) - len(rest)):
        rest.pop()
    return tuple(rest)


def _judged(plan: MonitoringPlan, report: ReportDocument, name: str) -> dict[str, object]:
    """Return what the plan adds to a parameter: baseline, limit, value at the reference temperature, held values."""
    quantity, item = plan.parameters.get(name, MonitoredQuantity()), report.parameters[name]
    judged: dict[str, object] = {"baseline": quantity.nominal} if quantity.has_baseline else {}
    judged |= {"is_example": True} if quantity.is_example else {}
    if quantity.as_right_as and item.value is not None:
        judged["as_right_as"] = held = plan.held_with(name)
        judged["reason"] = PARTS.join(filter(None, (item.reason, plan.texts.translated(only_as_right_as(held)))))
    if quantity.limits:
        worst = min(quantity.limits, key=lambda row: (-row.level.rank, abs(row.value - quantity.nominal)))
        judged["limit"] = worst.value
    if quantity.temperature and item.value is not None:
        referred = quantity.referred(item.value, 0.0, report.window.observed or {})
        judged |= {"referred": referred[0]} if referred else {}
    return judged


def history_point(plan: MonitoringPlan, report: ReportDocument, name: str) -> tuple[float, float, float] | None:
    """Return what a report adds to the history of a parameter: time (s), value and variance; None for nothing.

    The value is that at the reference temperature.
    """
    item, quantity = report.parameters[name], plan.parameters.get(name)
    is_new = report.decision in ACCEPTED and item.status is Status.ESTIMATED
    if quantity is None or not is_new or item.value is None or not item.sd:
        return None
    if not quantity.has_limits and not required_limits(report, plan.parameters, name):
        return None
    time, value, sd = report.window.end, item.value, item.sd
    if report.decision is WindowDecision.LEARNED and item.raw is not None and item.raw_sd:
        # Of this window alone, in its middle: its error is that of no other window, and lags behind no trend.
        time, value, sd = 0.5 * (report.window.start + report.window.end), item.raw, item.raw_sd
    referred = quantity.referred(value, sd, report.window.observed or {})
    return None if referred is None else (time, referred[0], referred[1] ** 2)


def _current_forecast(state: HealthState, report: ReportDocument, name: str) -> ForecastDocument | None:
    """Return the last forecast of a parameter; without its times while windows contradict what it was made from.

    A single window may be wrong. After several the parameter may have changed, and its forecast holds no more.
    """
    own, last = state.forecasts.get(name), state.doubtful[-PERSISTENT_WINDOWS:]
    is_contradicted = len(last) == PERSISTENT_WINDOWS and last[-1] - last[0] == PERSISTENT_WINDOWS - 1
    if own is None or not is_contradicted or last[-1] != report.window.index:
        return own
    return ForecastDocument(computed=own.computed, reason=CONTRADICTED) if own.watch or own.act or own.figures else own


def _with_forecasts(plan: MonitoringPlan, state: HealthState, report: ReportDocument) -> HealthState:
    """Return the state with the values of this window in the histories, with the forecasts that are due, and trends."""
    histories, forecasts, trends = dict(state.histories), dict(state.forecasts), dict(state.trends)
    for name in report.parameters:
        if (point := history_point(plan, report, name)) is None:
            continue
        histories[name] = with_point(histories.get(name, ()), *point)
        required = required_limits(report, plan.parameters, name)
        if (plan.parameters[name].limits or required) and is_due(forecasts.get(name), histories[name]):
            forecasts[name] = forecast(plan.parameters[name], histories[name], required)
        own, now = forecasts.get(name), report.window.end
        if seen := seen_trend(plan.parameters[name], histories[name], own, trends.get(name), now):
            trends[name] = seen
    return replace(state, histories=histories, forecasts=forecasts, trends=trends)


def _advance(
    plan: MonitoringPlan, before: ConditionRecord, observed: Observation, report: ReportDocument
) -> ConditionRecord:
    """Return the record after an observation, with its event; one that the window clears has an end."""
    event = before.event and before.event.model_copy(update={"change": None})
    if observed.level is None or (before.level is Level.HINT and observed.level is Level.OK):  # a hint is given once
        is_interrupted = event is None and report.decision is WindowDecision.SUSPECTED  # something else may be true
        return replace(before, event=event, recent=() if is_interrupted else before.recent)
    persistence = observed.persistence.of_windows(report.window.end - report.window.start)
    if before.returns(report.window.index if event is None else event.evidence.windows[0]):
        persistence = replace(persistence, fall=max(persistence.fall, RELEASE_WINDOWS))
    length = max(persistence.rise, persistence.fall, persistence.within)
    recent = (*before.recent, (observed.level, report.window))[-length:]
    level, count = _persistent(before.level, [item[0] for item in recent], persistence)
    first = recent[-count:][0][1]
    if event is None and level is not Level.OK:
        event = _raised(plan, observed, level, (first, report.window))
    elif event is not None and level is not before.level:
        is_over = level is Level.OK
        # A log may go back in time: an event keeps its begin, and ends after it.
        begin = max(first.start, event.since)
        changed = {"end": begin} if is_over else {"state": level, "since": begin}
        change = EventChange.CLEARED if is_over else EventChange.CHANGED
        event = event.model_copy(update={"change": change, **changed})
    others: tuple[str, ...] = ()
    if event is not None and observed.level is not Level.OK:
        described = event.model_copy(update=_description(plan, event, observed, report.window.index))
        if event.condition_id not in ("", described.condition_id) and event.change is None:
            others = (*before.others, described.condition_id)[-PERSISTENT_WINDOWS:]
        is_other = others == PERSISTENT_WINDOWS * (described.condition_id,)
        if is_other:
            described = described.model_copy(update={"change": EventChange.CHANGED})
        event = described if is_other or not others else event
    kept = recent[-count:] if level.rank < before.level.rank else recent  # what is over does not count again
    limit = _deciding_limit(before, observed, level, event)
    return ConditionRecord(level, kept, event, observed.persistence, before.cleared, others, limit)


def _deciding_limit(
    before: ConditionRecord, observed: Observation, level: Level, event: EventDocument | None
) -> float | None:
    """Return the value of the limit that decides ``level`` after an observation.

    A window at another level does not change what holds the present one: it may be the only such window.
    """
    if event is None or level is Level.OK:
        return None
    if observed.level is level and observed.limit is not None:
        return observed.limit
    return before.held if level is before.level else event.evidence.limit


def _ended(plan: MonitoringPlan, event: EventDocument, now: float) -> EventDocument:
    """Return a dropped event as it is cleared, with what persons wrote to it meanwhile."""
    reason = plan.texts.translated(event.reason or "")
    update = {"change": EventChange.CLEARED, "end": max(event.since, now), "reason": reason}
    return event.model_copy(update={**update, "sequence": None, "previous": None})


def _raised(
    plan: MonitoringPlan, observed: Observation, level: Level, windows: tuple[WindowDocument, WindowDocument]
) -> EventDocument:
    """Return a new event, not described yet, that the first to the last of ``windows`` agree on."""
    start = min(windows[0].start, windows[0].start if observed.since is None else observed.since)
    evidence = EvidenceDocument(windows=(windows[0].index, windows[1].index))
    return EventDocument(
        id=f"{observed.key}@{start:.1f}", part=observed.part, state=level, change=EventChange.RAISED,
        start=start, since=start, condition="", text="", evidence=evidence, language=plan.language,
        timezone=plan.timezone or None,
    )  # fmt: skip


def _persistent(level: Level, recent: Sequence[Level], persistence: Persistence) -> tuple[Level, int]:
    """Return the level after the ``recent`` observations, and how many windows ago the first of them began that agree.

    A condition that comes and goes ends after ``within`` consecutive windows without it.
    """
    rise, fall = persistence.rise, persistence.fall
    among = recent[-max(rise, persistence.within) :]
    agreed = sorted(among, key=lambda item: -item.rank)[rise - 1 : rise]
    if agreed and agreed[0].rank > level.rank:
        return agreed[0], len(among) - next(at for at, item in enumerate(among) if item.rank >= agreed[0].rank)
    shown = [at for at, item in enumerate(among) if item.rank >= level.rank]
    fall = fall if shown and len(shown) >= max(rise, 1 + shown[-1] - shown[0]) else max(fall, persistence.within)
    highest = max(recent[-fall:], key=lambda item: item.rank)
    return (highest, fall) if len(recent) >= fall and highest.rank < level.rank else (level, rise)


def _description(
    plan: MonitoringPlan, event: EventDocument, observed: Observation, window: int
) -> dict[str, str | EvidenceDocument | None]:
    """Return text, diagnosis and evidence of an observation that shows the condition, by the keys of the event."""
    texts = {"condition": str(observed.features.finding), "condition_id": str(observed.features.finding)}
    texts |= {"language": plan.language, **diagnose(plan.rules, observed.features, plan.texts)}
    texts["advice"] = "; ".join(filter(None, (texts.get("advice"), observed.advice)))
    numbers = {"windows": (event.evidence.windows[0], window), **(observed.numbers or {})}
    texts |= {"setting": observed.setting, "formulas": observed.formulas}
    evidence = event.evidence.model_copy(update=numbers)
    return {**texts, "timezone": plan.timezone or None, "text": observed.text, "evidence": evidence}


def _states(
    plan: MonitoringPlan,
    before: HealthDocument | None,
    report: ReportDocument,
    events: Sequence[EventDocument],
    determined: Collection[str],
) -> HealthDocument:
    """Return the states of parts and machine; ``events`` begin with the most severe.

    ``determined`` are the parameters that once were. Without data, all parts of the machine are at NO DATA.
    """
    worst = {event.part: event for event in reversed(events)}
    no_data = next((event for event in events if event.state is Level.NO_DATA and event.part == BUS), None)
    parts: dict[str, PartDocument] = {}
    for part in dict.fromkeys((*plan.parts, SENSORS, BUS, *worst)):
        earlier = before.parts.get(part) if before else None
        if event := worst.get(part, no_data):
            own = [item for item in events if item.part == event.part and item.state is event.state]
            kept = _kept(earlier, event.state, event.since, event.condition, ())
            parts[part] = kept.model_copy(update={"shelved": shelved_until(own)})
        elif missing := _undetermined(plan, part, report):
            key = "no_longer" if any(name in determined for name in missing) else "not_yet"
            reason = plan.texts(key, names=", ".join(missing))
            parts[part] = _kept(earlier, Level.NO_DATA, _begin(earlier, report), reason, missing)
        elif _waits_for_baseline(plan, part):
            reason = plan.texts("no_baseline")
            parts[part] = _kept(earlier, Level.NO_DATA, _begin(earlier, report), reason, ())
        else:
            parts[part] = _kept(earlier, Level.OK, _begin(earlier, report), "", ())
    levels = [item.state for item in parts.values() if item.state.rank > Level.NO_DATA.rank]
    is_known = any(parts[part].state is not Level.NO_DATA for part in plan.parts) or not plan.parts
    state = max(levels, key=lambda level: level.rank, default=Level.OK if is_known and not no_data else Level.NO_DATA)
    same = {name: item for name, item in parts.items() if item.state is state}
    reason = PARTS.join(reasons_of(same))
    since = min(item.since for item in same.values()) if levels else _begin(before, report)
    unknown = tuple(name for item in same.values() for name in item.undetermined)
    whole = _kept(before, state, since, reason, unknown)
    ends = [item.shelved for item in same.values() if item.shelved is not None]
    shelved = min(ends) if ends and len(ends) == len(same) else None
    return HealthDocument(
        **{**dict(whole), "shelved": shelved}, parts=parts, language=plan.language, timezone=plan.timezone or None
    )


def _begin(before: PartDocument | None, report: ReportDocument) -> float:
    """Return when a state begins with a window: not before the one before it, although a log may go back in time."""
    return report.window.start if before is None else max(report.window.start, before.since)


def _kept(
    before: PartDocument | None, state: Level, since: float, reason: str, undetermined: tuple[str, ...]
) -> PartDocument:
    """Return a state, since the report before or earlier if that has the same one."""
    since = min(before.since, since) if before is not None and before.state is state else since
    return PartDocument(state=state, since=since, reason=reason, undetermined=undetermined)


def _undetermined(plan: MonitoringPlan, part: str, report: ReportDocument) -> tuple[str, ...]:
    """Return the parameters of a part of the twin that its state lacks: those with limits, and all if none is known.

    Of a part without parameters of its own, it is enough that some parameter of the machine is known.
    """
    own = plan.parameters_of(part)
    unknown = [name for name, item in report.parameters.items() if item.value is None and (name in own or not own)]
    if part not in plan.parts or len(unknown) == len(own or report.parameters):
        return tuple(own or report.parameters) if part in plan.parts else ()
    return tuple(name for name in unknown if own and plan.parameters[name].limits)


def _waits_for_baseline(plan: MonitoringPlan, part: str) -> bool:
    """Whether no limit of the parameters of a part of the twin is judged, because all of them wait for a baseline."""
    own = [plan.parameters[name] for name in plan.parameters_of(part) or plan.parameters]
    return part in plan.parts and any(row.waiting for row in own) and not any(row.limits for row in own)
