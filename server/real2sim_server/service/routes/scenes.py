"""Scenes: list, load, import, and draw single frames."""

from __future__ import annotations

import asyncio
import re
import shutil
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Header, Request, Response
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import FormData, UploadFile

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier
from real2sim_proto.jobs import JobInfo
from real2sim_proto.lanes import SceneLanes
from real2sim_proto.scenes import SceneImport, SceneInfo, SceneList, SceneState
from real2sim_proto.sessions import SceneView

from ...edit import ScenarioState
from ...scene.io import DEMO_SCENE, SHIPPED_STREET
from ...scene.io.document import lane_document
from ...scene.io.splats import suffixes
from ..http.auth import TokenRoute
from ..http.idempotency import IdempotencyKey, form_digest
from ..http.problems import ServiceError, cancel_on_disconnect
from ..http.requests import ClientName
from ..http.responses import info_response, large_response
from ..jobs.jobs import JobContext, JobResult, NewJob, accepted_headers
from ..library.imports import (
    drop_claim,
    import_errors,
    import_scene,
    resolve_import,
    scene_name,
    staging_folder,
)
from ..library.scenes import bundle_folder
from ..library.views import scene_info
from ..rendering.renderer import (
    FRAME_RESPONSES,
    choose_frames_type,
    frame_response,
    frames_response,
)
from ..worker import Worker, WorkerOf
from .queries import FrameQueryOf, free_view_request

FREE_VIEW = "application/msgpack with all frames, each in its codec; or one frame as image file"
WAIT_S = 2.0
MAX_WAIT_S = 600.0

router = APIRouter(prefix="/v1", tags=["scenes"], route_class=TokenRoute)


@router.get("/scenes", response_model=SceneList)
async def list_scenes(worker: WorkerOf) -> Response:
    """Every scene below the worker's scene folder, resident or not, broken ones with the reason."""
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
    """The lanes of a scene: centre lines, neighbours, stop lines, signals; 404 where it has none.

    `roads=false` leaves out reference lines of roads.
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
    responses={202: {"model": JobInfo, "description": "loading goes on as a job"}},
)
async def load(
    worker: WorkerOf,
    scene: Identifier,
    prefer: Annotated[
        str | None,
        Header(description="`respond-async` for 202 at once, `wait=<s>` to wait longer (RFC 7240)"),
    ] = None,
    who: ClientName = "",
) -> Response:
    """Load a scene into memory.

    200 when it is there, at once or within two seconds; else 202 and the job that loads it. 507
    when the memory budget does not allow it.
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
    """Take a scene out of memory; 409 while sessions use it."""
    await worker.scene_cache.unload(scene)
    return await scene_response(worker, scene)


@router.get("/scenes/{scene}/render", responses=FRAME_RESPONSES, response_class=Response)
async def render(
    worker: WorkerOf, scene: Identifier, query: FrameQueryOf, request: Request
) -> Response:
    """One frame of the unedited scene, from where the recording vehicle was at ``t_us``."""
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
    """One instant of the scene from cameras anywhere, with objects where the request has them.

    Nothing is kept of it: for other programs that drive and want pictures.
    """
    modalities = [name for camera in body.cameras for name in camera.modalities]
    media_type = choose_frames_type(accept, modalities)
    resident = await worker.scene_cache.get(scene)
    render_request = await asyncio.to_thread(free_view_request, resident, body, media_type)
    rendered = await cancel_on_disconnect(request, worker.renderer.render(render_request))
    return frames_response(rendered, media_type, t_us=render_request.t_us)


def _wait_seconds(prefer: str | None) -> float:
    """Seconds that a client wants to wait for the end of a job."""
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
"""Where forms may be larger than other requests."""

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
    """Add a scene: a bundle or ply below the import folder (JSON), the demo street
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
    """The upload as a file in ``staging``: readers map files, and tell some formats by suffix."""
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
