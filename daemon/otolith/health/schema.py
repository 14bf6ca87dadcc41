"""The report schema: one document per window, the same on Zenoh, in recordings and as JSON Lines.

Every number is finite or absent. What has no content yet is absent.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Literal, get_args

from pydantic import Field

from otolith.acquisition.window import Array, Verdict, Window
from otolith.discovery.alternatives import WindowDecision
from otolith.discovery.decision import Approval
from otolith.discovery.hypotheses import FaultType
from otolith.estimation.information import Identifiability, Outcome
from otolith.health.limits import Level
from otolith_drivers.config_files import DocumentModel

Language = Literal["en", "de"]
LANGUAGES: tuple[Language, ...] = get_args(Language)

Count = Annotated[int, Field(ge=0, le=2**63 - 1)]
"""A number that each database and each number of 64 bits can have: anybody may publish a document."""


class FindingKind(StrEnum):
    """What was observed."""

    LIMIT = "limit"  # A parameter is beyond a limit
    LIMIT_FROM_START = "limit from the start"  # The same, since the first window that determined it
    TREND = "trend"  # A parameter within its limits is on its way to one
    LOST = "identifiability lost"  # A parameter that was determined is not any more, although the machine moves
    COMPONENT = "component"
    SENSOR = "sensor"
    TIMING = "late signal"
    NOISE = "noise"
    POLLED = "polled command"  # A command changes between its samples, and the machine file does not say so
    CLASS = "class"  # Several hypotheses explain the windows equally well
    OPEN = "open"  # Hypotheses are being compared
    MOVED = "moved"  # A parameter that the machine file gives as known is another
    RETURNS = "returns"  # Something changes again and again, and is never there for long
    UNEXPLAINED = "unexplained"
    NO_DATA = "no data"
    NO_TEMPERATURE = "no temperature"  # The temperature on which a parameter depends is not measured at present
    NO_SOURCE = "no source"  # One of several sources is down or gave no sample, or a source has a defect
    NO_OUTPUT = "no output"  # The daemon cannot publish, record or save something


class ComponentStatus(StrEnum):
    """Whether a component is still significant."""

    ADOPTED = "adopted"  # Several windows agreed on it; it is in the twin and tracked
    FADING = "fading"  # It is hardly significant any more


class NumberDocument(DocumentModel):
    """One value of a component, with its 95 % interval."""

    value: float
    sd: float
    low: float  # Lower end of the 95 % interval
    high: float
    unit: str


class AlternativeDocument(DocumentModel):
    """A hypothesis, and how probable it is."""

    reason: FaultType
    text: str
    probability: float


class ComponentDocument(DocumentModel):
    """A component that was added to the twin."""

    id: str  # Site, family and input: the same from adoption to the end
    site: str
    meaning: str  # Meaning of the site
    mode: Literal["additive", "multiplicative"]
    family: str
    input: str  # The source: empty for none, t, an angle, or a signal
    equation: str
    values: dict[str, NumberDocument]
    conditions: str  # Working conditions under which machines show such a component (Table 1 of the paper)
    domain: str  # Inputs for which the equation is valid, in words
    status: ComponentStatus
    approval: Approval
    probability: float  # Probability of the component when it was adopted
    onset: float  # Unix seconds
    alternatives: tuple[AlternativeDocument, ...] = ()  # Hypotheses that the data did not distinguish from it


class Severity(StrEnum):
    """Severity of a finding."""

    WARNING = "warning"
    FAULT = "fault"


class FindingDocument(DocumentModel):
    """A finding for the operator."""

    id: str
    kind: FindingKind
    subject: str = ""  # Signal, site or parameter that it is about
    value: NumberDocument | None = None  # Of a parameter that has moved
    severity: Severity
    condition: str
    text: str
    since: float  # Unix seconds
    error: float | None = None
    """Of a sensor, its error over the size of its signal; of a late signal, its delay in s, negative for an early one.
    """
    advice: str = ""
    setting: str = ""  # What to write into the machine file if it is wrong and the machine is not; for the specialist
    of_file: bool = False  # Whether it shows that the machine file is wrong, whatever happens to the machine


class EventChange(StrEnum):
    """What a window changed in an event."""

    RAISED = "raised"
    CHANGED = "changed"
    CLEARED = "cleared"
    NOTED = "noted"  # It happened at one moment, at which it also ends: the clock was set
    ACKNOWLEDGED = "acknowledged"  # A person has seen it
    SHELVED = "shelved"  # A person made it silent until a time
    UNSHELVED = "unshelved"  # It is no longer silent: by a person, or as the time is over
    COMMENTED = "commented"


OF_PERSONS = frozenset({EventChange.ACKNOWLEDGED, EventChange.SHELVED, EventChange.COMMENTED})
"""Changes that nobody has to be told of at once; the condition is as it was."""


class NoteDocument(DocumentModel):
    """What a person did with an event."""

    by: str  # Name or account
    at: float  # Unix seconds
    text: str = ""  # Reason or comment
    until: float | None = None  # Unix seconds, of a shelved event: when it is silent no more


class EvidenceDocument(DocumentModel):
    """What an event rests on."""

    windows: tuple[Count, Count]  # Index of the first and of the latest window that showed it
    value: float | None = None
    sd: float | None = None
    unit: str = ""
    limit: float | None = None  # The limit that was passed, in unit
    probability: float | None = None  # That the true value is beyond the limit


class EventDocument(DocumentModel):
    """A condition of a part that calls for attention, from the window that raised it to the one that cleared it."""

    id: str  # What it is about, and when it began: the same in each of its reports
    sequence: Count | None = None  # Of a change: see ReportDocument.sequence
    previous: Count | None = None  # Of a change: the sequence number of the change of an event before it
    part: str
    state: Level
    change: EventChange | None = None  # None if this window changed nothing
    start: float  # Unix seconds, as are since and end
    since: float  # Begin of the present state
    end: float | None = None
    condition: str
    condition_id: str = ""  # Ids of the rules that it is from, with spaces between; the same in all languages
    text: str
    cause: str = ""
    advice: str = ""
    setting: str = ""  # What to write into the machine file if it is wrong and the machine is not; for the specialist
    formulas: str = ""  # Equations of components and causes, which ``text`` has in words; for the specialist
    source: str = ""
    reason: str | None = None  # Why it is cleared although nothing shows that it is over: its learned state was dropped
    language: Language = "en"  # Of condition, text, cause, advice and reason
    timezone: str | None = None  # IANA name of the plant's zone, in which people read times
    evidence: EvidenceDocument
    acknowledged: NoteDocument | None = None  # Who has seen it; None again once it is worse, or its diagnosis another
    shelved: NoteDocument | None = None  # While it is silent
    comments: tuple[NoteDocument, ...] | None = None  # The last ones

    @property
    def is_silent(self) -> bool:
        """Whether nobody has to be told of its change at once: a hint, what is shelved, and what a person did."""
        return self.is_hint or self.shelved is not None or self.change in OF_PERSONS

    @property
    def is_urgent(self) -> bool:
        """Whether its part is at :attr:`Level.ACT` because of it."""
        return self.state is Level.ACT and self.end is None

    @property
    def is_hint(self) -> bool:
        """Whether only the machine file is wrong, so that it concerns nobody but the specialist."""
        return self.state is Level.HINT


class NoticeDocument(DocumentModel):
    """What is told of an event, or of a machine that fell silent, to other systems."""

    schema_: Literal["otolith.notice/1"] = "otolith.notice/1"
    key: str  # The same for each try to pass this notice on, and for no other notice
    site: str
    machine: str
    told: Literal["raised", "worse", "better", "cleared"]
    state: Level  # NO DATA of silence, OK once it is cleared
    part: str | None = None
    condition: str | None = None
    text: str | None = None
    cause: str | None = None
    advice: str | None = None
    start: float  # Unix seconds, as since and end
    since: float  # Begin of the present state
    end: float | None = None
    event: str  # Id of the event, the same from raised to cleared


class PartDocument(DocumentModel):
    """State of a part or of the machine."""

    state: Level
    since: float  # Unix seconds
    reason: str = ""
    shelved: float | None = None  # Unix seconds until which all events are silent that it is in this state for
    undetermined: tuple[str, ...] = ()  # The parameters because of which it is at NO DATA, although there are data


class HealthDocument(PartDocument):
    """State of the machine and of its parts."""

    parts: dict[str, PartDocument]
    language: Language = "en"  # Of the reasons
    timezone: str | None = None  # IANA name of the plant's zone, in which people read times
    has_agreed: bool | None = None  # True once it was as its file says for long: what begins then is a change


SCHEMA: Literal["otolith.report/1"] = "otolith.report/1"


class Status(StrEnum):
    """How far a published parameter may be trusted."""

    UNESTIMATED = "unestimated"  # No window has determined it yet; there is no value
    ESTIMATED = "estimated"  # From this window and those before it
    AMBIGUOUS = "ambiguous"
    """The hypotheses that explain the windows differ in it by more than is required; the interval holds all of them."""
    HELD = "held"  # From earlier windows; this one adds nothing; why is in the reason
    INVALID = "invalid"
    """The windows contradict the twin or the bounds, how is in the reason; the value is the last that did not."""


class QualityDocument(DocumentModel):
    """Sampling quality of a window."""

    verdict: Verdict
    missing: float
    longest_gap_s: float
    jitter_s: float
    skew_s: float
    reasons: tuple[str, ...] = ()


class WindowDocument(DocumentModel):
    """The window; start and end in Unix seconds."""

    index: Count
    start: float
    end: float
    records: Count
    quality: QualityDocument
    observed: dict[str, float] | None = None  # Mean of each observed signal, as a temperature in K
    absent: dict[str, str] | None = None  # Of several sources, those that are down or gave no sample: in words, by name
    outages: dict[str, str] | None = None  # Outputs of the daemon that fail for long, and why, by name


class CrossingDocument(DocumentModel):
    """When a parameter will pass a limit, Unix seconds."""

    limit: float  # In the unit of the parameter
    at: float  # Median
    low: float  # Lower end of the 80 % interval
    high: float | None = None  # None if it lies beyond ten times the length of the history


class ForecastDocument(DocumentModel):
    """When a parameter will pass limits, and lead figures of performance beyond required values, from its history."""

    computed: float  # Unix seconds
    family: Literal["", "linear", "exponential"] = ""  # Of the trend; empty without one
    watch: CrossingDocument | None = None
    act: CrossingDocument | None = None
    figures: dict[str, CrossingDocument] | None = None  # When each figure will lack its required value, by its name
    reason: str = ""  # Why there is no forecast


class HeldDocument(DocumentModel):
    """A value that is not estimated."""

    value: float
    unit: str


class ParameterDocument(DocumentModel):
    """One parameter: value, unit, uncertainty, status, reason."""

    value: float | None = None
    unit: str
    sd: float | None = None
    low: float | None = None  # Lower end of the 95 % interval
    high: float | None = None
    nominal: float
    baseline: float | None = None  # Healthy value, to which limits in percent refer; None if they refer to nominal
    is_example: bool | None = None  # True if nominal is of the twin's example, which is another machine; else None
    limit: float | None = None  # The nearest to the healthy value of the most severe limits; None without limits
    referred: float | None = None  # At the reference temperature, for the limits; None without a temperature
    raw: float | None = None  # Estimate of this window alone
    raw_sd: float | None = None
    trend_per_hour: float | None = None  # Present trend, in the unit of the parameter per hour
    trend_sd_per_hour: float | None = None
    status: Status
    progress: float = 0.0  # How far the interval has come from the bounds to what is required, 0 to 1
    identifiability: Identifiability | None = None
    reason: str = ""
    as_right_as: dict[str, HeldDocument] | None = None
    """Parameters that are held, and that the data do not tell from this one: where they are wrong, so is it."""
    forecast: ForecastDocument | None = None  # None without limits
    advice: str | None = None  # The experiment that would determine the parameter, if this window did not


class KeptDocument(DocumentModel):
    """Values of a parameter between which a figure of performance keeps its required value, others as they are."""

    low: float | None = None  # In the unit of the parameter, at the present temperature; None if no bound is beyond
    high: float | None = None
    unit: str


class LackDocument(CrossingDocument):
    """When a figure of performance will lack its required value: when a parameter passes ``limit``."""

    parameter: str
    unit: str  # Of the parameter


class RequirementDocument(DocumentModel):
    """The required value of a figure of performance, and whether the machine has it."""

    value: float  # In the unit of the figure
    met: bool | None = None  # Now; None while the 95 % interval holds the required value, or there is no value
    met_at_baseline: bool | None = None  # Of the baseline; None without one
    met_at_limit: bool | None = None  # With the parameter at its limit; None without one
    kept: dict[str, KeptDocument] | None = None  # By the parameter
    lacks: LackDocument | None = None  # From when on it is not met, if a trend goes on
    reason: str = ""  # Why no time is known, while it is met


class PerformanceDocument(DocumentModel):
    """A figure of performance: what the machine costs or yields."""

    meaning: str
    value: float | None = None
    unit: str
    sd: float | None = None
    low: float | None = None  # Lower end of the 95 % interval, which is that of the parameters
    high: float | None = None
    better: Literal["lower", "higher"]
    at: dict[str, float] | None = None  # The operating point, in the units of the twin
    over: Literal["window", "point"]  # Whether it is the mean over the window, or the value at the operating point
    status: Status
    reason: str = ""
    parameters: tuple[str, ...] = ()  # The estimated ones that it depends on
    baseline: float | None = None  # With the healthy values of these, at the present temperature
    at_limit: float | None = None  # With the parameter ``limited`` at its limit
    limited: str | None = None
    limit: float | None = None  # In the unit of that parameter, at the present temperature
    limit_unit: str | None = None
    requirement: RequirementDocument | None = None  # None if nothing is required


class FitDocument(DocumentModel):
    """How well the twin explains the window; root mean square errors per output, in the output's unit."""

    rmse_configured: dict[str, float]
    rmse_estimated: dict[str, float]
    rmse_completed: dict[str, float] | None = None  # With the components in the twin
    explained: bool  # Whether the estimated twin leaves nothing but noise
    cost: float  # RMSE of all outputs in units of their noise
    variance_ratio: float  # Variance between windows over the variance that they state; one if they agree
    outcome: Outcome  # How the search ended
    units: dict[str, str] = Field(default_factory=dict)  # Of the outputs


