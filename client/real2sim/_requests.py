"""One function per REST call: builds the request and parses the reply.

All functions are pure. The sync and the async client share them and differ only in the I/O.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypedDict, TypeVar, cast
from urllib.parse import urlencode

from real2sim_proto.episode import (
    AgentsSpec,
    ContactSpec,
    EgoSpec,
    LatencySpec,
    Randomization,
    ResetSpec,
    ScoringSpec,
    SensorSpec,
)
from real2sim_proto.jobs import (
    CalibrateRequest,
    DatasetRequest,
    DriveRequest,
    ExportRequest,
    JobInfo,
    JobList,
    SimulateRequest,
)
from real2sim_proto.lanes import SceneLanes
from real2sim_proto.operations import Operation
from real2sim_proto.scenarios import (
    CornerCaseChoice,
    Gallery,
    History,
    OperationBatch,
    OperationResult,
    ScenarioCreate,
    ScenarioDocument,
    ScenarioFork,
    ScenarioInfo,
    ScenarioList,
    ScenarioRename,
    StoryboardResult,
)
from real2sim_proto.scenes import (
    AssetCut,
    AssetInfo,
    AssetList,
    AssetPerson,
    AssetUpload,
    Fleet,
    Readiness,
    SceneImport,
    SceneInfo,
    SceneList,
    ServerInfo,
)
from real2sim_proto.sensors import LidarSpec, RadarSpec
from real2sim_proto.sessions import (
    SceneView,
    SessionClock,
    SessionCreate,
    SessionInfo,
    SessionList,
    SessionRender,
    SessionState,
    StepRequest,
)
from real2sim_proto.sweeps import SweepRequest

from ._calls import (
    MSGPACK,
    Call,
    Request,
    ViewRequest,
    bearer,
    checked,
    file_put,
    image,
    json_of,
    model_of,
    nothing,
    parse_image,
    parse_sweep,
    parse_view,
    post,
    segment,
    sent_fields,
    upload,
)
from .clouds import LidarCloud
from .images import Image
from .observation import View

# Sensors and options of an episode.

Sensor: TypeAlias = str | SensorSpec | Mapping[str, Any]
"""A camera: its name, or a spec, or a spec's fields: ``{"camera": "front", "width": 640}``."""

R = TypeVar("R", LidarSpec, RadarSpec)

LidarSensor: TypeAlias = str | LidarSpec | Mapping[str, Any]
"""A LiDAR: a name of the worker's catalogue, or a spec, or a spec's fields:
``{"lidar": "top", "model": "os1-128", "rate_hz": 20}``."""

RadarSensor: TypeAlias = str | RadarSpec | Mapping[str, Any]
"""A radar: a name of the worker's catalogue, or a spec, or a spec's fields:
``{"radar": "front", "model": "long-range"}``."""


class ResetOptions(TypedDict, total=False):
    """Options of reset except its sensors; meaning and defaults as in ``ResetSpec``."""

    lidars: Sequence[LidarSensor]
    radars: Sequence[RadarSensor]
    seed: int
    randomization: Randomization | Mapping[str, Any]
    start_us: int | None
    dt_us: int
    horizon: int | None
    beyond_log: Literal["end", "loop", "extend"]
    warmup_us: int
    ego: EgoSpec | Mapping[str, Any]
    action: Literal["trajectory", "control", "pose"]
    agents: AgentsSpec | Mapping[str, Any]
    privileged: bool
    deadline_ms: int | None
    on_timeout: Literal["hold_plan", "brake", "pause", "fail"]
    wall_clock_s: float | None
    latency: LatencySpec | Mapping[str, Any]
    on_collision: Literal["terminate", "continue"]
    contact: ContactSpec | Mapping[str, Any]
    scoring: ScoringSpec | Mapping[str, Any]


def sensor_specs(sensors: Sequence[Sensor], codec: str) -> list[SensorSpec]:
    """Specs of sensors; ``codec`` applies to those that set none.

    Raises:
        ValueError: an invalid field.
    """
    return [_sensor_spec(sensor, codec) for sensor in _several(sensors)]


