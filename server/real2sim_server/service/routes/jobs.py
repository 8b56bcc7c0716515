"""Jobs: long work that is followed, cancelled, and whose results are fetched."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import FileResponse, RedirectResponse, StreamingResponse

from real2sim_proto.base import Identifier
from real2sim_proto.jobs import JobInfo, JobList

from ..http.auth import TokenRoute
from ..http.disconnects import cancel_on_disconnect
from ..http.responses import event_stream, info_response
from ..jobs.jobs import Jobs
from ..rendering.renderer import RenderRequest
from ..rendering.responses import FRAME_RESPONSES, frame_response
from ..sessions.recording import RECORDING
from ..worker import WorkerOf
from .frame_query import FrameQueryOf

FILE_TYPES = (
    "video/webm",
    "application/json",
    "application/octet-stream",
    RECORDING,
    "application/x-tar",
    "image/jpeg",
    "application/xml",
    "application/vnd.apache.parquet",
)
"""Of what jobs leave."""

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=TokenRoute)


@router.get("")
async def list_jobs(
    worker: WorkerOf,
    subject: Annotated[
        Identifier | None, Query(description="only of this scene or scenario")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> JobList:
    """Jobs of this worker's store, newest first; also those of earlier runs."""
    return JobList(jobs=await worker.jobs.list(subject=subject, limit=limit))


@router.get("/{job_id}")
async def describe(worker: WorkerOf, job_id: Identifier) -> JobInfo:
    """One job: state, progress, and once it is over its result or error."""
    return await worker.jobs.get(job_id)


@router.delete(
    "/{job_id}",
    response_model=JobInfo,
    responses={204: {"description": "the job was over; it and its files are gone"}},
)
async def cancel(worker: WorkerOf, job_id: Identifier) -> Response:
    """Cancel a job that is not over; remove one that is, with its files."""
    info = await worker.jobs.cancel(job_id)
    return Response(status_code=204) if info is None else info_response(info)


@router.get(
    "/{job_id}/events",
    response_class=Response,
    responses={
        200: {
            "description": "one event for every change; the data of each is the job as JSON",
            "content": {"text/event-stream": {"schema": {"type": "string"}}},
        },
        204: {"description": "the job is over and `Last-Event-ID` was its last event"},
    },
)
async def events(
    worker: WorkerOf,
    job_id: Identifier,
    last_event_id: Annotated[
        str | None,
        Header(
            alias="Last-Event-ID",
            pattern=r"^[0-9]{1,9}$",
            description="go on behind this event",
            examples=["3"],
        ),
    ] = None,
) -> Response:
    """Server-sent events until the job is over; comes back to where it was with Last-Event-ID."""
    after = int(last_event_id or 0)
    info = await worker.jobs.get(job_id)
    if info.over and info.event <= after:
        return Response(status_code=204)  # tells browsers not to connect again
    return StreamingResponse(
        event_stream(_named(worker.jobs, job_id, after)),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


@router.get("/{job_id}/preview", responses=FRAME_RESPONSES, response_class=Response)
async def preview(
    worker: WorkerOf, job_id: Identifier, query: FrameQueryOf, request: Request
) -> Response:
    """One frame of a finished simulation, or of a drive from where its vehicle was at ``t_us``."""
    media_type = query.media_type()
    video_source = await worker.video_source(job_id)
    t_us = video_source.span[0] if query.t_us is None else query.t_us

    def build() -> RenderRequest:
        return query.render_request_for(
            video_source.scene,
            video_source.instances(t_us),
            t_us,
            media_type,
            video_source.T_world_vehicle(t_us),
        )

    render_request = await asyncio.to_thread(build)
    rendered = await cancel_on_disconnect(request, worker.renderer.render(render_request))
    return frame_response(rendered, media_type)


@router.get(
    "/{job_id}/files/{name}",
    response_class=Response,
    responses={
        200: {
            "description": "the file",
            "content": {
                media_type: {"schema": {"type": "string", "format": "binary"}}
                for media_type in FILE_TYPES
            },
        },
        206: {"description": "the part of it that `Range` asked for"},
        307: {"description": "where it may be fetched for a while, with `signed`"},
    },
)
async def file(
    worker: WorkerOf,
    job_id: Identifier,
    name: Identifier,
    signed: Annotated[
        bool,
        Query(description="answer 307 with an address at the object store, where there is one"),
    ] = False,
) -> Response:
    """A file that a finished job left; `Range` asks for a part of it."""
    if signed and worker.sharing is not None:
        seconds = worker.settings.objects_url_seconds
        url = await worker.sharing.signed_url("job", job_id, name, seconds=seconds)
        if url is not None:
            return RedirectResponse(url, headers={"Cache-Control": "no-store"})
    path, left = await worker.jobs.file(job_id, name)
    return FileResponse(path, media_type=left.media_type, filename=f"{job_id}.{name}")


async def _named(jobs: Jobs, job_id: str, after: int) -> AsyncIterator[tuple[int, str, str]]:
    async for info in jobs.events(job_id, after=after):
        name = info.state.value if info.over else "progress"
        yield info.event, name, info.model_dump_json()