class CostDocument(DocumentModel):
    """Computing effort of a report."""

    seconds: float | None = None  # Computing time, s; None in a replay, unless it was asked for
    latency_s: float | None = None  # From the end of the window to the publication of this report; None in a replay
    evaluations: Count = 0
    generations: Count = 0
    searched: bool = False  # Whether hypotheses were compared: components, moved parameters, faulty sensors


class SourceDocument(DocumentModel):
    """State of one of several sources of a machine."""

    signals: tuple[str, ...]
    up: bool
    reason: str = ""  # Why it is down
    warnings: tuple[str, ...] = ()  # What is wrong although it is up, a line each
    received: Count = 0  # Samples
    bad: Count = 0  # Received frames, replies or values that could not be used
    lost: Count = 0  # Samples that were sent or requested and did not arrive
    reconnects: Count = 0


class DriverDocument(DocumentModel):
    """State of the connection to the machine."""

    up: bool
    reason: str = ""  # Why the connection is down
    warnings: tuple[str, ...] = ()  # What is wrong although the connection is up, a line each
    plan: str = ""  # Polling plan and achieved rate of a polling driver
    sources: dict[str, SourceDocument] = Field(default_factory=dict)  # By name; the connection is up while any is


class CountersDocument(DocumentModel):
    """What was received and lost since the daemon started."""

    received: Count = 0  # Samples
    bad: Count = 0  # Received frames, replies or values that could not be used
    lost: Count = 0  # Samples that were sent or requested and did not arrive, or that overflowed a buffer
    reconnects: Count = 0
    windows: Count = 0  # Windows formed
    windows_bad: Count = 0  # Windows not estimated from because of their quality
    windows_missed: Count = 0  # Windows not estimated from because the worker was down or busy
    worker_restarts: Count = 0
    recordings_dropped: Count = 0  # Windows that the recorder did not accept in time, or lost when it ended
    recorder_restarts: Count = 0
    history_dropped: Count = 0  # Windows that the history did not take: its disk was full or too slow
    evidence_dropped: Count = 0  # Changes of events of which no evidence could be kept
    commands_failed: Count = 0  # Events for which on_event failed


