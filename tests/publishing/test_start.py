"""A daemon that compiles kernels says how many are done, to each reader whenever it connects, until a report."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from rich.console import Console

from otolith.cli.operation.live_table import LiveTable
from otolith.machine import load_machine
from otolith.publishing.publisher import Published, Publisher
from otolith.publishing.subscriber import Subscriber
from otolith.publishing.zenoh_config import Connection
from otolith.publishing.zenoh_session import StartDocument
from otolith.runtime.hall.daemon import Daemon
from otolith.runtime.hall.pool import Preparation
from otolith.runtime.service import Service
from tests.conftest import EXAMPLES, free_port
from tests.publishing.test_events import documents
from tests.waiting import wait_for

SITE, MACHINE = "hall", "press"


def start(done: int) -> StartDocument:
    return StartDocument(site=SITE, machine=MACHINE, done=done, total=11, text=Preparation(done, 11, True).text)


@contextmanager
def reader(endpoint: str) -> Iterator[Subscriber]:
    with Subscriber(Connection((endpoint,)), lambda _: None) as subscriber:
        yield subscriber


def test_a_reader_knows_how_far_a_daemon_is_that_starts() -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    publisher = Publisher([Published(SITE, MACHINE)], [endpoint])
    try:
        publisher.publish_start(start(2))
        with reader(endpoint) as first:
            wait_for(lambda: "2 of 11" in first.state())  # published before it was there
            publisher.publish_start(start(3))
            wait_for(lambda: "3 of 11" in first.state())
            assert first.state().startswith(f"{MACHINE} ({SITE})")
            publisher.publish_start(start(11))
            wait_for(lambda: not first.starting)
        with reader(endpoint) as later:
            wait_for(lambda: "no report yet" in later.state())
            assert later.starting == ()
    finally:
        publisher.close()


def test_the_live_table_names_a_second_machine_that_starts() -> None:
    document = documents()[0]
    table, console = LiveTable(lambda: "", starting=lambda: ["fan (hall): 3 of 11"]), Console(width=200)
    table.add(document.to_json())
    with console.capture() as capture:
        console.print(table)
    assert capture.get().rstrip().endswith("fan (hall): 3 of 11")


class Recorded:
    """What a service would publish and send to systemd."""

    def __init__(self) -> None:
        self.starts: list[StartDocument] = []
        self.statuses: list[str] = []

    def publish_start(self, document: StartDocument) -> None:
        self.starts.append(document)

    def send(self, *assignments: str) -> None:
        self.statuses += assignments


def test_the_service_tells_each_step_once() -> None:
    service, recorded = Service(load_machine(EXAMPLES / "dc-motor-in-process.toml")), Recorded()
    hall = Daemon([service])
    service.publisher = hall._notifier = recorded  # type: ignore[assignment]  # has the methods that are used
    for prepared, is_ready in (([], False), ([], False), ([True], False), ([True, True], False), ([True] * 11, True)):
        (worker,) = hall._pool.workers
        worker.prepared, worker.is_ready = list(prepared), is_ready
        hall._show_preparation()
        hall._show_preparation()
    assert [document.done for document in recorded.starts] == [0, 1, 2, 11]
    assert ["1 of 11" in status for status in recorded.statuses] == [False, True, False, False]


def test_no_session_is_closed_while_a_start_is_put_on_it() -> None:
    publisher, held = Publisher([Published(SITE, MACHINE)], []), list[bool]()

    class Session:
        def put(self, *_: object, **__: object) -> None:
            held.append(publisher._lock.locked())

    (own,) = publisher._sessions
    publisher._sessions = (replace(own, opened=Session()),)  # type: ignore[arg-type]  # has the method that is used
    publisher.publish_start(start(2))
    publisher._sessions = (own,)
    publisher.close()
    assert held == [True]
