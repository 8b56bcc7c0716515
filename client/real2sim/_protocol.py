"""The client's side of the drive socket, without the socket.

A drive session, sync or async, uses a :class:`ProtocolState`, which numbers messages, matches
answers to them, and converts bytes into answers or exceptions.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import websockets
from pydantic import BaseModel, TypeAdapter, ValidationError

from real2sim_proto import (
    DRIVE_SUBPROTOCOL,
    HTTP_STATUS,
    PROTOCOL_VERSION,
    SUPPORTED_SUBPROTOCOLS,
    CodecError,
    ErrorCode,
    decode,
    encode,
)
from real2sim_proto.codec import MAX_SERVER_MESSAGE_BYTES
from real2sim_proto.drive import (
    SERVER_MESSAGE,
    Action,
    Agent,
    Attach,
    Attached,
    Bye,
    Driven,
    Edit,
    Edited,
    Envelope,
    Error,
    Fork,
    Forked,
    Hello,
    Kept,
    Obs,
    Progress,
    Render,
    Reset,
    Restore,
    Result,
    Resume,
    Snapshot,
    View,
    Welcome,
)
from real2sim_proto.episode import ResetSpec, SensorSpec
from real2sim_proto.operations import Operation
from real2sim_proto.plans import PLAN, Control, Plan, PoseCommand, TrajectoryPlan

from ._calls import Reply, checked, describe, error_from_reply, read_fields, sent_fields
from ._http import Target
from .errors import (
    ConnectionLostError,
    ErrorDetails,
    MalformedReplyError,
    NotResetError,
    ProtocolMismatchError,
    ReplyTimeoutError,
    UnreachableError,
    error_for,
)

A = TypeVar("A", bound=Envelope)
M = TypeVar("M")

MAX_UNSOLICITED = 16
"""Buffered unsolicited observations; the oldest are dropped."""

_SUPERSEDED = {ErrorCode.STALE_STEP.value, ErrorCode.EPISODE_OVER.value}

MAX_MESSAGE_BYTES = MAX_SERVER_MESSAGE_BYTES
_STATUS = {code.value: status for code, status in HTTP_STATUS.items()}


@dataclass(frozen=True)
class PendingRequest(Generic[A]):
    """A message to send, and the type of its answer.

    Attributes:
        long_timeout: whether the answer may take as long as loading a scene.
        idempotent: whether it may be resent after a lost connection; the worker applies it once.
        only_at_revision: the only revision at which it may be resent.
        has_images: whether the answer may contain images.
    """

    id: int
    fields: Mapping[str, Any]
    answer: type[A]
    awaited: str
    long_timeout: bool = False
    idempotent: bool = True
    only_at_revision: int | None = None
    has_images: bool = False

    def encoded(self, slot: int | None = None) -> bytes:
        """The encoded message; ``slot`` is the shared memory slot for images of the answer."""
        return encode({**self.fields} if slot is None else {**self.fields, "slot": slot})


class ProtocolState:
    """Numbers messages and follows the session's step and revision."""

    def __init__(self) -> None:
        self._ids = 0
        self._step: int | None = None
        self._revision: int | None = None
        self._unsolicited: deque[Obs] = deque(maxlen=MAX_UNSOLICITED)

    @property
    def step(self) -> int | None:
        """Step of the newest observation; None before reset."""
        return self._step

    def hello(
        self, *, sdk: str, role: str, token: str | None, resume_token: str | None = None
    ) -> PendingRequest[Welcome]:
        """The first message; with a resume token it continues a lost connection."""
        resume = None
        if resume_token is not None:
            resume = Resume(token=resume_token, last_step=self._step)
        message = checked(
            Hello,
            id=self._next_id(),
            protocols=list(SUPPORTED_SUBPROTOCOLS),
            sdk=sdk,
            role=role,
            token=token,
            resume=resume,
        )
        return self._request_for(
            message, Welcome, "welcome (scene loading, first render)", long_timeout=True
        )

    def attach(self, secret: bytes) -> PendingRequest[Attached]:
        """Confirms that this client has opened the shared memory of the welcome."""
        message = Attach(id=self._next_id(), secret=secret)
        return self._request_for(
            message, Attached, "confirmation of shared memory", idempotent=False
        )

    def reset(self, spec: ResetSpec) -> PendingRequest[Obs]:
        """Starts an episode."""
        message = Reset(id=self._next_id(), spec=spec)
        return self._request_for(
            message, Obs, "observation 0 after reset", long_timeout=True, has_images=True
        )

    def action(self, plan: Plan | Mapping[str, Any]) -> PendingRequest[Obs]:
        """Answers the newest observation with a plan.

        Raises:
            NotResetError: there is no observation yet.
            ValueError: an invalid plan.
        """
        if self._step is None:
            raise NotResetError(
                ErrorDetails(409, ErrorCode.NOT_RESET, "no episode runs", hint="call reset() first")
            )
        message = Action(id=self._next_id(), step=self._step, plan=valid_plan(plan))
        return self._request_for(message, Obs, f"observation {self._step + 1}", has_images=True)

    def edit(self, operations: Sequence[Operation | Mapping[str, Any]]) -> PendingRequest[Edited]:
        """Changes the session's world, based on the last known revision."""
        message = checked(
            Edit, id=self._next_id(), base_rev=self._revision, operations=list(operations)
        )
        return self._request_for(
            message, Edited, "confirmation of the edit", only_at_revision=self._revision
        )

    def render(
        self, sensors: Sequence[SensorSpec], ranging: Mapping[str, Any]
    ) -> PendingRequest[View]:
        """Requests images of the current time, and clouds of LiDARs and radars."""
        message = checked(Render, id=self._next_id(), sensors=list(sensors), **ranging)
        # A LiDAR or lens that no step has used may need kernels that are not yet compiled.
        return self._request_for(message, View, "images", long_timeout=True, has_images=True)

    def agent(
        self,
        object_id: str,
        times_us: Sequence[int],
        poses: Sequence[tuple[float, float, float]],
    ) -> PendingRequest[Driven]:
        """Sets the plan of an externally driven object."""
        message = checked(
            Agent,
            id=self._next_id(),
            object_id=object_id,
            times_us=list(times_us),
            poses=list(poses),
        )
        return self._request_for(message, Driven, "confirmation of the object's plan")

    def snapshot(self, name: str) -> PendingRequest[Kept]:
        """Saves the current state under a name."""
        message = checked(Snapshot, id=self._next_id(), name=name)
        return self._request_for(message, Kept, "confirmation of the snapshot")

    def restore(self, name: str) -> PendingRequest[Obs]:
        """Returns to a snapshot."""
        message = checked(Restore, id=self._next_id(), name=name)
        return self._request_for(
            message, Obs, f"observation of snapshot {name!r}", long_timeout=True
        )

    def fork(self) -> PendingRequest[Forked]:
        """Creates another session from the current state."""
        return self._request_for(Fork(id=self._next_id()), Forked, "a fork", idempotent=False)

    def bye(self) -> PendingRequest[Result]:
        """Ends the session."""
        return self._request_for(
            Bye(id=self._next_id()), Result, "result of the session", idempotent=False
        )

    def read(self, data: bytes | str, request: PendingRequest[A]) -> A | None:
        """The answer in ``data``; None for progress and for late answers to older requests.

        Raises:
            StatusError: the worker refuses the message.
            ProtocolMismatchError: the worker has another version.
            MalformedReplyError: not a valid message.
        """
        message = server_message(data, SERVER_MESSAGE)
        if isinstance(message, Error):
            if message.id not in {0, request.id} and not message.fatal:
                return None
            superseded = message.code in _SUPERSEDED and request.answer is Obs
            if superseded and (newest := self.take_unsolicited(newest=True)) is not None:
                # The planner was late and the worker advanced without it.
                return newest  # type: ignore[return-value]
            raise error_of(message)
        if isinstance(message, Obs) and message.id == 0:
            self._unsolicited.append(message)
            return None
        if isinstance(message, Progress) or 0 < message.id < request.id:
            return None
        if not isinstance(message, request.answer) or message.id != request.id:
            raise MalformedReplyError(
                f"{type(message).__name__.lower()} with id {message.id} arrived, but "
                f"{request.awaited} with id {request.id} was awaited"
            )
        self._track(message)
        return message

    def take_unsolicited(self, *, newest: bool = False) -> Obs | None:
        """The oldest unsolicited observation; ``newest`` takes the newest and drops the others."""
        if not self._unsolicited:
            return None
        message = self._unsolicited.pop() if newest else self._unsolicited.popleft()
        if newest:
            self._unsolicited.clear()
        self._track(message)
        return message

    def handle_unsolicited(self, data: bytes | str) -> None:
        """Process a message while no answer is pending.

        Raises:
            StatusError: the worker ends the connection, for the reason in the error.
        """
        message = server_message(data, SERVER_MESSAGE)
        if isinstance(message, Error):
            raise error_of(message)
        if isinstance(message, Obs):
            self._unsolicited.append(message)

    def _track(self, message: Envelope) -> None:
        if isinstance(message, Obs):
            self._step, self._revision = message.step, message.revision
        elif isinstance(message, Edited | View):
            self._revision = message.revision
        elif isinstance(message, Welcome) and self._step is None:
            self._step, self._revision = message.step, message.revision

    def _next_id(self) -> int:
        self._ids += 1
        return self._ids

    @staticmethod
    def _request_for(
        message: Envelope, answer: type[A], awaited: str, **how: Any
    ) -> PendingRequest[A]:
        return PendingRequest(message.id, sent_fields(message), answer, awaited, **how)


