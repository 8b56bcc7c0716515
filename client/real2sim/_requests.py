"""One function a REST call: what goes out, and how the answer is read.

Everything here is pure, so that the sync and the async client share all of it and differ only
in who waits.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from real2sim_proto import CodecError, decode
from real2sim_proto.drive import Frame as WireFrame
from real2sim_proto.drive import SensorSpec
from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import (
    History,
    HistoryEntry,
    OperationBatch,
    OperationResult,
    ScenarioCreate,
    ScenarioInfo,
    ScenarioList,
)
from real2sim_proto.scenes import Readiness, SceneImport, SceneInfo, SceneList, ServerInfo
from real2sim_proto.sessions import (
    SessionCreate,
    SessionInfo,
    SessionList,
    SessionRender,
    SessionState,
    StepRequest,
)

from ._retry import parse_retry_after
from .errors import InvalidValue, MalformedReplyError, Real2SimError, Refusal, error_for
from .images import Image, frame_from_wire
from .observation import View, view_from_frames

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)

MSGPACK = "application/msgpack"
MEDIA_TYPES = {"raw": MSGPACK, "jpeg": "image/jpeg", "png": "image/png"}


@dataclass(frozen=True)
class Request:
    """What goes out. ``idempotent`` requests may be sent again when no reply came."""

    method: str
    path: str
    params: dict[str, str] = field(default_factory=dict)
    headers: dict[str, str] = field(default_factory=dict)
    body: bytes | None = None
    form: dict[str, str] = field(default_factory=dict)
    upload: Path | None = None
    idempotent: bool = True
    patient: bool = False
    accepted: frozenset[int] = frozenset()

    def __str__(self) -> str:
        return f"{self.method} {self.path}"


@dataclass(frozen=True)
class Reply:
    """What came back; header names in lower case."""

    status: int
    headers: Mapping[str, str]
    content: bytes

    @property
    def media_type(self) -> str:
        return self.headers.get("content-type", "").partition(";")[0].strip().lower()


@dataclass(frozen=True)
class Call(Generic[T]):
    """A request and how its reply is read."""

    request: Request
    parse: Callable[[Reply], T]


# --- worker and scenes ------------------------------------------------------------------------


def server_info() -> Call[ServerInfo]:
    return Call(Request("GET", "/v1/server"), _model(ServerInfo))


def readiness() -> Call[Readiness]:
    request = Request("GET", "/readyz", accepted=frozenset({503}))
    return Call(request, _model(Readiness))


def list_scenes() -> Call[SceneList]:
    return Call(Request("GET", "/v1/scenes"), _model(SceneList))


def get_scene(scene: str) -> Call[SceneInfo]:
    return Call(Request("GET", f"/v1/scenes/{_segment(scene)}"), _model(SceneInfo))


def load_scene(scene: str) -> Call[None]:
    path = f"/v1/scenes/{_segment(scene)}/residency"
    return Call(Request("PUT", path, patient=True), _nothing)


def unload_scene(scene: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/scenes/{_segment(scene)}/residency"), _nothing)


def import_scene(path: str, scene: str | None) -> Call[SceneInfo]:
    body = checked(SceneImport, path=path, scene=scene)
    return Call(_post("/v1/scenes", body, patient=True), _model(SceneInfo))


def upload_scene(path: Path, scene: str | None) -> Call[SceneInfo]:
    key = new_key()
    # The boundary follows from the key, so that every try sends the same bytes.
    headers = {
        "Idempotency-Key": key,
        "Content-Type": f"multipart/form-data; boundary=real2sim-{key}",
    }
    form = {} if scene is None else {"scene": scene}
    request = Request("POST", "/v1/scenes", headers=headers, form=form, upload=path, patient=True)
    return Call(request, _model(SceneInfo))


def render_scene(scene: str, view: ViewRequest) -> Call[Image]:
    return _image(f"/v1/scenes/{_segment(scene)}/render", view)


@dataclass(frozen=True)
class ViewRequest:
    """One image of one camera at one instant; ``codec`` is never 'auto' here."""

    camera: str
    t_us: int | None
    width: int | None
    modality: str
    codec: str


# --- scenarios --------------------------------------------------------------------------------


def create_scenario(scene: str, name: str) -> Call[ScenarioInfo]:
    body = checked(ScenarioCreate, scene=scene, name=name)
    return Call(_post("/v1/scenarios", body), _model(ScenarioInfo))


def list_scenarios() -> Call[ScenarioList]:
    return Call(Request("GET", "/v1/scenarios"), _model(ScenarioList))


def get_scenario(scenario_id: str) -> Call[ScenarioInfo]:
    return Call(Request("GET", _scenario(scenario_id)), _model(ScenarioInfo))


def delete_scenario(scenario_id: str) -> Call[None]:
    return Call(Request("DELETE", _scenario(scenario_id)), _nothing)


def apply_operations(
    scenario_id: str, operations: Sequence[Operation | Mapping[str, Any]], etag: str, dry_run: bool
) -> Call[OperationResult]:
    body = checked(OperationBatch, operations=list(operations), dry_run=dry_run)
    request = _post(f"{_scenario(scenario_id)}/operations", body, if_match=etag)
    return Call(request, _model(OperationResult))


def undo(scenario_id: str, etag: str) -> Call[OperationResult]:
    request = _post(f"{_scenario(scenario_id)}/undo", None, if_match=etag)
    return Call(request, _model(OperationResult))


def redo(scenario_id: str, etag: str) -> Call[OperationResult]:
    request = _post(f"{_scenario(scenario_id)}/redo", None, if_match=etag)
    return Call(request, _model(OperationResult))


def history(scenario_id: str, after: int | None) -> Call[History]:
    params = {} if after is None else {"after": str(after)}
    request = Request("GET", f"{_scenario(scenario_id)}/operations", params=params)
    return Call(request, _model(History))


def preview(scenario_id: str, view: ViewRequest) -> Call[Image]:
    return _image(f"{_scenario(scenario_id)}/preview", view)


# --- sessions ---------------------------------------------------------------------------------


def create_session(
    scene: str | None, scenario: str | None, body: SessionCreate | None
) -> Call[SessionInfo]:
    if (scene is None) == (scenario is None):
        raise ValueError(
            f"a session runs on one world; scene={scene!r} and scenario={scenario!r} were given, "
            "name exactly one of them"
        )
    params = {"scene": scene} if scene is not None else {"scenario": str(scenario)}
    request = _post("/v1/sessions", body, params=params, patient=True)
    return Call(request, _model(SessionInfo))


def list_sessions() -> Call[SessionList]:
    return Call(Request("GET", "/v1/sessions"), _model(SessionList))


def get_session(session_id: str, token: str | None) -> Call[SessionInfo]:
    request = Request("GET", _session(session_id), headers=_bearer(token))
    return Call(request, _model(SessionInfo))


def delete_session(session_id: str, token: str | None) -> Call[None]:
    return Call(Request("DELETE", _session(session_id), headers=_bearer(token)), _nothing)


def step_session(session_id: str, token: str | None, body: StepRequest) -> Call[SessionState]:
    """Moves the clock, so it is never sent twice."""
    request = Request(
        "POST",
        f"{_session(session_id)}/step",
        headers=_bearer(token) | {"Content-Type": "application/json"},
        body=_json(body),
        idempotent=False,
        patient=True,
    )
    return Call(request, _model(SessionState))


def session_state(session_id: str, token: str | None) -> Call[SessionState]:
    request = Request("GET", f"{_session(session_id)}/state", headers=_bearer(token))
    return Call(request, _model(SessionState))


def render_session(session_id: str, token: str | None, sensors: Sequence[SensorSpec]) -> Call[View]:
    """Never moves time, so it may be sent again."""
    body = checked(SessionRender, sensors=list(sensors))
    request = Request(
        "POST",
        f"{_session(session_id)}/render",
        headers=_bearer(token) | {"Content-Type": "application/json", "Accept": MSGPACK},
        body=_json(body),
    )
    return Call(request, _parse_view)


# --- the way in -------------------------------------------------------------------------------


def checked(model: type[M], /, **fields: Any) -> M:
    """A model of these fields.

    Raises:
        ValueError: one sentence that names every field that is not allowed, and why.
    """
    try:
        return model(**fields)
    except ValidationError as error:
        raise ValueError(f"{model.__name__}: {describe(error)}") from error


def describe(error: ValidationError) -> str:
    """What is wrong, in one line: ``sensors/0/width: input should be ...``."""
    problems = []
    for problem in error.errors(include_url=False, include_context=False)[:4]:
        place = "/".join(str(part) for part in problem["loc"])
        given = repr(problem["input"])
        given = given if len(given) <= 60 else f"{given[:57]}..."
        problems.append(f"{place}: {problem['msg']}, not {given}")
    more = error.error_count() - len(problems)
    return "; ".join(problems) + (f"; and {more} more" if more > 0 else "")


def new_key() -> str:
    """An Idempotency-Key: made once a call, the same for all its tries."""
    return uuid.uuid4().hex


def _post(
    path: str,
    body: BaseModel | None,
    *,
    params: dict[str, str] | None = None,
    if_match: str | None = None,
    patient: bool = False,
) -> Request:
    headers = {"Idempotency-Key": new_key()}
    if body is not None:
        headers["Content-Type"] = "application/json"
    if if_match is not None:
        headers["If-Match"] = if_match
    content = None if body is None else _json(body)
    return Request("POST", path, params or {}, headers, content, patient=patient)


def _json(body: BaseModel) -> bytes:
    return body.model_dump_json(exclude_none=True).encode()


def _segment(name: str) -> str:
    if not name or name in {".", ".."}:
        raise ValueError(f"{name!r} is not a name that a path can hold")
    return quote(name, safe="")


def _scenario(scenario_id: str) -> str:
    return f"/v1/scenarios/{_segment(scenario_id)}"


def _session(session_id: str) -> str:
    return f"/v1/sessions/{_segment(session_id)}"


def _bearer(token: str | None) -> dict[str, str]:
    return {} if token is None else {"Authorization": f"Bearer {token}"}


def _image(path: str, view: ViewRequest) -> Call[Image]:
    if view.codec not in MEDIA_TYPES:
        allowed = ", ".join(("auto", *MEDIA_TYPES))
        raise ValueError(f"codec {view.codec!r} is unknown; allowed are {allowed}")
    params = {"camera": view.camera, "modality": view.modality}
    params |= {} if view.t_us is None else {"t_us": str(view.t_us)}
    params |= {} if view.width is None else {"width": str(view.width)}
    headers = {"Accept": MEDIA_TYPES[view.codec]}
    request = Request("GET", path, params, headers)
    return Call(request, lambda reply: _parse_image(reply, view.modality))


# --- the way back -----------------------------------------------------------------------------


def refusal_error(reply: Reply) -> Real2SimError:
    """The exception for an answer of status 400 or above, problem document or not."""
    try:
        problem = json.loads(reply.content)
    except ValueError:
        problem = None
    retry_after = parse_retry_after(reply.headers.get("retry-after"))
    if not isinstance(problem, dict):
        text = reply.content[:200].decode("utf-8", "replace").strip() or "empty body"
        detail = f"the answer has status {reply.status} and is no problem document: {text!r}"
        return error_for(Refusal(reply.status, "UNKNOWN", detail, retry_after=retry_after))
    return error_for(
        Refusal(
            status=reply.status,
            code=str(problem.get("code", "UNKNOWN")),
            detail=str(problem.get("detail") or problem.get("title") or f"status {reply.status}"),
            hint=_text(problem.get("hint")),
            request_id=_text(problem.get("request_id")) or reply.headers.get("x-request-id"),
            errors=tuple(_invalid_values(problem.get("errors"))),
            retry_after=retry_after,
            revision=problem["revision"] if isinstance(problem.get("revision"), int) else None,
            missed=tuple(_missed(problem.get("missed"))),
        )
    )


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) and value else None


def _invalid_values(values: Any) -> list[InvalidValue]:
    if not isinstance(values, list):
        return []
    return [
        InvalidValue(str(value.get("pointer", "")), str(value.get("message", "")))
        for value in values
        if isinstance(value, dict)
    ]


def _missed(values: Any) -> list[HistoryEntry]:
    entries = []
    for value in values if isinstance(values, list) else []:
        try:
            entries.append(HistoryEntry.model_validate(value))
        except ValidationError:
            # The refusal matters more than one entry that a newer worker writes differently.
            continue
    return entries


def _nothing(_reply: Reply) -> None:
    return None


def _model(model: type[M]) -> Callable[[Reply], M]:
    def parse(reply: Reply) -> M:
        try:
            return model.model_validate_json(reply.content)
        except ValidationError as error:
            raise MalformedReplyError(
                f"the worker's answer is not a {model.__name__}: {describe(error)}",
                hint="is this address a Real2Sim worker, of this protocol version?",
            ) from error

    return parse


def _parse_image(reply: Reply, modality: str) -> Image:
    if reply.media_type == MSGPACK:
        return frame_from_wire(_wire_frame(_decoded(reply)))
    codecs = {media_type: codec for codec, media_type in MEDIA_TYPES.items()}
    codec = codecs.get(reply.media_type)
    if codec is None:
        raise MalformedReplyError(f"the worker sent {reply.media_type!r} where an image was asked")
    dtype = "uint8" if modality == "rgb" else "uint16"
    return Image(data=reply.content, codec=codec, modality=modality, dtype=dtype)


def _parse_view(reply: Reply) -> View:
    message = _decoded(reply)
    frames = message.get("frames")
    if not isinstance(frames, list):
        raise MalformedReplyError("the worker's answer to render has no list of frames")
    wires = [_wire_frame(frame) for frame in frames]
    return view_from_frames(
        wires,
        t_us=int(message.get("t_us", wires[0].t_us if wires else 0)),
        revision=int(message.get("revision", 0)),
        timing=message.get("timing", {}),
    )


def _decoded(reply: Reply) -> dict[str, Any]:
    try:
        return decode(reply.content)
    except CodecError as error:
        raise MalformedReplyError(f"the worker's answer cannot be read: {error}") from error


def _wire_frame(value: Any) -> WireFrame:
    known = {k: v for k, v in dict(value).items() if k in WireFrame.model_fields}
    try:
        return WireFrame.model_validate(known)
    except ValidationError as error:
        raise MalformedReplyError(f"the worker sent a broken frame: {describe(error)}") from error
