"""The state of a drive session, for the sync and the async client."""

from __future__ import annotations

import math
import mmap
import os
import random
import stat
import weakref
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from real2sim_proto import ErrorCode
from real2sim_proto.base import bearer_token
from real2sim_proto.drive import (
    SHM_FOLDER,
    SHM_HEADER_BYTES,
    SHM_MAGIC,
    SHM_SECRET_BYTES,
    Frame,
    Result,
    Welcome,
)
from real2sim_proto.sessions import SessionInfo

from ._calls import RETRYABLE_CODES, RETRYABLE_STATUS
from ._handles import Handle
from ._http import Target
from ._protocol import PendingRequest, ProtocolState
from .errors import (
    CapacityError,
    ConnectionLostError,
    GatewayError,
    MalformedReplyError,
    NotOpenError,
    Real2SimError,
    ReplyTimeoutError,
    SessionElsewhereError,
    StatusError,
    UnreachableError,
)
from .version import SDK

if TYPE_CHECKING:
    from real2sim_proto.drive import SharedMemory


# --- Poses ----------------------------------------------------------------------------------------

# Rigid poses are 4x4 matrices, rotations are quaternions wxyz.

Matrix = NDArray[np.float64]


def pose_matrix(position: Sequence[float], quaternion: Sequence[float]) -> Matrix:
    """[4, 4] of a position and a unit quaternion wxyz."""
    w, x, y, z = quaternion
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = position
    return pose


