"""A site that runs: real daemons over Zenoh, real requests, and a browser."""

import json
import re
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from html.parser import HTMLParser
from itertools import product
from pathlib import Path

import pytest
from benchmarks.browser import Browser, browser, program
from prometheus_client.parser import text_string_to_metric_families

from otolith.health.limits import Level
from otolith.health.schema import DaemonDocument, Status
from otolith.publishing.zenoh_session import session
from otolith.site.app import MAX_QUERY, REFRESH
from otolith.site.serving.live import MAX_LIVE
from otolith.site.words import words_in
from tests.hostile import HOSTILE
from tests.sites.machines import Daemon, Stranger, daemons, own_endpoint, raised, report_of, sent
from tests.sites.serving import Served, serving
from tests.storage.histories import SITE
from tests.waiting import PATIENCE, wait_for

WELL, FAULTY, HOSTILE_ONE = "press-1", "press-2", "press-3"
PAGES = ("/", "/?language=de", "/compare", f"/machine/{SITE}/{FAULTY}", f"/machine/{SITE}/{HOSTILE_ONE}", "/nowhere")
TEXTS = [text.encode(errors="replace").decode() for text in HOSTILE if len(text) < 1000]


class Tags(HTMLParser):
    """The elements of a page, and their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


@dataclass(frozen=True, slots=True)
class Running:
    """Two daemons and a stranger."""

    well: Daemon
    faulty: Daemon
    hostile: Stranger


def publish(running: Running) -> None:
    """What each of them says at present."""
    now = time.time()
    well, faulty, hostile = running.well, running.faulty, running.hostile
    well.publish(report_of(WELL, end=now))
    faulty.publish(report_of(FAULTY, end=now, value=7.9, state=Level.ACT, events=(raised(time=now - 60.0),)))
    events = tuple(
        raised(Level.WATCH, now - 60.0 - index).model_copy(update={
            "id": f"e{index}", "part": text, "condition": text, "advice": text, "text": text, "cause": text})
        for index, text in enumerate(TEXTS)
    )  # fmt: skip
    parameter = report_of().parameters["R_a"]
    own = {text: parameter.model_copy(update={"unit": text, "reason": text, "status": Status.HELD}) for text in TEXTS}
    report = report_of(HOSTILE_ONE, end=now, state=Level.WATCH, events=events)
    hostile.publish(
        report.model_copy(
            update={
                "parameters": own,
                "twin": TEXTS[8],
                "daemon": DaemonDocument(version=TEXTS[5]),
                "notes": tuple(TEXTS),
            }
        )
    )


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("histories")
    with daemons(folder, WELL, FAULTY) as (well, faulty), closing(Stranger(HOSTILE_ONE)) as hostile:
        now = time.time()
        for index in range(60):
            for each in (well, faulty):
                each.keep(report_of(each.machine, end=now - 3500.0 + 56.0 * index, value=6.5 + 0.02 * index))
        for each in (well, faulty):
            each.wait()
        yield Running(well, faulty, hostile)


@pytest.fixture(scope="module")
def site(running: Running, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    endpoints = (running.well.endpoint, running.faulty.endpoint, running.hostile.endpoint)
    with serving(tmp_path_factory.mktemp("site"), *endpoints, more='title = "Works"') as served:

        def are_all_shown() -> bool:
            publish(running)
            hall = served.ask("/").text
            return 'id="count-OK">1<' in hall and 'id="count-ACT">1<' in hall and 'id="count-WATCH">1<' in hall

        wait_for(are_all_shown)
        yield served


@pytest.fixture(autouse=True)
def _reports_come(running: Running) -> None:
    publish(running)


def test_the_hall_says_of_each_machine_its_state_why_since_when_and_what_to_do(site: Served) -> None:
    hall = site.ask("/").text
    cards = {each["id"]: each for tag, each in Tags(hall).found if tag == "li" and "id" in each}
    assert list(cards) == [f"m-{SITE}.{name}" for name in (FAULTY, HOSTILE_ONE, WELL)]
    faulty = hall.partition(f'id="m-{SITE}.{FAULTY}"')[2].partition("</li>")[0]
    for needle in ("ACT", "since", "winding: short circuit between turns", "measure resistance", "R_a 108 %", "■"):
        assert needle in faulty
    german = site.ask("/?language=de").text
    assert "seit" in german
    assert 'lang="de"' in german
    assert site.ask("/", accept_language="de-AT,de;q=0.9").text.count("Maschinen")


@pytest.mark.parametrize(
    ("query", "shown"),
    [("?state=ACT", {FAULTY}), ("?name=PRESS-1", {WELL}), (f"?area={SITE}", {WELL, FAULTY, HOSTILE_ONE}),
     ("?area=nowhere", set()), ("?state=%3Cscript%3E", set())],
)  # fmt: skip
def test_a_filter_lets_through_what_it_says(site: Served, query: str, shown: set[str]) -> None:
    found = set(re.findall(rf'id="m-{SITE}\.([\w-]+)"', site.ask(f"/{query}").text))
    assert found == shown


def test_a_machine_has_its_report_page_with_its_past(site: Served) -> None:
    answer = site.ask(f"/machine/{SITE}/{FAULTY}?time=1h")
    page = answer.text
    assert float(answer.headers["refresh"]) == REFRESH
    for needle in ("ACT", "short circuit between turns", "measure resistance", "R_a", "polyline"):
        assert needle in page
    assert len(re.findall(r"<polyline[^>]*points=\"([^\"]*)\"", page)[0].split()) > 20
    assert site.ask(f"/machine/{SITE}/nobody").status == 404


def test_machines_of_one_twin_and_the_events_of_the_week_are_compared(site: Served) -> None:
    page = site.ask("/compare").text
    for needle in ("dc_motor: R_a", WELL, FAULTY, "short circuit between turns"):
        assert needle in page


@pytest.mark.parametrize("path", [*PAGES, "/metrics", "/healthz", "/site.css", "/site.js"])
def test_every_answer_has_the_headers_that_confine_it(site: Served, path: str) -> None:
    headers = site.ask(path).headers
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "script-src 'unsafe" not in policy
    assert "http" not in policy
    assert headers["x-content-type-options"] == "nosniff"


@pytest.mark.parametrize("path", PAGES)
def test_texts_from_outside_are_texts_on_every_page(site: Served, path: str) -> None:
    page = site.ask(path).text
    for tag, attributes in Tags(page).found:
        assert tag not in {"img", "iframe", "object", "base"}
        assert not any(name.startswith("on") for name in attributes)
        assert tag != "script" or attributes.get("src") == "/site.js"
        for name in ("href", "src", "action"):
            assert re.match(r"/(?!/)|\?|#|data:,$", attributes.get(name) or "/"), attributes
    assert "alert(1)</script>" not in page
    assert not set("\x1b\0\x9b\x07\u202e\u2066") & set(page)


def test_a_search_is_written_back_as_text(site: Served) -> None:
    page = site.ask("/?name=%22%3E%3Cscript%3Ealert(1)%3C/script%3E&area=%3Cb%3E").text
    assert "<script>alert" not in page
    assert "<b>" not in page.partition("<form")[2].partition("</form>")[0]


@pytest.mark.parametrize(
    ("headers", "method", "status"),
    [
        ({"host": "attacker.example"}, "GET", 421),
        ({"host": "127.0.0.1.attacker.example"}, "GET", 421),
        ({"host": ""}, "GET", 421),
        ({"host": "[::1"}, "GET", 421),
        ({"origin": "http://attacker.example"}, "GET", 403),
        ({"origin": "null"}, "GET", 403),
        ({"origin": "http://["}, "GET", 403),
        *(
            ({"host": host}, "GET", 421)
            for host in (
                "evil@127.0.0.1",
                "127.0.0.1:80:evil",
                "127.0.0.1/evil",
                "127.0.0.1, evil",
                "[::1",
                "127.0.0.1:x",
            )
        ),
        ({"transfer_encoding": "chunked"}, "GET", 501),
        ({"transfer_encoding": "chunked", "content_length": "6"}, "GET", 501),
        ({"content_length": "5"}, "GET", 400),
        ({}, "POST", 405),
        ({"content_length": "5"}, "POST", 405),
        ({}, "DELETE", 405),
        ({}, "OPTIONS", 405),
    ],
)
def test_what_is_not_for_the_site_is_refused(site: Served, headers: dict[str, str], method: str, status: int) -> None:
    assert site.ask("/", method, b"", **headers).status == status


def test_no_second_request_hides_in_the_content_of_another(site: Served) -> None:
    """Of two servers in a row, one may see the end of a request elsewhere than the other."""
    own, hidden = f"Host: 127.0.0.1:{site.port}\r\n", "GET /healthz HTTP/1.1\r\n"
    lengths = ("Content-Length: 6\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n", "Content-Length: 3\r\n\r\n",
               "Content-Length: 6\r\nContent-Length: 5\r\n\r\nabcde", "Transfer-Encoding: xchunked\r\n\r\n",
               "Content-Length : 5\r\n\r\n")  # fmt: skip
    for method, length in product(("GET", "POST"), lengths):
        with socket.create_connection(("127.0.0.1", site.port), PATIENCE) as raw:
            raw.sendall(f"{method} / HTTP/1.1\r\n{own}{length}{hidden}{own}\r\n".encode())
            answer = raw.makefile("rb").read()
        assert answer.count(b"HTTP/1.1 ") == 1
    assert "WARNING" not in site.said.now()  # anybody can send many


@pytest.mark.parametrize(
    "path",
    ["/../../../etc/passwd", "/..%2f..%2fetc%2fpasswd", "/site.css/../../app.py", "/pages/hall.html", "/%00",
     f"/machine/{SITE}/..%2f..%2fetc", "/machine/%2e%2e/%2e%2e", f"/machine/{SITE}/**", f"/machine/*/{FAULTY}"],
)  # fmt: skip
def test_no_path_leads_out_of_the_site(site: Served, path: str) -> None:
    answer = site.ask(path)
    assert answer.status == 404
    assert "root:" not in answer.text


def test_a_long_query_is_refused(site: Served) -> None:
    assert site.ask(f"/?name={'x' * MAX_QUERY}").status == 414


def test_metrics_can_be_scraped(site: Served) -> None:
    answer = site.ask("/metrics")
    assert answer.headers["content-type"].startswith("text/plain; version=")
    families = {family.name: family for family in text_string_to_metric_families(answer.text)}
    states = {sample.labels["machine"]: sample.labels["state"]
              for sample in families["otolith_machine_state"].samples if sample.value == 1.0}  # fmt: skip
    assert states == {WELL: "ok", FAULTY: "act", HOSTILE_ONE: "watch"}
    (value,) = [sample.value for sample in families["otolith_parameter_value"].samples
                if sample.labels["machine"] == FAULTY]  # fmt: skip
    assert value == 7.9
    parameters = {sample.labels["parameter"] for sample in families["otolith_parameter_value"].samples}
    assert parameters == {"R_a", *TEXTS}


def test_health_says_whether_it_is_connected(site: Served, tmp_path: Path) -> None:
    assert json.loads(site.ask("/healthz").text)["machines"] == 3
    assert site.ask("/healthz").status == 200
    with serving(tmp_path, own_endpoint()) as alone:
        assert alone.ask("/healthz").status == 503
        assert "zenoh" in alone.ask("/").text.lower()  # how to reach a daemon


def test_who_claims_the_name_of_another_machine_is_refused(tmp_path: Path) -> None:
    endpoint = own_endpoint()
    with session([endpoint]) as router, serving(tmp_path, endpoint) as served:
        _, content = sent(report_of(FAULTY, end=time.time(), state=Level.ACT))

        def is_refused() -> bool:
            router.put(f"otolith/{SITE}/{WELL}/report", content)
            return bool(re.search(r'reason="other_name"\} [1-9]', served.ask("/metrics").text))

        wait_for(is_refused)
        hall = served.ask("/").text
        assert words_in("en")["refused_other_name"].partition("}")[2] in hall
        assert f"m-{SITE}" not in hall


def test_a_site_ends_by_a_signal_also_while_somebody_looks(running: Running, tmp_path: Path) -> None:
    with serving(tmp_path, running.well.endpoint) as served:
        looking = served.open("/live")
        assert looking.getresponse().status == 200
        served.process.send_signal(signal.SIGTERM)
        assert served.process.wait(30.0) == 0
        looking.close()


def test_readers_that_take_nothing_hinder_nobody(site: Served) -> None:
    """Idle connections, half of a request, and more live readers than are served, none of which reads."""
    with ExitStack() as stack:
        for index in range(300):
            idle = stack.enter_context(socket.create_connection(("127.0.0.1", site.port)))
            idle.sendall(b"GET / HTTP/1.1\r\n" if index % 2 else b"")
        live = [stack.enter_context(closing(site.open("/live"))) for _ in range(MAX_LIVE + 6)]
        refused = [each for each in live[-6:] if each.getresponse().status == 503]
        assert len(refused) == 6
        assert site.ask("/").status == 200
        assert site.ask("/metrics").status == 200


@pytest.fixture(scope="module")
def tab() -> Iterator[Browser]:
    if (path := program()) is None:
        pytest.skip("no browser: apt install chromium")
    with browser(path) as opened:
        yield opened


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (360, 740)])
def test_pages_are_readable_in_a_browser_and_ask_nobody_else(
    site: Served, tab: Browser, width: int, height: int
) -> None:
    for path in PAGES:
        tab.open(f"{site.address.rstrip('/')}{path}", width, height, is_phone=width < 500)
        assert path == "/nowhere" or tab.console() == []
        assert {re.sub(r"(?<=\d)/.*", "/", each) for each in tab.requested() if each != "data:,"} == {site.address}
        assert tab.value("innerWidth") == width
        assert tab.value("document.documentElement.scrollWidth") <= width
        if path == "/compare":  # a phone has no room for columns
            shown = tab.value("getComputedStyle(document.querySelector('.table tr')).display")
            assert (shown == "block") is (width < 500)


def test_a_fault_shows_in_an_open_browser_without_asking_again(site: Served, running: Running, tab: Browser) -> None:
    tab.open(f"{site.address}?state=", 1280, 720)
    text = f"document.getElementById('m-{SITE}.{WELL}').innerText"
    wait_for(lambda: bool(tab.value("document.getElementById('live').textContent === 'live'")))
    assert "ACT" not in tab.value(text)
    now = time.time()

    def is_shown() -> bool:
        running.well.publish(report_of(WELL, end=now, state=Level.ACT, events=(raised(time=now),)))
        return "ACT" in tab.value(text)

    wait_for(is_shown)
    first = "document.querySelector('.card').dataset.order < document.querySelectorAll('.card')[1].dataset.order"
    assert tab.value(first)
    assert tab.console() == []
