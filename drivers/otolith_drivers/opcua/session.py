"""One session with a server for all drivers of this process that read it alike; each has a subscription of its own.

What fails in one subscription ends that one only. Whether the session itself has failed is asked at once then.
"""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol
from urllib.parse import urlsplit

from asyncua import Client, ua

from otolith_drivers.common.message_times import ExchangeClock
from otolith_drivers.common.reconnection import LASTING, OwnFaults, ReconnectBackoff, ThreadedDriver
from otolith_drivers.common.sharing import Place, SharedConnection
from otolith_drivers.opcua.connection import (
    CLOSE_TIMEOUT,
    OpcUaCredentials,
    OpcuaOptions,
    RefusedError,
    connected,
    exchange,
    next_message,
    reason,
)

log = logging.getLogger(__name__)

FIRST_EXCHANGES = 5  # questions for the server's time before the first value is used
EXCHANGE_PERIOD = 2.0  # s between two such questions later on
MAX_ASKING = 5  # requests for messages that wait at the server at most
REFUSED_PAUSE = 1.0  # s until a request for messages is repeated that the server has refused
DEFAULT_PORT = 4840
EXPECTED = (OSError, TimeoutError, asyncio.CancelledError, ua.UaError, RefusedError)  # What ends a session
Take = Callable[[ua.PublishResult], None]


class SessionUser(Protocol):
    """A user of a session; both are called in its event loop."""

    async def serve(self, session: "OpcuaSession", client: Client) -> None:
        """Subscribe, again after each failure, until this is cancelled."""

    def lose(self, cause: str) -> None:
        """Note why there is no session."""


