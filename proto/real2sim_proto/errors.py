"""Stable error codes, their HTTP status, and the RFC 9457 problem document."""

from __future__ import annotations

from enum import StrEnum

from pydantic import BaseModel, ConfigDict, Field

PROBLEM_MEDIA_TYPE = "application/problem+json"


class ErrorCode(StrEnum):
    """Machine-readable error codes. Codes are never renamed."""

    INVALID_REQUEST = "INVALID_REQUEST"
    UNAUTHORIZED = "UNAUTHORIZED"
    NOT_FOUND = "NOT_FOUND"
    METHOD_NOT_ALLOWED = "METHOD_NOT_ALLOWED"
    NOT_ACCEPTABLE = "NOT_ACCEPTABLE"
    UNKNOWN_SCENE = "UNKNOWN_SCENE"
    UNKNOWN_SCENARIO = "UNKNOWN_SCENARIO"
    UNKNOWN_SESSION = "UNKNOWN_SESSION"
    UNKNOWN_OBJECT = "UNKNOWN_OBJECT"
    UNKNOWN_CAMERA = "UNKNOWN_CAMERA"
    UNKNOWN_ASSET = "UNKNOWN_ASSET"
    UNKNOWN_JOB = "UNKNOWN_JOB"
    JOB_NOT_DONE = "JOB_NOT_DONE"
    JOB_FAILED = "JOB_FAILED"
    UNSUPPORTED = "UNSUPPORTED"
    TIME_OUT_OF_RANGE = "TIME_OUT_OF_RANGE"
    SCENE_BROKEN = "SCENE_BROKEN"
    SCENE_IN_USE = "SCENE_IN_USE"
    ASSET_IN_USE = "ASSET_IN_USE"
    IMPORT_FAILED = "IMPORT_FAILED"
    ALREADY_EXISTS = "ALREADY_EXISTS"
    INVALID_OPERATION = "INVALID_OPERATION"
    STALE_REVISION = "STALE_REVISION"
    NOTHING_TO_UNDO = "NOTHING_TO_UNDO"
    NOTHING_TO_REDO = "NOTHING_TO_REDO"
    IDEMPOTENCY_CONFLICT = "IDEMPOTENCY_CONFLICT"
    PAYLOAD_TOO_LARGE = "PAYLOAD_TOO_LARGE"
    REQUEST_TIMEOUT = "REQUEST_TIMEOUT"
    TOO_MANY_CONNECTIONS = "TOO_MANY_CONNECTIONS"
    FOREIGN_PAGE = "FOREIGN_PAGE"
    FORBIDDEN = "FORBIDDEN"
    OVER_CAPACITY = "OVER_CAPACITY"
    TOO_MANY_REQUESTS = "TOO_MANY_REQUESTS"
    TOO_MANY_SESSIONS = "TOO_MANY_SESSIONS"
    TOO_MANY_JOBS = "TOO_MANY_JOBS"
    QUEUE_FULL = "QUEUE_FULL"
    OUT_OF_MEMORY = "OUT_OF_MEMORY"
    QUOTA_EXCEEDED = "QUOTA_EXCEEDED"
    STORAGE_FULL = "STORAGE_FULL"
    STORAGE_UNAVAILABLE = "STORAGE_UNAVAILABLE"
    DRAINING = "DRAINING"
    UNSUPPORTED_PROTOCOL = "UNSUPPORTED_PROTOCOL"
    BAD_MESSAGE = "BAD_MESSAGE"
    INVALID_ACTION = "INVALID_ACTION"
    NOT_RESET = "NOT_RESET"
    EPISODE_OVER = "EPISODE_OVER"
    STEP_CONFLICT = "STEP_CONFLICT"
    STALE_STEP = "STALE_STEP"
    BAD_STEP = "BAD_STEP"
    CONTROLLER_TAKEN = "CONTROLLER_TAKEN"
    NOT_CONTROLLER = "NOT_CONTROLLER"
    SESSION_CLOSED = "SESSION_CLOSED"
    SESSION_ELSEWHERE = "SESSION_ELSEWHERE"
    TIMEOUT = "TIMEOUT"
    INTERNAL = "INTERNAL"


