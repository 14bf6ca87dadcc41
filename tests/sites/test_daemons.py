"""Which versions run, and which certificates expire when, in words."""

import json
import re
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from otolith.health.schema import CertificateDocument, DaemonDocument, Language
from otolith.machine_file import TlsTable, ZenohTable
from otolith.publishing.certificates import CERTIFICATE_DAYS, make_authority, make_certificate, utc_now
from otolith.publishing.zenoh_config import Access
from otolith.site.app import FIRST_PEERS
from otolith.site.compare import peers
from otolith.site.daemons import MAX_VERSION, MAX_VERSIONS, NAMED, ExpiryRow, certificates, own_certificate, versions
from otolith.site.hall import PAGES
from otolith.site.known import Knowledge
from otolith.site.words import words_in
from tests.conftest import free_port
from tests.hostile import HOSTILE
from tests.sites.machines import Daemon, report_of, sent
from tests.sites.serving import serving
from tests.storage.histories import START
from tests.waiting import wait_for

DAY = 86_400.0  # s
YEAR = 365.0 * DAY


def known(*daemons: DaemonDocument | None) -> Knowledge:
    knowledge = Knowledge()
    for index, daemon in enumerate(daemons):
        knowledge.take(*sent(report_of(f"m-{index}").model_copy(update={"daemon": daemon})), START)
    return knowledge


def expiring(days: float, lifetime: float = YEAR) -> DaemonDocument:
    until = START + days * DAY
    return DaemonDocument(version="1", certificate=CertificateDocument(since=until - lifetime, until=until))


def rows_of(*daemons: DaemonDocument | None, language: Language = "en") -> list[ExpiryRow]:
    return certificates(known(*daemons), START, language, "UTC", None)


def test_versions_are_counted_the_rarest_first() -> None:
    new, old = DaemonDocument(version="2.0"), DaemonDocument(version="1.9")
    rows = versions(known(*[new] * 11, old, None), "en")
    assert [(row.version, row.count, row.more) for row in rows] == [
        ("1.9", 1, 0), ("unknown", 1, 0), ("2.0", 11, 11 - NAMED),
    ]  # fmt: skip
    many = known(*(DaemonDocument(version=f"{index}{'x' * 1000}") for index in range(30)))
    assert [len(row.version) for row in versions(many, "en")] == [MAX_VERSION] * MAX_VERSIONS


@pytest.mark.parametrize(
    ("days", "lifetime", "when", "state"),
    [
        (400.0, YEAR, "in 400 days", "valid"),
        (31.0, YEAR, "in 31 days", "valid"),
        (29.0, YEAR, "in 29 days", "expires soon"),
        (1.0, YEAR, "tomorrow", "expires soon"),
        (0.01, YEAR, "today", "expires soon"),
        (-0.01, YEAR, "today", "expired"),
        (-1.0, YEAR, "yesterday", "expired"),
        (-12.0, YEAR, "12 days ago", "expired"),
        (3.0, 7.0 * DAY, "in 3 days", "valid"),  # an authority renews it by itself
        (0.5, 7.0 * DAY, "tomorrow", "expires soon"),
    ],
)
def test_the_end_of_a_certificate_is_said_in_words(days: float, lifetime: float, when: str, state: str) -> None:
    (row,) = rows_of(expiring(days, lifetime))
    assert (row.when, row.state) == (when, state)
    assert row.is_due is (state != "valid")
    assert row.date == f"{datetime.fromtimestamp(START + days * DAY, UTC):%Y-%m-%d}"


def test_the_first_to_end_is_the_first_and_who_has_none_is_not_there() -> None:
    rows = rows_of(expiring(50.0), DaemonDocument(version="1"), None, expiring(-3.0), expiring(20.0))
    assert [row.machine.name for row in rows if row.machine] == ["m-3", "m-4", "m-0"]


def test_a_time_that_no_calendar_has_hinders_no_page() -> None:
    wild = [DaemonDocument(version="1", certificate=CertificateDocument(since=since, until=until))
            for since, until in ((0.0, 1e300), (-1e300, START), (START, -1.0), (START + YEAR, START))]  # fmt: skip
    assert len(rows_of(*wild)) <= 1
    assert rows_of(expiring(20.0), language="de")[0].when == "in 20 Tagen"


def test_a_table_of_the_page_has_each_machine_once_and_those_that_matter_at_once() -> None:
    """Also where several tables stand one below the other."""
    knowledge = Knowledge()
    for twin in ("dc_motor", "fan"):
        for index in range(12):
            own = {"twin": twin, "daemon": expiring(100.0 + index)}
            value = 7.0 if index < 9 else 6.5  # the last ones differ, and are far from the limit
            knowledge.take(*sent(report_of(f"{twin}-{index}", value=value).model_copy(update=own)), START)
    tables: dict[str, object] = {
        "peers": peers(knowledge, START, "en"), "certificates": certificates(knowledge, START, "en", "UTC", None),
    }  # fmt: skip
    frame: dict[str, object] = {"events": (), "poor": (), "versions": (), "refused": {}, "words": words_in("en")}
    frame |= {"language": "en", "title": "", "time": "", "here": "compare", "dropped": 0}
    page = PAGES.get_template("compare.html").render(**tables, **frame, first=FIRST_PEERS)
    for name in ("dc_motor-0", "dc_motor-11", "fan-8", "fan-11"):
        assert page.count(f">{name}</a>") == len(tables)
    at_once = re.sub(r"<details>.*?</details>", "", page, flags=re.DOTALL)
    assert [at_once.count(f">fan-{index}</a>") for index in (0, 8, 11)] == [2, 0, 1]


def test_hostile_versions_are_one_line() -> None:
    texts = {json.loads(json.dumps(text.encode(errors="replace").decode())) for text in HOSTILE}
    for row in versions(known(*(DaemonDocument(version=text) for text in sorted(texts))), "en"):
        assert len(row.version.splitlines()) <= 1


def test_the_page_has_versions_and_certificates_of_daemons_and_site(tmp_path: Path) -> None:
    keys, port = tmp_path / "keys", free_port(socket.SOCK_STREAM)
    make_authority(keys, utc_now())
    make_certificate(keys, "press", ["localhost"], utc_now() - timedelta(days=CERTIFICATE_DAYS - 12, hours=1))
    make_certificate(keys, "site", [], utc_now())
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path("press.crt"), key=Path("press.key"))
    endpoint = f"tls/localhost:{port}"
    daemon = Daemon(tmp_path, "press-3", endpoint, Access(ZenohTable(tls=tls), keys / "machine.toml"))
    files = "\n".join(f'{key} = "{keys / name}"' for key, name in
                      (("ca", "ca.crt"), ("certificate", "site.crt"), ("key", "site.key")))  # fmt: skip
    own = DaemonDocument(version="9.8.7", certificate=daemon._publisher.certificate)
    try:
        daemon.publish(report_of().model_copy(update={"daemon": own}))
        with serving(tmp_path, endpoint, tables=files) as site:
            wait_for(lambda: "9.8.7" in site.ask("/compare").text)
            page = site.ask("/compare").text
            assert "expires soon" in page
            assert "this site" in page
            assert "läuft bald ab" in site.ask("/compare?language=de").text
    finally:
        daemon.close()


def test_a_certificate_that_cannot_be_read_hinders_no_page(tmp_path: Path) -> None:
    path = tmp_path / "own.crt"
    assert own_certificate(path) is None
    path.write_text("none", encoding="utf-8")
    assert own_certificate(path) is None
    assert own_certificate(None) is None
