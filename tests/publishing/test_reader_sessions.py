"""A reader asks a machine where it heard it, not at every endpoint."""

import socket
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from otolith.publishing.reader_sessions import Arrival, ReaderSessions
from otolith.publishing.zenoh_config import Connection
from otolith.publishing.zenoh_session import ALIVE, EVENT, REPORT, prefix, session
from tests.conftest import free_port
from tests.waiting import wait_for

SITE, MACHINES = "here", ("a", "b", "c", "d")


@pytest.fixture
def asked() -> Iterator[tuple[tuple[str, ...], Counter[str]]]:
    """The endpoint of each machine, and how many queries each gets; all answer for themselves only."""
    queries: Counter[str] = Counter()
    with ExitStack() as stack:
        endpoints: list[str] = []
        declared: list[object] = []
        for name in MACHINES:
            endpoints.append(f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}")
            own = stack.enter_context(session([endpoints[-1]]))
            declared.append(own.liveliness().declare_token(ALIVE.under(SITE, name)))

            def answer(query: zenoh.Query, name: str = name) -> None:
                queries[name] += 1
                key = str(query.key_expr)
                if key.startswith(f"{prefix(SITE, name)}/"):
                    query.reply(key, f"{name} {query.parameters}")

            declared.append(own.declare_queryable("otolith/**", answer))
        yield tuple(endpoints), queries


def test_a_machine_is_asked_at_its_endpoint_only(asked: tuple[tuple[str, ...], Counter[str]]) -> None:
    endpoints, queries = asked
    alive: set[str] = set()

    def receive(arrival: Arrival) -> None:
        alive.add(arrival.machine)

    reader = ReaderSessions(Connection(endpoints), (REPORT,), receive)
    reader.start()
    try:
        wait_for(lambda: len(alive) == len(MACHINES))
        for name in MACHINES:
            (answer,) = reader.get(f"{REPORT.under(SITE, name)}?after=1")
            assert answer == (REPORT.under(SITE, name), f"{name} after=1".encode())
        assert queries == dict.fromkeys(MACHINES, 1)
        assert reader.get(f"{EVENT.under(SITE, 'nobody')}") == []
    finally:
        reader.close()
