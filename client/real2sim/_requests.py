"""One function a REST call: what goes out, and how the answer is read.

Everything here is pure, so that the sync and the async client share all of it and differ only
in who waits.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from real2sim_proto.assets import AssetCut, AssetInfo, AssetList, AssetUpload
from real2sim_proto.episode import SensorSpec
from real2sim_proto.jobs import ExportRequest, JobInfo, JobList, SimulateRequest
from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import (
    History,
    OperationBatch,
    OperationResult,
    ScenarioCreate,
    ScenarioDocument,
    ScenarioFork,
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

from ._replies import (
    MEDIA_TYPES,
    MSGPACK,
    Reply,
    describe,
    model_of,
    nothing,
    parse_image,
    parse_view,
)
from .images import Image
from .observation import View

T = TypeVar("T")
M = TypeVar("M", bound=BaseModel)


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
class Call(Generic[T]):
    """A request and how its reply is read."""

    request: Request
    parse: Callable[[Reply], T]


# --- worker and scenes ------------------------------------------------------------------------


def server_info() -> Call[ServerInfo]:
    return Call(Request("GET", "/v1/server"), model_of(ServerInfo))


def readiness() -> Call[Readiness]:
    request = Request("GET", "/readyz", accepted=frozenset({503}))
    return Call(request, model_of(Readiness))


def list_scenes() -> Call[SceneList]:
    return Call(Request("GET", "/v1/scenes"), model_of(SceneList))


def get_scene(scene: str) -> Call[SceneInfo]:
    return Call(Request("GET", f"/v1/scenes/{_segment(scene)}"), model_of(SceneInfo))


def load_scene(scene: str) -> Call[None]:
    path = f"/v1/scenes/{_segment(scene)}/residency"
    return Call(Request("PUT", path, patient=True), nothing)


def unload_scene(scene: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/scenes/{_segment(scene)}/residency"), nothing)


def import_scene(path: str, scene: str | None) -> Call[SceneInfo]:
    body = checked(SceneImport, path=path, scene=scene)
    return Call(_post("/v1/scenes", body, patient=True), model_of(SceneInfo))


def upload_scene(path: Path, scene: str | None) -> Call[SceneInfo]:
    form = {} if scene is None else {"scene": scene}
    return Call(_upload("/v1/scenes", path, form), model_of(SceneInfo))


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
    return Call(_post("/v1/scenarios", body), model_of(ScenarioInfo))


def list_scenarios() -> Call[ScenarioList]:
    return Call(Request("GET", "/v1/scenarios"), model_of(ScenarioList))


def get_scenario(scenario_id: str) -> Call[ScenarioInfo]:
    return Call(Request("GET", _scenario(scenario_id)), model_of(ScenarioInfo))


def delete_scenario(scenario_id: str) -> Call[None]:
    return Call(Request("DELETE", _scenario(scenario_id)), nothing)


def apply_operations(
    scenario_id: str, operations: Sequence[Operation | Mapping[str, Any]], etag: str, dry_run: bool
) -> Call[OperationResult]:
    body = checked(OperationBatch, operations=list(operations), dry_run=dry_run)
    request = _post(f"{_scenario(scenario_id)}/operations", body, if_match=etag)
    return Call(request, model_of(OperationResult))


def undo(scenario_id: str, etag: str) -> Call[OperationResult]:
    request = _post(f"{_scenario(scenario_id)}/undo", None, if_match=etag)
    return Call(request, model_of(OperationResult))


def redo(scenario_id: str, etag: str) -> Call[OperationResult]:
    request = _post(f"{_scenario(scenario_id)}/redo", None, if_match=etag)
    return Call(request, model_of(OperationResult))


def history(scenario_id: str, after: int | None) -> Call[History]:
    params = {} if after is None else {"after": str(after)}
    request = Request("GET", f"{_scenario(scenario_id)}/operations", params=params)
    return Call(request, model_of(History))


def preview(scenario_id: str, view: ViewRequest) -> Call[Image]:
    return _image(f"{_scenario(scenario_id)}/preview", view)


def fork_scenario(scenario_id: str, name: str | None, revision: int | None) -> Call[ScenarioInfo]:
    body = checked(ScenarioFork, name=name, revision=revision)
    return Call(_post(f"{_scenario(scenario_id)}/fork", body), model_of(ScenarioInfo))


def export_scenario(scenario_id: str) -> Call[ScenarioDocument]:
    request = Request("GET", f"{_scenario(scenario_id)}/export", patient=True)
    return Call(request, model_of(ScenarioDocument))


def import_scenario(document: ScenarioDocument) -> Call[ScenarioInfo]:
    return Call(_post("/v1/scenarios/import", document, patient=True), model_of(ScenarioInfo))


def simulate(scenario_id: str, body: SimulateRequest) -> Call[JobInfo]:
    return Call(_post(f"{_scenario(scenario_id)}/simulate", body, patient=True), model_of(JobInfo))


# --- jobs and exports -------------------------------------------------------------------------


def create_export(body: ExportRequest) -> Call[JobInfo]:
    return Call(_post("/v1/exports", body, patient=True), model_of(JobInfo))


def list_jobs(subject: str | None) -> Call[JobList]:
    params = {} if subject is None else {"subject": subject}
    return Call(Request("GET", "/v1/jobs", params), model_of(JobList))


def get_job(job_id: str) -> Call[JobInfo]:
    return Call(Request("GET", f"/v1/jobs/{_segment(job_id)}"), model_of(JobInfo))


def cancel_job(job_id: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/jobs/{_segment(job_id)}"), nothing)


def job_file(job_id: str, name: str) -> Call[bytes]:
    path = f"/v1/jobs/{_segment(job_id)}/files/{_segment(name)}"
    return Call(Request("GET", path, patient=True), lambda reply: reply.content)


# --- assets -----------------------------------------------------------------------------------


def list_assets() -> Call[AssetList]:
    return Call(Request("GET", "/v1/assets", patient=True), model_of(AssetList))


def get_asset(asset_id: str) -> Call[AssetInfo]:
    return Call(Request("GET", f"/v1/assets/{_segment(asset_id)}"), model_of(AssetInfo))


def cut_asset(body: AssetCut) -> Call[AssetInfo]:
    return Call(_post("/v1/assets", body, patient=True), model_of(AssetInfo))


def upload_asset(path: Path, asked: AssetUpload) -> Call[AssetInfo]:
    form = {name: str(value) for name, value in asked if value is not None}
    return Call(_upload("/v1/assets", path, form), model_of(AssetInfo))


def delete_asset(asset_id: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/assets/{_segment(asset_id)}"), nothing)


def asset_thumbnail(asset_id: str, width: int) -> Call[Image]:
    path = f"/v1/assets/{_segment(asset_id)}/thumbnail"
    request = Request("GET", path, {"width": str(width)}, patient=True)
    return Call(request, lambda reply: parse_image(reply, "rgb"))


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
    return Call(request, model_of(SessionInfo))


def list_sessions() -> Call[SessionList]:
    return Call(Request("GET", "/v1/sessions"), model_of(SessionList))


def get_session(session_id: str, token: str | None) -> Call[SessionInfo]:
    request = Request("GET", _session(session_id), headers=_bearer(token))
    return Call(request, model_of(SessionInfo))


def delete_session(session_id: str, token: str | None) -> Call[None]:
    return Call(Request("DELETE", _session(session_id), headers=_bearer(token)), nothing)


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
    return Call(request, model_of(SessionState))


def session_state(session_id: str, token: str | None) -> Call[SessionState]:
    request = Request("GET", f"{_session(session_id)}/state", headers=_bearer(token))
    return Call(request, model_of(SessionState))


def record_session(session_id: str, token: str | None, frames: bool) -> Call[bytes]:
    """The recording of the running episode."""
    request = Request(
        "GET",
        f"{_session(session_id)}/recording",
        params={"frames": "true"} if frames else {},
        headers=_bearer(token),
        patient=True,
    )
    return Call(request, lambda reply: reply.content)


def render_session(session_id: str, token: str | None, sensors: Sequence[SensorSpec]) -> Call[View]:
    """Never moves time, so it may be sent again."""
    body = checked(SessionRender, sensors=list(sensors))
    request = Request(
        "POST",
        f"{_session(session_id)}/render",
        headers=_bearer(token) | {"Content-Type": "application/json", "Accept": MSGPACK},
        body=_json(body),
        patient=True,
    )
    return Call(request, parse_view)


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


def _upload(path: str, file: Path, form: dict[str, str]) -> Request:
    key = new_key()
    # The boundary follows from the key, so that every try sends the same bytes.
    headers = {
        "Idempotency-Key": key,
        "Content-Type": f"multipart/form-data; boundary=real2sim-{key}",
    }
    return Request("POST", path, headers=headers, form=form, upload=file, patient=True)


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
    request = Request("GET", path, params, headers, patient=True)
    return Call(request, lambda reply: parse_image(reply, view.modality))
