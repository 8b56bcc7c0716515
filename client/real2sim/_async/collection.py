"""What a client has several of: scenes, scenarios, assets, jobs, sessions."""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from typing import TYPE_CHECKING, Generic, TypeVar

from .concurrency import Lookup
from .transport import AsyncTransport

T = TypeVar("T")


class AsyncCollection(Lookup, Generic[T]):
    """Lists what the worker has; iterating over it asks the worker once.

    Examples:
        >>> client = real2sim.connect_async()
        >>> [info.scene async for info in client.scenes]
        ['street']
    """

    def __init__(self, transport: AsyncTransport) -> None:
        self._transport = transport

    if TYPE_CHECKING:

        async def list(self) -> Sequence[T]: ...

    async def __aiter__(self) -> AsyncIterator[T]:
        for one in await self.list():
            yield one

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._transport.target})"
