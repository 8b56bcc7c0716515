"""Jobs: follow, cancel and fetch results; start exports, sweeps and searches."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Request, Response
from fastapi.responses import FileResponse, RedirectResponse, StreamingResponse

from real2sim_proto.base import Identifier
from real2sim_proto.jobs import (
    EXPORT_BODY,
    DatasetRequest,
    ExportBody,
    ExportRequest,
    JobInfo,
    JobList,
)
from real2sim_proto.sweeps import SweepRequest

from ...datasets.drive import EpisodeDrive, ScenarioDrive
from ...datasets.plan import Variant, swept
from ...edit import ScenarioState, instances_at
from ...scene import Scene
from ...world.recording import Recording, RecordingError, recording_of_bytes
from ..exports import (
    DatasetSource,
    EngineBackend,
    VideoSource,
    check_camera,
    check_dataset,
    export_video,
    frame_times,
    make_dataset,
    plan_of,
)
from ..http.auth import TokenRoute, bearer_token, unauthorized
from ..http.requests import ClientName, IdempotencyKey
from ..http.responses import cancel_on_disconnect, event_stream, info_response
from ..jobs import JobContext, JobResult, Jobs, NewJob, Work, accepted_headers
from ..renderer import FRAME_RESPONSES, RenderRequest, frame_response
from ..sessions.recording import RECORDING, episode_of
from ..sessions.registry import check_not_closed
from ..sessions.session import opens_session
from ..worker import Worker, WorkerOf
from .queries import FrameQueryOf

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
"""Media types of result files."""

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], route_class=TokenRoute)


@router.get("")
async def list_jobs(
    worker: WorkerOf,
    subject: Annotated[
        Identifier | None, Query(description="jobs of this scene or scenario")
    ] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
) -> JobList:
    """Jobs in this worker's store, newest first, including those of earlier runs."""
    return JobList(jobs=await worker.jobs.list(subject=subject, limit=limit))


@router.get("/{job_id}")
async def describe(worker: WorkerOf, job_id: Identifier) -> JobInfo:
    """One job: state, progress, and at its end the result or error."""
    return await worker.jobs.get(job_id)


@router.delete(
    "/{job_id}",
    response_model=JobInfo,
    responses={204: {"description": "the job was over; it and its files are gone"}},
)
async def cancel(worker: WorkerOf, job_id: Identifier) -> Response:
    """Cancel an unfinished job, or delete a finished one with its files."""
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
            description="continue after this event",
            examples=["3"],
        ),
    ] = None,
) -> Response:
    """Server-sent events until the job ends; `Last-Event-ID` resumes the stream."""
    after = int(last_event_id or 0)
    info = await worker.jobs.get(job_id)
    if info.over and info.event <= after:
        return Response(status_code=204)  # tells browsers not to reconnect
    return StreamingResponse(
        event_stream(_named(worker.jobs, job_id, after)),
        media_type="text/event-stream",
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


@router.get("/{job_id}/preview", responses=FRAME_RESPONSES, response_class=Response)
async def preview(
    worker: WorkerOf, job_id: Identifier, query: FrameQueryOf, request: Request
) -> Response:
    """One frame of a finished simulation, or of a drive from its vehicle's pose at ``t_us``."""
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
        Query(description="answer 307 with an address of the object store, if there is one"),
    ] = False,
) -> Response:
    """A result file of a finished job; supports `Range`."""
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


# --- Exports -------------------------------------------------------------------------------------

exports_router = APIRouter(prefix="/v1/exports", tags=["exports"], route_class=TokenRoute)


@exports_router.post("", status_code=202, response_model=JobInfo)
async def create(
    worker: WorkerOf,
    body: ExportBody,
    request: Request,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Start an export; the response is a job.

    Exports a **video** of a scene, the current scenario or a simulation, from a camera's path; once
    the job has succeeded, `GET /v1/jobs/{id}/files/video.webm`. Or a labelled **data set** of a
    scene, the current scenario, a recorded episode or the running episode of a session, in public
    formats: `GET /v1/jobs/{id}/files/dataset.tar`, `manifest.json` and `preview_0.jpg`.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        revision = None
        if body.scenario is not None:
            revision = (await worker.scenarios.view(body.scenario)).revision
        work = await _work(worker, body, revision, request)
        fields = body.model_dump(mode="json", exclude_none=True, exclude={"recording"})
        if revision is not None:
            fields["revision"] = revision
        new = NewJob("export", _subject(body), fields, who, portable=_is_portable(body))
        info = await worker.jobs.start(new, work, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))


async def rebuild(worker: Worker, info: JobInfo) -> Work:
    """The export of a stored job, with the scenario at its revision."""
    fields = dict(info.request)
    revision = fields.pop("revision", None)
    return await _work(worker, EXPORT_BODY.validate_python(fields), revision, None)


async def _work(
    worker: Worker,
    body: ExportRequest | DatasetRequest,
    revision: int | None,
    request: Request | None,
) -> Work:
    if isinstance(body, DatasetRequest):
        return await _dataset_work(worker, body, revision, request)
    return await _video_work(worker, body, revision)


def _is_portable(body: ExportRequest | DatasetRequest) -> bool:
    """Whether all inputs are in the store and identical for all workers."""
    if isinstance(body, DatasetRequest):
        return body.session is None and body.recording is None
    return body.simulation is None


def _subject(body: ExportRequest | DatasetRequest) -> str:
    other = body.session if isinstance(body, DatasetRequest) else body.simulation
    return body.scenario or body.scene or other or ""


# --- videos -----------------------------------------------------------------------------------


