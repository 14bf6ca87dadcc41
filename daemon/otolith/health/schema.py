"""The report: one document per window, the same on Zenoh, in recordings and as JSON Lines.

Every number is finite or absent; what has no content yet is absent, not invented.

The part of the report that is about components and findings.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from otolith.acquisition.window import Array, Verdict, Window
from otolith.discovery.adopted import Approval
from otolith.discovery.hypotheses import FaultType
from otolith.discovery.sequential_test import WindowDecision
from otolith.estimation.information import Identifiability, Outcome
from otolith_drivers.config_files import StrictModel


class ComponentStatus(StrEnum):
    """Where a component is in its life."""

    ADOPTED = "adopted"
    """Several windows agreed on it; it is in the twin and followed."""
    FADING = "fading"
    """It can hardly be seen any more."""


class NumberDocument(StrictModel):
    """A number of a component."""

    value: float
    sd: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    unit: str


class AlternativeDocument(StrictModel):
    """Another explanation, and how probable it is."""

    reason: FaultType
    text: str
    probability: float


class ComponentDocument(StrictModel):
    """A component that the twin lacked."""

    id: str
    """Site, family and input: the same for as long as the component lives."""
    site: str
    meaning: str
    """Of the site."""
    mode: Literal["additive", "multiplicative"]
    family: str
    input: str
    """What it depends on: empty for nothing, ``t``, an angle, or a signal."""
    equation: str
    values: dict[str, NumberDocument]
    conditions: str
    """Working conditions under which machines show such a thing (Table 1 of the paper)."""
    domain: str
    """Inputs for which such an equation is valid, in words."""
    status: ComponentStatus
    approval: Approval
    probability: float
    """When it was adopted."""
    onset: float
    """Unix seconds."""
    alternatives: tuple[AlternativeDocument, ...] = ()
    """What the data could not tell it from."""


class Severity(StrEnum):
    """How urgent a finding is."""

    WARNING = "warning"
    FAULT = "fault"


class FindingDocument(StrictModel):
    """What an operator should read."""

    id: str
    severity: Severity
    condition: str
    text: str
    since: float
    """Unix seconds."""
    advice: str = ""


SCHEMA: Literal["otolith.report/1"] = "otolith.report/1"


class Status(StrEnum):
    """How far a published parameter may be trusted."""

    UNESTIMATED = "unestimated"
    """No window has determined it yet; there is no value."""
    ESTIMATED = "estimated"
    """From this window and those before it."""
    HELD = "held"
    """From earlier windows; this one adds nothing, and the reason says why."""
    INVALID = "invalid"
    """The windows contradict the twin or the bounds, and the reason says how; the value is the last that did not."""


class QualityDocument(StrictModel):
    """How well the window was sampled."""

    verdict: Verdict
    missing: float
    longest_gap_s: float
    jitter_s: float
    skew_s: float
    reasons: tuple[str, ...] = ()


class WindowDocument(StrictModel):
    """Which stretch of time the report is about; start and end in Unix seconds."""

    index: int
    start: float
    end: float
    records: int
    quality: QualityDocument


class ParameterDocument(StrictModel):
    """One parameter: value, unit, uncertainty, status, reason."""

    value: float | None = None
    unit: str
    sd: float | None = None
    low: float | None = None
    """Lower end of the 95 % interval."""
    high: float | None = None
    nominal: float
    raw: float | None = None
    """What this window alone says."""
    raw_sd: float | None = None
    trend_per_hour: float | None = None
    """How it changes now, in its unit per hour."""
    trend_sd_per_hour: float | None = None
    status: Status
    progress: float = 0.0
    """How far its interval has come from the bounds to what is asked for, 0 to 1."""
    identifiability: Identifiability | None = None
    reason: str = ""
    advice: str | None = None
    """What move of the machine would pin it down, if it is not."""


class FitDocument(StrictModel):
    """How well the twin explains the window; root mean square errors per output, in the output's unit."""

    rmse_configured: dict[str, float]
    rmse_estimated: dict[str, float]
    rmse_completed: dict[str, float] | None = None
    """With the components."""
    explained: bool
    """Whether the estimated twin leaves nothing but noise."""
    cost: float
    """RMSE of all outputs in units of their noise."""
    variance_ratio: float
    """How much more windows differ from each other than each of them says, as a ratio of variances: one if all is well.
    """
    outcome: Outcome
    """How the search ended."""


