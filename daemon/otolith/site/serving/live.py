"""Server-sent events: the cards that changed, to each browser that shows the hall."""

import asyncio
from collections.abc import Awaitable, Callable

from starlette.responses import PlainTextResponse, Response
from starlette.types import Receive, Scope, Send

from otolith.site.hall import Filter, Rendered, Shown, removal
from otolith.site.serving.pieces import grouped

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
MAX_LIVE = 64  # browsers that get live events at a time
TICK = 1.0  # s between two looks for what has changed


class Live(Response):
    """A stream of events; who does not take them is cut by the server, as every slow reader."""

    def __init__(self, look: Callable[[], Awaitable[Shown]], chosen: Filter, free: asyncio.Semaphore) -> None:
        """``look`` returns the hall, ``free`` has a place for each stream that may run."""
        super().__init__(media_type="text/event-stream")
        self._look, self._chosen, self._free = look, chosen, free

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until the browser leaves."""
        if self._free.locked():
            text = f"{MAX_LIVE} browsers get live events already\n"
            await PlainTextResponse(text, 503)(scope, receive, send)
            return
        async with self._free:
            headers = [(name, value) for name, value in self.raw_headers if name != b"content-length"]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            tasks = asyncio.ensure_future(self._run(send)), asyncio.ensure_future(_left(receive))
            try:
                await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)

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