class OpcuaSession(ThreadedDriver, SharedConnection[SessionUser]):
    """The session, in a thread that runs its event loop, and connects again after every fault."""

    def __init__(self, options: OpcuaOptions, credentials: OpcUaCredentials) -> None:
        ThreadedDriver.__init__(self)
        SharedConnection.__init__(self)
        self.clock = ExchangeClock()
        self.certificate_warnings: list[str] = []
        self.cause = "not connected yet"  # Why there is no session
        self.own_faults = OwnFaults(log)
        self._options, self._credentials = options, credentials
        self._subscriptions: dict[SessionUser, int] = {}
        self._takers: dict[int, Take] = {}  # Who takes the messages of a subscription
        self._lost = ""  # why the library has lost the connection
        self._clocks_due = 0.0  # s; when they are compared again
        self._opening = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._news: asyncio.Event | None = None  # something is to be done before the next comparison of the clocks

    @staticmethod
    def place(options: OpcuaOptions, credentials: OpcUaCredentials) -> Place:
        """Return what a session is of: another user or certificate, or other security, makes another one."""
        url = urlsplit(options.endpoint)
        server = (str(url.hostname).lower(), url.port or DEFAULT_PORT, url.path)
        secure = (options.security, options.mode, credentials.certificate, credentials.server)
        return "opcua", server, secure, options.user, credentials.password, options.timeout

    def open(self) -> None:
        """Start the thread, if it does not run."""
        with self._opening:
            if self._thread is None:
                self._start("opcua-session", lambda: asyncio.run(self._run()))

    def close(self) -> None:
        self._stop.set()
        if self._task is not None:
            self._call(self._task.cancel)
        self.users_changed()
        super().close()

    def users_changed(self) -> None:
        """Serve those who are there now."""
        if self._news is not None:
            self._call(self._news.set)

    async def subscribe(
        self, client: Client, user: SessionUser, asked: ua.CreateSubscriptionParameters, take: Take
    ) -> ua.CreateSubscriptionResult:
        """Create the subscription of ``user`` instead of the one that it had; ``take`` takes its messages."""
        await self._unsubscribe(client, user)
        result = await client.uaclient.session.create_subscription(asked, take)
        self._subscriptions[user] = int(result.SubscriptionId)
        self._takers[int(result.SubscriptionId)] = take
        return result

    async def _unsubscribe(self, client: Client, user: SessionUser) -> None:
        number = self._subscriptions.pop(user, None)
        if number is not None:
            self._takers.pop(number, None)
            with suppress(OSError, TimeoutError, ua.UaError):
                ended = client.uaclient.session.delete_subscriptions([number])
                await asyncio.wait_for(ended, CLOSE_TIMEOUT)

    def holds(self, client: Client) -> bool:
        """Return whether ``client`` is connected, so that what fails is of one subscription."""
        return not self._lost and client.uaclient.protocol is not None and not client.uaclient.protocol.is_closed

    def doubt(self) -> None:
        """Ask at once whether the server is there, and how its clock is; called in the event loop."""
        self._clocks_due = 0.0
        if self._news is not None:
            self._news.set()

    def _call(self, call: Callable[[], object]) -> None:
        """Make a call in the event loop, if it runs."""
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(call)

    async def _run(self) -> None:
        self._news = asyncio.Event()
        self._loop, self._task, backoff = asyncio.get_running_loop(), asyncio.current_task(), ReconnectBackoff()
        while not self._stop.is_set():
            begun = time.monotonic()
            try:
                await self._session()
            except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - nothing may end the thread
                if self._stop.is_set():
                    return
                if not isinstance(error, EXPECTED):
                    self.own_faults.note(error, "a session with the server", time.monotonic())
                self._lose(reason(error, self._options.timeout))
            if time.monotonic() - begun >= LASTING:
                backoff.reset()
            if self._stop.is_set():
                return
            try:
                await asyncio.sleep(backoff.next())
            except asyncio.CancelledError:
                return

    def _lose(self, cause: str) -> None:
        self.cause = cause
        for user in self.users:
            user.lose(cause)

    async def _session(self) -> None:
        """Serve the users until the session fails, which raises."""
        async with connected(self._options, self._credentials) as (client, self.certificate_warnings):
            client.connection_lost_callback = self._note_loss
            self._lost = ""
            for _ in range(FIRST_EXCHANGES):
                await self._compare_clocks(client)
            self._subscriptions, self._takers, self.cause = {}, {}, "not connected yet"
            serving, asking = dict[SessionUser, asyncio.Task[None]](), list[asyncio.Task[None]]()
            try:
                while not self._stop.is_set():  # a cancellation may be swallowed by the library
                    await self._serve_users(client, serving)
                    for _ in range(len(asking) + 1, min(len(serving), MAX_ASKING)):
                        asking.append(asyncio.create_task(self._ask_for_messages(client)))
                    await self._wait(client)
            finally:
                await _end([*serving.values(), *asking])

    async def _serve_users(self, client: Client, serving: dict[SessionUser, "asyncio.Task[None]"]) -> None:
        """Begin to serve users who have come, and end it for those who have left."""
        users = self.users
        for user in [user for user in serving if user not in users]:
            await _end([serving.pop(user)])
            await self._unsubscribe(client, user)
        for user in users:
            if user not in serving or serving[user].done():
                serving[user] = asyncio.create_task(user.serve(self, client))

    async def _wait(self, client: Client) -> None:
        """Wait until users change or the clocks are to be compared, which shows whether the server is there."""
        assert self._news is not None  # noqa: S101 - for the type checker
        with suppress(TimeoutError):
            await asyncio.wait_for(self._news.wait(), max(0.0, self._clocks_due - time.monotonic()))
        self._news.clear()
        if self._lost:
            raise ConnectionError(self._lost)
        if time.monotonic() >= self._clocks_due:
            await self._compare_clocks(client)

    async def _ask_for_messages(self, client: Client) -> None:
        """Ask for messages beside the library, which has one request at the server for all subscriptions.

        With one only, the time to the server and back would limit how many messages all machines get together.
        """
        received: list[ua.SubscriptionAcknowledgement] = []
        while True:
            try:
                result = await next_message(client, received)
            except Exception as error:  # noqa: BLE001 - a server may answer anything
                if not isinstance(error, EXPECTED):
                    self.own_faults.note(error, "reading a message of the server", time.monotonic())
                received = []
                await asyncio.sleep(REFUSED_PAUSE)
                continue
            received = []
            if (take := self._takers.get(result.SubscriptionId)) is not None:
                take(result)
            if result.NotificationMessage.NotificationData:
                number = result.NotificationMessage.SequenceNumber
                received = [ua.SubscriptionAcknowledgement(SubscriptionId=result.SubscriptionId, SequenceNumber=number)]

    async def _note_loss(self, error: Exception) -> None:
        """Take the cause from the library, which after this presents a lost connection as ended subscriptions."""
        self._lost = "the server does not answer" if isinstance(error, TimeoutError) else "the connection was closed"
        if self._news is not None:
            self._news.set()

    async def _compare_clocks(self, client: Client) -> None:
        await exchange(client, self.clock)
        self._clocks_due = time.monotonic() + EXCHANGE_PERIOD


async def _end(tasks: Sequence["asyncio.Task[None]"]) -> None:
    """Cancel tasks, and wait until they have ended."""
    for task in tasks:
        task.cancel()
    if tasks:
        await asyncio.wait(tasks, timeout=CLOSE_TIMEOUT)
