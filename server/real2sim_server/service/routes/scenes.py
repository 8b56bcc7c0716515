"""Scenes: list, load, import, render single frames, and fetch their Gaussians and skies."""

from __future__ import annotations

import asyncio
import hashlib
import re
import shutil
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier, Microseconds
from real2sim_proto.jobs import JobInfo
from real2sim_proto.lanes import SceneLanes
from real2sim_proto.scenes import SceneImport, SceneInfo, SceneList, SceneState, UpAxis
from real2sim_proto.sessions import SceneView

from ...edit import ScenarioState, cloud_of, figure_of
from ...render.modalities import encode_image
from ...scene import Scene
from ...scene.io import DEMO_SCENE, SHIPPED_STREET
from ...scene.io.document import lane_document
from ...scene.io.splats import suffixes
from ..http.auth import TokenRoute
from ..http.requests import ClientName, IdempotencyKey, form_digest
from ..http.responses import ServiceError, cancel_on_disconnect, etag, info_response, large_response
from ..jobs import JobContext, JobResult, NewJob, accepted_headers
from ..library.imports import (
    drop_claim,
    import_errors,
    import_scene,
    resolve_import,
    scene_name,
    staging_folder,
)
from ..library.scenes import bundle_folder
from ..library.views import scene_info, spz_of
from ..renderer import FRAME_RESPONSES, choose_frames_type, frame_response, frames_response
from ..worker import Worker, WorkerOf
from .queries import FrameQueryOf, free_view_request

FREE_VIEW = "application/msgpack with all frames, each in its codec; or one frame as image file"
WAIT_S = 2.0
MAX_WAIT_S = 600.0

router = APIRouter(prefix="/v1", tags=["scenes"], route_class=TokenRoute)


@router.get("/scenes", response_model=SceneList)
async def list_scenes(worker: WorkerOf) -> Response:
    """All scenes in the worker's scene folder, resident or not; broken ones have a reason."""
    scene_cache = worker.scene_cache
    listed = [
        (item, scene_cache.state(name)) for name, item in (await scene_cache.refresh()).items()
    ]

    def build() -> SceneList:
        infos = [scene_info(i, state, summary=i.summary, tracks=False) for i, state in listed]
        return SceneList(scenes=infos)

    return await large_response(build)


@router.get("/scenes/{scene}", response_model=SceneInfo)
async def describe(worker: WorkerOf, scene: Identifier) -> Response:
    """One scene with cameras, objects and their trajectories, extent and the recorded ego path."""
    return await scene_response(worker, scene)


@router.get("/scenes/{scene}/lanes", response_model=SceneLanes)
async def lanes(worker: WorkerOf, scene: Identifier, roads: bool = True) -> Response:
    """The lanes of a scene: centre lines, neighbours, stop lines, signals; 404 if it has none.

    `roads=false` omits the reference lines of roads.
    """
    summary = await worker.scene_cache.summary(scene)
    graph = await asyncio.to_thread(lambda: summary.lanes)
    if graph is None:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"scene {scene!r} has no lanes",
            hint="give it some with `real2sim map SCENE --from FILE`",
        )
    return await large_response(lambda: lane_document(graph, with_roads=roads))


@router.put(
    "/scenes/{scene}/residency",
    response_model=SceneInfo,
    responses={202: {"model": JobInfo, "description": "loading continues as a job"}},
)
async def load(
    worker: WorkerOf,
    scene: Identifier,
    prefer: Annotated[
        str | None,
        Header(
            description=(
                "`respond-async` to answer 202 immediately, `wait=<s>` to wait longer (RFC 7240)"
            )
        ),
    ] = None,
    who: ClientName = "",
) -> Response:
    """Load a scene into memory.

    Returns 200 if it is loaded within two seconds, else 202 and the job that loads it. Returns 507
    if the memory budget does not allow it.
    """
    state = worker.scene_cache.state(scene)
    if state is SceneState.RESIDENT:
        return await scene_response(worker, scene)
    await worker.scene_cache.summary(scene)

    async def work(_context: JobContext) -> JobResult:
        await worker.scene_cache.get(scene)
        return JobResult()

    new = NewJob("load_scene", scene, who=who, light=True)
    job = await worker.jobs.start(new, work)
    job = await worker.jobs.wait(job.job_id, _wait_seconds(prefer))
    if job.error is not None:
        raise ServiceError(
            ErrorCode(job.error.code),
            job.error.detail,
            hint=job.error.hint,
            extra=job.error.model_extra,
        )
    if not job.over:
        return info_response(job, status=202, headers=accepted_headers(job))
    return await scene_response(worker, scene)


