"""Connections to the site that send or take nothing: they are cut, and cost others neither memory nor a place."""

import asyncio
import socket
from collections.abc import Awaitable, Callable
from contextlib import ExitStack

import pytest
from starlette.types import ASGIApp, Receive, Scope, Send

from otolith.site import server as server_module
from otolith.site.server import MAX_UNREAD, Server, listening_on, server_of
from otolith.site.serving.counts import Counts, Hindered
from otolith.site.serving.live import Places
from otolith.site.serving.pieces import PIECE, Pieces
from tests.conftest import free_port
from tests.waiting import PATIENCE

LARGE, SMALL = [b"x" * 4096] * 2000, [b"a"]  # 8 MB are more than kernels keep
REQUEST = b"GET / HTTP/1.1\r\nhost: a\r\n\r\n"
BODY = b"GET / HTTP/1.1\r\nhost: a\r\ncontent-length: 999999\r\n\r\nxx"

Open = Callable[..., Awaitable[socket.socket]]
Test = Callable[[Server, Open], Awaitable[None]]


def serving(content: list[bytes]) -> ASGIApp:
    async def page(scope: Scope, receive: Receive, send: Send) -> None:
        await Pieces(content, "text/plain")(scope, receive, send)

    return page


def with_server(content: list[bytes], test: Test, counts: Counts | None = None) -> None:
    """Run a test beside a server; it opens connections, which send something, and are closed at its end."""

    async def run() -> None:
        server, port = server_of(serving(content), hindered=counts), free_port(socket.SOCK_STREAM)
        with listening_on(("127.0.0.1", port)) as listening, ExitStack() as clients:
            loop = asyncio.get_running_loop()

            async def opened(sent: bytes = b"", source: str = "127.0.0.1") -> socket.socket:
                client = clients.enter_context(socket.socket())
                client.setblocking(False)
                client.bind((source, 0))
                await loop.sock_connect(client, ("127.0.0.1", port))
                await loop.sock_sendall(client, sent)
                return client

            task = asyncio.create_task(server.serve([listening]))
            try:
                async with asyncio.timeout(PATIENCE):
                    await test(server, opened)
            finally:
                clients.close()
                server.should_exit = True
                await task

    asyncio.run(run())


def unread(server: Server) -> list[int]:
    return [each.unread for each in server.server_state.connections]  # type: ignore[union-attr]


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "PATIENCE", 0.5)
    monkeypatch.setattr(server_module, "SWEEP", 1)


@pytest.mark.parametrize("sent", [b"", REQUEST[:9], REQUEST, 5 * REQUEST, BODY],
                         ids=["nothing", "half-a-request", "no-reading", "pipelined", "half-a-body"])  # fmt: skip
def test_who_neither_sends_nor_takes_anything_is_cut(sent: bytes) -> None:
    async def test(server: Server, opened: Open) -> None:
        await opened(sent)
        while not server.server_state.connections:
            await asyncio.sleep(0.01)
        while server.server_state.connections:
            await asyncio.sleep(0.02)

    with_server(LARGE, test)


@pytest.mark.parametrize("sent", [REQUEST[:25], REQUEST + REQUEST[:25], BODY])
def test_who_sends_piece_by_piece_what_never_becomes_whole_is_cut(sent: bytes) -> None:
    async def test(server: Server, opened: Open) -> None:
        loop, client = asyncio.get_running_loop(), await opened(sent)

        async def send_for_ever() -> None:
            while True:
                await loop.sock_sendall(client, b"a")
                await asyncio.sleep(0.05)

        with pytest.raises(OSError, match=r"(?i)reset|pipe"):
            await send_for_ever()

    with_server(SMALL, test)


def test_who_reads_slowly_gets_all_and_has_little_waiting() -> None:
    most = [0]

    async def test(server: Server, opened: Open) -> None:
        loop, client, count = asyncio.get_running_loop(), await opened(REQUEST), 0
        while count < sum(map(len, LARGE)):
            count += len(await loop.sock_recv(client, 200_000))
            most[0] = max([most[0], *unread(server)])
            await asyncio.sleep(0.01)

    with_server(LARGE, test)
    assert 0 < most[0] <= MAX_UNREAD + 2 * PIECE


def test_readers_who_take_nothing_do_not_fill_the_memory_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "PATIENCE", 3600.0)
    monkeypatch.setattr(server_module, "MAX_ALL_UNREAD", 10 * MAX_UNREAD)

    async def test(server: Server, opened: Open) -> None:
        for _ in range(40):
            await opened(REQUEST)
        while not (0 < len(waiting := unread(server)) < 40 and 0 < sum(waiting) <= 10 * MAX_UNREAD):
            await asyncio.sleep(0.05)

    with_server(LARGE, test)


def test_a_new_connection_has_the_place_of_the_one_that_waits_for_longest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "PATIENCE", 3600.0)
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 20)

    async def test(_: Server, opened: Open) -> None:
        for _index in range(60):
            await opened()
        answer = await asyncio.get_running_loop().sock_recv(await opened(REQUEST), 100)
        assert answer.split()[1] == b"200"

    with_server(SMALL, test)


def test_one_address_leaves_places_for_live_events_to_others() -> None:
    places = Places(8)
    greedy = [places.take("a") for _ in range(20)]
    assert sum(each is not None for each in greedy) == 8
    others = [places.take(address) for address in ("b", "c", "b", "c")]
    assert None not in others
    ended = [each for each in greedy if each is not None and each.is_set()]
    assert len(ended) == 4  # the oldest of the address that has most
    assert ended == greedy[:4]
    assert places.take("a") is None
    for each in greedy[:8]:
        assert each is not None
        places.leave("a", each)
    assert [places.take("d") is not None for _ in range(5)] == [True, True, True, True, False]


def test_of_many_connections_those_of_the_address_with_the_most_give_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "PATIENCE", 3600.0)
    monkeypatch.setattr(server_module, "MAX_CONNECTIONS", 20)
    counts = Counts()

    async def test(server: Server, opened: Open) -> None:
        first = await opened()  # which has waited for longest
        for _index in range(60):
            await opened(source="127.0.0.2")
        while counts[Hindered.ROOM] < 41:
            await asyncio.sleep(0.01)
        loop = asyncio.get_running_loop()
        await loop.sock_sendall(first, REQUEST)
        assert (await loop.sock_recv(first, 100)).split()[1] == b"200"
        assert len(server.server_state.connections) <= 20

    with_server(SMALL, test, counts)
    assert set(counts) == {Hindered.ROOM}


def test_who_is_cut_is_counted_by_why() -> None:
    counts = Counts()

    async def test(_: Server, opened: Open) -> None:
        await opened()
        await opened(REQUEST)
        while not (counts[Hindered.IDLE] and counts[Hindered.SLOW]):
            await asyncio.sleep(0.05)

    with_server(LARGE, test, counts)
    assert set(counts) == {Hindered.IDLE, Hindered.SLOW}
