"""Server-sent events: the cards that changed, to each browser that shows the hall."""

import asyncio
from collections import defaultdict
from collections.abc import Awaitable, Callable

from starlette.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from otolith.site.hall import Filter, Rendered, Shown, removal
from otolith.site.serving.counts import Counts, Hindered
from otolith.site.serving.pieces import grouped

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_LIVE = 64  # browsers that get live events at a time
TICK = 1.0  # s between two looks for what has changed


class Places:
    """Of the streams that may run: an address that has many of them gives way to one that has fewer."""

    def __init__(self, count: int = MAX_LIVE) -> None:
        self._free = count
        self._held: defaultdict[str, list[asyncio.Event]] = defaultdict(list)  # By address, the oldest first

    def take(self, address: str) -> asyncio.Event | None:
        """Return what is set once the place is another's; None if there is none."""
        if self._free:
            self._free -= 1
        else:
            most = max(self._held, key=lambda key: len(self._held[key]))
            if len(self._held[most]) < len(self._held[address]) + 2:
                return None
            self._held[most].pop(0).set()
        self._held[address].append(ended := asyncio.Event())
        return ended

    def leave(self, address: str, ended: asyncio.Event) -> None:
        """Give the place back, unless it is another's."""
        if not ended.is_set():
            self._held[address].remove(ended)
            self._free += 1
        if not self._held[address]:
            del self._held[address]


class Live(Response):
    """A stream of events; who does not take them is cut by the server, as every slow reader."""

    def __init__(self, look: Callable[[], Awaitable[Shown]], chosen: Filter, places: Places, hindered: Counts) -> None:
        """``look`` returns the hall."""
        super().__init__(media_type="text/event-stream")
        self._look, self._chosen, self._places, self._hindered = look, chosen, places, hindered

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until the browser leaves, or its place is another's."""
        address = (scope.get("client") or ("", 0))[0]
        ended = self._places.take(address)
        if ended is None:
            self._hindered[Hindered.LIVE] += 1
            text = f"{MAX_LIVE} browsers get live events already\n"
            await PlainTextResponse(text, 503)(scope, receive, send)
            return
        try:
            headers = [(name, value) for name, value in self.raw_headers if name != b"content-length"]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            tasks = [asyncio.ensure_future(each) for each in (self._run(send), _left(receive), ended.wait())]
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
        finally:
            self._places.leave(address, ended)

    async def _run(self, send: Send) -> None:
        known: dict[str, Rendered] = {}
        while True:
            hall = await self._look()
            cards = {card.id: card for card in hall.cards if self._chosen.lets(card)}
            changes = [card.event for key, card in cards.items() if known.get(key) is not card]
            changes += [removal(card) for key, card in known.items() if key not in cards]
            known = cards
            for part in grouped([*changes, hall.numbers()]):
                await send({"type": "http.response.body", "body": part, "more_body": True})
                await asyncio.sleep(0)  # as for pages
            await asyncio.sleep(TICK)


async def _left(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
