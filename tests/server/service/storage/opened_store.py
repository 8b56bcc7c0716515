"""A store, opened for a piece of work."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import TypeVar

from real2sim_server.service.storage.store import Store

T = TypeVar("T")


def run(url: str, work: Callable[[Store], Awaitable[T]]) -> T:
    """Run ``work(store)`` on a store opened for it."""

    async def inside() -> T:
        store = Store(url)
        await store.open()
        try:
            return await work(store)
        finally:
            await store.close()

    return asyncio.run(inside())