HTTP_STATUS: dict[ErrorCode, int] = {
    ErrorCode.INVALID_REQUEST: 422,
    ErrorCode.UNAUTHORIZED: 401,
    ErrorCode.NOT_FOUND: 404,
    ErrorCode.METHOD_NOT_ALLOWED: 405,
    ErrorCode.NOT_ACCEPTABLE: 406,
    ErrorCode.UNKNOWN_SCENE: 404,
    ErrorCode.UNKNOWN_SCENARIO: 404,
    ErrorCode.UNKNOWN_SESSION: 404,
    ErrorCode.UNKNOWN_OBJECT: 404,
    ErrorCode.UNKNOWN_CAMERA: 404,
    ErrorCode.UNKNOWN_ASSET: 404,
    ErrorCode.UNKNOWN_JOB: 404,
    ErrorCode.JOB_NOT_DONE: 409,
    ErrorCode.JOB_FAILED: 409,
    ErrorCode.UNSUPPORTED: 501,
    ErrorCode.TIME_OUT_OF_RANGE: 422,
    ErrorCode.SCENE_BROKEN: 409,
    ErrorCode.SCENE_IN_USE: 409,
    ErrorCode.ASSET_IN_USE: 409,
    ErrorCode.IMPORT_FAILED: 422,
    ErrorCode.ALREADY_EXISTS: 409,
    ErrorCode.INVALID_OPERATION: 422,
    ErrorCode.STALE_REVISION: 412,
    ErrorCode.NOTHING_TO_UNDO: 409,
    ErrorCode.NOTHING_TO_REDO: 409,
    ErrorCode.IDEMPOTENCY_CONFLICT: 422,
    ErrorCode.PAYLOAD_TOO_LARGE: 413,
    ErrorCode.REQUEST_TIMEOUT: 408,
    ErrorCode.TOO_MANY_CONNECTIONS: 503,
    ErrorCode.FOREIGN_PAGE: 403,
    ErrorCode.FORBIDDEN: 403,
    ErrorCode.OVER_CAPACITY: 429,
    ErrorCode.TOO_MANY_REQUESTS: 429,
    ErrorCode.TOO_MANY_SESSIONS: 429,
    ErrorCode.TOO_MANY_JOBS: 429,
    ErrorCode.QUEUE_FULL: 503,
    ErrorCode.OUT_OF_MEMORY: 507,
    ErrorCode.QUOTA_EXCEEDED: 507,
    ErrorCode.STORAGE_FULL: 507,
    ErrorCode.STORAGE_UNAVAILABLE: 503,
    ErrorCode.DRAINING: 503,
    ErrorCode.UNSUPPORTED_PROTOCOL: 426,
    ErrorCode.BAD_MESSAGE: 400,
    ErrorCode.INVALID_ACTION: 422,
    ErrorCode.NOT_RESET: 409,
    ErrorCode.EPISODE_OVER: 409,
    ErrorCode.STEP_CONFLICT: 409,
    ErrorCode.STALE_STEP: 409,
    ErrorCode.BAD_STEP: 409,
    ErrorCode.CONTROLLER_TAKEN: 409,
    ErrorCode.NOT_CONTROLLER: 403,
    ErrorCode.SESSION_CLOSED: 410,
    ErrorCode.SESSION_ELSEWHERE: 503,
    ErrorCode.TIMEOUT: 504,
    ErrorCode.INTERNAL: 500,
}

RETRYABLE = frozenset(
    {
        ErrorCode.OVER_CAPACITY,
        ErrorCode.TOO_MANY_REQUESTS,
        ErrorCode.TOO_MANY_SESSIONS,
        ErrorCode.TOO_MANY_JOBS,
        ErrorCode.QUEUE_FULL,
        ErrorCode.DRAINING,
        ErrorCode.TIMEOUT,
        ErrorCode.REQUEST_TIMEOUT,
        ErrorCode.TOO_MANY_CONNECTIONS,
        ErrorCode.STORAGE_FULL,
        ErrorCode.STORAGE_UNAVAILABLE,
        ErrorCode.SESSION_ELSEWHERE,
    }
)
"""Codes after which the unchanged request may succeed later."""


class ProblemDetail(BaseModel):
    """One invalid value in a request."""

    model_config = ConfigDict(extra="ignore")

    pointer: str = Field(description="JSON pointer into the request, e.g. '/operations/0/x'")
    message: str


class Problem(BaseModel):
    """RFC 9457 problem document; the body of every reply with status 400 or above.

    Readers ignore unknown members, so that newer workers can add some.
    """

    model_config = ConfigDict(extra="allow")

    type: str = Field(default="about:blank", description="URI reference of the kind of problem")
    title: str = Field(description="short sentence, the same for every problem of this code")
    status: int
    code: ErrorCode | str = Field(
        union_mode="left_to_right", description="error code; newer workers may add codes"
    )
    detail: str = Field(description="the given value and what is allowed")
    hint: str | None = Field(default=None, description="how to fix it")
    instance: str | None = Field(default=None, description="path of the request")
    request_id: str | None = None
    retryable: bool = False
    errors: list[ProblemDetail] = Field(default_factory=list)


def title_of(code: ErrorCode) -> str:
    """Readable form of a code: ``Unknown scene``."""
    return code.value.replace("_", " ").capitalize()
