"""Scenes: what there is, what is in memory, single frames."""

from __future__ import annotations

import asyncio
import re
from typing import Annotated

from fastapi import APIRouter, Header, Request, Response

from real2sim_proto.base import Identifier
from real2sim_proto.jobs import JobInfo
from real2sim_proto.scenes import SceneInfo, SceneList, SceneState

from ...edit import ScenarioState
from ..http.clients import ClientName
from ..http.disconnects import unless_gone
from ..http.problems import ServiceError
from ..http.responses import FRAME_RESPONSES, frame_response, info_response, large_response
from ..jobs.jobs import JobContext, JobResult, NewJob, accepted_headers
from ..library.views import scene_info
from ..worker import WorkerOf
from .frame_query import FrameQueryOf

WAIT_S = 2.0
MAX_WAIT_S = 600.0

router = APIRouter(prefix="/v1", tags=["scenes"])


@router.get("/scenes", response_model=SceneList)
async def list_scenes(worker: WorkerOf) -> Response:
    """Every scene below the worker's scene folder, resident or not, broken ones with the reason."""
    residency = worker.residency
    listed = [(item, residency.state(name)) for name, item in (await residency.refresh()).items()]

    def build() -> SceneList:
        infos = [scene_info(i, state, summary=i.summary, tracks=False) for i, state in listed]
        return SceneList(scenes=infos)

    return await large_response(build)


@router.get("/scenes/{scene}", response_model=SceneInfo)
async def describe(worker: WorkerOf, scene: Identifier) -> Response:
    """One scene with cameras, objects and their trajectories, extent and the recorded ego path."""
    return await scene_response(worker, scene)


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
    state = worker.residency.state(scene)
    if state is SceneState.RESIDENT:
        return await scene_response(worker, scene)
    await worker.residency.summary(scene)

    async def work(_ticket: JobContext) -> JobResult:
        await worker.residency.get(scene)
        return JobResult()

    new = NewJob("load_scene", scene, who=who, light=True)
    job = await worker.jobs.start(new, work)
    job = await worker.jobs.wait(job.job_id, _patience(prefer))
    if job.error is not None:
        raise ServiceError(
            job.error.code,
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
    await worker.residency.unload(scene)
    return await scene_response(worker, scene)


@router.get("/scenes/{scene}/render", responses=FRAME_RESPONSES, response_class=Response)
async def render(
    worker: WorkerOf, scene: Identifier, asked: FrameQueryOf, request: Request
) -> Response:
    """One frame of the unedited scene, from where the recording vehicle was at ``t_us``."""
    media_type = asked.media_type()
    resident = await worker.residency.get(scene)
    shot = await asyncio.to_thread(
        lambda: asked.shot(resident, ScenarioState.of(resident), media_type)
    )
    pictured = await unless_gone(request, worker.pictures.take(shot))
    return frame_response(pictured, media_type)


def _patience(prefer: str | None) -> float:
    """Seconds that a client wants to wait for the end of a job."""
    asked = (prefer or "").lower()
    if "respond-async" in asked:
        return 0.0
    wait = re.search(r"\bwait=(\d{1,4})\b", asked)
    return min(float(wait.group(1)), MAX_WAIT_S) if wait else WAIT_S


async def scene_response(
    worker: WorkerOf, scene: str, *, status: int = 200, headers: dict[str, str] | None = None
) -> Response:
    """The full description of one scene."""
    listing = await worker.residency.listing(scene)
    state = worker.residency.state(scene)
    summary = await worker.residency.summary(scene) if listing.summary else None
    return await large_response(
        lambda: scene_info(listing, state, summary=summary, tracks=True),
        status=status,
        headers=headers,
    )
