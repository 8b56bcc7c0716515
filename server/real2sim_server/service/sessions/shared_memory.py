"""Images for a controller on the same machine, in a file that both processes map.

The worker creates a file for each controller and names it in the welcome. A client that can open it
returns the secret at its start. This proves that both see the same memory; an address would not,
because of containers and tunnels. The name is then removed, so that the memory is freed once worker
and client have released it, even after a crash. A name remains only if a worker is killed before
its client has answered. The next worker then removes it.

Each message names the slot for the images of its answer. The worker writes only to that slot, and
only for that answer. An image therefore stays unchanged until the client reuses the slot.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import secrets
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import structlog
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.drive import (
    SHM_ALIGNMENT,
    SHM_FOLDER,
    SHM_HEADER_BYTES,
    SHM_MAGIC,
    SHM_SECRET_BYTES,
)

from ..frames import EncodedFrame, placed_frame
from ..http.auth import secrets_equal
from ..http.responses import ServiceError
from ..library.scenes import IdleItem, MemoryBudget

SLOTS = 4
"""The observation in progress, the newest, and two earlier ones that a planner may hold."""
PREFIX = "real2sim-"
NAME_BYTES = 16
READ_ONLY = 0o400
"""Read-only for the worker's user, so that no client truncates the file by mistake."""

log = structlog.get_logger(__name__)


