"""Scenarios: create, edit, undo, look."""

from __future__ import annotations

import asyncio
import re
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier, Microseconds
from real2sim_proto.jobs import CalibrateRequest, JobInfo, SimulateRequest
from real2sim_proto.scenarios import (
    History,
    OperationBatch,
    OperationResult,
    ScenarioCreate,
    ScenarioDocument,
    ScenarioFork,
    ScenarioInfo,
    ScenarioList,
    ScenarioRename,
)

from ...edit.points import Part, ply_of_points, points_at
from ..http.auth import TokenRoute
from ..http.disconnects import cancel_on_disconnect
from ..http.idempotency import IdempotencyKey, IdempotentRequest
from ..http.problems import ServiceError
from ..http.requests import ClientName
from ..http.responses import etag, info_response, large_response
from ..jobs.jobs import accepted_headers
from ..rendering.responses import FRAME_RESPONSES, frame_response
from ..scenarios.scenarios import created_headers, tag
from ..worker import Worker, WorkerOf
from .frame_query import FrameQueryOf
from .sweep_query import SWEEP_RESPONSES, SweepQueryOf, sweep_response

router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"], route_class=TokenRoute)

IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        description='refuse the change unless the scenario has this ETag, e.g. "r41"',
        examples=['"r41"'],
    ),
]
PLY = "application/octet-stream"
_ETAG = re.compile(r'"r(0|[1-9][0-9]{0,8})"')


@dataclass(frozen=True)
class Change:
    """What a request that changes a scenario may carry."""

    request: Request
    if_match: str | None
    idempotency_key: str | None
    who: str

    @property
    def expected(self) -> int | None:
        """Revision that the change was made for. Raises ServiceError: INVALID_REQUEST."""
        return expected_revision(self.if_match)

    def guard(self, worker: Worker) -> AbstractAsyncContextManager[IdempotentRequest]:
        """See :meth:`Idempotency.guard`."""
        return worker.idempotency.guard(self.request, self.idempotency_key)


async def _change_of(
    request: Request,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Change:
    return Change(request, if_match, idempotency_key, who)


ChangeOf = Annotated[Change, Depends(_change_of)]


@router.post("", status_code=201, response_model=ScenarioInfo)
async def create(
    worker: WorkerOf, body: ScenarioCreate, request: Request, idempotency_key: IdempotencyKey = None
) -> Response:
    """A new scenario on a scene; it is stored and survives a restart."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.scenarios.create(body, idempotent=idempotent)
        return info_response(info, status=201, headers=created_headers(info))


@router.get("")
async def list_scenarios(worker: WorkerOf) -> ScenarioList:
    """All scenarios of this worker, oldest first, without their objects."""
    return ScenarioList(scenarios=await worker.scenarios.list())


@router.post("/import", status_code=201, response_model=ScenarioInfo)
async def import_(
    worker: WorkerOf,
    body: ScenarioDocument,
    request: Request,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A new scenario from a file that `GET .../export` gave, here or elsewhere.

    Its scene is found by hash. The whole history comes along, undo and redo included.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.scenarios.import_(body, idempotent=idempotent)
        return info_response(info, status=201, headers=created_headers(info))


@router.get("/{scenario_id}", response_model=ScenarioInfo)
async def describe(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """One scenario with all its objects as they are now."""
    view = await worker.scenarios.view(scenario_id)
    return await large_response(view.info, headers={"ETag": etag(view.revision)})


@router.patch("/{scenario_id}", response_model=ScenarioInfo)
async def rename(worker: WorkerOf, scenario_id: Identifier, body: ScenarioRename) -> Response:
    """Give a scenario another name; its id and its history stay."""
    view = await worker.scenarios.rename(scenario_id, body.name)
    return await large_response(view.info, headers={"ETag": etag(view.revision)})


@router.delete("/{scenario_id}", status_code=204, response_class=Response)
async def delete(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """Remove a scenario and its history. Sessions that began from it go on."""
    await worker.scenarios.delete(scenario_id)
    return Response(status_code=204)


@router.post("/{scenario_id}/operations", response_model=OperationResult)
async def edit(
    worker: WorkerOf,
    scenario_id: Identifier,
    body: OperationBatch,
    change: ChangeOf,
) -> Response:
    """Apply a batch of operations, all or none; 412 with the missed entries when it is stale."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await worker.scenarios.edit(
            scenario_id,
            body.operations,
            expected=change.expected,
            dry_run=body.dry_run,
            idempotent=idempotent,
            who=change.who,
        )
        return info_response(result, headers=tag(result))


@router.get("/{scenario_id}/operations")
async def history(
    worker: WorkerOf, scenario_id: Identifier, after: Annotated[int, Query(ge=0)] = 0
) -> History:
    """Revisions behind ``after``, oldest first."""
    return await worker.scenarios.history(scenario_id, after=after)


@router.post("/{scenario_id}/undo", response_model=OperationResult)
async def undo(
    worker: WorkerOf,
    scenario_id: Identifier,
    change: ChangeOf,
) -> Response:
    """Take back the last batch that is in effect."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await worker.scenarios.undo(
            scenario_id, expected=change.expected, idempotent=idempotent, who=change.who
        )
        return info_response(result, headers=tag(result))


@router.post("/{scenario_id}/redo", response_model=OperationResult)
async def redo(
    worker: WorkerOf,
    scenario_id: Identifier,
    change: ChangeOf,
) -> Response:
    """Bring back the last batch that was undone."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await worker.scenarios.redo(
            scenario_id, expected=change.expected, idempotent=idempotent, who=change.who
        )
        return info_response(result, headers=tag(result))


