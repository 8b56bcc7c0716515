"""Scenarios: create, edit, undo, query; their storyboards and the gallery of corner cases."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Annotated, TypeVar

from fastapi import APIRouter, Body, Depends, Header, Query, Request, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier, Microseconds
from real2sim_proto.jobs import CalibrateRequest, JobInfo, SimulateRequest
from real2sim_proto.operations import SetStoryboard
from real2sim_proto.scenarios import (
    CornerCaseChoice,
    CornerCaseInfo,
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
from real2sim_proto.storyboard import Storyboard

from ...edit.compose import Part, ply_of_points, points_at
from ...scenarios import ScenarioError
from ...scenarios.flat_scene import fitted_to_scene
from ...scenarios.gallery import GALLERY, corner_case, shipped_picture
from ...scenarios.openscenario import ReadOptions, read_openscenario_text, write_openscenario
from ..http.auth import TokenRoute
from ..http.requests import ClientName, IdempotencyKey, IdempotentRequest
from ..http.responses import ServiceError, cancel_on_disconnect, etag, info_response, large_response
from ..jobs import accepted_headers
from ..renderer import FRAME_RESPONSES, frame_response
from ..scenarios import created_headers, tag
from ..worker import Worker, WorkerOf
from .queries import SWEEP_RESPONSES, FrameQueryOf, SweepQueryOf, sweep_response

router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"], route_class=TokenRoute)

IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        description='reject the change unless the scenario has this ETag, e.g. "r41"',
        examples=['"r41"'],
    ),
]
PLY = "application/octet-stream"
_ETAG = re.compile(r'"r(0|[1-9][0-9]{0,8})"')


@dataclass(frozen=True)
class Change:
    """Optional parts of a request that changes a scenario."""

    request: Request
    if_match: str | None
    idempotency_key: str | None
    who: str

    @property
    def expected(self) -> int | None:
        """Revision that the change is based on. Raises ServiceError: INVALID_REQUEST."""
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
    """Create a scenario on a scene; it is stored and survives a restart."""
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
    """Create a scenario from a file of `GET .../export`, of this or another worker.

    Its scene is identified by hash. The whole history is included, with undo and redo.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.scenarios.import_(body, idempotent=idempotent)
        return info_response(info, status=201, headers=created_headers(info))


