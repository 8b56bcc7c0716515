"""Run code with an open store."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from real2sim_server.service.storage.store import Store

T = TypeVar("T")


def run(url: str, work: Callable[[Store], Awaitable[T]], **options: Any) -> T:
    """Run ``work(store)`` with a store opened with these options."""

    async def inside() -> T:
        store = Store(url, **options)
        await store.open()
        try:
            return await work(store)
        finally:
            await store.close()

    return asyncio.run(inside())