def valid_plan(plan: Plan | Mapping[str, Any]) -> Plan:
    """The plan as its model.

    Raises:
        ValueError: describes the invalid field in one sentence.
    """
    if isinstance(plan, Mapping) and "kind" not in plan:
        # The members identify the kind, because no two kinds share a required member.
        models: tuple[type[BaseModel], ...] = (TrajectoryPlan, Control, PoseCommand)
        kinds = [m for m in models if _required(m) <= set(plan)]
        if not kinds:
            raise ValueError(
                f"plan: {dict(plan)!r} has no kind; give 'trajectory' (times_us, poses), 'control' "
                "(acceleration, steering) or 'pose' (x, y, yaw)"
            )
        plan = {"kind": kinds[0].model_fields["kind"].default, **plan}
    elif not isinstance(plan, Mapping | BaseModel):
        raise ValueError(
            f"plan: {plan!r} is a {type(plan).__name__}; write real2sim.Control(acceleration=1.0, "
            "steering=0.0) [m/s^2, rad], a TrajectoryPlan or a PoseCommand, or its fields with "
            "its kind"
        )
    try:
        return PLAN.validate_python(plan)
    except ValidationError as error:
        raise ValueError(f"plan: {describe(error)}") from error


def _required(model: type[BaseModel]) -> set[str]:
    return {name for name, field in model.model_fields.items() if field.is_required()}


