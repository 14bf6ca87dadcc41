"""What the options of ``otolith init`` have answered."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Answers:
    """What options have answered."""

    twin: str | None = None
    signals: Mapping[str, str] = field(default_factory=dict)
    unknown: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, str] = field(default_factory=dict)
    noises: Mapping[str, str] = field(default_factory=dict)
    displays: Mapping[str, str] = field(default_factory=dict)  # Of signals, as "1450 rpm"
    name: str | None = None
    site: str | None = None
    sample_period: str | None = None
    window: str | None = None