@router.get("/{scenario_id}", response_model=ScenarioInfo)
async def describe(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """One scenario with all its current objects."""
    view = await worker.scenarios.view(scenario_id)
    return await large_response(view.info, headers={"ETag": etag(view.revision)})


@router.patch("/{scenario_id}", response_model=ScenarioInfo)
async def rename(worker: WorkerOf, scenario_id: Identifier, body: ScenarioRename) -> Response:
    """Rename a scenario; its id and its history do not change."""
    view = await worker.scenarios.rename(scenario_id, body.name)
    return await large_response(view.info, headers={"ETag": etag(view.revision)})


@router.delete("/{scenario_id}", status_code=204, response_class=Response)
async def delete(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """Delete a scenario and its history. Sessions that started from it continue."""
    await worker.scenarios.delete(scenario_id)
    return Response(status_code=204)


@router.post("/{scenario_id}/operations", response_model=OperationResult)
async def edit(
    worker: WorkerOf,
    scenario_id: Identifier,
    body: OperationBatch,
    change: ChangeOf,
) -> Response:
    """Apply a batch of operations, all or none; 412 with the missed entries if it is stale."""
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
    """Revisions after ``after``, oldest first."""
    return await worker.scenarios.history(scenario_id, after=after)


@router.post("/{scenario_id}/undo", response_model=OperationResult)
async def undo(
    worker: WorkerOf,
    scenario_id: Identifier,
    change: ChangeOf,
) -> Response:
    """Undo the last batch that is in effect."""
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
    """Redo the last batch that was undone."""
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
    """Create an independent scenario with the same history, up to a revision."""
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
    """Start a physics rollout of the current scenario; the response is a job.

    Once it has succeeded, its result has contacts and figures, and its file `playback.json` has
    poses and energies of every frame. `GET /v1/jobs/{id}/preview` shows it, `POST /v1/exports`
    exports a video.
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
    """Fit physics parameters of an object to observations of it; the response is a job.

    Its result has `factors` on the initial values, the `uncertainty` of each (of observations and
    cell size together), `values` where a factor applies to a known value, and in `untold` the
    parameters that these observations do not determine.
    """
    async with worker.idempotency.guard(request, idempotency_key) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        info = await worker.calibrations.start(scenario_id, body, who=who, idempotent=idempotent)
        return info_response(info, status=202, headers=accepted_headers(info))


@router.get("/{scenario_id}/export", response_model=ScenarioDocument)
async def export(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """The scenario with its whole history as one JSON file that refers to its scene by hash."""
    document = await worker.scenarios.export(scenario_id)
    name = f"{scenario_id}.scenario.json"
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return await large_response(lambda: document, headers=headers)


@router.get("/{scenario_id}/preview", responses=FRAME_RESPONSES, response_class=Response)
async def preview(
    worker: WorkerOf, scenario_id: Identifier, query: FrameQueryOf, request: Request
) -> Response:
    """One frame of the current scenario, from the recording vehicle's pose at ``t_us``."""
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
    t_us: Annotated[
        Microseconds | None, Query(description="default: start of the scenario")
    ] = None,
    part: Annotated[Part, Query(description="part of the scene")] = "all",
) -> Response:
    """The centres of the Gaussians of the current scenario at a time: a point cloud with colour,
    normal, semantic class and instance. Faint Gaussians are omitted."""
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
    """Simulate a sweep of a LiDAR of the catalogue in the current scenario, on the recording
    vehicle; ``t_us`` is the time of its last ray."""
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
    """Revision in ``If-Match``; None if any is accepted.

    Raises:
        ServiceError: INVALID_REQUEST for values other than ``"r<number>"`` or ``*``.
    """
    if if_match is None or if_match.strip() == "*":
        return None
    match = _ETAG.fullmatch(if_match.strip())
    if match is None:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f'If-Match {if_match!r} is not a revision; revisions look like "r41", with the quotes',
            hint="send the ETag of the last answer unchanged",
        )
    return int(match.group(1))


# --- Storyboards ---------------------------------------------------------------------------------

storyboards_router = APIRouter(prefix="/v1", tags=["storyboards"], route_class=TokenRoute)

XOSC, SVG = "application/xml", "image/svg+xml"
T = TypeVar("T")


@storyboards_router.get("/gallery")
async def gallery() -> Gallery:
    """Predefined corner cases; apply one with `POST /v1/scenarios/{id}/corner-case`."""
    return Gallery(
        cases=[
            CornerCaseInfo(
                name=case.name,
                title=case.title,
                family=case.family,
                parameters=dict(case.parameters),
                picture=f"/v1/gallery/{case.name}/picture",
            )
            for case in GALLERY.values()
        ]
    )


@storyboards_router.get(
    "/gallery/{case}/picture",
    response_class=Response,
    responses={
        200: {
            "description": "an SVG document, three times as wide as it is high",
            "content": {SVG: {"schema": {"type": "string"}}},
        }
    },
)
async def picture(case: Identifier) -> Response:
    """A corner case from above: the paths of the road users, and where they meet an ego that
    drives straight on at 10 m/s (blue)."""
    if case not in GALLERY:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"the gallery has no {case!r}",
            hint=f"GET /v1/gallery lists them: {', '.join(GALLERY)}",
        )
    content = await asyncio.to_thread(shipped_picture, case)
    headers = {"Cache-Control": "private, max-age=3600"}
    return Response(content, media_type=SVG, headers=headers)


@storyboards_router.post("/scenarios/{scenario_id}/corner-case", response_model=OperationResult)
async def apply_corner_case(
    worker: WorkerOf, scenario_id: Identifier, body: CornerCaseChoice, change: ChangeOf
) -> Response:
    """Apply a corner case of the gallery to the scenario; an edit, which can be undone."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        board = await _read(lambda: corner_case(body.name).storyboard(**body.parameters))
        result = await _set(worker, scenario_id, board, change, idempotent)
        return info_response(result, headers=tag(result))


@storyboards_router.get(
    "/scenarios/{scenario_id}/storyboard", name="describe", response_model=Storyboard | None
)
async def describe_storyboard(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """Storyboard of the scenario's sessions; null if there is none."""
    view = await worker.scenarios.view(scenario_id)
    board = view.state.storyboard
    content = "null" if board is None else await asyncio.to_thread(board.model_dump_json)
    headers = {"ETag": etag(view.revision)}
    return Response(content, headers=headers, media_type="application/json")


