"""What named users command through the site is done once and under their names, and nothing that others send."""

import re
import shlex
import socket
import ssl
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import urlencode

import psutil
import pytest
from benchmarks.browser import browser, program

from otolith.health.limits import Level
from otolith.health.notes import OperatorNote
from otolith.machine_file import AccessTable, TlsTable, ZenohTable
from otolith.publishing.certificates import Identity, make_authority, make_certificate, utc_now
from otolith.publishing.commands.documents import CommandKind
from otolith.publishing.reader_sessions import NotCarriedOutError
from otolith.publishing.zenoh_config import Access
from otolith.site.access.orders import FORM_AGE, MAX_FORM, MAX_ORDERS, Orders
from otolith.site.access.users import HANDSHAKE, MAX_SHAKING, User
from otolith.site.app import FORM_TIME
from otolith.site.settings import load_site
from otolith.site.words import words_in
from otolith.storage.decisions import DecisionsFile
from otolith.storage.history import history_path
from otolith_drivers.errors import ConfigurationError
from tests.cli.commands import otolith
from tests.hostile import HOSTILE
from tests.messages import assert_says
from tests.publishing.test_commands import COMPONENT, LIMIT, SINE
from tests.sites.machines import Daemon, daemons, own_endpoint, report_of
from tests.sites.serving import Answer, Served, serving
from tests.storage.histories import SITE
from tests.waiting import PATIENCE, wait_for

NAME = "press-2"
PAGE = f"/machine/{SITE}/{NAME}"
FILES = 'ca = "{0}/ca.crt"\ncertificate = "{0}/site.crt"\nkey = "{0}/site.key"\n[access]\nusers = ["anna"]\n'


class Forms(HTMLParser):
    """The forms of a page: where each is sent, and its fields."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        own = {name: value or "" for name, value in attrs}
        if tag == "form":
            self.found.append((own["action"], {}))
        if tag == "input":
            self.found[-1][1][own["name"]] = own["value"]


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, and certificates of a site, a machine, a user and somebody else."""
    folder = tmp_path_factory.mktemp("keys")
    make_authority(folder, utc_now())
    make_certificate(folder, "site", ["127.0.0.1", "localhost"], utc_now())
    for name in (NAME, "anna", "eve"):
        make_certificate(folder, name, [], utc_now())
    return folder


def browser_of(keys: Path, name: str = "") -> ssl.SSLContext:
    """The certificate of a person in a browser; of nobody without a name."""
    context = ssl.create_default_context(cafile=keys / "ca.crt")
    if name:
        context.load_cert_chain(keys / f"{name}.crt", keys / f"{name}.key")
    return context


