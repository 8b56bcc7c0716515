"""Raw images out of memory that the worker has written them to, on the same machine.

The client says with each message which slot the images of the answer may be written to, and names
none that somebody still looks at: a slot comes back when the last array on it is gone. Who keeps
every image is soon given them over the socket.
"""

from __future__ import annotations

import math
import mmap
import os
import stat
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from real2sim_proto.shared_memory import FOLDER, HEADER_BYTES, MAGIC, SECRET_BYTES

from .errors import MalformedReplyError

if TYPE_CHECKING:
    from real2sim_proto.drive import Frame, SharedMemory


class SharedFrames:
    """The memory that a worker has offered, open.

    Args:
        offer: of a welcome.

    Attributes:
        secret: proves to the worker that this is its memory.

    Raises:
        OSError: it is not on this machine, or not for us.
    """

    def __init__(self, offer: SharedMemory) -> None:
        self._slot_bytes = offer.slot_bytes
        self._memory = _mapped(Path(FOLDER, offer.name), self._begin(offer.slots))
        self.secret = self._memory[len(MAGIC) : len(MAGIC) + SECRET_BYTES]
        self._free = list(reversed(range(offer.slots)))
        self._lent: int | None = None

    def lend(self) -> int | None:
        """The slot for images of the answer to the next message; None where all are looked at."""
        if self._lent is None and self._free:
            self._lent = self._free.pop()
        return self._lent

    def pixels_of(self, frames: Sequence[Frame]) -> list[memoryview | None]:
        """What lies in the slot lent for an answer; None for each image that came with it.

        Raises:
            MalformedReplyError: an image that does not lie in that slot.
        """
        if all(frame.offset is None for frame in frames):
            return [None] * len(frames)
        if self._lent is None:
            raise MalformedReplyError("an image in shared memory where no slot was named")
        slot, self._lent = self._lent, None
        begin = self._begin(slot)
        # Views of it end in this array, which gives the slot back when the last of them is gone.
        owner = np.frombuffer(self._memory, np.uint8, self._slot_bytes, begin)
        weakref.finalize(owner, self._free.append, slot).atexit = False
        return [_part(owner.data, frame, begin) for frame in frames]

    def _begin(self, slot: int) -> int:
        return HEADER_BYTES + slot * self._slot_bytes


def _part(slot: memoryview, frame: Frame, begin: int) -> memoryview | None:
    """The bytes of a frame in its slot, which begins at ``begin``."""
    if frame.offset is None:
        return None
    first = frame.offset - begin
    size = math.prod(frame.shape) * np.dtype(frame.dtype).itemsize
    if first < 0 or size < 0 or first + size > len(slot):
        raise MalformedReplyError(
            f"{size} bytes at {frame.offset} of the shared memory are not in the slot named"
        )
    return slot[first : first + size]


def _mapped(path: Path, size: int) -> mmap.mmap:
    """The first ``size`` bytes of a worker's file, to be read. Raises OSError: it is none."""
    flags = os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
    file = os.open(path, flags)
    try:
        found = os.fstat(file)
        if not stat.S_ISREG(found.st_mode) or found.st_size < size:
            raise OSError(f"{path} has {found.st_size} bytes of {size}")
        memory = mmap.mmap(file, size, access=mmap.ACCESS_READ)
    except (ValueError, OverflowError) as error:
        raise OSError(f"{path} cannot be mapped: {error}") from error
    finally:
        os.close(file)
    if memory[: len(MAGIC)] != MAGIC:
        raise OSError(f"{path} is no shared memory of a worker")
    return memory
