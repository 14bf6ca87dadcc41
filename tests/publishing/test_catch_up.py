"""A subscriber gets every report and event once and in order, also those published while it was away."""

import json
import queue
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.subscriber import MessageOrder, Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith.publishing.zenoh_session import EVENT, MAX_REPLIES, REPORT, Topic, session, time_range
from otolith.storage.history import SUFFIX
from otolith.storage.history_writer import Bounds, HistoryWriter
from tests.conftest import free_port
from tests.storage.histories import MACHINE, SITE, START, documents
from tests.waiting import PATIENCE, wait_for

BOUNDS = Bounds(50_000_000, 3650, 24)
NOW = 1_790_000_000.0

ROUTER = """
import json, sys, zenoh
config = zenoh.Config()
settings = {"mode": "router", "listen/endpoints": [sys.argv[1]], "scouting/multicast/enabled": False}
for key, value in settings.items():
    config.insert_json5(key, json.dumps(value))
with zenoh.open(config):
    print("open", flush=True)
    sys.stdin.read()
"""

# What the daemon does with its reports. Each line of standard input publishes so many; the answer is the last number.
# Of a negative number, nothing reaches Zenoh: a router drops what a reader that is too slow does not fetch.
DAEMON = """
import sys
from pathlib import Path
from otolith.machine_file import ZenohTable
from otolith.publishing.zenoh_config import Access
from otolith.publishing.publisher import Published, Publisher
from otolith.storage.history_writer import Bounds
from otolith.storage.history_writer import HistoryWriter
from tests.storage.histories import MACHINE, SITE, documents
writer = HistoryWriter(Path(sys.argv[1]), Bounds(50_000_000, 3650, 24))
begin = float(sys.argv[3])
numbers, _ = writer.open(begin)
writer.start()
publisher = Publisher([Published(SITE, MACHINE, writer)], [], Access(ZenohTable(listen=(), connect=(sys.argv[2],))))
reports = documents(1_000_000, start=begin)
print("open", flush=True)
for line in sys.stdin:
    for _ in range(abs(int(line))):
        report = numbers.number(next(reports))
        writer.add(report)
        if int(line) > 0:
            publisher.publish(report)
        if len(writer._waiting) > 200:
            writer._written.wait(60.0)
    writer._written.wait(60.0)
    print(report.sequence, flush=True)
publisher.close()
writer.stop(60.0)
"""


