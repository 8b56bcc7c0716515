"""A store, opened for a piece of work."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from real2sim_server.service.storage.store import Store

T = TypeVar("T")


def run(url: str, work: Callable[[Store], Awaitable[T]], **options: Any) -> T:
    """Run ``work(store)`` on a store opened for it, with options of its own."""

    async def inside() -> T:
        store = Store(url, **options)
        await store.open()
        try:
            return await work(store)
        finally:
            await store.close()

    return asyncio.run(inside())
