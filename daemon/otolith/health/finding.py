"""The part of the report that is about components and findings."""

from enum import StrEnum
from typing import Literal

from otolith.adaptation.catalogue import Approval
from otolith.adaptation.claims import Reason
from otolith_drivers.toml_files import Closed


class ComponentStatus(StrEnum):
    """Where a component is in its life."""

    ADOPTED = "adopted"
    """Several windows agreed on it; it is in the twin and followed."""
    FADING = "fading"
    """It can hardly be seen any more."""


class NumberDocument(Closed):
    """A number of a component."""

    value: float
    sd: float
    low: float
    """Lower end of the 95 % interval."""
    high: float
    unit: str


class AlternativeDocument(Closed):
    """Another explanation, and how probable it is."""

    reason: Reason
    text: str
    probability: float


class ComponentDocument(Closed):
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


class FindingDocument(Closed):
    """What an operator should read."""

    id: str
    severity: Severity
    condition: str
    text: str
    since: float
    """Unix seconds."""
    advice: str = ""