@router.delete("/scenes/{scene}/residency", response_model=SceneInfo)
async def unload(worker: WorkerOf, scene: Identifier) -> Response:
    """Unload a scene from memory; 409 while sessions use it."""
    await worker.scene_cache.unload(scene)
    return await scene_response(worker, scene)


@router.get("/scenes/{scene}/render", responses=FRAME_RESPONSES, response_class=Response)
async def render(
    worker: WorkerOf, scene: Identifier, query: FrameQueryOf, request: Request
) -> Response:
    """One frame of the unedited scene, from the recording vehicle's pose at ``t_us``."""
    media_type = query.media_type()
    resident = await worker.scene_cache.get(scene)
    render_request = await asyncio.to_thread(
        lambda: query.render_request(resident, ScenarioState.of(resident), media_type)
    )
    rendered = await cancel_on_disconnect(request, worker.renderer.render(render_request))
    return frame_response(rendered, media_type)


@router.post(
    "/scenes/{scene}/render",
    responses={200: FRAME_RESPONSES[200] | {"description": FREE_VIEW}},
    response_class=Response,
)
async def view(
    worker: WorkerOf,
    scene: Identifier,
    body: SceneView,
    request: Request,
    accept: Annotated[str | None, Header()] = None,
) -> Response:
    """Render one instant of the scene from any cameras, with objects at the requested poses.

    Nothing is stored. For external simulators that need images.
    """
    modalities = [name for camera in body.cameras for name in camera.modalities]
    media_type = choose_frames_type(accept, modalities)
    resident = await worker.scene_cache.get(scene)
    render_request = await asyncio.to_thread(free_view_request, resident, body, media_type)
    rendered = await cancel_on_disconnect(request, worker.renderer.render(render_request))
    return frames_response(rendered, media_type, t_us=render_request.t_us)


def _wait_seconds(prefer: str | None) -> float:
    """Seconds that a client is willing to wait for the end of a job."""
    preference = (prefer or "").lower()
    if "respond-async" in preference:
        return 0.0
    wait = re.search(r"\bwait=(\d{1,4})\b", preference)
    return min(float(wait.group(1)), MAX_WAIT_S) if wait else WAIT_S


async def scene_response(
    worker: WorkerOf, scene: str, *, status: int = 200, headers: dict[str, str] | None = None
) -> Response:
    """The full description of one scene."""
    listing = await worker.scene_cache.listing(scene)
    state = worker.scene_cache.state(scene)
    summary = await worker.scene_cache.summary(scene) if listing.summary else None
    return await large_response(
        lambda: scene_info(listing, state, summary=summary, tracks=True),
        status=status,
        headers=headers,
    )


# --- Imports -------------------------------------------------------------------------------------

UPLOAD_PATHS = ("/v1/scenes",)
"""Paths whose forms may be larger than other requests."""

_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": SceneImport.model_json_schema(),
                "example": {"path": "street.r2s", "scene": "street"},
            },
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "a .ply"},
                        "scene": {"type": "string", "description": "name to give it"},
                    },
                }
            },
        },
    }
}


@router.post("/scenes", status_code=201, response_model=SceneInfo, openapi_extra=_BODY)
async def import_(
    worker: WorkerOf, request: Request, idempotency_key: IdempotencyKey = None
) -> Response:
    """Add a scene: a bundle or ply in the import folder (JSON), the demo street
    (`{"demo": true}`), or an uploaded ply."""
    kind = request.headers.get("Content-Type", "").split(";")[0].strip().lower()
    with worker.imports.place():
        if kind != "multipart/form-data":
            add_scene = partial(_import_path, worker, await request.body())
            return await _imported(worker, request, idempotency_key, add_scene)
        async with request.form(max_files=1, max_fields=1) as form:
            content = await form_digest(form) if idempotency_key is not None else None
            add_scene = partial(_import_upload, worker, form)
            return await _imported(worker, request, idempotency_key, add_scene, content=content)


async def _imported(
    worker: Worker,
    request: Request,
    key: str | None,
    add_scene: Callable[[str | None], Awaitable[str]],
    *,
    content: bytes | None = None,
) -> Response:
    async with worker.idempotency.guard(request, key, content=content) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        name = await add_scene(idempotent.claim)
        await worker.scene_cache.refresh()
        headers = {"Location": f"/v1/scenes/{name}"}
        response = await scene_response(worker, name, status=201, headers=headers)
        reply = idempotent.reply_bytes(bytes(response.body), status=201, headers=headers)
        await worker.idempotency.store(reply)
        if idempotent.claim is not None:
            await asyncio.to_thread(drop_claim, bundle_folder(worker.settings.scenes_path, name))
        return response


