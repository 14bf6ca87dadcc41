"""Answers in pieces: what many readers get is in memory once, and each has only a few pieces of it in flight."""

import asyncio
from collections.abc import Iterable, Iterator, Mapping, Sequence

from starlette.responses import Response
from starlette.types import Receive, Scope, Send

# Thresholds: docs/reference/thresholds-site.md has the origin of each.
PIECE = 16 << 10  # bytes that are sent at a time


class Pieces(Response):
    """An answer whose content is in pieces that others have, too."""

    def __init__(
        self, content: Sequence[bytes], media_type: str, status: int = 200, headers: Mapping[str, str] | None = None
    ) -> None:
        length = {"content-length": str(sum(map(len, content)))}
        super().__init__(None, status, {**(headers or {}), **length}, media_type)
        self._content = content

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it as fast as it is taken."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        for part in () if scope["method"] == "HEAD" else grouped(self._content):
            await send({"type": "http.response.body", "body": part, "more_body": True})
            await asyncio.sleep(0)  # others have their turn, and that the reader has left is seen
        await send({"type": "http.response.body", "body": b""})


def grouped(content: Iterable[bytes]) -> Iterator[bytes]:
    """Yield the content in parts of about :data:`PIECE` bytes, and none that is much longer."""
    part, size = list[bytes](), 0
    for piece in content:
        for begin in range(0, len(piece), PIECE):
            own = piece[begin : begin + PIECE]
            part.append(own)
            size += len(own)
            if size >= PIECE:
                yield b"".join(part)
                part, size = [], 0
    if part:
        yield b"".join(part)