async def _video_work(worker: Worker, body: ExportRequest, revision: int | None) -> Work:
    video_source = await _video_source(worker, body, revision)
    check_camera(video_source, body, max_pixels=worker.settings.max_pixels_per_step)
    frame_times(video_source, body)

    async def work(context: JobContext) -> JobResult:
        return await export_video(video_source, body, renderer=worker.renderer, context=context)

    return work


async def _video_source(
    worker: Worker, request: ExportRequest, revision: int | None
) -> VideoSource:
    if request.simulation is not None:
        return await worker.video_source(request.simulation)
    if request.scenario is not None and revision is not None:
        view = await worker.scenarios.view(request.scenario)
        scene = await worker.scene_cache.get(view.row.scene)
        state = await worker.scenarios.state_at(request.scenario, revision)
    else:
        scene = await worker.scene_cache.get(request.scene or "")
        state = await asyncio.to_thread(ScenarioState.of, scene)
    return VideoSource(scene, lambda t_us: instances_at(scene, state, t_us), state.clock)


# --- data sets --------------------------------------------------------------------------------


async def _dataset_work(
    worker: Worker, body: DatasetRequest, revision: int | None, request: Request | None
) -> Work:
    plan = plan_of(body)
    source = await _dataset_source(worker, body, revision, request)
    max_pixels = worker.settings.max_pixels_per_step
    await asyncio.to_thread(check_dataset, source.variants, plan, max_pixels=max_pixels)
    loop = asyncio.get_running_loop()

    async def work(context: JobContext) -> JobResult:
        backend = EngineBackend(worker.engine, worker.backend, context, loop)
        return await make_dataset(
            source, plan, dry_run=body.dry_run, backend=backend, quota=worker.jobs.quota
        )

    return work


async def _dataset_source(
    worker: Worker, body: DatasetRequest, revision: int | None, request: Request | None
) -> DatasetSource:
    if body.session is not None and request is not None:
        return await _session_source(worker, body.session, request)
    if body.recording is not None:
        recording = await asyncio.to_thread(_read_recording, body.recording)
        return await _episode_source(worker, recording, body.scene or "")
    if body.scenario is not None:
        view = await worker.scenarios.view(body.scenario)
        document = await worker.scenarios.export(body.scenario)
        scene = await worker.scene_cache.get(view.row.scene)
        done = document.entries[:revision]
        entries = [entry.model_dump(mode="json", exclude_none=True) for entry in done]
        assert revision is not None
        state = await worker.scenarios.state_at(body.scenario, revision)
        return await _edited_source(scene, state, body, _made_of(entries))
    scene = await worker.scene_cache.get(body.scene or "")
    state = await asyncio.to_thread(ScenarioState.of, scene)
    return await _edited_source(scene, state, body, {"operations": []})


async def _edited_source(
    scene: Scene, state: ScenarioState, body: DatasetRequest, made_of: dict[str, Any]
) -> DatasetSource:
    if body.sweep is None:
        return DatasetSource([Variant(ScenarioDrive(scene, state))], made_of)
    variants = await asyncio.to_thread(swept, scene, state, body.sweep, body.seed)
    made_of["sweep"] = body.sweep.model_dump(mode="json", exclude_none=True)
    return DatasetSource(variants, made_of)


def _made_of(entries: list[dict[str, Any]]) -> dict[str, Any]:
    """A scenario's history without timestamps: equal edits give equal bytes."""
    if all(entry["kind"] == "edit" for entry in entries):
        return {"operations": [edit for entry in entries for edit in entry["operations"]]}
    kept = ("kind", "operations", "target")
    return {"history": [{k: entry[k] for k in kept if k in entry} for entry in entries]}


async def _session_source(worker: Worker, session_id: str, request: Request) -> DatasetSource:
    row = check_not_closed(await worker.sessions.row(session_id))
    # If the worker requires a token, the route has checked it; it gives access to every session.
    if not worker.accounts.needs_token and not opens_session(bearer_token(request), row):
        error = unauthorized("the data set of a session wants the session's token")
        error.hint = "send 'Authorization: Bearer <token>'; POST /v1/sessions gave the token"
        raise error
    session = await worker.sessions.find(session_id)
    async with session.lock:
        recording = await episode_of(worker.sessions, session)
    return await _episode_source(worker, recording, row.scene)


def _read_recording(text: str) -> Recording:
    try:
        data = base64.b64decode(text, validate=True)
    except ValueError as error:
        raise RecordingError(f"recording: it is not base64 ({error})") from error
    return recording_of_bytes(data, "recording")


async def _episode_source(worker: Worker, recording: Recording, name: str) -> DatasetSource:
    scene = await worker.scene_cache.get(name)
    find = worker.assets.find
    drive = await asyncio.to_thread(lambda: EpisodeDrive.of(recording, scene, assets=find))
    return DatasetSource([Variant(drive)], {"episode": recording.digests[-1]})


# --- Sweeps and searches -------------------------------------------------------------------------

sweeps_router = APIRouter(prefix="/v1/sweeps", tags=["sweeps"], route_class=TokenRoute)


@sweeps_router.post("", name="create", status_code=202, response_model=JobInfo)
async def create_sweep(
    worker: WorkerOf,
    body: SweepRequest,
    request: Request,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Start a sweep: planners drive points of a parameter space; or, with `method` of kind
    `search`, a search for avoidable failures of a planner. The response is a job. Once it has
    succeeded, `GET /v1/jobs/{id}/files/episodes.parquet` has one row per episode. The `worst`
    episodes of the result have `EPISODE.r2e` and, for a scenario, `EPISODE.xosc`. A search writes
    `failures.json`, `failures.tar` with its page, and each failure as `failure_01.xosc` and
    `.r2e`."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.sweeps.start(body, who=who, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))