class Segment:
    """The shared memory of one controller.

    :meth:`place` may run on any thread, for one answer at a time. All other methods are for the
    event loop.

    Args:
        path: path of the new file.
        slot_bytes: size of each slot; memory is only allocated when images need it.
        budget: memory budget that includes it.

    Attributes:
        attached: whether the client has confirmed with the secret that it has opened the memory.

    Raises:
        OSError: shared memory is not available on this machine.
    """

    def __init__(self, path: Path, slot_bytes: int, budget: MemoryBudget) -> None:
        self.attached = False
        self._path = path
        self._slot_bytes = slot_bytes
        self._budget = budget
        self._secret = secrets.token_bytes(SHM_SECRET_BYTES)
        self._memory: NDArray[np.uint8] = np.empty(0, np.uint8)
        self._taken = [0] * SLOTS
        self._refused: int | None = None
        self._lock = threading.Lock()
        flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        self._file: int | None = os.open(path, flags, READ_ONLY)
        try:
            _lock(self._file)
            size = SHM_HEADER_BYTES + SLOTS * slot_bytes
            os.ftruncate(self._file, size)
            os.posix_fallocate(self._file, 0, SHM_HEADER_BYTES)
            # The memory is unmapped with the last array that uses it, possibly on another thread.
            self._memory = np.frombuffer(mmap.mmap(self._file, size), np.uint8)
        except BaseException:
            self.close()
            raise
        beginning = np.frombuffer(SHM_MAGIC + self._secret, np.uint8)
        self._memory[: len(beginning)] = beginning

    @property
    def offer(self) -> dict[str, Any]:
        """The protocol's SharedMemory."""
        return {"name": self._path.name, "slots": SLOTS, "slot_bytes": self._slot_bytes}

    @property
    def closed(self) -> bool:
        """Whether the connection has ended."""
        return self._file is None

    @property
    def taken_bytes(self) -> int:
        """Allocated memory [bytes]."""
        return sum(self._taken)

    def attach(self, secret: bytes) -> None:
        """Record that the client has opened the memory.

        Raises:
            ServiceError: INVALID_REQUEST if the secret is wrong.
        """
        if not secrets_equal(secret.hex(), self._secret.hex()):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                "the secret does not match the shared memory of this connection's welcome",
                hint="send bytes 16 to 47 of the file, or continue without shared memory",
            )
        self.attached = True
        self._remove_name()

    def slot(self, number: int | None) -> FrameSlot | None:
        """The slot of a message; None if the message names none or the client has not attached.

        Raises:
            ServiceError: INVALID_REQUEST if the slot does not exist.
        """
        if number is None or not self.attached:
            return None
        if number >= SLOTS:
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                f"slot {number}; the shared memory has slots 0 to {SLOTS - 1}",
            )
        return FrameSlot(self, number)

    def place(self, number: int, frames: Sequence[EncodedFrame]) -> list[EncodedFrame] | None:
        """Copy raw images into a slot; returns frames with their offsets.

        None if they do not fit, or if the machine or the budget has no memory left.
        """
        memory, begin = self._memory, SHM_HEADER_BYTES + number * self._slot_bytes
        offsets, end = [], begin
        for frame in frames:
            if frame.codec == "raw":
                offsets.append(end)
                end += -(-len(frame.data) // SHM_ALIGNMENT) * SHM_ALIGNMENT
        if not offsets or not self._take(number, end - begin):
            return None
        places = iter(offsets)
        return [
            _placed(frame, memory, next(places)) if frame.codec == "raw" else frame
            for frame in frames
        ]

    def close(self) -> None:
        """Release the memory, and remove its name if it still exists."""
        with self._lock:
            if self._file is None:
                return
            self._remove_name()
            os.close(self._file)
            self._file = None
            self._taken = [0] * SLOTS
            self._memory = np.empty(0, np.uint8)

    def _take(self, number: int, size: int) -> bool:
        """Whether the first ``size`` bytes of a slot can be allocated.

        Writing to pages that the system cannot provide would kill the process.
        """
        if size <= self._taken[number]:
            return True
        if size > self._slot_bytes or (self._refused is not None and size >= self._refused):
            return False
        with self._lock:
            if self._file is None:
                return False
            begin, before = SHM_HEADER_BYTES + number * self._slot_bytes, self._taken[number]
            try:
                self._reserve(number, size)
                os.posix_fallocate(self._file, begin, size)
            except (OSError, ServiceError) as error:
                self._taken[number], self._refused = before, size
                log.info("images go over the socket", reason=str(error), needed_bytes=size)
                return False
        return True

    def _reserve(self, number: int, size: int) -> None:
        """Reserve memory for a slot. Raises ServiceError: OUT_OF_MEMORY."""
        taken = self._taken
        self._budget.make_room(
            "shared memory of images",
            size - taken[number],
            reserve=lambda: taken.__setitem__(number, size),
        )

    def _remove_name(self) -> None:
        with contextlib.suppress(OSError):
            self._path.unlink()


def _placed(frame: EncodedFrame, memory: NDArray[np.uint8], offset: int) -> EncodedFrame:
    """Copy a raw image to an offset and return its frame; NumPy releases the GIL meanwhile."""
    pixels = np.frombuffer(frame.data, np.uint8)
    np.copyto(memory[offset : offset + len(pixels)], pixels)
    return placed_frame(frame, offset)


class FrameSlot(NamedTuple):
    """Slot for the images of one answer.

    Attributes:
        segment: shared memory of the connection.
        number: number of the slot.
    """

    segment: Segment
    number: int

    def place(self, frames: Sequence[EncodedFrame]) -> list[EncodedFrame] | None:
        """See :meth:`Segment.place`."""
        return self.segment.place(self.number, frames)


class Segments:
    """Shared memory of a worker's controllers, within the memory budget.

    Args:
        budget: memory budget that includes it.
        segment_bytes: size for one controller; 0 disables shared memory.
    """

    def __init__(self, budget: MemoryBudget, segment_bytes: int) -> None:
        self._budget = budget
        self._slot_bytes = segment_bytes // SLOTS // mmap.PAGESIZE * mmap.PAGESIZE
        self._segments: tuple[Segment, ...] = ()
        budget.add(self)

    @property
    def held_bytes(self) -> int:
        """Memory allocated for images [bytes]."""
        return sum(segment.taken_bytes for segment in self._segments)

    def idle(self) -> Sequence[IdleItem]:
        """Always empty, because clients may be using all of the memory."""
        return ()

    def create(self) -> Segment | None:
        """Memory for a controller; None if not available."""
        if not self._slot_bytes or not hasattr(os, "posix_fallocate"):
            return None
        path = Path(SHM_FOLDER, PREFIX + secrets.token_hex(NAME_BYTES))
        try:
            segment = Segment(path, self._slot_bytes, self._budget)
        except OSError as error:
            log.info("no shared memory is offered", reason=str(error))
            return None
        self._segments = (*(s for s in self._segments if not s.closed), segment)
        return segment


def sweep_segments() -> list[Path]:
    """Remove the files left by this user's killed workers, and return their paths."""
    found = Path(SHM_FOLDER).glob(PREFIX + "[0-9a-f]" * 2 * NAME_BYTES)
    return [path for path in found if _removed_if_left(path)]


def _removed_if_left(path: Path) -> bool:
    """Remove a name unless its process is alive; returns whether it was removed."""
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        if os.fstat(file).st_uid == os.geteuid():
            _lock(file)
            path.unlink()
            return True
    except OSError:
        pass
    finally:
        os.close(file)
    return False


def _lock(file: int) -> None:
    """Lock a file until it is closed; the lock ends with the process. Raises OSError."""
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
