"""The machines of a hall that are not served: what is published of them, so that somebody mends them."""

from collections.abc import Collection, Iterable

from otolith import __version__
from otolith.acquisition.window import Verdict
from otolith.discovery.alternatives import WindowDecision
from otolith.health.limits import MACHINE, Level
from otolith.health.schema import (
    CertificateDocument,
    DaemonDocument,
    DriverDocument,
    HealthDocument,
    PartDocument,
    QualityDocument,
    ReportDocument,
    WindowDocument,
)
from otolith.health.text import texts_in
from otolith.publishing.publisher import Published, Publisher
from otolith.runtime.hall.files import Names, Refused

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
LEFT_OUT_INTERVAL = 10.0  # s between two reports that a machine is not served, and the length of their windows


class LeftOut:
    """Publishes at intervals that machines are not served; without sequence numbers, as they are in no history."""

    def __init__(self) -> None:
        self._machines: dict[Names, tuple[Refused, float]] = {}  # And since when, Unix s
        self._published: dict[Names, Publisher] = {}
        self._due = 0.0  # Monotonic s

    def replace(self, refused: Iterable[Refused], served: Collection[Names], now: float) -> None:
        """Go on with other machines, without those that are ``served`` under the same name; ``now`` in Unix s."""
        before = self._machines
        self._machines = {}
        for each in refused:
            if not (each.is_served or each.names in served or each.names in self._machines):
                known = before.get(each.names)
                self._machines[each.names] = each, known[1] if known and known[0] == each else now
        for names in set(self._published) - set(self._machines):
            self._published.pop(names).remove(*names)
        self._due = 0.0

    def add(self, refused: Refused, now: float) -> None:
        """Publish of a further machine that it is not served; ``now`` in Unix s."""
        self._machines[refused.names], self._due = (refused, now), 0.0

    def publish(self, publisher: Publisher, now: float, unix: float) -> None:
        """Publish what is due at ``now`` (monotonic s), which is ``unix`` (Unix s)."""
        if now < self._due:
            return
        self._due = now + LEFT_OUT_INTERVAL
        for names, (refused, since) in self._machines.items():
            if (before := self._published.get(names)) is not publisher:
                if before is not None:
                    before.remove(*names)
                publisher.add(Published(*names))
                self._published[names] = publisher
            publisher.publish(left_out_report(refused, since, unix, publisher.certificate))


def left_out_report(
    refused: Refused, since: float, now: float, certificate: CertificateDocument | None = None
) -> ReportDocument:
    """Return the report of a machine that is not served ``since`` a time; times in Unix s.

    ``certificate`` is that of the daemon that leaves it out.
    """
    site, machine = refused.names
    reason = texts_in(refused.language)("not_served", reason=refused.reason)
    quality = QualityDocument(
        verdict=Verdict.BAD, missing=1.0, longest_gap_s=LEFT_OUT_INTERVAL, jitter_s=0.0, skew_s=0.0, reasons=(reason,)
    )
    part = PartDocument(state=Level.NO_DATA, since=since, reason=reason)
    return ReportDocument(
        machine=machine,
        site=site,
        twin="",
        window=WindowDocument(index=0, start=now - LEFT_OUT_INTERVAL, end=now, records=0, quality=quality),
        decision=WindowDecision.BAD,
        parameters={},
        health=HealthDocument(**part.model_dump(), parts={MACHINE: part}, language=refused.language),
        driver=DriverDocument(up=False, reason=reason),
        daemon=DaemonDocument(version=__version__, certificate=certificate),
        notes=(reason,),
    )
