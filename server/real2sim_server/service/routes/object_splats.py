"""An object of a scenario for programs that draw it themselves: its Gaussians as they are now."""

from __future__ import annotations

import asyncio
from typing import Annotated

from fastapi import APIRouter, Query, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier, Microseconds

from ...edit import cloud_of, figure_of
from ...scene.io.formats import Spz
from ..http.auth import TokenRoute
from ..http.problems import ServiceError
from ..http.responses import etag
from ..library.splat_files import GZIP_LEVEL
from ..worker import WorkerOf
from .scene_splats import SPZ

router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"], route_class=TokenRoute)


@router.get(
    "/{scenario_id}/splats",
    response_class=Response,
    responses={
        200: {
            "description": "an spz file of version 3",
            "headers": {
                "X-Real2Sim-Figure": {
                    "description": "`posed`: of a person who walks, at this instant",
                    "schema": {"type": "string"},
                },
            },
            "content": {SPZ: {"schema": {"type": "string", "format": "binary"}}},
        },
    },
)
async def splats(
    *,
    worker: WorkerOf,
    scenario_id: Identifier,
    object_id: Annotated[Identifier, Query(description="of which, in the frame of its box")],
    t_us: Annotated[Microseconds | None, Query(description="default: its start")] = None,
) -> Response:
    """The Gaussians of one object of a scenario as it is now, those that cover most first: of an
    asset, of a person as far in walking as at ``t_us``, as large as edits have made it. An spz file
    in the frame of its box; axes are kept: z is up."""
    view = await worker.scenarios.view(scenario_id)
    scene = await worker.scene_cache.get(view.row.scene)
    subject = next((o for o in view.state.visible if o.object_id == object_id), None)
    if subject is None:
        raise ServiceError(
            ErrorCode.UNKNOWN_OBJECT,
            f"scenario {scenario_id!r} has no object {object_id!r}",
            hint="GET /v1/scenarios/{id} lists them",
        )
    instant = view.state.clock[0] if t_us is None else t_us
    headers = {"Cache-Control": "no-store", "ETag": etag(view.revision)}
    if figure_of(scene, subject) is not None:
        headers["X-Real2Sim-Figure"] = "posed"

    def made() -> bytes:
        cloud = cloud_of(scene, subject, instant)
        if subject.scale != (1.0, 1.0, 1.0):
            cloud = cloud.stretched(subject.scale)
        return Spz(gzip_level=GZIP_LEVEL).encode(cloud.select(cloud.by_importance()))

    return Response(await asyncio.to_thread(made), media_type=SPZ, headers=headers)