class Process:
    """A program in a process of its own, which answers each line."""

    def __init__(self, program: str, *arguments: object) -> None:
        command = [sys.executable, "-c", program, *map(str, arguments)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.answer() == "open"

    def answer(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def ask(self, line: object) -> str:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self.answer()

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate(timeout=PATIENCE)


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Function that starts a program; all end with the test."""
    started: list[Process] = []

    def begin(program: str, *arguments: object) -> Process:
        started.append(Process(program, *arguments))
        return started[-1]

    yield begin
    for process in started:
        process.kill()


def sequences(texts: list[str]) -> list[int]:
    return [json.loads(text)["sequence"] for text in texts]


def test_everything_comes_once_and_in_order_over_an_hour_without_router_and_a_killed_daemon(
    start: Callable[..., Process], tmp_path: Path
) -> None:
    endpoint, path = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    router, daemon = start(ROUTER, endpoint), start(DAEMON, path, endpoint, START)
    reports, events = list[str](), list[str]()

    def receive(text: str) -> None:
        (reports if "schema" in json.loads(text) else events).append(text)

    with Subscriber(Connection((endpoint,)), receive, topics=(REPORT, EVENT)) as subscriber:
        wait_for(lambda: bool(daemon.ask(1)) and bool(reports))  # connected
        assert subscriber.connected
        before = len(reports)
        daemon.ask(60)
        wait_for(lambda: len(reports) >= before + 60)
        router.kill()
        wait_for(lambda: not subscriber.connected)
        daemon.ask(900)
        daemon.kill()
        daemon = start(DAEMON, path, endpoint, START + 1800.0)
        last = int(daemon.ask(900))  # an hour of windows of 2 s
        start(ROUTER, endpoint)
        wait_for(lambda: bool(reports) and sequences(reports)[-1] == last)  # without any further report
        last = int(daemon.ask(5))
        wait_for(lambda: sequences(reports)[-1] == last)
        wait_for(lambda: len(events) >= 9 + 9)
        assert subscriber.order.missed == 0
    published = [json.loads(text) for text in HistoryWriter(path, BOUNDS).reader.messages("report", 10_000)]
    first = sequences(reports)[0]
    assert sequences(reports) == [report["sequence"] for report in published if report["sequence"] >= first]
    assert len(reports) >= 60 + 1800 + 5
    assert sequences(events) == sequences(HistoryWriter(path, BOUNDS).reader.messages("event", 100))[-len(events) :]

    again: list[str] = []
    middle = sequences(reports)[700]
    with Subscriber(
        Connection((endpoint,)), again.append, MACHINE, after=middle
    ):  # another process went on with its own work
        wait_for(lambda: bool(again) and sequences(again)[-1] == last)
    assert again == reports[701:]


@pytest.mark.parametrize("topics", [(EVENT,), (REPORT, EVENT)])
def test_the_first_event_is_not_missed(
    topics: tuple[Topic, ...], start: Callable[..., Process], tmp_path: Path
) -> None:
    """The subscriber has seen none when it is cut off."""
    endpoint, path = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    router, daemon = start(ROUTER, endpoint), start(DAEMON, path, endpoint, START)
    events: list[str] = []
    daemon.ask(20)

    def receive(text: str) -> None:
        if "schema" not in json.loads(text):
            events.append(text)

    with Subscriber(Connection((endpoint,)), receive, topics=topics) as subscriber:
        wait_for(lambda: bool(subscriber.order.keys))
        router.kill()
        wait_for(lambda: not subscriber.connected)
        daemon.ask(200)
        start(ROUTER, endpoint)
        wait_for(lambda: len(events) == 2)


def test_a_slow_subscriber_misses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("otolith.publishing.subscriber.MAX_BEHIND", 10)
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    writer = HistoryWriter(tmp_path / f"{SITE}.{MACHINE}{SUFFIX}", BOUNDS)
    numbers, _ = writer.open(START)
    writer.start()
    publisher = Publisher([Published(SITE, MACHINE, writer)], [endpoint])
    received, may_continue = list[str](), queue.Queue[None]()

    def receive(text: str) -> None:
        if len(received) == 3:
            may_continue.get(timeout=PATIENCE)
        received.append(text)

    with Subscriber(Connection((endpoint,)), receive, after=0) as subscriber:
        wait_for(lambda: subscriber.connected)
        for report in documents(200):
            numbered = numbers.number(report)
            writer.add(numbered)
            publisher.publish(numbered)
        may_continue.put(None)
        wait_for(lambda: len(received) >= 200)
        assert len(set(sequences(received))) == len(received) == 200
        assert sequences(received) == sorted(sequences(received))
    publisher.close()
    writer.stop(PATIENCE)


def test_queries_select_by_time_and_number(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    writer = HistoryWriter(tmp_path / f"{SITE}.{MACHINE}{SUFFIX}", BOUNDS)
    now = time.time()
    numbers, _ = writer.open(now)
    writer.start()
    publisher = Publisher([Published(SITE, MACHINE, writer)], [endpoint])
    for report in documents(MAX_REPLIES + 200, start=now - 2.0 * (MAX_REPLIES + 200)):
        writer.add(numbers.number(report))
        if report.window.index % 100 == 0:
            writer._written.wait(PATIENCE)
    writer._written.wait(PATIENCE)
    key = REPORT.under(SITE, MACHINE)
    with session(connect=[endpoint]) as client:

        def asked(selector: str) -> list[float]:
            replies = [reply.ok for reply in client.get(selector, timeout=PATIENCE)]
            return [json.loads(reply.payload.to_string())["window"]["end"] for reply in replies if reply is not None]

        wait_for(lambda: bool(asked(f"{key}?_time=[now(-20s)..]")))
        recent = asked(f"{key}?_time=[now(-20s)..now()]")
        assert recent == sorted(recent)
        assert 5 <= len(recent) <= 10
        begin, end = (datetime.fromtimestamp(now - age, UTC).isoformat() for age in (100.0, 80.0))
        assert len(asked(f"{key}?_time=[{begin}..{end}]".replace("+00:00", "Z"))) in {10, 11}
        assert len(asked(f"{key}?_time=[..]")) == MAX_REPLIES
        assert asked(f"{key}?after={10**17};_time=[..]") == []
        assert len(asked(f"{key}?_time=[..];limit=3")) == 3
        assert asked(f"{key}?_time=[..];last=3") == recent[-3:]
        events = client.get(f"{EVENT.under(SITE, MACHINE)}?_time=[..]", timeout=PATIENCE)
        assert len([reply for reply in events if reply.ok]) == 12
        for wrong in (
            "_time=yesterday",
            "_time=[now(-1y)..]",
            "after=-1",
            "after=x",
            "after=0;limit=-1",
            "last=-1",
            f"after={'9' * 40}",
        ):
            (reply,) = client.get(f"{key}?{wrong}", timeout=PATIENCE)
            assert reply.err is not None, wrong
            assert "write" in reply.err.payload.to_string() or "isoformat" in reply.err.payload.to_string()
    publisher.close()
    writer.stop(PATIENCE)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[now(-1h)..now()]", (NOW - 3600.0, NOW)),
        ("[now(-1.5d)..]", (NOW - 1.5 * 86_400.0, None)),
        ("[..now(-10s)]", (None, NOW - 10.0)),
        ("[2026-01-31T06:00:00Z..2026-01-31T07:00:00.5+01:00]", (1769839200.0, 1769839200.5)),
    ],
)
def test_a_time_range_is_that_of_zenoh(text: str, expected: tuple[float | None, float | None]) -> None:
    assert time_range(text, NOW) == expected


def test_an_outward_bracket_excludes_its_bound() -> None:
    start, end = time_range("]now()..now()[", NOW)
    assert start is not None
    assert end is not None
    assert end < NOW < start


@given(
    published=st.integers(1, 60),
    received=st.lists(st.integers(0, 59), max_size=150),
    unsaved=st.sets(st.integers(0, 59)),
    after=st.none() | st.just(0),
)
def test_whatever_is_lost_or_repeated_is_passed_on_once_and_in_order(
    published: int, received: list[int], unsaved: set[int], after: int | None
) -> None:
    """Messages arrive in any selection, order and repetition; the history lacks those that were not saved."""
    numbers = [10 + 3 * index for index in range(published)]
    texts = {
        number: json.dumps({"sequence": number, "previous": before})
        for number, before in zip(numbers, [None, *numbers], strict=False)
    }
    saved = {number: text for index, (number, text) in enumerate(texts.items()) if index not in unsaved}
    newest, passed = 0, list[str]()

    def query(_: str, last: int) -> list[str]:
        return [text for number, text in saved.items() if last < number <= newest][:MAX_REPLIES]

    order = MessageOrder(query, passed.append, lambda: False, after)
    for index in [index for index in received if index < published]:
        newest = max(newest, numbers[index])
        order.take("key", texts[numbers[index]])
    got = sequences(passed)
    assert got == sorted(set(got))
    if got:
        begin = 0 if after is not None else got[0]
        assert {number for number in saved if begin <= number <= newest} <= set(got)
        follows = [json.loads(text)["previous"] for text in passed[1:]]
        assert order.missed == sum(before > last for last, before in zip(got, follows, strict=False))


def test_watch_states_what_the_history_no_longer_has(tmp_path: Path, start: Callable[..., Process]) -> None:
    """Its reader was away for longer than reports are kept."""
    endpoint, path = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    start(ROUTER, endpoint)
    daemon = start(DAEMON, path, endpoint, START)
    handled, before = int(daemon.ask(10)), int(daemon.ask(20))
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM report WHERE sequence <= ?", (before,))
    last = int(daemon.ask(5))
    command = [sys.executable, "-m", "otolith", "watch", "--json", "--connect", endpoint, "--after", str(handled)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as watch:
        assert watch.stdout is not None
        assert watch.stderr is not None
        lines = [watch.stdout.readline() for _ in range(5)]
        assert sequences(lines)[-1] == last
        assert f"reports after number {handled} up to {before} are missing" in watch.stderr.readline()
        watch.send_signal(signal.SIGINT)


def test_messages_without_numbers_are_passed_on() -> None:
    passed: list[str] = []
    order = MessageOrder(lambda *_: [], passed.append, lambda: False, None)
    for text in ("no json", "[1]", '{"sequence": "x"}', "{}", "[" * 200_000, f'{{"sequence": {"9" * 5000}}}'):
        order.take("key", text)
    assert len(passed) == 6


def test_a_payload_that_is_no_text_ends_no_subscriber() -> None:
    endpoint, passed = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", list[str]()
    with session([endpoint]) as other, Subscriber(Connection((endpoint,)), passed.append) as subscriber:
        wait_for(lambda: subscriber.connected)

        def received() -> bool:
            other.put(REPORT.under(SITE, MACHINE), b"\xff\xfe")
            other.put(REPORT.under(SITE, MACHINE), "text")
            return "text" in passed

        wait_for(received)
    assert "\ufffd\ufffd" in passed


def test_watch_ends_as_asked_while_no_daemon_answers() -> None:
    """A thread that comes back from Zenoh while the interpreter ends would abort the process with a core dump."""
    connects = [f"--connect=tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}" for _ in range(12)]
    command = [sys.executable, "-m", "otolith", "watch", "--json", *connects]
    watch = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert watch.stderr is not None
    with watch.stderr:
        assert watch.stderr.readline().startswith("no daemon reached yet")
        watch.terminate()
        assert watch.stderr.read() == ""
    assert watch.wait(PATIENCE) == 128 + signal.SIGTERM


def test_what_was_lost_comes_without_a_later_message(start: Callable[..., Process], tmp_path: Path) -> None:
    endpoint, path = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    start(ROUTER, endpoint)
    daemon = start(DAEMON, path, endpoint, START)
    reports, events = list[str](), list[str]()

    def receive(text: str) -> None:
        (reports if "schema" in json.loads(text) else events).append(text)

    with Subscriber(Connection((endpoint,)), receive, topics=(REPORT, EVENT)) as subscriber:
        wait_for(lambda: bool(daemon.ask(1)) and bool(reports))
        last = int(daemon.ask(-300))
        kept = HistoryWriter(path, BOUNDS).reader.messages("event", 100)
        first = sequences(reports)[0]
        expected = [number for number in sequences(kept) if number > first]
        assert expected
        wait_for(lambda: sequences(reports)[-1] == last and sequences(events)[-len(expected) :] == expected)
        assert subscriber.order.missed == 0


def test_watch_prints_every_report_once_although_it_was_stopped(tmp_path: Path, start: Callable[..., Process]) -> None:
    """The command itself, as another process; its reader is slow as well."""
    endpoint, path = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}", tmp_path / f"{SITE}.{MACHINE}{SUFFIX}"
    start(ROUTER, endpoint)
    daemon = start(DAEMON, path, endpoint, START)
    daemon.ask(30)
    command = [sys.executable, "-m", "otolith", "watch", "--json", "--connect", endpoint, "--after", "0"]
    watch = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert watch.stdout is not None
    lines = [watch.stdout.readline() for _ in range(30)]
    watch.send_signal(signal.SIGSTOP)
    last = int(daemon.ask(700))
    watch.send_signal(signal.SIGCONT)
    while sequences(lines[-1:]) != [last]:
        lines.append(watch.stdout.readline())
    watch.send_signal(signal.SIGINT)
    assert watch.wait(PATIENCE) == 130
    assert watch.stdout.read() == ""
    watch.stdout.close()
    assert len(lines) == 730
    assert sequences(lines) == sorted(set(sequences(lines)))
