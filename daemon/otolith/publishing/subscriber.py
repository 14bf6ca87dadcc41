"""A subscriber that gets each message once and in order, also those that were published while it was away."""

import json
import queue
import threading
import time
from collections.abc import Callable, Iterable
from typing import Self

from otolith.publishing.reader_sessions import QUERY_TIMEOUT, Arrival, ReaderSessions
from otolith.publishing.zenoh_config import Connection
from otolith.publishing.zenoh_session import MAX_REPLIES, REPORT, START, StartDocument, Topic

# Thresholds: docs/reference/thresholds-runtime.md has the origin of each.
QUERY_TRIES = 5  # queries for what is missing
QUERY_PAUSE = 0.5  # s between them
QUERY_PERIOD = 10.0  # s between queries for what was lost on the way without a later message that shows it
MAX_BEHIND = 1000  # messages that wait for on_message; later ones come from the history
MAX_KEYS = 1000  # of machines, of which the position is kept


class MessageOrder:
    """Passes on each message of a key once and in order; ``query`` returns the messages after a sequence number.

    A message has a sequence number and that of the one before it. One without numbers is passed on as it comes. The
    topics of a machine share their numbers, so that the first report also shows from where on events can be missing.
    """

    def __init__(
        self,
        query: Callable[[str, int], list[str]],
        on_message: Callable[[str], None],
        pause: Callable[[], bool],
        after: int | None,
        topics: tuple[Topic, ...] = (REPORT,),
    ) -> None:
        """``pause`` waits between two queries and returns whether to stop; ``after`` is where unknown keys begin."""
        self._query, self._on_message, self._pause, self._after = query, on_message, pause, after
        self._topics = topics
        self._last: dict[str, int] = {}
        self.missed, self.gap = 0, (0, 0)  # Gaps that no query could fill; numbers before the last one and at its end

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of which messages were passed on."""
        return tuple(self._last)

    def begin(self, key: str, text: str) -> None:
        """Begin with the number of a message, whether or not its topic is subscribed, where nothing is known yet."""
        sequence, _ = _numbers(text)
        if sequence is not None and self._after is None:
            for topic in self._topics:
                self._last.setdefault(f"{key.rpartition('/')[0]}/{topic.key}", sequence)

    def take(self, key: str, text: str) -> None:
        """Pass a message on, after those before it that are missing."""
        sequence, previous = _numbers(text)
        last = self._last.get(key, self._after)
        if sequence is not None and last is not None:
            if previous is not None and previous > last:
                self._fill_gap(key, previous)
                last = self._last.get(key, last)
            if sequence <= last:
                return
            self._count_gap(last, previous)
        self._pass_on(key, text, sequence)

    def catch_up(self, key: str) -> None:
        """Query the messages after the last one, and pass them on."""
        last = self._last.get(key, self._after)
        is_full = last is not None
        while is_full and last is not None:
            texts = self._query(key, last)
            for number, text in sorted((_numbers(text)[0] or 0, text) for text in texts):
                if number > last:
                    self._count_gap(last, _numbers(text)[1])
                    last = number
                    self._pass_on(key, text, number)
            is_full = len(texts) >= MAX_REPLIES

    def _fill_gap(self, key: str, previous: int) -> None:
        """Pass on what is missing up to the message ``previous``.

        A complete answer ends with the message that showed the gap, even if it lacks the ones before.
        """
        for _ in range(QUERY_TRIES):
            self.catch_up(key)
            if self._last.get(key, 0) >= previous or self._pause():
                return

    def _count_gap(self, last: int, previous: int | None) -> None:
        """Count a gap if the message before the next one, ``previous``, is later than ``last``, which is 0 at first."""
        if last and previous is not None and previous > last:
            self.missed, self.gap = self.missed + 1, (last, previous)

    def _pass_on(self, key: str, text: str, sequence: int | None) -> None:
        if sequence is not None:
            if key not in self._last and key.endswith(f"/{REPORT.key}"):
                self.begin(key, text)
            self._last.pop(key, None)
            self._last[key] = sequence
            while len(self._last) > MAX_KEYS:
                del self._last[next(iter(self._last))]
        self._on_message(text)


class Subscriber:
    """Passes the messages of machines to ``on_message``, which may block; it runs in a thread of its own."""

    def __init__(
        self,
        connection: Connection,
        on_message: Callable[[str], None],
        machine: str = "*",
        topics: tuple[Topic, ...] = (REPORT,),
        after: int | None = None,
    ) -> None:
        """Begin after a sequence number, or without it with the latest report.

        ``machine`` is the name of one, with or without its site and a point before it, or ``*``.

        Without endpoints it reads all daemons on this computer that this user may read.

        Raises:
            ConfigurationError: a file of the credentials is missing or cannot be used.
        """
        self._topics = topics
        self._waiting: queue.Queue[tuple[str, str | None]] = queue.Queue(MAX_BEHIND)
        self._stopping, self._is_behind = threading.Event(), threading.Event()
        self.order = MessageOrder(self._query, on_message, lambda: self._stopping.wait(QUERY_PAUSE), after, topics)
        site, _, name = machine.rpartition(".")
        self._site, self._machine, self._from_now = site or "*", name, after is None
        needed = {REPORT, START, *topics}  # a report also shows from where on events can be missing
        self._sessions = ReaderSessions(connection, needed, self._receive, (self._site, name))
        self._starts: dict[str, StartDocument] = {}  # By the key of the machine, until its first report
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._sessions.start()

    @property
    def connected(self) -> bool:
        """Whether a daemon or a router is connected."""
        return self._sessions.connected

    @property
    def starting(self) -> tuple[str, ...]:
        """How far each daemon is that starts, in words."""
        return tuple(f"{each.machine} ({each.site}): {each.text}" for each in tuple(self._starts.values()))

    def state(self) -> str:
        """Return what it waits for, in words."""
        addresses, is_remote = ", ".join(self._sessions.addresses), bool(self._sessions.endpoints)
        if self.connected and (starting := self.starting):
            return "; ".join(starting)
        if self.connected and is_remote:
            reports = REPORT.under(self._site, self._machine)
            cause = f"no window has ended since, or this reader may not read {reports}"
            return f"connected, no report yet: {cause} ({addresses})"
        if self.connected:
            return "connected, no report yet: the first one comes at the end of the first window"
        if is_remote:
            return f"no daemon reached yet, or it refuses this reader; --connect sets where to look ({addresses})"
        if addresses:
            return f"no daemon reached yet: it starts, or was killed and left its socket ({addresses})"
        own = "no daemon of this user runs here, and no service whose reports it may read (the group otolith may)"
        return f"{own}; --connect sets where to look"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._sessions.close()
        self._thread.join(QUERY_TIMEOUT)

    def _receive(self, arrival: Arrival) -> None:
        if arrival.content is not None:
            self._put(arrival.key, arrival.content.decode(errors="replace"))  # anybody may publish anything
        elif arrival.is_alive:
            self._put(arrival.key, None)
        else:
            self._starts.pop(arrival.machine, None)

    def _put(self, key: str, text: str | None) -> None:
        try:
            self._waiting.put_nowait((key, text))
        except queue.Full:
            self._is_behind.set()

    def _run(self) -> None:
        due = time.monotonic() + QUERY_PERIOD
        while not self._stopping.is_set():
            if time.monotonic() >= due or (self._is_behind.is_set() and self._waiting.empty()):
                self._is_behind.clear()
                self._catch_up(self.order.keys)
                due = time.monotonic() + QUERY_PERIOD
            try:
                key, text = self._waiting.get(timeout=QUERY_PAUSE)
            except queue.Empty:
                continue
            if text is not None:
                self._take(key, text)
            else:
                self._begin_or_catch_up(key.rpartition("/")[0])

    def _take(self, key: str, text: str) -> None:
        machine, _, topic_key = key.rpartition("/")
        if topic_key == START.key:
            self._take_start(machine, text)
            return
        self._starts.pop(machine, None)
        is_subscribed = any(key.endswith(f"/{topic.key}") for topic in self._topics)
        (self.order.take if is_subscribed else self.order.begin)(key, text)

    def _take_start(self, machine: str, text: str) -> None:
        try:
            document = StartDocument.model_validate_json(text)
        except ValueError:  # anybody may publish anything
            return
        self._starts.pop(machine, None)
        if document.done < document.total and len(self._starts) < MAX_KEYS:
            self._starts[machine] = document

    def _begin_or_catch_up(self, machine: str) -> None:
        """Take the latest report of a daemon that is new here, or what was published while it was not connected."""
        for text in self._get(f"{machine}/{START.key}"):
            self._take_start(machine, text)
        keys = [f"{machine}/{topic.key}" for topic in self._topics]
        if self._from_now and not set(keys) & set(self.order.keys):
            for text in self._get(f"{machine}/{REPORT.key}"):
                self._take(f"{machine}/{REPORT.key}", text)
        else:
            self._catch_up(keys)

    def _catch_up(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.order.catch_up(key)

    def _query(self, key: str, after: int) -> list[str]:
        return self._get(f"{key}?after={after}")

    def _get(self, selector: str) -> list[str]:
        return [content.decode(errors="replace") for _, content in self._sessions.get(selector)]


def _numbers(text: str) -> tuple[int | None, int | None]:
    """Return sequence number and previous one of a message; None where it has none."""
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return None, None
    values = (message.get(name) if isinstance(message, dict) else None for name in ("sequence", "previous"))
    sequence, previous = (value if isinstance(value, int) else None for value in values)
    return sequence, previous
