"""Gaussians and skies of scenes and objects, for programs that draw them themselves."""

from __future__ import annotations

import asyncio
import hashlib
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Header, Query, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier, Microseconds

from ...edit import cloud_of, figure_of
from ...render.modalities import encode_image
from ...scene import Scene
from ...scene.io.spz import Spz
from ..http.auth import TokenRoute
from ..http.problems import ServiceError
from ..http.responses import etag
from ..library.splat_files import GZIP_LEVEL
from ..worker import WorkerOf

# --- Scenes --------------------------------------------------------------------------------------

SPZ = "application/octet-stream"
DEFAULT_COUNT = 32_768
MAX_COUNT = 262_144

router = APIRouter(prefix="/v1", tags=["scenes"], route_class=TokenRoute)

KnownHash = Annotated[
    str | None,
    Query(
        max_length=64,
        description="the scene's `content_hash`: the answer may then be kept for ever; "
        "404 where it is another scene by now",
    ),
]
IfNoneMatch = Annotated[str | None, Header(description="304 where the ETag is still this one")]


@router.get(
    "/scenes/{scene}/splats",
    response_class=Response,
    responses={
        200: {
            "description": "an spz file of version 3",
            "headers": {
                "X-Real2Sim-Total": {
                    "description": "Gaussians there are",
                    "schema": {"type": "integer"},
                },
                "X-Real2Sim-Figure": {
                    "description": "`rest`: of a person who walks, who is sent in the rest pose",
                    "schema": {"type": "string"},
                },
            },
            "content": {SPZ: {"schema": {"type": "string", "format": "binary"}}},
        },
        304: {"description": "the client has it"},
    },
)
async def splats(
    *,
    worker: WorkerOf,
    scene: Identifier,
    object_id: Annotated[
        Identifier | None, Query(description="of which, in its own frame; default: background")
    ] = None,
    first: Annotated[int, Query(ge=0, description="how many more important ones to skip")] = 0,
    count: Annotated[int, Query(ge=1, le=MAX_COUNT, description="at most")] = DEFAULT_COUNT,
    content_hash: KnownHash = None,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """Gaussians of the background (world frame) or of one object (its box's frame), those that
    cover most first, as an spz file; axes are kept: z is up."""
    resident = await worker.scene_cache.get(scene)
    headers = _caching(resident, content_hash, f"splats {object_id} {first} {count}")
    subject = None if object_id is None else resident.object(object_id)
    cloud = resident.background if subject is None else subject.cloud
    if subject is not None and subject.figure is not None:
        headers["X-Real2Sim-Figure"] = "rest"
    headers["X-Real2Sim-Total"] = str(len(cloud))
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)

    known = (resident.content_hash, object_id or "")
    file = await asyncio.to_thread(worker.splat_files.part, cloud, known, first, count)
    return Response(file, media_type=SPZ, headers=headers)


@router.get(
    "/scenes/{scene}/sky",
    response_class=Response,
    responses={
        200: {
            "description": "picture",
            "content": {"image/png": {"schema": {"type": "string", "format": "binary"}}},
        },
        304: {"description": "the client has it"},
        404: {"description": "the scene has no sky"},
    },
)
async def sky(
    worker: WorkerOf,
    scene: Identifier,
    content_hash: KnownHash = None,
    if_none_match: IfNoneMatch = None,
) -> Response:
    """The cube map of the sky: six faces side by side, +x -x +y -y +z -z of the world; at u, v in
    [-1, 1] (right, down) they look along (1, -u, -v), (-1, u, -v), (u, 1, -v), (-u, -1, -v),
    (v, -u, 1), (-v, -u, -1)."""
    resident = await worker.scene_cache.get(scene)
    headers = _caching(resident, content_hash, "sky")
    if resident.sky is None:
        raise ServiceError(ErrorCode.NOT_FOUND, f"scene {scene!r} has no sky", hint="it is black")
    if if_none_match == headers["ETag"]:
        return Response(status_code=304, headers=headers)
    faces = resident.sky.faces

    def made() -> bytes:
        strip = np.concatenate(list(faces.cpu().numpy()), axis=1)
        pixels = np.rint(np.clip(strip, 0, 1) * 255).astype(np.uint8)
        return encode_image(pixels, "rgb", "png").data

    return Response(await asyncio.to_thread(made), media_type="image/png", headers=headers)


def _caching(scene: Scene, content_hash: str | None, what: str) -> dict[str, str]:
    """Headers that say for how long an answer holds. Raises ServiceError: NOT_FOUND."""
    if content_hash is not None and content_hash != scene.content_hash:
        raise ServiceError(
            ErrorCode.NOT_FOUND,
            f"scene {scene.name!r} with content_hash {content_hash!r} is not here; "
            f"it has {scene.content_hash!r}",
            hint="read the scene again",
        )
    tag = hashlib.sha256(f"{scene.content_hash} {what}".encode()).hexdigest()[:32]
    kept = "private, max-age=31536000, immutable" if content_hash else "private, no-cache"
    return {"ETag": f'"{tag}"', "Cache-Control": kept}


object_router = APIRouter(prefix="/v1/scenarios", tags=["scenarios"], route_class=TokenRoute)


@object_router.get(
    "/{scenario_id}/splats",
    name="splats",
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
async def object_splats(
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
