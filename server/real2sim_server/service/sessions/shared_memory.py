"""Images for a controller on the same machine: a file in memory that both have mapped.

The worker makes one for each controller and names it in the welcome. A client that can open it
sends back the secret at its beginning: proof that both see the same memory, which no address gives
where there are containers and tunnels. From then on nobody needs the name and it goes, so that the
memory is free once worker and client have let go of it, however each of them ends; a name is left
behind only by a worker that is killed before its client has answered, and the next one sweeps it.

With each message the client says which slot the images of its answer may be written to, and the
worker writes nowhere else and at no other time. So an image stays as it is for as long as its
client keeps the slot to itself, and no further message has to say so.
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

from ..http.auth import secrets_equal
from ..http.responses import ServiceError
from ..library.scenes import IdleItem, MemoryBudget
from ..rendering.frames import EncodedFrame, placed_frame

SLOTS = 4
"""The observation under way, the newest, and two before it that a planner may hold."""
PREFIX = "real2sim-"
NAME_BYTES = 16
READ_ONLY = 0o400
"""Of our user alone, who may not write through the name: no client cuts it short by mistake."""

log = structlog.get_logger(__name__)


class Segment:
    """The shared memory of one controller. Its images are placed on any thread, one answer at a
    time; all else happens on the event loop.

    Args:
        path: of a file that does not exist yet.
        slot_bytes: of each slot; nothing is taken of the machine's memory before images need it.
        budget: in which that counts.

    Attributes:
        attached: whether the client has proved that it has opened the memory.

    Raises:
        OSError: there is no such memory here.
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
            # Unmapped with the last array on it, which another thread may be using.
            self._memory = np.frombuffer(mmap.mmap(self._file, size), np.uint8)
        except BaseException:
            self.close()
            raise
        beginning = np.frombuffer(SHM_MAGIC + self._secret, np.uint8)
        self._memory[: len(beginning)] = beginning

    @property
    def offer(self) -> dict[str, Any]:
        """Of the wire's SharedMemory."""
        return {"name": self._path.name, "slots": SLOTS, "slot_bytes": self._slot_bytes}

    @property
    def closed(self) -> bool:
        """Whether the connection has ended."""
        return self._file is None

    @property
    def taken_bytes(self) -> int:
        """What is taken of the machine's memory."""
        return sum(self._taken)

    def attach(self, secret: bytes) -> None:
        """The client has opened the memory. Raises ServiceError: INVALID_REQUEST, it has not."""
        if not secrets_equal(secret.hex(), self._secret.hex()):
            raise ServiceError(
                ErrorCode.INVALID_REQUEST,
                "the secret does not match the shared memory of this connection's welcome",
                hint="send bytes 16 to 47 of the file, or continue without shared memory",
            )
        self.attached = True
        self._remove_name()

    def slot(self, number: int | None) -> FrameSlot | None:
        """The slot of a message; None where it names none, or the client has not attached.

        Raises:
            ServiceError: INVALID_REQUEST, there is no such slot.
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
        """Copy raw images into a slot; the frames that say where they lie.

        None where they do not fit, or the machine or the budget has no such memory left.
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
        """Let go of the memory, and of its name where that is still there."""
        with self._lock:
            if self._file is None:
                return
            self._remove_name()
            os.close(self._file)
            self._file = None
            self._taken = [0] * SLOTS
            self._memory = np.empty(0, np.uint8)

    def _take(self, number: int, size: int) -> bool:
        """Whether the first ``size`` bytes of a slot are there to be written to.

        Pages of a file that the system cannot provide would end the process when written to.
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
        """Count memory of a slot. Raises ServiceError: OUT_OF_MEMORY."""
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
    """The frame of a raw image that is copied there; NumPy lets other threads run meanwhile."""
    pixels = np.frombuffer(frame.data, np.uint8)
    np.copyto(memory[offset : offset + len(pixels)], pixels)
    return placed_frame(frame, offset)


class FrameSlot(NamedTuple):
    """Where the images of one answer may be written.

    Attributes:
        segment: of the connection.
        number: of the slot.
    """

    segment: Segment
    number: int

    def place(self, frames: Sequence[EncodedFrame]) -> list[EncodedFrame] | None:
        """As :meth:`Segment.place`."""
        return self.segment.place(self.number, frames)


class Segments:
    """The shared memory of a worker's controllers, under its budget of memory.

    Args:
        budget: in which it counts.
        segment_bytes: of one controller; 0 offers none.
    """

    def __init__(self, budget: MemoryBudget, segment_bytes: int) -> None:
        self._budget = budget
        self._slot_bytes = segment_bytes // SLOTS // mmap.PAGESIZE * mmap.PAGESIZE
        self._segments: tuple[Segment, ...] = ()
        budget.add(self)

    @property
    def held_bytes(self) -> int:
        """Memory that images have taken."""
        return sum(segment.taken_bytes for segment in self._segments)

    def idle(self) -> Sequence[IdleItem]:
        """Nothing: clients may be looking at all of it."""
        return ()

    def create(self) -> Segment | None:
        """Memory for a controller; None where there is none to be had."""
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
    """Remove the names that killed workers of this user have left behind; returns them."""
    found = Path(SHM_FOLDER).glob(PREFIX + "[0-9a-f]" * 2 * NAME_BYTES)
    return [path for path in found if _removed_if_left(path)]


def _removed_if_left(path: Path) -> bool:
    """Remove a name unless it belongs to a process that lives; whether it is removed."""
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
    """Own a file until it is closed; the kernel ends that with the process. Raises OSError."""
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
