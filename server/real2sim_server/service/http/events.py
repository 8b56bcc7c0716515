"""Server-sent events (WHATWG HTML, section 9.2)."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

HEARTBEAT_S = 10.0
"""Comments this far apart keep proxies from closing a stream on which nothing happens."""


async def event_stream(events: AsyncIterator[tuple[int, str, str]]) -> AsyncIterator[bytes]:
    """The bytes of (id, name, data without line breaks), with heartbeats in between."""
    source = aiter(events)
    pending: asyncio.Future[tuple[int, str, str]] | None = None
    try:
        while True:
            pending = pending or asyncio.ensure_future(anext(source))
            done, _ = await asyncio.wait({pending}, timeout=HEARTBEAT_S)
            if not done:
                yield b": still here\n\n"
                continue
            try:
                number, name, data = pending.result()
            except StopAsyncIteration:
                return
            pending = None
            yield f"id: {number}\nevent: {name}\ndata: {data}\n\n".encode()
    finally:
        if pending is not None:
            pending.cancel()
