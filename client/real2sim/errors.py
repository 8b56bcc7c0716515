"""Exceptions of the SDK.

::

    Real2SimError                      all of the below; has .hint
    ├── UnreachableError               no worker answers there            (also a ConnectionError)
    │   └── ConnectionLostError        the drive socket broke
    ├── ReplyTimeoutError              no reply in time                   (also a TimeoutError)
    ├── ProtocolMismatchError          client and worker speak different protocol versions
    ├── MalformedReplyError            the worker sent something that is not a valid reply
    ├── ImageDecodeError               an image of this codec cannot be decoded here
    ├── NotOpenError                   the session was never opened, or is closed
    └── StatusError                    the worker refused; has .status .code .detail .request_id ...
        ├── InvalidRequestError        a value is not allowed             (422, 400, 413)
        │   ├── InvalidOperationError      of an edit
        │   └── InvalidActionError         of a plan
        ├── UnauthorizedError          token missing or wrong             (401, 403)
        ├── NotFoundError              no such scene, scenario, session, object, camera (404)
        ├── ConflictError              not in this state                  (409)
        │   ├── StaleRevisionError         someone else edited first      (412); has .missed
        │   ├── StepConflictError          this step was answered with other content
        │   ├── StaleStepError             the session is past this step
        │   ├── BadStepError               the session is not there yet
        │   ├── NotResetError              reset comes first
        │   ├── EpisodeOverError           the episode has ended; reset starts another
        │   └── ControllerTakenError       another client drives this session
        ├── CapacityError              the worker is full; has .retry_after (429, 503, 507)
        │   └── SessionElsewhereError      another worker has the session
        ├── SessionClosedError         the session is over                (410)
        └── WorkerFailedError          a fault of the worker              (500, 504)
            └── GatewayError               of a proxy, whose worker is gone   (502)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from real2sim_proto.scenarios import HistoryEntry


class Real2SimError(Exception):
    """Base of all errors of the SDK.

    Attributes:
        hint: how to fix it, or None. A traceback shows it.

    Examples:
        >>> client = real2sim.connect()
        >>> try:
        ...     client.scenes.get("nowhere")
        ... except real2sim.NotFoundError as error:
        ...     print(error.status, error.code)
        404 UNKNOWN_SCENE
    """

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.hint = hint
        if hint is not None:
            # A traceback shows notes, so scripts show the hint too.
            self.add_note(f"hint: {hint}")


class UnreachableError(Real2SimError, ConnectionError):
    """No worker answers at the address."""


class ConnectionLostError(UnreachableError):
    """The drive socket broke while a reply was awaited."""


class ReplyTimeoutError(Real2SimError, TimeoutError):
    """A reply did not arrive in time."""

    def __init__(self, awaited: str, seconds: float, *, hint: str | None = None) -> None:
        super().__init__(f"no {awaited} within {seconds:g} s", hint=hint)
        self.awaited = awaited
        self.seconds = seconds


class ProtocolMismatchError(Real2SimError):
    """Client and worker speak different versions of the protocol."""


class MalformedReplyError(Real2SimError):
    """The worker sent something that is not a valid reply."""


class ImageDecodeError(Real2SimError):
    """An image cannot be decoded here; its encoded bytes are still available."""


class NotOpenError(Real2SimError):
    """A drive session was used before it was opened or after it was closed."""


@dataclass(frozen=True)
class InvalidValue:
    """One value that the worker did not accept."""

    pointer: str
    message: str


@dataclass(frozen=True)
class ErrorDetails:
    """Details of a worker's error response."""

    status: int
    code: str
    detail: str
    hint: str | None = None
    request_id: str | None = None
    errors: Sequence[InvalidValue] = ()
    retry_after: float | None = None
    step: int | None = None
    revision: int | None = None
    missed: Sequence[HistoryEntry] = ()


class StatusError(Real2SimError):
    """The worker refused a request or a message.

    Attributes:
        status: HTTP status; drive socket messages have the status of the same code.
        code: stable code, see ``real2sim_proto.ErrorCode``; newer workers may send others.
        detail: the given value and the allowed ones.
        request_id: identifies the request in the worker's log.
        errors: rejected values, with JSON pointers into the request.
        retry_after: seconds after which to retry.
        step: current step of the drive session, if the worker sends it.
    """

    def __init__(self, details: ErrorDetails) -> None:
        # Many workers include the first error in the detail.
        unsaid = [e for e in details.errors if e.message not in details.detail]
        places = "; ".join(f"{e.pointer or '/'}: {e.message}" for e in unsaid)
        message = f"{details.detail} ({places})" if places else details.detail
        super().__init__(f"{message} [{details.code}]", hint=details.hint)
        self.status = details.status
        self.code = details.code
        self.detail = details.detail
        self.request_id = details.request_id
        self.errors = tuple(details.errors)
        self.retry_after = details.retry_after
        self.step = details.step