@storyboards_router.put("/scenarios/{scenario_id}/storyboard", response_model=OperationResult)
async def replace(
    worker: WorkerOf, scenario_id: Identifier, body: Storyboard, change: ChangeOf
) -> Response:
    """Set the storyboard of the scenario's sessions, unless a reset sets its own; an edit, which
    can be undone."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await _set(worker, scenario_id, body, change, idempotent)
        return info_response(result, headers=tag(result))


@storyboards_router.delete("/scenarios/{scenario_id}/storyboard", response_model=OperationResult)
async def remove(worker: WorkerOf, scenario_id: Identifier, change: ChangeOf) -> Response:
    """Remove the storyboard of the scenario; an edit, which can be undone."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await _set(worker, scenario_id, None, change, idempotent)
        return info_response(result, headers=tag(result))


@storyboards_router.get(
    "/scenarios/{scenario_id}/storyboard.xosc",
    response_class=Response,
    responses={
        200: {
            "description": "an OpenSCENARIO 1.3 file",
            "content": {XOSC: {"schema": {"type": "string"}}},
        }
    },
)
async def export_xosc(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """The scenario's storyboard as an OpenSCENARIO file."""
    view = await worker.scenarios.view(scenario_id)
    board = view.state.storyboard
    if board is None:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"nothing is written that happens in scenario {scenario_id!r}",
            hint="PUT .../storyboard.xosc a file, or POST .../corner-case a case of the gallery",
        )
    content = await _read(lambda: write_openscenario(board))
    name = f"{scenario_id}.xosc"
    headers = {
        "Content-Disposition": f'attachment; filename="{name}"',
        "ETag": etag(view.revision),
    }
    return Response(content, headers=headers, media_type=XOSC)


@storyboards_router.put("/scenarios/{scenario_id}/storyboard.xosc", response_model=StoryboardResult)
async def import_xosc(  # noqa: PLR0917, one parameter for each part of the request
    worker: WorkerOf,
    scenario_id: Identifier,
    body: Annotated[bytes, Body(media_type=XOSC)],
    change: ChangeOf,
    leave_out: Annotated[
        list[str] | None, Query(max_length=100, description="elements of the file to leave out")
    ] = None,
    ego: Annotated[
        str | None, Query(max_length=200, description="name of the ego entity; default: Ego")
    ] = None,
    strict: Annotated[
        bool, Query(description="refuse elements without effect instead of noting them")
    ] = False,
) -> Response:
    """Set the storyboard from an OpenSCENARIO 1.0 to 1.3 file without catalogs.

    Its roads are aligned with the recorded drive, so the ego starts where it was recorded.
    Unsupported elements are refused with their name and line.
    """
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        view = await worker.scenarios.view(scenario_id)
        options = ReadOptions(leave_out=frozenset(leave_out or ()), ego=ego, strict=strict)

        def read() -> tuple[Storyboard, tuple[str, ...]]:
            found = read_openscenario_text(body, "storyboard.xosc", options)
            start_us = view.state.clock[0]
            return fitted_to_scene(found.board, view.summary, start_us=start_us), found.notes

        board, notes = await _read(read)
        result = await _set(worker, scenario_id, board, change, idempotent)
        told = StoryboardResult(**dict(result), notes=list(notes))
        return info_response(told, headers=tag(result))


async def _set(
    worker: Worker,
    scenario_id: str,
    board: Storyboard | None,
    change: Change,
    idempotent: IdempotentRequest,
) -> OperationResult:
    return await worker.scenarios.edit(
        scenario_id,
        [SetStoryboard(storyboard=board)],
        expected=change.expected,
        dry_run=False,
        idempotent=idempotent,
        who=change.who,
    )


async def _read(made: Callable[[], T]) -> T:
    """Read a file or the gallery on another thread. Raises ServiceError."""
    try:
        return await asyncio.to_thread(made)
    except ScenarioError as error:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            str(error),
            hint="leave_out=NAME takes an element out by its name",
        ) from error
    except ValueError as error:
        raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error
