"""Exports: what leaves the worker as a file."""

from __future__ import annotations

import asyncio

from fastapi import APIRouter, Request, Response

from real2sim_proto.jobs import ExportRequest, JobInfo

from ...edit import ScenarioState, instances_at
from ..http.clients import ClientName
from ..http.idempotency import IdempotencyKey
from ..http.responses import info_response
from ..jobs.exports import Film, check_camera, export_video, frame_times
from ..jobs.jobs import JobContext, JobResult, NewJob, accepted_headers
from ..worker import Worker, WorkerOf

router = APIRouter(prefix="/v1/exports", tags=["exports"])


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
    async with worker.idempotency.once(request, idempotency_key) as once:
        if once.replay:
            return worker.replayed(once.replay)
        film = await _film(worker, body)
        check_camera(film, body, max_pixels=worker.settings.max_pixels_per_step)
        frame_times(film, body)

        async def work(ticket: JobContext) -> JobResult:
            return await export_video(film, body, pictures=worker.pictures, ticket=ticket)

        subject = body.scenario or body.scene or body.simulation or ""
        asked = body.model_dump(mode="json", exclude_none=True)
        info = await worker.jobs.start(NewJob("export", subject, asked, who), work, once=once)
        return info_response(info, status=202, headers=accepted_headers(info))


async def _film(worker: Worker, asked: ExportRequest) -> Film:
    if asked.simulation is not None:
        return await worker.simulations.film(asked.simulation)
    if asked.scenario is not None:
        view = await worker.scenarios.view(asked.scenario)
        scene = await worker.residency.get(view.row.scene)
        return Film(scene, lambda t_us: instances_at(scene, view.state, t_us), view.state.clock)
    scene = await worker.residency.get(asked.scene or "")
    state = await asyncio.to_thread(ScenarioState.of, scene)
    return Film(scene, lambda t_us: instances_at(scene, state, t_us), state.clock)