class InvalidRequestError(StatusError):
    """A value of the request is not allowed."""


class InvalidOperationError(InvalidRequestError):
    """An edit refers to something that does not exist, or cannot be applied."""


class InvalidActionError(InvalidRequestError):
    """A plan is not of the session's kind, or not drivable."""


class UnauthorizedError(StatusError):
    """The token is missing or wrong, or lacks the permission."""


class NotFoundError(StatusError):
    """No scene, scenario, session, object or camera of that name."""


class ConflictError(StatusError):
    """The request conflicts with the current state of the worker."""


class StaleRevisionError(ConflictError):
    """Someone else edited the scenario first; review their edits and apply yours again.

    Attributes:
        revision: current revision of the scenario, if the worker sends it.
        missed: history entries that this client has not seen, oldest first.
    """

    def __init__(self, details: ErrorDetails) -> None:
        super().__init__(details)
        self.revision = details.revision
        self.missed = tuple(details.missed)


class StepConflictError(ConflictError):
    """This step was already answered, with different content."""


class StaleStepError(ConflictError):
    """The session is past this step."""


class BadStepError(ConflictError):
    """The session has not reached this step yet."""


class NotResetError(ConflictError):
    """No episode is running; call ``reset`` first."""


class EpisodeOverError(ConflictError):
    """The episode has ended; ``reset`` starts another."""


class ControllerTakenError(ConflictError):
    """Another client drives this session."""


class CapacityError(StatusError):
    """The worker has no room for this now."""


class SessionElsewhereError(CapacityError):
    """Another worker has the session; drive sessions reconnect to it automatically."""


class SessionClosedError(StatusError):
    """The session is over."""


class WorkerFailedError(StatusError):
    """A fault of the worker, not of the request."""


class GatewayError(WorkerFailedError):
    """A proxy reports that the worker behind it is gone; another one may replace it soon."""


_BY_CODE: dict[str, type[StatusError]] = {
    "INVALID_OPERATION": InvalidOperationError,
    "INVALID_ACTION": InvalidActionError,
    "UNAUTHORIZED": UnauthorizedError,
    "NOT_CONTROLLER": UnauthorizedError,
    "STALE_REVISION": StaleRevisionError,
    "STEP_CONFLICT": StepConflictError,
    "STALE_STEP": StaleStepError,
    "BAD_STEP": BadStepError,
    "NOT_RESET": NotResetError,
    "EPISODE_OVER": EpisodeOverError,
    "CONTROLLER_TAKEN": ControllerTakenError,
    "OVER_CAPACITY": CapacityError,
    "QUEUE_FULL": CapacityError,
    "OUT_OF_MEMORY": CapacityError,
    "QUOTA_EXCEEDED": CapacityError,
    "STORAGE_FULL": CapacityError,
    "STORAGE_UNAVAILABLE": CapacityError,
    "DRAINING": CapacityError,
    "SESSION_CLOSED": SessionClosedError,
    "SESSION_ELSEWHERE": SessionElsewhereError,
}

_BY_STATUS: dict[int, type[StatusError]] = {
    400: InvalidRequestError,
    401: UnauthorizedError,
    403: UnauthorizedError,
    404: NotFoundError,
    409: ConflictError,
    410: SessionClosedError,
    412: StaleRevisionError,
    413: InvalidRequestError,
    422: InvalidRequestError,
    429: CapacityError,
    502: GatewayError,
    503: CapacityError,
    507: CapacityError,
}


def error_for(details: ErrorDetails) -> Real2SimError:
    """The exception for a worker's error: by code if known, else by status."""
    if details.code == "UNSUPPORTED_PROTOCOL" or details.status == 426:
        return ProtocolMismatchError(details.detail, hint=details.hint)
    by_status = _BY_STATUS.get(
        details.status, WorkerFailedError if details.status >= 500 else StatusError
    )
    return _BY_CODE.get(details.code, by_status)(details)