class CostDocument(StrictModel):
    """What the report took."""

    seconds: float = 0.0
    """Of computing."""
    latency_s: float = 0.0
    """From the end of the window to the publication of this report."""
    evaluations: int = 0
    generations: int = 0
    searched: bool = False
    """Whether it was asked what else could have happened: components, moved parameters, lying sensors."""


class DriverDocument(StrictModel):
    """How the connection to the machine fares."""

    up: bool
    reason: str = ""
    """Why it is down."""
    warnings: tuple[str, ...] = ()
    """What is wrong although it is up, a line each."""
    plan: str = ""
    """What is asked of the machine and what is achieved, where it is asked."""


class CountersDocument(StrictModel):
    """What was received and what was lost since the daemon started: nothing is lost silently."""

    received: int = 0
    """Samples."""
    bad: int = 0
    """Frames, replies or values that came and could not be used."""
    lost: int = 0
    """Samples that were sent or asked for and never came, or that found no room."""
    reconnects: int = 0
    windows: int = 0
    """Windows cut."""
    windows_bad: int = 0
    """Not estimated from, for their quality."""
    windows_missed: int = 0
    """Not adapted to, because the worker was dead or busy."""
    worker_restarts: int = 0
    recordings_dropped: int = 0
    """Windows that the recorder did not take in time."""


class ReportDocument(StrictModel):
    """The document itself."""

    schema_: Literal["otolith.report/1"] = SCHEMA
    machine: str
    site: str
    twin: str
    model: str = "DT"
    """``DT`` the twin as configured, ``DT'`` with estimated parameters (the paper's names)."""
    window: WindowDocument
    decision: WindowDecision
    """What was made of the window."""
    parameters: dict[str, ParameterDocument]
    components: tuple[ComponentDocument, ...] = ()
    """That the twin lacked."""
    explanations: tuple[AlternativeDocument, ...] = ()
    """Of what has happened, while that is not decided; the most probable first."""
    findings: tuple[FindingDocument, ...] = ()
    fit: FitDocument | None = None
    """None where nothing was estimated from the window."""
    cost: CostDocument = CostDocument()
    counters: CountersDocument | None = None
    driver: DriverDocument | None = None
    """None in a replay."""

    def to_json(self) -> str:
        """As published: absent where there is no content, ``schema`` first."""
        return self.model_dump_json(exclude_none=True).replace('"schema_"', '"schema"', 1)

    @classmethod
    def from_json(cls, text: str) -> "ReportDocument":
        """The inverse of :meth:`to_json`.

        Raises:
            pydantic.ValidationError: not a report of this schema.
        """
        return cls.model_validate_json(text.replace('"schema"', '"schema_"', 1))


@dataclass(frozen=True, slots=True)
class Traces:
    """The curves behind a report, in the units of the twin; not a number where a record was missing."""

    outputs: tuple[str, ...]
    measured: Array
    """(records, outputs)."""
    predicted: Array | None
    """(records, outputs); None where nothing was estimated."""
    noise: tuple[float, ...]
    inputs: tuple[str, ...]
    driving: Array
    """(records, inputs), as measured."""


@dataclass(frozen=True, slots=True)
class Report:
    """What the heart says of a window."""

    document: ReportDocument
    traces: Traces


def window_document(window: Window) -> WindowDocument:
    """The part of the report that is known before any estimation."""
    quality = window.quality
    return WindowDocument(
        index=window.index,
        start=window.start,
        end=window.end,
        records=window.records,
        quality=QualityDocument(
            verdict=quality.verdict,
            missing=quality.missing,
            longest_gap_s=quality.longest_gap,
            jitter_s=quality.jitter,
            skew_s=quality.skew,
            reasons=quality.reasons,
        ),
    )