async def _import_path(worker: Worker, body: bytes, claim: str | None) -> str:
    request = _parse(body)
    settings = worker.settings

    def work() -> str:
        if request.path is None:
            source, name = SHIPPED_STREET, scene_name(SHIPPED_STREET, request.scene or DEMO_SCENE)
        else:
            source = resolve_import(settings.import_path, request.path)
            name = scene_name(source, request.scene)
        _import(worker, source, name, claim)
        return name

    return await worker.imports.run(work)


async def _import_upload(worker: Worker, form: FormData, claim: str | None) -> str:
    file, given = form.get("file"), form.get("scene")
    if not isinstance(file, UploadFile) or not isinstance(given, str | None):
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            "the form needs a part 'file' with the splat file, and may have a field 'scene'",
        )

    def work() -> str:
        name = scene_name(Path(file.filename or "upload"), given)
        with (
            import_errors(Path("upload"), setting="MAX_SCENE_BYTES"),
            staging_folder(worker.settings.scenes_path) as staging,
        ):
            _import(worker, stored_upload(file, staging), name, claim)
        return name

    return await worker.imports.run(work)


def _import(worker: Worker, source: Path, name: str, claim: str | None) -> None:
    import_scene(
        source,
        scenes=worker.settings.scenes_path,
        name=name,
        limits=worker.scene_limits,
        quota=worker.scenes_quota,
        claim=claim,
    )


def stored_upload(file: UploadFile, staging: Path) -> Path:
    """Write the upload to ``staging``: readers map files, and some formats need the suffix."""
    given = Path(file.filename or "upload.ply").name.lower()
    ending = next((suffix for suffix in suffixes() if given.endswith(suffix)), ".ply")
    stored = staging / f"upload{ending}"
    with stored.open("xb") as target:
        shutil.copyfileobj(file.file, target, 1 << 20)
    return stored


def _parse(body: bytes) -> SceneImport:
    try:
        return SceneImport.model_validate_json(body)
    except ValidationError as error:
        found: list[Any] = [e | {"loc": ("body", *e["loc"])} for e in error.errors()]
        raise RequestValidationError(found) from error


# Gaussians and skies of scenes and objects, for external renderers.

# --- Scenes --------------------------------------------------------------------------------------

SPZ = "application/octet-stream"
DEFAULT_COUNT = 32_768
MAX_COUNT = 262_144


KnownHash = Annotated[
    str | None,
    Query(
        max_length=64,
        description=(
            "the scene's `content_hash`, which makes the answer cacheable forever; 404 if "
            "the scene has changed"
        ),
    ),
]
SpzUpAxis = Annotated[UpAxis, Query(description="axis that points up in the file")]
IfNoneMatch = Annotated[str | None, Header(description="answer 304 if the ETag is unchanged")]


