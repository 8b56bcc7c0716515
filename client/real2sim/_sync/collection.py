# Made from _async/collection.py by scripts/unasync.py; edit that file, then run the script.
"""What a client has several of: scenes, scenarios, assets, jobs, sessions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Generic, TypeVar

from .concurrency import Lookup
from .transport import Transport

T = TypeVar("T")


class Collection(Lookup, Generic[T]):
    """Lists what the worker has; iterating over it asks the worker once.

    Examples:
        >>> client = real2sim.connect()
        >>> [info.scene for info in client.scenes]
        ['street']
    """

    def __init__(self, transport: Transport) -> None:
        self._transport = transport

    if TYPE_CHECKING:

        def list(self) -> Sequence[T]: ...

    def __iter__(self) -> Iterator[T]:
        for one in self.list():
            yield one

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self._transport.target})"
