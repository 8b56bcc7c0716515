"""Exports: what leaves the worker as a file."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request, Response

from real2sim_proto.jobs import ExportRequest, JobInfo

from ...edit import ScenarioState, instances_at
from ..http.auth import TokenRoute
from ..http.clients import ClientName
from ..http.idempotency import IdempotencyKey
from ..http.responses import info_response
from ..jobs.exports import VideoSource, check_camera, export_video, frame_times
from ..jobs.jobs import JobContext, JobResult, NewJob, accepted_headers
from ..worker import Worker, WorkerOf

router = APIRouter(prefix="/v1/exports", tags=["exports"], route_class=TokenRoute)


@router.post("", status_code=202, response_model=JobInfo)
async def create(
    worker: WorkerOf,
    body: ExportRequest,
    request: Request,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Make a video of a scene, a scenario as it is now, or a simulation, from a camera's way.

    The answer is a job; once it has succeeded, `GET /v1/jobs/{id}/files/video.webm`.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        video_source = await _video_source(worker, body)
        check_camera(video_source, body, max_pixels=worker.settings.max_pixels_per_step)
        frame_times(video_source, body)

        async def work(context: JobContext) -> JobResult:
            return await export_video(video_source, body, renderer=worker.renderer, context=context)

        subject = body.scenario or body.scene or body.simulation or ""
        new = NewJob("export", subject, body.model_dump(mode="json", exclude_none=True), who)
        info = await worker.jobs.start(new, work, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))


async def _video_source(worker: Worker, request: ExportRequest) -> VideoSource:
    if request.simulation is not None:
        return await worker.simulations.video_source(request.simulation)
    if request.scenario is not None:
        view = await worker.scenarios.view(request.scenario)
        scene = await worker.scene_cache.get(view.row.scene)
        return VideoSource(
            scene, lambda t_us: instances_at(scene, view.state, t_us), view.state.clock
        )
    scene = await worker.scene_cache.get(request.scene or "")
    state = await asyncio.to_thread(ScenarioState.of, scene)
    return VideoSource(scene, lambda t_us: instances_at(scene, state, t_us), state.clock)