@router.get(
    "/scenes/{scene}/splats",
    response_class=Response,
    responses={
        200: {
            "description": "an spz file of version 3",
            "headers": {
                "X-Real2Sim-Total": {
                    "description": "Gaussians there are",
                    "schema": {"type": "integer"},
                },
                "X-Real2Sim-Figure": {
                    "description": "`rest`: a walking person, in the rest pose",
                    "schema": {"type": "string"},
                },
            },
            "content": {SPZ: {"schema": {"type": "string", "format": "binary"}}},
        },
        304: {"description": "the client has it"},
    },
)
async def splats(
    *,
    worker: WorkerOf,
    scene: Identifier,
    object_id: Annotated[
        Identifier | None, Query(description="object, in its own frame; default: the background")
    ] = None,
    first: Annotated[
        int, Query(ge=0, description="number of more important Gaussians to skip")
    ] = 0,
    count: Annotated[
        int, Query(ge=1, le=MAX_COUNT, description="largest number of Gaussians")
    ] = DEFAULT_COUNT,
    up_axis: SpzUpAxis = "y",
    content_hash: KnownHash = None,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Gaussians of the background (world frame) or of one object (its box's frame) as an spz file,
    sorted by decreasing coverage. Spz files are y up (z forward); with `up_axis=z` the file has the
    axes of the scene."""
    resident = await worker.scene_cache.get(scene)
    headers = _caching(resident, content_hash, f"splats {object_id} {first} {count} {up_axis}")
    subject = None if object_id is None else resident.object(object_id)
    cloud = resident.background if subject is None else subject.cloud
    if subject is not None and subject.figure is not None:
        headers["X-Real2Sim-Figure"] = "rest"
    headers["X-Real2Sim-Total"] = str(len(cloud))
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)

    known = (resident.content_hash, object_id or "")
    file = await asyncio.to_thread(
        worker.splat_files.part, cloud, known, first, count, up_axis=up_axis
    )
    return Response(file, media_type=SPZ, headers=headers)


@router.get(
    "/scenes/{scene}/sky",
    response_class=Response,
    responses={
        200: {
            "description": "picture",
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        },
        304: {"description": "the client has it"},
        404: {"description": "the scene has no sky"},
    },
)
async def sky(
    worker: WorkerOf,
    scene: Identifier,
    content_hash: KnownHash = None,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """The cube map of the sky: six faces side by side, +x -x +y -y +z -z of the world; at u, v in
    [-1, 1] (right, down) they look along (1, -u, -v), (-1, u, -v), (u, 1, -v), (-u, -1, -v),
    (v, -u, 1), (-v, -u, -1)."""
    resident = await worker.scene_cache.get(scene)
    headers = _caching(resident, content_hash, "sky")
    if resident.sky is None:
        raise ServiceError(ErrorCode.NOT_FOUND, f"scene {scene!r} has no sky", hint="it is black")
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    faces = resident.sky.faces

    def made() -> bytes:
        strip = np.concatenate(list(faces.cpu().numpy()), axis=1)
        pixels = np.rint(np.clip(strip, 0, 1) * 255).astype(np.uint8)
        return encode_image(pixels, "rgb", "png").data

    return Response(await asyncio.to_thread(made), media_type="image/png", headers=headers)


def _caching(scene: Scene, content_hash: str | None, what: str) -> dict[str, str]:
    """Cache headers of a response. Raises ServiceError: NOT_FOUND."""
    if content_hash is not None and content_hash != scene.content_hash:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"scene {scene.name!r} with content_hash {content_hash!r} is not here; "
            f"it has {scene.content_hash!r}",
            hint="read the scene again",
        )
    tag = hashlib.sha256(f"{scene.content_hash} {what}".encode()).hexdigest()[:32]
    kept = "private, max-age=31536000, immutable" if content_hash else "private, no-cache"
    return {"ETag": f'"{tag}"', "Cache-Control": kept}


object_router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"], route_class=TokenRoute)


@object_router.get(
    "/{scenario_id}/splats",
    name="splats",
    response_class=Response,
    responses={
        200: {
            "description": "an spz file of version 3",
            "headers": {
                "X-Real2Sim-Figure": {
                    "description": "`posed`: a walking person, in its pose at this time",
                    "schema": {"type": "string"},
                },
            },
            "content": {SPZ: {"schema": {"type": "string", "format": "binary"}}},
        },
    },
)
async def object_splats(
    *,
    worker: WorkerOf,
    scenario_id: Identifier,
    object_id: Annotated[Identifier, Query(description="object, in the frame of its box")],
    t_us: Annotated[
        Microseconds | None, Query(description="default: start of the scenario")
    ] = None,
    up_axis: SpzUpAxis = "y",
) -> Response:
    """The current Gaussians of one object of a scenario, sorted by decreasing coverage: of an
    asset, or of a person in the pose at ``t_us``, at its edited size. An spz file in the frame of
    its box, y up (z forward); with `up_axis=z` it has the axes of the box."""
    view = await worker.scenarios.view(scenario_id)
    scene = await worker.scene_cache.get(view.row.scene)
    subject = next((o for o in view.state.visible if o.object_id == object_id), None)
    if subject is None:
        raise ServiceError(
            ErrorCode.UNKNOWN_OBJECT,
            f"scenario {scenario_id!r} has no object {object_id!r}",
            hint="GET /v1/scenarios/{id} lists them",
        )
    instant = view.state.clock[0] if t_us is None else t_us
    headers = {"Cache-Control": "no-store", "ETag": etag(view.revision)}
    if figure_of(scene, subject) is not None:
        headers["X-Real2Sim-Figure"] = "posed"

    def made() -> bytes:
        cloud = cloud_of(scene, subject, instant)
        if subject.scale != (1.0, 1.0, 1.0):
            cloud = cloud.stretched(subject.scale)
        return spz_of(cloud.select(cloud.by_importance()), up_axis)

    return Response(await asyncio.to_thread(made), media_type=SPZ, headers=headers)
