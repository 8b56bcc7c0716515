"""What happens in a scenario: its storyboard as JSON and as OpenSCENARIO, and the gallery."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Annotated, TypeVar

from fastapi import APIRouter, Body, Query, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier
from real2sim_proto.operations import SetStoryboard
from real2sim_proto.scenarios import (
    CornerCaseChoice,
    CornerCaseInfo,
    Gallery,
    OperationResult,
    StoryboardResult,
)
from real2sim_proto.storyboard import Storyboard

from ...scenarios.errors import ScenarioError
from ...scenarios.fit import fitted_to_scene
from ...scenarios.gallery import GALLERY, corner_case
from ...scenarios.gallery.pictures import shipped
from ...scenarios.openscenario import ReadOptions, read_openscenario_text, write_openscenario
from ..http.auth import TokenRoute
from ..http.idempotency import IdempotentRequest
from ..http.problems import ServiceError
from ..http.responses import etag, info_response
from ..scenarios.scenarios import tag
from ..worker import Worker, WorkerOf
from .scenarios import Change, ChangeOf

router = APIRouter(prefix="/v1", tags=["storyboards"], route_class=TokenRoute)

XOSC, SVG = "application/xml", "image/svg+xml"
T = TypeVar("T")


@router.get("/gallery")
async def gallery() -> Gallery:
    """Ready corner cases; `POST /v1/scenarios/{id}/corner-case` takes one over."""
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


@router.get(
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
    """A corner case from above: who comes from where, and where an ego that goes straight on at
    10 m/s (blue) meets them."""
    if case not in GALLERY:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"the gallery has no {case!r}",
            hint=f"GET /v1/gallery lists them: {', '.join(GALLERY)}",
        )
    content = await asyncio.to_thread(shipped, case)
    headers = {"Cache-Control": "private, max-age=3600"}
    return Response(content, media_type=SVG, headers=headers)


@router.post("/scenarios/{scenario_id}/corner-case", response_model=OperationResult)
async def apply_corner_case(
    worker: WorkerOf, scenario_id: Identifier, body: CornerCaseChoice, change: ChangeOf
) -> Response:
    """Let a corner case of the gallery be what happens in the scenario; an edit as others are."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        board = await _read(lambda: corner_case(body.name).storyboard(**body.parameters))
        result = await _set(worker, scenario_id, board, change, idempotent)
        return info_response(result, headers=tag(result))


@router.get("/scenarios/{scenario_id}/storyboard", response_model=Storyboard | None)
async def describe(worker: WorkerOf, scenario_id: Identifier) -> Response:
    """What happens in sessions of the scenario; null where nothing is written."""
    view = await worker.scenarios.view(scenario_id)
    board = view.state.storyboard
    content = "null" if board is None else await asyncio.to_thread(board.model_dump_json)
    headers = {"ETag": etag(view.revision)}
    return Response(content, headers=headers, media_type="application/json")


@router.put("/scenarios/{scenario_id}/storyboard", response_model=OperationResult)
async def replace(
    worker: WorkerOf, scenario_id: Identifier, body: Storyboard, change: ChangeOf
) -> Response:
    """Say what happens in sessions of the scenario, unless a reset brings a storyboard of its own;
    an edit as others are, to be undone."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await _set(worker, scenario_id, body, change, idempotent)
        return info_response(result, headers=tag(result))


@router.delete("/scenarios/{scenario_id}/storyboard", response_model=OperationResult)
async def remove(worker: WorkerOf, scenario_id: Identifier, change: ChangeOf) -> Response:
    """Let nothing happen in sessions of the scenario; an edit as others are."""
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        result = await _set(worker, scenario_id, None, change, idempotent)
        return info_response(result, headers=tag(result))


@router.get(
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
    """What happens in the scenario as an OpenSCENARIO file."""
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


@router.put("/scenarios/{scenario_id}/storyboard.xosc", response_model=StoryboardResult)
async def import_xosc(  # noqa: PLR0917, one parameter for each part of the request
    worker: WorkerOf,
    scenario_id: Identifier,
    body: Annotated[bytes, Body(media_type=XOSC)],
    change: ChangeOf,
    leave_out: Annotated[
        list[str] | None, Query(max_length=100, description="elements of the file to leave out")
    ] = None,
    ego: Annotated[
        str | None, Query(max_length=200, description="entity that is the ego; default: Ego")
    ] = None,
) -> Response:
    """Say what happens in the scenario by an OpenSCENARIO 1.0 to 1.3 file without catalogs.

    Its roads are laid along the recorded drive, so that the ego begins where it was recorded. What
    is not supported is refused by its name and line.
    """
    async with change.guard(worker) as idempotent:
        if idempotent.replay:
            return worker.replayed(idempotent.replay)
        view = await worker.scenarios.view(scenario_id)
        options = ReadOptions(leave_out=frozenset(leave_out or ()), ego=ego)

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
    """What a file or the gallery gives, on another thread. Raises ServiceError."""
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
