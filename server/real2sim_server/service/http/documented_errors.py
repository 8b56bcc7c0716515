"""Which errors each call may answer with, for its OpenAPI operation.

Most follow from what a call takes: a scene in its path may be unknown, a body too large. The rest
stands in a table by operation.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from real2sim_proto import HTTP_STATUS, PROBLEM_MEDIA_TYPE, ErrorCode
from real2sim_proto.errors import title_of

C = ErrorCode

OF_EVERY_CALL = (
    C.BAD_MESSAGE,
    C.UNAUTHORIZED,
    C.FOREIGN_PAGE,
    C.FORBIDDEN,
    C.REQUEST_TIMEOUT,
    C.PAYLOAD_TOO_LARGE,
    C.TOO_MANY_REQUESTS,
    C.INTERNAL,
    C.QUEUE_FULL,
    C.DRAINING,
    C.TOO_MANY_CONNECTIONS,
    C.STORAGE_UNAVAILABLE,
    C.STORAGE_FULL,
)
_OF_SCENES = (C.UNKNOWN_SCENE, C.SCENE_BROKEN, C.OUT_OF_MEMORY)
OF_PARAMETER: dict[str, tuple[ErrorCode, ...]] = {
    "scene": _OF_SCENES,
    "scenario_id": (C.UNKNOWN_SCENARIO, *_OF_SCENES),
    "session_id": (
        C.UNKNOWN_SESSION,
        C.SESSION_CLOSED,
        *_OF_SCENES,
        C.OVER_CAPACITY,
        C.TOO_MANY_SESSIONS,
    ),
    "job_id": (C.UNKNOWN_JOB,),
    "asset_id": (C.UNKNOWN_ASSET,),
    "accept": (C.NOT_ACCEPTABLE,),
    "If-Match": (C.STALE_REVISION,),
    "Idempotency-Key": (C.IDEMPOTENCY_CONFLICT,),
    "camera": (C.UNKNOWN_CAMERA,),
    "t_us": (C.TIME_OUT_OF_RANGE,),
}
"""By the names of path, query and header parameters."""

_OF_EDITS = (C.INVALID_OPERATION, C.UNKNOWN_OBJECT, C.UNKNOWN_ASSET, C.ALREADY_EXISTS)
_OF_EPISODES = (C.NOT_RESET, C.EPISODE_OVER, C.CONTROLLER_TAKEN, C.INVALID_ACTION)
OF_OPERATION: dict[str, tuple[ErrorCode, ...]] = {
    "assets-add": (
        C.QUOTA_EXCEEDED,
        C.UNKNOWN_OBJECT,
        C.ALREADY_EXISTS,
        C.IMPORT_FAILED,
        *_OF_SCENES,
    ),
    "assets-delete": (C.ASSET_IN_USE,),
    "exports-create": (
        *_OF_SCENES,
        C.UNKNOWN_SCENARIO,
        C.UNKNOWN_JOB,
        C.UNKNOWN_SESSION,
        C.SESSION_CLOSED,
        C.NOT_RESET,
        C.JOB_NOT_DONE,
        C.UNSUPPORTED,
        C.TOO_MANY_JOBS,
        C.QUOTA_EXCEEDED,
    ),
    "health-metrics": (C.NOT_FOUND,),
    "jobs-file": (C.JOB_NOT_DONE, C.NOT_FOUND),
    "jobs-preview": (C.JOB_NOT_DONE, C.JOB_FAILED, *_OF_SCENES),
    "scenarios-create": _OF_SCENES,
    "scenarios-edit": _OF_EDITS,
    "scenarios-import_": (*_OF_SCENES, *_OF_EDITS),
    "scenarios-points": (*_OF_SCENES, C.TIME_OUT_OF_RANGE),
    "scenarios-redo": (C.NOTHING_TO_REDO,),
    "scenarios-simulate": (C.TOO_MANY_JOBS, C.QUOTA_EXCEEDED, C.UNSUPPORTED, C.UNKNOWN_OBJECT),
    "scenarios-undo": (C.NOTHING_TO_UNDO,),
    "scenes-import_": (
        C.QUOTA_EXCEEDED,
        C.IMPORT_FAILED,
        C.ALREADY_EXISTS,
        C.NOT_FOUND,
        C.OUT_OF_MEMORY,
    ),
    "scenes-load": (C.JOB_FAILED,),
    "scenes-sky": (C.NOT_FOUND,),
    "scenes-splats": (C.NOT_FOUND, C.UNKNOWN_OBJECT),
    "scenes-unload": (C.SCENE_IN_USE,),
    "sessions-create": (
        *_OF_SCENES,
        C.UNKNOWN_SCENARIO,
        C.UNKNOWN_CAMERA,
        C.OVER_CAPACITY,
        C.TOO_MANY_SESSIONS,
    ),
    "sessions-edit": (*_OF_EDITS, C.NOT_RESET, C.STALE_REVISION),
    "sessions-fork": _OF_EPISODES,
    "sessions-recording": _OF_EPISODES,
    "sessions-render": (*_OF_EPISODES, C.UNKNOWN_CAMERA, C.NOT_ACCEPTABLE),
    "sessions-reset": (*_OF_EPISODES, C.UNKNOWN_CAMERA),
    "sessions-state": _OF_EPISODES,
    "sessions-step": _OF_EPISODES,
    "storyboards-apply_corner_case": _OF_EDITS,
    "storyboards-import_xosc": _OF_EDITS,
    "storyboards-picture": (C.NOT_FOUND,),
    "storyboards-remove": _OF_EDITS,
    "storyboards-replace": _OF_EDITS,
    "sweeps-create": (*_OF_SCENES, C.TOO_MANY_JOBS, C.QUOTA_EXCEEDED),
}
"""What does not follow from parameters, by operation id."""


def document_errors(operation: dict[str, Any]) -> None:
    """Give an operation one answer for each status of its errors, and none for others."""
    responses = operation["responses"]
    for undocumented in ("422", "default"):
        responses.pop(undocumented, None)
    by_status: dict[str, list[ErrorCode]] = {}
    for code in dict.fromkeys(_codes(operation)):
        by_status.setdefault(str(HTTP_STATUS[code]), []).append(code)
    for status, codes in by_status.items():
        if status in responses:  # the operation says more about it
            responses[status].setdefault("content", {})[PROBLEM_MEDIA_TYPE] = _content()
            continue
        told = "; ".join(f"`{code.value}`: {title_of(code).lower()}" for code in codes)
        responses[status] = {"description": told, "content": {PROBLEM_MEDIA_TYPE: _content()}}


def _codes(operation: dict[str, Any]) -> Iterable[ErrorCode]:
    yield from OF_EVERY_CALL
    parameters = operation.get("parameters", ())
    if parameters or "requestBody" in operation:
        yield C.INVALID_REQUEST
    for parameter in parameters:
        yield from OF_PARAMETER.get(parameter["name"], ())
    yield from OF_OPERATION.get(operation["operationId"], ())


def _content() -> dict[str, Any]:
    return {"schema": {"$ref": "#/components/schemas/Problem"}}