def quaternion_of(R: Matrix) -> tuple[float, float, float, float]:
    """wxyz of a rotation: the largest eigenvector of Bar-Itzhack's matrix (2000).

    It represents the rotation nearest to ``R``, so single precision is sufficient.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = R
    K = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    x, y, z, w = np.linalg.eigh(K)[1][:, -1].tolist()
    sign = -1.0 if w < 0 else 1.0
    return (sign * w, sign * x, sign * y, sign * z)


def pose_between(before: Matrix, after: Matrix, fraction: float) -> Matrix:
    """[4, 4] between two poses: positions linear, rotations along the shortest arc."""
    p, q = np.array(quaternion_of(before[:3, :3])), np.array(quaternion_of(after[:3, :3]))
    cosine = float(p @ q)
    q, cosine = (q, cosine) if cosine >= 0 else (-q, -cosine)
    angle = float(np.arccos(min(cosine, 1.0)))
    if angle < 1e-6:
        mixed = p + fraction * (q - p)
    else:
        mixed = np.sin((1 - fraction) * angle) * p + np.sin(fraction * angle) * q
    position = (1 - fraction) * before[:3, 3] + fraction * after[:3, 3]
    return pose_matrix(position.tolist(), (mixed / np.linalg.norm(mixed)).tolist())


# --- Shared memory --------------------------------------------------------------------------------

# Raw images on the worker's machine. Each message names a slot for the images of its reply. A slot
# is free again once the last array that uses it is released. If a caller holds all slots, further
# images arrive over the socket.


class SharedFrames:
    """Shared memory offered by a worker, opened.

    Args:
        offer: offer of a welcome.

    Attributes:
        secret: proves to the worker that this client has opened it.

    Raises:
        OSError: it is not on this machine, or not accessible.
    """

    def __init__(self, offer: SharedMemory) -> None:
        self._slot_bytes = offer.slot_bytes
        self._memory = _mapped(Path(SHM_FOLDER, offer.name), self._begin(offer.slots))
        self.secret = self._memory[len(SHM_MAGIC) : len(SHM_MAGIC) + SHM_SECRET_BYTES]
        self._free = list(reversed(range(offer.slots)))
        self._lent: int | None = None

    def lend(self) -> int | None:
        """The slot for images of the next answer, or None if the caller still holds all slots."""
        if self._lent is None and self._free:
            self._lent = self._free.pop()
        return self._lent

    def pixels_of(self, frames: Sequence[Frame]) -> list[memoryview | None]:
        """Pixels of an answer's images in shared memory; None for each image sent over the socket.

        Raises:
            MalformedReplyError: an image outside the slot.
        """
        if all(frame.offset is None for frame in frames):
            return [None] * len(frames)
        if self._lent is None:
            raise MalformedReplyError("an image in shared memory, but the request named no slot")
        slot, self._lent = self._lent, None
        begin = self._begin(slot)
        # All views share this array; the slot is returned when the last of them is released.
        owner = np.frombuffer(self._memory, np.uint8, self._slot_bytes, begin)
        weakref.finalize(owner, self._free.append, slot).atexit = False
        return [_part(owner.data, frame, begin) for frame in frames]

    def _begin(self, slot: int) -> int:
        return SHM_HEADER_BYTES + slot * self._slot_bytes


def _part(slot: memoryview, frame: Frame, begin: int) -> memoryview | None:
    """The bytes of a frame in a slot that starts at offset ``begin`` of the shared memory."""
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
    """Map the first ``size`` bytes of a worker's shared memory file, read-only.

    Raises:
        OSError: the file is missing, too small or not shared memory of a worker.
    """
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
    if memory[: len(SHM_MAGIC)] != SHM_MAGIC:
        raise OSError(f"{path} is not shared memory of a worker")
    return memory


LOST_ERRORS = (ConnectionLostError, SessionElsewhereError, GatewayError)
"""Errors after which a session reconnects: its worker is gone, or another worker took it over."""

MAX_RECONNECTS = 10_000


def backoff(attempt: int) -> float:
    """Seconds to wait before reconnection attempt number ``attempt``, with jitter."""
    return min(0.05 * 2.0**attempt, 2.0) * (0.75 + 0.25 * random.random())


def is_transient(error: Real2SimError) -> bool:
    """Whether connecting to a restarting worker can fail with this error.

    A reverse proxy answers 502 for a moment after the worker has stopped.
    """
    if isinstance(error, StatusError) and error.status in RETRYABLE_STATUS:
        return True
    return isinstance(error, UnreachableError | CapacityError | ReplyTimeoutError)


def is_passing(error: Real2SimError) -> bool:
    """Whether the worker refused a message only temporarily, so that it may be sent again.

    For example, its store is unreachable, its queue is full, or the token has reached a limit.
    """
    return is_away(error) or (isinstance(error, StatusError) and error.code in RETRYABLE_CODES)


def is_away(error: Real2SimError) -> bool:
    """Whether the request had no effect because the store or the worker was unavailable.

    The worker's store is unreachable, or a proxy finds no worker that accepts new requests.
    """
    if not isinstance(error, StatusError):
        return False
    return error.code == ErrorCode.STORAGE_UNAVAILABLE or (
        error.status == 503 and error.code == "UNKNOWN"
    )


@dataclass(frozen=True)
class SessionPlan:
    """Which session to open, and its options.

    Attributes:
        scene, scenario: subject of a new session; exactly one of them.
        session_id: joins this session instead of creating one.
        token: token of the joined session.
        role: ``controller`` or ``observer``.
        codec: codec of sensors that set none: ``auto``, ``raw``, ``jpeg`` or ``png``.
        reconnect: seconds to retry a lost connection or a temporarily refused message; 0 disables
            retries.
        shared_memory: True requires it, False disables it, None uses it if possible, unless the
            client sets a default.
    """

    scene: str | None = None
    scenario: str | None = None
    session_id: str | None = None
    token: str | None = field(default=None, repr=False)
    role: str = "controller"
    codec: str = "auto"
    reconnect: float = 60.0
    shared_memory: bool | None = None


class SessionBase(Handle):
    """State of a drive session, shared by the sync and the async variant."""

    _instead: ClassVar = {
        "action_space": "real2sim.make_env(scene='street'), which has spaces",
        "apply_control": "session.step(real2sim.Control(acceleration=1.0, steering=0.0))",
        "get_observation": "what session.reset() and session.step(plan) return",
        "info": "session.welcome",
        "metrics": "obs.metrics, of what session.step(plan) returns",
        "objects": "session.welcome.objects, or obs.agents after session.reset(privileged=True)",
        "obs": "what session.reset() and session.step(plan) return",
        "observation_space": "real2sim.make_env(scene='street'), which has spaces",
        "observe": "what session.reset() and session.step(plan) return",
        "run": "real2sim.planners.run_episode(session, planner)",
        "seed": "session.reset(seed=0)",
        "start": "session.open(), or `with client.session(...) as session:`",
        "tick": "session.step(plan)",
    }

    def __init__(self, target: Target, plan: SessionPlan) -> None:
        self._target = target
        self._plan = plan
        self._codec = target.codec(plan.codec)
        self._protocol = ProtocolState()
        self._memory: SharedFrames | None = None
        self._welcome: Welcome | None = None
        self._result: Result | None = None
        self._token = plan.token if plan.token is None else bearer_token(plan.token)
        self._info: SessionInfo | None = None

    def __repr__(self) -> str:
        name = self._welcome.session_id if self._welcome else self._plan.session_id
        return f"{type(self).__name__}({name!r}, step={self._protocol.step})"

    @property
    def welcome(self) -> Welcome:
        """The worker's welcome message: cameras, objects, time range, limits, versions.

        Raises:
            NotOpenError: the session has not been opened yet.
        """
        if self._welcome is None:
            raise not_open()
        return self._welcome

    @property
    def session_id(self) -> str:
        """Id of the session on its worker."""
        return self.welcome.session_id

    @property
    def token(self) -> str:
        """Authorises others to join this session: ``client.join(s.session_id, token=s.token)``."""
        if self._token is None:
            raise not_open()
        return self._token

    @property
    def cameras(self) -> list[str]:
        """Names of the cameras available as sensors."""
        return [camera.name for camera in self.welcome.cameras]

    @property
    def shared_memory(self) -> bool:
        """Whether raw images arrive through shared memory."""
        return self._memory is not None

    @property
    def result(self) -> Result | None:
        """Final scores; known after ``close``."""
        return self._result

    def _hello(self) -> PendingRequest[Welcome]:
        resume_token = self._welcome.resume_token if self._welcome else None
        return self._protocol.hello(
            sdk=SDK, role=self._plan.role, token=self._token, resume_token=resume_token
        )

    def _offered_memory(self) -> SharedFrames | None:
        """The shared memory offered by the welcome, opened; None if unavailable or disabled.

        Raises:
            UnreachableError: shared memory is required but unavailable.
        """
        offer = self.welcome.shared_memory
        if self._uses_shared_memory is False or self._plan.role != "controller":
            return None
        reason = "the worker offers none"
        if offer is not None:
            try:
                return SharedFrames(offer)
            except OSError as error:
                reason = str(error)
        self._without_memory(reason)
        return None

    def _without_memory(self, reason: str) -> None:
        """Continue over the socket. Raises UnreachableError if shared memory is required."""
        if self._uses_shared_memory:
            raise UnreachableError(
                f"no shared memory with the worker at {self._target.url}: {reason}",
                hint="worker and client need one /dev/shm and one user; in containers one IPC "
                "namespace (ipc: host or service:...)",
            )

    @property
    def _uses_shared_memory(self) -> bool | None:
        own = self._plan.shared_memory
        return self._target.shared_memory if own is None else own

    def _use_memory(self, memory: SharedFrames | None) -> None:
        """Read images from ``memory`` from now on; None reads them from the socket."""
        self._memory = memory
        near = memory is not None and self._plan.codec == "auto"
        self._codec = "raw" if near else self._target.codec(self._plan.codec)

    def _slot_for(self, request: PendingRequest[Any]) -> int | None:
        """Shared memory slot for images of the answer, or None."""
        return self._memory.lend() if self._memory and request.has_images else None

    def _pixels_of(self, frames: Sequence[Frame]) -> Sequence[memoryview | None]:
        """Pixels of an answer's images in shared memory, with None for all others."""
        return () if self._memory is None else self._memory.pixels_of(frames)

    def _may_resend(self, request: PendingRequest[Any]) -> bool:
        """Whether to reconnect and send the request again."""
        return self._welcome is not None and self._plan.reconnect > 0 and request.idempotent

    def _check_not_applied(self, request: PendingRequest[Any]) -> None:
        """Raises ConnectionLostError if the request may already have taken effect."""
        expected, revision = request.only_at_revision, self.welcome.revision
        if expected is not None and revision != expected:
            raise ConnectionLostError(
                f"the connection was lost before {request.awaited} arrived; the session is at "
                f"revision {revision}, so it took effect",
                hint="the session continues; read the next observation",
            )

    def _timeout_of(self, request: PendingRequest[Any]) -> float:
        return self._target.long_timeout if request.long_timeout else self._target.timeout

    def _reply_timeout(self, request: PendingRequest[Any]) -> ReplyTimeoutError:
        return ReplyTimeoutError(
            f"{request.awaited} from {self._target.url}",
            self._timeout_of(request),
            hint="the worker may be busy; see `real2sim status`, or give a longer timeout",
        )


def not_open() -> NotOpenError:
    """The error for using a session before it is opened or after it is closed."""
    return NotOpenError(
        "the session is not open",
        hint="write `with client.session(...) as session:`, or call open() first and close() last; "
        "the async client has `async with`",
    )


class SessionTokens:
    """Tokens of the sessions that a client created. The worker sends each token only once."""

    def __init__(self, own: str | None) -> None:
        self._own = own
        self._tokens: dict[str, str] = {}

    def keep(self, info: SessionInfo) -> SessionInfo:
        self._tokens[info.session_id] = info.token
        return info

    def forget(self, session_id: str) -> None:
        self._tokens.pop(session_id, None)

    def of(self, session_id: str) -> str | None:
        """The token to send: the worker token, which opens every session, or the session token."""
        return self._own or self._tokens.get(session_id)