def server_message(data: bytes | str, messages: TypeAdapter[M]) -> M:
    """Parse a message of the worker, one of ``messages``.

    Raises:
        ProtocolMismatchError: the worker has another version.
        MalformedReplyError: not a valid message.
    """
    if isinstance(data, str):
        raise MalformedReplyError("the worker sent text where binary messages are spoken")
    try:
        fields = decode(data, max_bytes=MAX_MESSAGE_BYTES)
    except CodecError as error:
        raise MalformedReplyError(f"the worker's message cannot be read: {error}") from error
    version = fields.get("v")
    if isinstance(version, int) and version != PROTOCOL_VERSION:
        raise ProtocolMismatchError(
            f"the worker sends messages of protocol version {version}; this client speaks "
            f"{PROTOCOL_VERSION}",
            hint="install a client and a worker of the same major version",
        )
    try:
        return read_fields(messages, fields)
    except ValidationError as error:
        raise MalformedReplyError(
            f"the worker's message is not valid: {describe(error)}"
        ) from error


def error_of(message: Error) -> Exception:
    """The exception for an error message of the worker."""
    return error_for(
        ErrorDetails(
            status=_STATUS.get(message.code, 500),
            code=message.code,
            detail=message.detail,
            hint=message.hint,
            step=message.step,
            retry_after=message.retry_after_s,
        )
    )


# Opening and loss of the socket, for the sync and the async client.


def socket_options(target: Target, session_id: str) -> dict[str, Any]:
    """Arguments for opening the socket: no compression, large messages, and timeouts."""
    return {
        "uri": target.drive_url(session_id),
        "subprotocols": [DRIVE_SUBPROTOCOL],
        "additional_headers": target.headers,
        "compression": None,
        "max_size": MAX_MESSAGE_BYTES,
        "open_timeout": target.timeout,
        "close_timeout": min(target.timeout, 5.0),
        "proxy": None if target.loopback else True,
    }


def check_subprotocol(chosen: str | None) -> None:
    """Refuse a worker that did not choose our subprotocol. Raises ProtocolMismatchError."""
    if chosen != DRIVE_SUBPROTOCOL:
        raise ProtocolMismatchError(
            f"the worker chose drive protocol {chosen or 'none'}; this client speaks "
            f"{DRIVE_SUBPROTOCOL}",
            hint="install a client and a worker of the same major version",
        )


@contextlib.contextmanager
def handshake_errors(target: Target) -> Iterator[None]:
    """Convert errors of the socket's handshake into errors of the SDK."""
    try:
        yield
    except websockets.exceptions.InvalidStatus as error:
        response = error.response
        headers = {name.lower(): value for name, value in response.headers.raw_items()}
        reply = Reply(response.status_code, headers, bytes(response.body or b""))
        raise error_from_reply(reply) from error
    except TimeoutError:
        raise ReplyTimeoutError(
            f"answer to the drive socket's handshake from {target.url}", target.timeout
        ) from None
    except websockets.exceptions.NegotiationError as error:
        raise ProtocolMismatchError(
            f"the worker did not agree to drive protocol {DRIVE_SUBPROTOCOL}: {error}",
            hint="install a client and a worker of the same major version",
        ) from error
    except (OSError, websockets.exceptions.WebSocketException) as error:
        raise UnreachableError(
            f"the drive socket at {target.url} did not open: {error}",
            hint="is the worker up? see `real2sim status`",
        ) from None


@contextlib.contextmanager
def lost_connection(target: Target, awaited: str) -> Iterator[None]:
    """Raise ConnectionLostError if the socket closes while an answer is awaited."""
    try:
        yield
    except websockets.exceptions.ConnectionClosed as error:
        close = error.rcvd
        said = f"{close.code} {close.reason}".strip() if close else "without a close frame"
        leaving = close is not None and close.code in {1001, 1012}
        raise ConnectionLostError(
            f"the worker at {target.url} closed the drive socket ({said}) while "
            f"{awaited} was awaited",
            hint="the worker is shutting down or restarting" if leaving else None,
        ) from error
