"""Scenes: what there is, what is in memory, single frames."""

from __future__ import annotations

import asyncio
import re
from typing import Annotated

from fastapi import APIRouter, Header, Request, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier
from real2sim_proto.jobs import JobInfo
from real2sim_proto.lanes import SceneLanes
from real2sim_proto.scenes import SceneInfo, SceneList, SceneState
from real2sim_proto.views import SceneView

from ...edit import ScenarioState
from ...scene.io.lane_document import lane_document
from ..http.auth import TokenRoute
from ..http.disconnects import cancel_on_disconnect
from ..http.problems import ServiceError
from ..http.requests import ClientName
from ..http.responses import info_response, large_response
from ..jobs.jobs import JobContext, JobResult, NewJob, accepted_headers
from ..library.views import scene_info
from ..rendering.responses import (
    FRAME_RESPONSES,
    choose_frames_type,
    frame_response,
    frames_response,
)
from ..worker import WorkerOf
from .frame_query import FrameQueryOf
from .free_view import free_view_request

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