def reset_spec(sensors: Sequence[Sensor], codec: str, options: ResetOptions) -> ResetSpec:
    """The spec of an episode.

    Raises:
        ValueError: an invalid field.
    """
    given: dict[str, Any] = dict(options)
    given |= ranging_specs(options.get("lidars", ()), options.get("radars", ()))
    return checked(ResetSpec, sensors=sensor_specs(sensors, codec), **given)


def ranging_specs(
    lidars: Sequence[LidarSensor], radars: Sequence[RadarSensor]
) -> dict[str, list[LidarSpec] | list[RadarSpec]]:
    """Specs of LiDARs and radars as message members; omitted arguments are absent.

    Raises:
        ValueError: an invalid field.
    """
    found: dict[str, list[LidarSpec] | list[RadarSpec]] = {}
    if lidars:
        found["lidars"] = [_ranging_spec(LidarSpec, "lidar", s) for s in _several(lidars)]
    if radars:
        found["radars"] = [_ranging_spec(RadarSpec, "radar", s) for s in _several(radars)]
    return found


def _several(sensors: Any) -> Sequence[Any]:
    """Sensors as a sequence; accepts a single sensor."""
    return sensors if isinstance(sensors, Sequence) and not isinstance(sensors, str) else [sensors]


def _ranging_spec(kind: type[R], name: str, sensor: object) -> R:
    if isinstance(sensor, kind):
        return sensor
    fields = {name: sensor} if isinstance(sensor, str) else dict(cast(Mapping[str, Any], sensor))
    return checked(kind, **fields)


def _sensor_spec(sensor: Sensor, codec: str) -> SensorSpec:
    if isinstance(sensor, SensorSpec):
        return sensor
    fields = {"camera": sensor} if isinstance(sensor, str) else dict(sensor)
    return checked(SensorSpec, **({"codec": codec} | fields))


# --- worker and scenes ------------------------------------------------------------------------


def server_info() -> Call[ServerInfo]:
    return Call(Request("GET", "/v1/server"), model_of(ServerInfo))


def fleet() -> Call[Fleet]:
    return Call(Request("GET", "/v1/fleet"), model_of(Fleet))


def readiness() -> Call[Readiness]:
    request = Request("GET", "/readyz", accepted=frozenset({503}))
    return Call(request, model_of(Readiness))


def list_scenes() -> Call[SceneList]:
    return Call(Request("GET", "/v1/scenes"), model_of(SceneList))


def get_scene(scene: str) -> Call[SceneInfo]:
    return Call(Request("GET", f"/v1/scenes/{segment(scene)}"), model_of(SceneInfo))


def scene_lanes(scene: str) -> Call[SceneLanes]:
    return Call(Request("GET", f"/v1/scenes/{segment(scene)}/lanes"), model_of(SceneLanes))


def scene_splats(scene: str, params: Mapping[str, str]) -> Call[bytes]:
    path = f"/v1/scenes/{segment(scene)}/splats"
    request = Request("GET", path, dict(params), long_timeout=True)
    return Call(request, lambda reply: reply.content)


def object_splats(scenario_id: str, object_id: str, t_us: int | None, up_axis: str) -> Call[bytes]:
    params = {"object_id": object_id, "up_axis": up_axis} | (
        {} if t_us is None else {"t_us": str(t_us)}
    )
    request = Request("GET", f"{_scenario(scenario_id)}/splats", params, long_timeout=True)
    return Call(request, lambda reply: reply.content)


def scene_sky(scene: str) -> Call[Image]:
    path = f"/v1/scenes/{segment(scene)}/sky"
    return Call(Request("GET", path, long_timeout=True), lambda reply: parse_image(reply, "rgb"))


def load_scene(scene: str) -> Call[None]:
    path = f"/v1/scenes/{segment(scene)}/residency"
    return Call(Request("PUT", path, long_timeout=True), nothing)


