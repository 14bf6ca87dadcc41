"""The daemons of a site: which versions run, and which certificates expire."""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from otolith.acquisition.quality import is_of_calendar
from otolith.health.schema import CertificateDocument, Language
from otolith.health.text import zone_of
from otolith.publishing.zenoh_config import Validity
from otolith.site.known import Knowledge, KnownMachine
from otolith.site.words import words_in
from otolith_drivers.common.time_zones import local_moment
from otolith_drivers.errors import ConfigurationError
from otolith_drivers.outside_text import visible

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_VERSION = 40  # characters of a version that are shown
MAX_VERSIONS = 20  # that are shown
NAMED = 8  # machines that are named of each version


@dataclass(frozen=True, slots=True)
class VersionRow:
    """A version, and how many daemons have it."""

    version: str
    count: int
    machines: tuple[KnownMachine, ...]  # The first ones

    @property
    def more(self) -> int:
        """How many machines are not named."""
        return self.count - len(self.machines)


@dataclass(frozen=True, slots=True)
class ExpiryRow:
    """When a certificate ends, in words."""

    machine: KnownMachine | None  # None of the site itself
    date: str
    when: str
    state: str
    is_due: bool  # Whether it has expired or expires soon


def versions(knowledge: Knowledge, language: Language) -> list[VersionRow]:
    """Return the versions by the last reports, those of the fewest machines first."""
    groups: dict[str, list[KnownMachine]] = {}
    for machine in knowledge:
        if machine.report is not None:
            own = machine.report.daemon.version if machine.report.daemon else words_in(language)["version_unknown"]
            groups.setdefault(visible(own[:MAX_VERSION]), []).append(machine)
    rows = sorted(groups.items(), key=lambda row: (len(row[1]), row[0]))[:MAX_VERSIONS]
    return [VersionRow(version, len(machines), tuple(machines[:NAMED])) for version, machines in rows]


def own_certificate(path: Path | None) -> CertificateDocument | None:
    """Return the validity of the certificate of the site; None if it has none that can be read."""
    if path is None:
        return None
    from otolith.publishing.certificates import authorities  # noqa: PLC0415 - slow to import

    try:
        own, *_ = authorities(path, ())
    except (ConfigurationError, ValueError):
        return None
    return CertificateDocument(since=own.not_valid_before_utc.timestamp(), until=own.not_valid_after_utc.timestamp())


def certificates(
    knowledge: Knowledge, now: float, language: Language, zone: str | None, own: CertificateDocument | None
) -> list[ExpiryRow]:
    """Return when the certificates of the site itself, ``own``, and of the daemons end, the first one first."""
    found: list[tuple[CertificateDocument, KnownMachine | None, str | None]] = []
    if own is not None:
        found.append((own, None, zone))
    for machine in knowledge:
        report = machine.report
        if report is not None and report.daemon is not None and report.daemon.certificate is not None:
            found.append((report.daemon.certificate, machine, zone or zone_of(report)))
    valid = (row for row in found if is_of_calendar(row[0].since) and is_of_calendar(row[0].until))
    return [_expiry(*row, now, words_in(language)) for row in sorted(valid, key=lambda row: row[0].until)]


def _expiry(
    certificate: CertificateDocument, machine: KnownMachine | None, zone: str | None, now: float, words: dict[str, str]
) -> ExpiryRow:
    end, today = local_moment(certificate.until, zone), local_moment(now, zone)
    validity = Validity(
        Path(), datetime.fromtimestamp(certificate.until, UTC), timedelta(seconds=certificate.until - certificate.since)
    )
    is_over = certificate.until <= now
    is_due = certificate.until - now < validity.notices[0].total_seconds()
    state = words["expired" if is_over else "expires_soon" if is_due else "valid"]
    return ExpiryRow(machine, f"{end:%F}", _when((end.date() - today.date()).days, words), state, is_due)


def _when(days: int, words: dict[str, str]) -> str:
    """Return how far a day is away."""
    near = {-1: "yesterday", 0: "today", 1: "tomorrow"}
    if days in near:
        return words[near[days]]
    return words["in_days" if days > 0 else "days_ago"].format(count=abs(days))