@router.post("/{scenario_id}/fork", status_code=201, response_model=ScenarioInfo)
async def fork(
    worker: WorkerOf,
    scenario_id: Identifier,
    request: Request,
    body: ScenarioFork | None = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A new scenario with the same history, up to a revision; the two go separate ways."""
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.scenarios.fork(
            scenario_id, body or ScenarioFork(), idempotent=idempotent
        )
        return info_response(info, status=201, headers=created_headers(info))


@router.post("/{scenario_id}/simulate", status_code=202, response_model=JobInfo)
async def simulate(  # noqa: PLR0917, one parameter for each part of the request
    worker: WorkerOf,
    scenario_id: Identifier,
    request: Request,
    body: SimulateRequest | None = None,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Let physics move the scenario as it is now; the answer is a job.

    Once it has succeeded, its result has contacts and figures, its file `playback.json` poses and
    energies of every frame; `GET /v1/jobs/{id}/preview` shows it, `POST /v1/exports` films it.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.simulations.start(
            scenario_id, body or SimulateRequest(), who=who, idempotent=idempotent
        )
        return info_response(info, status=202, headers=accepted_headers(info))


@router.post("/{scenario_id}/calibrate", status_code=202, response_model=JobInfo)
async def calibrate(  # noqa: PLR0917, one parameter for each part of the request
    worker: WorkerOf,
    scenario_id: Identifier,
    request: Request,
    body: CalibrateRequest,
    idempotency_key: IdempotencyKey = None,
    who: ClientName = "",
) -> Response:
    """Find values of an object with which a simulation shows what was seen of it; a job.

    Its result has `factors` on what was given, `uncertainty` of each (what observations leave open
    and what cells do, together), `values` where a factor makes one, and in `untold` the parameters
    that these observations say nothing about.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.calibrations.start(scenario_id, body, who=who, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))


@router.get("/{scenario_id}/export", response_model=ScenarioDocument)
async def export(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """The scenario with its whole history as one JSON file that names its scene by hash."""
    document = await worker.scenarios.export(scenario_id)
    name = f"{scenario_id}.scenario.json"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return await large_response(lambda: document, headers=headers)


@router.get("/{scenario_id}/preview", responses=FRAME_RESPONSES, response_class=Response)
async def preview(
    worker: WorkerOf, scenario_id: Identifier, query: FrameQueryOf, request: Request
) -> Response:
    """One frame of the scenario as it is now, from where the recording vehicle was at ``t_us``."""
    media_type = query.media_type()
    view = await worker.scenarios.view(scenario_id)
    scene = await worker.scene_cache.get(view.row.scene)
    render_request = await asyncio.to_thread(query.render_request, scene, view.state, media_type)
    rendered = await cancel_on_disconnect(request, worker.renderer.render(render_request))
    return frame_response(rendered, media_type, revision=view.revision)


@router.get(
    "/{scenario_id}/points",
    response_class=Response,
    responses={
        200: {
            "description": "a binary ply file",
            "content": {PLY: {"schema": {"type": "string", "format": "binary"}}},
        }
    },
)
async def points(
    worker: WorkerOf,
    scenario_id: Identifier,
    t_us: Annotated[Microseconds | None, Query(description="default: its start")] = None,
    part: Annotated[Part, Query(description="of the scene")] = "all",
) -> Response:
    """The centres of the Gaussians of the scenario as it is now at an instant: a point cloud with
    colour, normal, semantic class and instance. Faint ones are left out."""
    view = await worker.scenarios.view(scenario_id)
    scene = await worker.scene_cache.get(view.row.scene)
    first, last = view.state.clock
    instant = first if t_us is None else t_us
    if not first <= instant <= last:
        raise ServiceError(
            ErrorCode.TIME_OUT_OF_RANGE, f"t_us {instant}; the scenario has {first} to {last} us"
        )

    def made() -> bytes:
        return b"".join(ply_of_points(points_at(scene, view.state, instant, part=part)))

    name = f"{scenario_id}.ply"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return Response(await asyncio.to_thread(made), media_type=PLY, headers=headers)


@router.get("/{scenario_id}/sweep", responses=SWEEP_RESPONSES, response_class=Response)
async def sweep(
    worker: WorkerOf, scenario_id: Identifier, query: SweepQueryOf, request: Request
) -> Response:
    """What a LiDAR of the catalogue measures in the scenario as it is now, on the recording
    vehicle; its last ray is fired at ``t_us``."""
    media_type = query.media_type()
    mounted = await asyncio.to_thread(query.mounted)
    view = await worker.scenarios.view(scenario_id)
    scene = await worker.scene_cache.get(view.row.scene)
    cloud = await cancel_on_disconnect(
        request,
        worker.sessions.pipeline.recorded_sweep(
            scene, view.state, mounted, query.instant(view.state)
        ),
    )
    return await asyncio.to_thread(sweep_response, cloud, media_type, revision=view.revision)


def expected_revision(if_match: str | None) -> int | None:
    """Revision that ``If-Match`` names; None where any will do.

    Raises:
        ServiceError: INVALID_REQUEST for anything but ``"r<number>"`` or ``*``.
    """
    if if_match is None or if_match.strip() == "*":
        return None
    match = _ETAG.fullmatch(if_match.strip())
    if match is None:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f'If-Match {if_match!r} is no revision of ours; it looks like "r41", quotes included',
            hint="send the ETag of the last answer unchanged",
        )
    return int(match.group(1))