@pytest.fixture(scope="module")
def daemon(keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    tls = TlsTable(ca=Path("ca.crt"), certificate=Path(f"{NAME}.crt"), key=Path(f"{NAME}.key"))
    access = Access(ZenohTable(tls=tls, access=AccessTable(commands=("site",))), keys / "machine.toml")
    with closing(Daemon(tmp_path_factory.mktemp("history"), NAME, own_endpoint(), access)) as own:
        yield own


def publish(daemon: Daemon) -> None:
    report = report_of(NAME, end=time.time(), state=Level.ACT, events=(LIMIT, SINE))
    daemon.publish(report.model_copy(update={"components": (COMPONENT,)}))


@pytest.fixture(scope="module")
def anna(daemon: Daemon, keys: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A site, as a user sees it who may send commands."""
    folder, tables = tmp_path_factory.mktemp("site"), FILES.format(keys)
    with serving(folder, daemon.endpoint, tables=tables, tls=browser_of(keys, "anna")) as served:

        def is_shown() -> bool:
            publish(daemon)
            return 'id="count-ACT">1<' in served.ask("/").text

        wait_for(is_shown)
        yield served


@pytest.fixture(autouse=True)
def _reports_come(daemon: Daemon) -> None:
    publish(daemon)


def forms(served: Served) -> list[tuple[str, dict[str, str]]]:
    return Forms(served.ask(PAGE).text).found


def send(served: Served, path: str, fields: dict[str, str], **headers: str) -> Answer:
    return served.ask(path, "POST", urlencode(fields).encode(), **{"origin": served.address.rstrip("/"), **headers})


def notes_of(daemon: Daemon) -> tuple[OperatorNote, ...]:
    return daemon.decisions.read().notes


def test_a_user_sends_each_command_once_and_the_history_has_the_name(anna: Served, daemon: Daemon) -> None:
    kinds = [fields["kind"] for _, fields in forms(anna)]
    assert kinds == ["acknowledge", "acknowledge", "approve", "reject"]
    before = len(notes_of(daemon))
    (path, fields), *_ = forms(anna)
    for word in ("order_done", "order_again"):  # a double click
        answer = send(anna, path, fields, sec_fetch_site="same-origin")
        assert (answer.status, words_in("en")[word] in answer.text) == (200, True)
    (note,) = notes_of(daemon)[before:]
    assert (note.event, note.by, note.id) == (LIMIT.id, "anna (site)", fields["id"])
    german = next(each for each in Forms(anna.ask(f"{PAGE}?language=de").text).found if each[1]["kind"] == "approve")
    assert words_in("de")["order_done"] in send(anna, *german).text
    assert daemon.decisions.read().approved == {COMPONENT.id}
    assert notes_of(daemon)[-1].by == "anna (site)"


def test_nobody_else_sends_commands_and_nobody_else_is_shown_a_form(anna: Served, daemon: Daemon, keys: Path) -> None:
    (path, fields), *_ = forms(anna)
    before = notes_of(daemon)
    for name in ("eve", NAME, ""):
        other = replace(anna, tls=browser_of(keys, name))
        page = other.ask(PAGE).text
        assert "otolith event acknowledge" in page
        assert "<form" not in page
        answer = send(other, path, fields)
        assert (answer.status, words_in("en")["order_user"] in answer.text) == (403, True)
    make_authority(keys / "other", utc_now())
    make_certificate(keys / "other", "anna", [], utc_now())
    forged = browser_of(keys)
    forged.load_cert_chain(keys / "other" / "anna.crt", keys / "other" / "anna.key")
    with pytest.raises(OSError):  # noqa: PT011 - TLS or the connection ends, as it comes
        send(replace(anna, tls=forged), path, fields)
    assert notes_of(daemon) == before


@pytest.mark.parametrize(
    "headers",
    [{"origin": "https://evil.example"}, {"origin": "null"}, {"origin": ""}, {"sec_fetch_site": "cross-site"},
     {"sec_fetch_site": "same-site"}, {"scheme": "http"}],
    ids=lambda headers: " ".join(f"{name}={value}" for name, value in headers.items()),
)  # fmt: skip
def test_a_page_of_another_site_sends_nothing(anna: Served, daemon: Daemon, headers: dict[str, str]) -> None:
    (path, fields), *_ = forms(anna)
    before = notes_of(daemon)
    if headers.pop("scheme", ""):
        headers["origin"] = f"http://127.0.0.1:{anna.port}"
    assert send(anna, path, fields, **headers).status == 403
    without = anna.ask(path, "POST", urlencode(fields).encode())
    assert without.status == 403
    assert notes_of(daemon) == before


SENT = """(() => {
    if (!location.href.startsWith("%s") || document.readyState !== "complete" || window.isSent) return;
    window.isSent = true;
    const form = document.createElement("form");
    form.method = "post"; form.action = "%scommand";
    document.body.append(form); form.submit();
})()"""


def test_a_browser_says_which_page_sends_a_form(anna: Served) -> None:
    """Without a certificate the form is refused for that, so not because of the page that sends it."""
    if (path := program()) is None:
        pytest.skip("no browser: apt install chromium")
    with browser(path, ["--ignore-certificate-errors"]) as tab:

        def value(expression: str) -> object:
            try:
                return tab.value(expression)
            except RuntimeError as error:  # the page was left while it was asked
                if "navigated" not in str(error):
                    raise
                return None

        def is_at(page: str) -> bool:
            return bool(value("location.href") == page)

        def is_answered(page: str, needle: str) -> bool:
            value(SENT % (page, anna.address))
            return needle in str(value("document.body.innerText"))

        for page in ("", PAGE.removeprefix("/")):
            tab.open(f"{anna.address}{page}", 1280, 720)
            wait_for(partial(is_at, f"{anna.address}{page}"))
            wait_for(partial(is_answered, f"{anna.address}{page}", words_in("en")["order_user"]))
        tab.open("data:text/html,<p>another site", 1280, 720)
        wait_for(partial(is_answered, "data:", "of this site only"))


@pytest.mark.parametrize("field", ["site", "machine", "event", "kind", "id", "at", "token"])
def test_a_form_that_was_changed_sends_nothing(anna: Served, daemon: Daemon, field: str) -> None:
    path, fields = forms(anna)[0]
    before = notes_of(daemon)
    value = fields[field]
    for other in (value[:-1] + ("0" if value[-1] != "0" else "1"), "", "\x00", value + "9"):
        answer = send(anna, path, fields | {field: other})
        assert answer.status in {400, 403}
    del fields[field]
    assert send(anna, path, fields).status in {400, 403}
    assert notes_of(daemon) == before


@pytest.mark.parametrize(
    "content", [b"\xff", b"a" * (MAX_FORM + 1), b"a=1&" * 100, b"site=%ff", b"=" * 50, b'{"kind": "approve"}']
)
def test_what_is_no_form_is_refused(anna: Served, content: bytes) -> None:
    answer = anna.ask("/command", "POST", content, origin=anna.address.rstrip("/"))
    assert answer.status in {400, 403}


@pytest.mark.full
def test_who_does_not_finish_the_handshake_is_cut(anna: Served) -> None:
    with socket.create_connection(("127.0.0.1", anna.port), PATIENCE) as silent:
        begun = time.monotonic()
        assert silent.recv(1) == b""
        assert time.monotonic() - begun >= HANDSHAKE - 1.0
    assert anna.ask("/").status == 200


@pytest.mark.full
def test_many_handshakes_that_are_never_finished_take_little_memory_and_lock_nobody_out(anna: Served) -> None:
    process = psutil.Process(anna.process.pid)
    before = process.memory_info().rss
    with ExitStack() as stack:
        for _ in range(MAX_SHAKING + 500):
            stack.enter_context(socket.create_connection(("127.0.0.1", anna.port), PATIENCE))
        assert anna.ask("/").status == 200
        assert process.memory_info().rss - before < (MAX_SHAKING + 500) * 100_000


@pytest.mark.full
def test_who_sends_a_form_slowly_is_refused(anna: Served) -> None:
    origin = anna.address.rstrip("/")
    with closing(anna.open("/command", "POST", origin=origin, content_length="100")) as slow:
        begun = time.monotonic()
        while time.monotonic() - begun < FORM_TIME + 2.0:
            slow.send(b"a")
            time.sleep(0.5)
        assert slow.getresponse().status == 400


def test_other_methods_and_addresses_are_still_read_only(anna: Served) -> None:
    origin = anna.address.rstrip("/")
    assert anna.ask("/", "POST", b"x", origin=origin).status == 405
    assert anna.ask("/command", "PUT", b"x", origin=origin).status == 405
    assert anna.ask("/command").status in {404, 405}


def test_no_secret_is_in_the_log_and_no_page_is_kept(anna: Served, keys: Path) -> None:
    (path, fields), *_ = forms(anna)
    send(anna, path, fields)
    said = anna.said.now()
    assert fields["token"] not in said
    assert (keys / "site.key").read_text().splitlines()[1] not in said
    assert anna.ask(PAGE).headers["cache-control"] == "no-store"


class Sender:
    """Takes what a site sends to daemons."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.answer = b'{"id": "%s", "is_new": true}' % (b"0" * 32)

    def __call__(self, key: str, content: bytes) -> bytes:
        self.sent.append(content)
        if not self.answer:
            raise NotCarriedOutError("no <event> is open")
        return self.answer


@pytest.fixture
def sender() -> Sender:
    return Sender()


class Clock:
    now = 1.8e9


@pytest.fixture
def orders(keys: Path, sender: Sender) -> Orders:
    Clock.now = time.time()
    own = Identity(keys / "ca.crt", keys / "site.crt", keys / "site.key")
    return Orders(("anna",), own, sender, lambda: Clock.now, lambda: Clock.now)


ANNA = User("anna", 4e9)
ABOUT = (SITE, NAME, LIMIT.id, CommandKind.ACKNOWLEDGE)


def form(orders: Orders, user: User = ANNA) -> bytes:
    return urlencode(orders.fields(user, ABOUT)).encode()


def test_a_form_is_only_for_its_user_for_a_while_and_until_the_certificate_ends(orders: Orders, sender: Sender) -> None:
    of_eve = form(orders, User("eve", 4e9))
    assert orders.give(ANNA, of_eve).status == 403
    own = form(orders)
    assert orders.give(User("anna", Clock.now - 1.0), own).status == 403
    Clock.now += FORM_AGE + 2.0
    assert orders.give(ANNA, own).status == 403
    assert not sender.sent


def test_a_form_that_is_sent_later_again_is_the_same_command_of_the_same_time(orders: Orders, sender: Sender) -> None:
    own = form(orders)
    for _ in range(2):
        orders.give(ANNA, own)
        Clock.now += 100.0
    first, again = ([re.findall(pattern, each.decode()) for pattern in (r'"id\\":\\"(\w+)', r'"at\\":([\d.]+)')]
                    for each in sender.sent)  # fmt: skip
    assert first == again
    assert all(first)


def test_a_user_sends_so_many_commands_in_a_minute(orders: Orders, sender: Sender) -> None:
    for _ in range(MAX_ORDERS):
        assert orders.give(ANNA, form(orders)).status == 200
    assert orders.give(ANNA, form(orders)).status == 429
    assert len(sender.sent) == MAX_ORDERS
    Clock.now += 61.0
    assert orders.give(ANNA, form(orders)).status == 200


@pytest.mark.parametrize(("answer", "status"), [(b"", 409), (b"x", 502), (b'{"id": 1}', 502)])
def test_what_a_daemon_says_is_told(orders: Orders, sender: Sender, answer: bytes, status: int) -> None:
    sender.answer = answer
    outcome = orders.give(ANNA, form(orders))
    assert outcome.status == status
    assert outcome.machine == f"{SITE}/{NAME}"


@pytest.mark.parametrize(
    ("tables", "needles"),
    [
        ('[access]\nusers = ["anna"]', ("[access]", "[zenoh]", "sign")),
        ('[zenoh]\nca = "a"\ncertificate = "b"\nkey = "c"\n[access]\nusers = []', ("access.users",)),
        ('[zenoh]\nca = "a"\ncertificate = "b"\nkey = "c"\n[access]\nusers = ["a"]\nkey = "c"', ("belong together",)),
    ],
)
def test_a_mistake_in_who_may_send_is_named(tmp_path: Path, tables: str, needles: tuple[str, ...]) -> None:
    file = tmp_path / "site.toml"
    file.write_text(tables, encoding="utf-8")
    with pytest.raises(ConfigurationError) as caught:
        load_site(file)
    assert_says(str(caught.value), *needles)


def test_without_access_the_page_has_lines_that_do_what_they_say(tmp_path: Path) -> None:
    """The specialist pastes them on the computer of the daemon."""
    with (
        daemons(history_path(SITE, NAME).parent, NAME) as (daemon,),
        serving(tmp_path, daemon.endpoint) as served,
    ):

        def is_shown() -> bool:
            publish(daemon)
            return "<pre" in served.ask(PAGE).text

        wait_for(is_shown)
        page = served.ask(PAGE).text
        daemon.wait()
        assert "<form" not in page
        assert served.ask("/command", "POST", b"x", origin=served.address.rstrip("/")).status == 405
        assert words_in("de")["commands_read"] in served.ask(f"{PAGE}?language=de").text
        lines = [shlex.split(line) for line in re.findall(r"<pre[^>]*>(otolith event [^<]*)</pre>", page)]
        assert lines
        for line in lines:
            assert otolith(*line[1:]).exit_code == 0
        decisions = DecisionsFile(history_path(SITE, NAME).parents[1] / "components", SITE, NAME)
        assert {note.event for note in decisions.read().notes} == {LIMIT.id, SINE.id}


def test_no_name_from_outside_becomes_a_command(tmp_path: Path) -> None:
    with daemons(tmp_path, NAME) as (daemon,), serving(tmp_path, daemon.endpoint) as served:
        texts = [text.encode(errors="replace").decode() for text in HOSTILE if len(text) < 150]
        events = tuple(LIMIT.model_copy(update={"id": f"{text}@1.0"}) for text in texts)

        def is_shown() -> bool:
            daemon.publish(report_of(NAME, end=time.time(), state=Level.ACT, events=(*events, SINE)))
            return "component/shaft" in served.ask(PAGE).text

        wait_for(is_shown)
        page = served.ask(PAGE).text
        for line in re.findall(r"<pre[^>]*>(otolith event [^<]*)</pre>", page):
            plain = line.replace("&#39;", "'").replace("&amp;", "&")
            assert len(shlex.split(plain)) == 5
            assert plain.isprintable()