class CertificateDocument(DocumentModel):
    """The certificate by which a daemon is recognised over the network."""

    since: float  # Unix seconds: begin of its validity
    until: float  # Unix seconds: after it nobody can connect


class DaemonDocument(DocumentModel):
    """What is to be known of the daemon beside its machine."""

    version: str  # Of Otolith
    certificate: CertificateDocument | None = None  # None without endpoints that need one


class ReportDocument(DocumentModel):
    """The report of one window."""

    schema_: Literal["otolith.report/1"] = SCHEMA
    sequence: Count | None = None  # Rises from message to message of a machine, also after a restart; None in a replay
    previous: Count | None = None  # Sequence number of the report before it; None for the first one
    machine: str
    site: str
    twin: str
    model: str = "DT"  # The paper's name: DT as configured, DT' with estimated parameters, DT'' with components
    window: WindowDocument
    decision: WindowDecision  # What the window led to
    parameters: dict[str, ParameterDocument]
    performance: dict[str, PerformanceDocument] | None = None  # Of twins that state figures; without the components
    components: tuple[ComponentDocument, ...] = ()  # Components in the twin
    explanations: tuple[AlternativeDocument, ...] = ()  # Hypotheses while they are undecided; most probable first
    findings: tuple[FindingDocument, ...] = ()
    health: HealthDocument | None = None  # State of the machine and of its parts
    events: tuple[EventDocument, ...] = ()  # Those open, and those that this window cleared; most severe first
    fit: FitDocument | None = None  # None for a window that was not estimated from
    cost: CostDocument = CostDocument()
    counters: CountersDocument | None = None
    driver: DriverDocument | None = None  # None in a replay
    daemon: DaemonDocument | None = None  # None in a replay
    notes: tuple[str, ...] = ()  # About the daemon since its start: which saved state it could not use, and why

    @property
    def is_left_out(self) -> bool:
        """Whether the machine is not served: its report has no number and no twin, and says why."""
        return self.sequence is None and not self.twin

    @property
    def open_events(self) -> tuple[EventDocument, ...]:
        """The events that are not cleared, without hints; most severe first."""
        return tuple(event for event in self.events if event.end is None and not event.is_hint)

    @property
    def hints(self) -> tuple[EventDocument, ...]:
        """What is wrong in the machine file."""
        return tuple(event for event in self.events if event.end is None and event.is_hint)

    def to_json(self) -> str:
        """Return the published JSON in one line: ``schema`` first, absent keys where there is no content."""
        return self.json_line().replace('"schema_"', '"schema"', 1)

    @classmethod
    def from_json(cls, text: str) -> "ReportDocument":
        """Return the report of a JSON text, as :meth:`to_json` wrote it; raise ValidationError if it is none."""
        return cls.model_validate_json(text.replace('"schema"', '"schema_"', 1))


@dataclass(frozen=True, slots=True)
class Traces:
    """The curves of a window in the units of the twin; not-a-number where nothing was measured."""

    offsets: Array  # (records,) time since the first record, s
    outputs: tuple[str, ...]
    measured: Array  # (records, outputs)
    predicted: Array | None  # (records, outputs); None for a window that was not estimated from
    noise: tuple[float, ...]
    inputs: tuple[str, ...]
    driving: Array  # (records, inputs), as measured


@dataclass(frozen=True, slots=True)
class Report:
    """The report document of a window, with its curves."""

    document: ReportDocument
    traces: Traces


def window_document(window: Window) -> WindowDocument:
    """Return the part of the report that is known before any estimation."""
    quality = window.quality
    return WindowDocument(
        index=window.index,
        start=window.start,
        end=window.end,
        records=window.records,
        observed=dict(window.observed) or None,
        absent=dict(window.absent) or None,
        outages=dict(window.outages) or None,
        quality=QualityDocument(
            verdict=quality.verdict,
            missing=quality.missing,
            longest_gap_s=quality.longest_gap,
            jitter_s=quality.jitter,
            skew_s=quality.skew,
            reasons=quality.reasons,
        ),
    )