def unload_scene(scene: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/scenes/{segment(scene)}/residency"), nothing)


def import_scene(path: str, scene: str | None) -> Call[SceneInfo]:
    body = checked(SceneImport, path=path, scene=scene)
    return Call(post("/v1/scenes", body, long_timeout=True), model_of(SceneInfo))


def upload_scene(path: Path, scene: str | None) -> Call[SceneInfo]:
    form = {} if scene is None else {"scene": scene}
    return Call(upload("/v1/scenes", path, form), model_of(SceneInfo))


def render_scene(scene: str, view: ViewRequest) -> Call[Image]:
    return image(f"/v1/scenes/{segment(scene)}/render", view)


def view_scene(scene: str, body: SceneView) -> Call[View]:
    """Safe to retry: it changes nothing."""
    request = Request(
        "POST",
        f"/v1/scenes/{segment(scene)}/render",
        headers={"Content-Type": "application/json", "Accept": MSGPACK},
        body=json_of(body),
        long_timeout=True,
    )
    return Call(request, parse_view)


# --- scenarios --------------------------------------------------------------------------------


def create_scenario(scene: str, name: str) -> Call[ScenarioInfo]:
    body = checked(ScenarioCreate, scene=scene, name=name)
    return Call(post("/v1/scenarios", body), model_of(ScenarioInfo))


def list_scenarios() -> Call[ScenarioList]:
    return Call(Request("GET", "/v1/scenarios"), model_of(ScenarioList))


def get_scenario(scenario_id: str) -> Call[ScenarioInfo]:
    return Call(Request("GET", _scenario(scenario_id)), model_of(ScenarioInfo))


def rename_scenario(scenario_id: str, name: str) -> Call[ScenarioInfo]:
    request = Request(
        "PATCH",
        _scenario(scenario_id),
        headers={"Content-Type": "application/json"},
        body=json_of(checked(ScenarioRename, name=name)),
    )
    return Call(request, model_of(ScenarioInfo))


def delete_scenario(scenario_id: str) -> Call[None]:
    return Call(Request("DELETE", _scenario(scenario_id)), nothing)


def apply_operations(
    scenario_id: str, operations: Sequence[Operation | Mapping[str, Any]], etag: str, dry_run: bool
) -> Call[OperationResult]:
    body = checked(OperationBatch, operations=list(operations), dry_run=dry_run)
    request = post(f"{_scenario(scenario_id)}/operations", body, if_match=etag)
    return Call(request, model_of(OperationResult))


def undo(scenario_id: str, etag: str) -> Call[OperationResult]:
    request = post(f"{_scenario(scenario_id)}/undo", None, if_match=etag)
    return Call(request, model_of(OperationResult))


def redo(scenario_id: str, etag: str) -> Call[OperationResult]:
    request = post(f"{_scenario(scenario_id)}/redo", None, if_match=etag)
    return Call(request, model_of(OperationResult))


def history(scenario_id: str, after: int | None) -> Call[History]:
    params = {} if after is None else {"after": str(after)}
    request = Request("GET", f"{_scenario(scenario_id)}/operations", params=params)
    return Call(request, model_of(History))


def preview(scenario_id: str, view: ViewRequest) -> Call[Image]:
    return image(f"{_scenario(scenario_id)}/preview", view)


def sweep(scenario_id: str, lidar: str, t_us: int | None) -> Call[LidarCloud]:
    request = Request(
        "GET",
        f"{_scenario(scenario_id)}/sweep",
        params={"lidar": lidar} | ({} if t_us is None else {"t_us": str(t_us)}),
        headers={"Accept": MSGPACK},
        long_timeout=True,
    )
    return Call(request, parse_sweep)


def fork_scenario(scenario_id: str, name: str | None, revision: int | None) -> Call[ScenarioInfo]:
    body = checked(ScenarioFork, name=name, revision=revision)
    return Call(post(f"{_scenario(scenario_id)}/fork", body), model_of(ScenarioInfo))


def export_scenario(scenario_id: str) -> Call[ScenarioDocument]:
    request = Request("GET", f"{_scenario(scenario_id)}/export", long_timeout=True)
    return Call(request, model_of(ScenarioDocument, whole=True))


def scenario_points(scenario_id: str, t_us: int | None, part: str) -> Call[bytes]:
    params = {"part": part} | ({} if t_us is None else {"t_us": str(t_us)})
    request = Request("GET", f"{_scenario(scenario_id)}/points", params, long_timeout=True)
    return Call(request, lambda reply: reply.content)


def import_scenario(document: ScenarioDocument) -> Call[ScenarioInfo]:
    return Call(post("/v1/scenarios/import", document, long_timeout=True), model_of(ScenarioInfo))


def gallery() -> Call[Gallery]:
    return Call(Request("GET", "/v1/gallery"), model_of(Gallery))


def apply_corner_case(
    scenario_id: str, name: str, parameters: Mapping[str, float], etag: str
) -> Call[OperationResult]:
    body = checked(CornerCaseChoice, name=name, parameters=dict(parameters))
    request = post(f"{_scenario(scenario_id)}/corner-case", body, if_match=etag)
    return Call(request, model_of(OperationResult))


def gallery_picture(name: str) -> Call[bytes]:
    path = f"/v1/gallery/{segment(name)}/picture"
    return Call(Request("GET", path), lambda reply: reply.content)


def read_xosc(
    scenario_id: str,
    content: bytes,
    leave_out: Sequence[str],
    ego: str | None,
    etag: str,
    *,
    strict: bool,
) -> Call[StoryboardResult]:
    query = [("leave_out", name) for name in leave_out]
    query += [] if ego is None else [("ego", ego)]
    query += [("strict", "true")] if strict else []
    path = f"{_scenario(scenario_id)}/storyboard.xosc"
    path += f"?{urlencode(query)}" if query else ""
    request = file_put(path, content, "application/xml", if_match=etag)
    return Call(request, model_of(StoryboardResult))


def write_xosc(scenario_id: str) -> Call[bytes]:
    path = f"{_scenario(scenario_id)}/storyboard.xosc"
    return Call(Request("GET", path, long_timeout=True), lambda reply: reply.content)


def simulate(scenario_id: str, body: SimulateRequest) -> Call[JobInfo]:
    return Call(
        post(f"{_scenario(scenario_id)}/simulate", body, long_timeout=True), model_of(JobInfo)
    )


def calibrate(scenario_id: str, body: CalibrateRequest) -> Call[JobInfo]:
    return Call(
        post(f"{_scenario(scenario_id)}/calibrate", body, long_timeout=True), model_of(JobInfo)
    )


# --- jobs and exports -------------------------------------------------------------------------


def create_export(body: ExportRequest) -> Call[JobInfo]:
    return Call(post("/v1/exports", body, long_timeout=True), model_of(JobInfo))


def create_dataset(body: DatasetRequest, token: str | None) -> Call[JobInfo]:
    request = post("/v1/exports", body, long_timeout=True)
    return Call(replace(request, headers=request.headers | bearer(token)), model_of(JobInfo))


def create_sweep(body: SweepRequest) -> Call[JobInfo]:
    return Call(post("/v1/sweeps", body, long_timeout=True), model_of(JobInfo))


def list_jobs(subject: str | None) -> Call[JobList]:
    params = {} if subject is None else {"subject": subject}
    return Call(Request("GET", "/v1/jobs", params), model_of(JobList))


def get_job(job_id: str) -> Call[JobInfo]:
    return Call(Request("GET", f"/v1/jobs/{segment(job_id)}"), model_of(JobInfo))


def cancel_job(job_id: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/jobs/{segment(job_id)}"), nothing)


def job_file(job_id: str, name: str) -> Call[bytes]:
    path = f"/v1/jobs/{segment(job_id)}/files/{segment(name)}"
    return Call(Request("GET", path, long_timeout=True), lambda reply: reply.content)


# --- assets -----------------------------------------------------------------------------------


def list_assets() -> Call[AssetList]:
    return Call(Request("GET", "/v1/assets", long_timeout=True), model_of(AssetList))


def get_asset(asset_id: str) -> Call[AssetInfo]:
    return Call(Request("GET", f"/v1/assets/{segment(asset_id)}"), model_of(AssetInfo))


def cut_asset(body: AssetCut) -> Call[AssetInfo]:
    return Call(post("/v1/assets", body, long_timeout=True), model_of(AssetInfo))


def make_person(body: AssetPerson) -> Call[AssetInfo]:
    return Call(post("/v1/assets", body, long_timeout=True), model_of(AssetInfo))


def upload_asset(path: Path, asked: AssetUpload) -> Call[AssetInfo]:
    form = {name: str(value) for name, value in sent_fields(asked).items()}
    return Call(upload("/v1/assets", path, form), model_of(AssetInfo))


def delete_asset(asset_id: str) -> Call[None]:
    return Call(Request("DELETE", f"/v1/assets/{segment(asset_id)}"), nothing)


def asset_thumbnail(asset_id: str, width: int) -> Call[Image]:
    path = f"/v1/assets/{segment(asset_id)}/thumbnail"
    request = Request("GET", path, {"width": str(width)}, long_timeout=True)
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
    request = post("/v1/sessions", body, params=params, long_timeout=True)
    return Call(request, model_of(SessionInfo))


def list_sessions() -> Call[SessionList]:
    return Call(Request("GET", "/v1/sessions"), model_of(SessionList))


def get_session(session_id: str, token: str | None) -> Call[SessionInfo]:
    request = Request("GET", _session(session_id), headers=bearer(token))
    return Call(request, model_of(SessionInfo))


def delete_session(session_id: str, token: str | None) -> Call[None]:
    return Call(Request("DELETE", _session(session_id), headers=bearer(token)), nothing)


def step_session(session_id: str, token: str | None, body: StepRequest) -> Call[SessionState]:
    """Not retried: it advances the clock."""
    request = Request(
        "POST",
        f"{_session(session_id)}/step",
        headers=bearer(token) | {"Content-Type": "application/json"},
        body=json_of(body),
        idempotent=False,
        long_timeout=True,
    )
    return Call(request, model_of(SessionState))


def session_state(session_id: str, token: str | None, after: int | None) -> Call[SessionState]:
    request = Request(
        "GET",
        f"{_session(session_id)}/state",
        params={} if after is None else {"after": str(after)},
        headers=bearer(token),
        long_timeout=after is not None,
    )
    return Call(request, model_of(SessionState))


def session_clock(session_id: str, token: str | None, body: SessionClock) -> Call[SessionInfo]:
    """Not retried: the steps would run twice."""
    request = Request(
        "PUT",
        f"{_session(session_id)}/clock",
        headers=bearer(token) | {"Content-Type": "application/json"},
        body=json_of(body),
        idempotent=False,
    )
    return Call(request, model_of(SessionInfo))


def drive_session(session_id: str, token: str | None, body: DriveRequest) -> Call[JobInfo]:
    request = post(f"{_session(session_id)}/drive", body, long_timeout=True)
    return Call(replace(request, headers=request.headers | bearer(token)), model_of(JobInfo))


def fork_session(session_id: str, token: str | None, step: int | None) -> Call[SessionInfo]:
    request = post(f"{_session(session_id)}/fork", None, long_timeout=True)
    params = {} if step is None else {"step": str(step)}
    made = replace(request, params=params, headers=request.headers | bearer(token))
    return Call(made, model_of(SessionInfo))


def record_session(session_id: str, token: str | None, frames: bool) -> Call[bytes]:
    """The recording of the running episode."""
    request = Request(
        "GET",
        f"{_session(session_id)}/recording",
        params={"frames": "true"} if frames else {},
        headers=bearer(token),
        long_timeout=True,
    )
    return Call(request, lambda reply: reply.content)


def render_session(
    session_id: str, token: str | None, sensors: Sequence[SensorSpec], ranging: Mapping[str, Any]
) -> Call[View]:
    """Safe to retry: it does not advance the clock."""
    body = checked(SessionRender, sensors=list(sensors), **ranging)
    request = Request(
        "POST",
        f"{_session(session_id)}/render",
        headers=bearer(token) | {"Content-Type": "application/json", "Accept": MSGPACK},
        body=json_of(body),
        long_timeout=True,
    )
    return Call(request, parse_view)


def _scenario(scenario_id: str) -> str:
    return f"/v1/scenarios/{segment(scenario_id)}"


def _session(session_id: str) -> str:
    return f"/v1/sessions/{segment(session_id)}"
