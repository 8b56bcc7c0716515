"""One budget of memory for everything that is loaded: scenes and assets."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from real2sim_proto import ErrorCode

from ..http.problems import ServiceError


@dataclass(frozen=True)
class IdleItem:
    """Something in memory that nobody uses.

    Attributes:
        used_at: when it was used last, by the monotonic clock.
        nbytes: what it takes.
        drop: forgets it; the bytes that come free, at once or within a moment.
    """

    used_at: float
    nbytes: int
    drop: Callable[[], int]


class MemoryHolder(Protocol):
    """What loads things under the budget. Both are called on any thread."""

    @property
    def held_bytes(self) -> int:
        """Memory of all that is loaded or being loaded."""

    def idle(self) -> Sequence[IdleItem]:
        """What could be forgotten."""


class MemoryBudget:
    """Bytes that all holders may take together. Safe to use on any thread.

    Args:
        total_bytes: the budget.
    """

    def __init__(self, total_bytes: int) -> None:
        self.total_bytes = total_bytes
        self._holders: list[MemoryHolder] = []
        self._lock = threading.Lock()

    def add(self, holder: MemoryHolder) -> None:
        """Count what ``holder`` loads."""
        self._holders.append(holder)

    @property
    def free_bytes(self) -> int:
        """What is left; negative where users keep more than the budget alive."""
        return self.total_bytes - sum(holder.held_bytes for holder in self._holders)

    def make_room(self, what: str, needed: int, *, reserve: Callable[[], None]) -> None:
        """Forget idle things, longest unused first, until ``needed`` bytes fit.

        Args:
            what: for messages, as ``scene 'street'``.
            needed: bytes.
            reserve: makes its holder count them; called while no other call can take the room.

        Raises:
            ServiceError: OUT_OF_MEMORY.
        """
        if needed > self.total_bytes:
            raise _out_of_memory(
                f"{what} needs {needed} bytes, the budget is {self.total_bytes}",
                hint="raise REAL2SIM_SCENE_MEMORY_BYTES, or thin it out",
                needed=needed,
                free=self.total_bytes,
            )
        with self._lock:
            free = self.free_bytes
            idle = sorted(
                (item for holder in self._holders for item in holder.idle()),
                key=lambda item: item.used_at,
            )
            if needed <= free + sum(item.nbytes for item in idle):
                for item in idle:
                    if needed <= free:
                        break
                    free += item.drop()
            if needed > free:
                raise _out_of_memory(
                    f"{what} needs {needed} bytes; of the budget of {self.total_bytes} all but "
                    f"{free} are taken by scenes and assets that are in use",
                    hint="close sessions on other scenes, or raise REAL2SIM_SCENE_MEMORY_BYTES",
                    needed=needed,
                    free=free,
                )
            reserve()


def _out_of_memory(detail: str, *, hint: str, needed: int, free: int) -> ServiceError:
    extra = {"needed_bytes": needed, "free_bytes": free}
    return ServiceError(ErrorCode.OUT_OF_MEMORY, detail, hint=hint, extra=extra)
