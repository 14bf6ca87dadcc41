"""The commands that can be given about a machine: as a line for the specialist, and as what a daemon is sent."""

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from otolith.health.schema import EventDocument, ReportDocument
from otolith.publishing.commands.desk import component_of
from otolith.publishing.commands.documents import CommandKind

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_OFFERED = 20  # events of a page
PLAIN = re.compile(r"[\w./][\w./()@:+,*^=\- ]{0,199}")
"""Names that can be read out and pasted; others were not written by a daemon."""
LINES: Mapping[CommandKind, tuple[str, str]] = {
    CommandKind.ACKNOWLEDGE: ("event", "acknowledge"),
    CommandKind.APPROVE: ("components", "approve"),
    CommandKind.REJECT: ("components", "reject"),
}


@dataclass(frozen=True, slots=True)
class OfferedCommand:
    """A command that can be given now."""

    kind: CommandKind
    line: str  # For a shell on the computer of the daemon


@dataclass(frozen=True, slots=True)
class EventOffers:
    """An open event, and what can be commanded about it."""

    event: EventDocument
    offers: tuple[OfferedCommand, ...]


def offers_of(report: ReportDocument) -> list[EventOffers]:
    """Return the open events of a machine about which something can be commanded, the most severe first."""
    found = (EventOffers(event, tuple(_offers(report, event))) for event in report.open_events)
    return [each for each in found if each.offers][:MAX_OFFERED]


def _offers(report: ReportDocument, event: EventDocument) -> Iterator[OfferedCommand]:
    key, component = event.id.rpartition("@")[0], component_of(report, event)
    subjects = {} if event.acknowledged is not None else {CommandKind.ACKNOWLEDGE: key}
    if component is not None:
        subjects |= {CommandKind.APPROVE: component.id, CommandKind.REJECT: component.id}
    for kind, subject in subjects.items():
        if PLAIN.fullmatch(subject) and PLAIN.fullmatch(event.id):
            words = ("otolith", *LINES[kind], f"{report.site}.{report.machine}", subject)
            yield OfferedCommand(kind, shlex.join(words))
