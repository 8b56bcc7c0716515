"""Scenes: what there is, what is in memory, single frames."""

from __future__ import annotations

from fastapi import APIRouter, Response

from real2sim_proto.base import Identifier
from real2sim_proto.scenes import SceneInfo, SceneList

from ...edit import ScenarioState
from ..answers import FRAME_RESPONSES, frame_response, info_response
from ..views import scene_info
from ..worker import WorkerOf
from .frame_query import FrameQueryOf

router = APIRouter(prefix="/v1", tags=["scenes"])


@router.get("/scenes")
async def list_scenes(worker: WorkerOf) -> SceneList:
    """Every scene below the worker's scene folder, resident or not, broken ones with the reason."""
    residency = worker.residency
    return SceneList(
        scenes=[
            scene_info(item, residency.state(name), summary=item.summary, tracks=False)
            for name, item in (await residency.refresh()).items()
        ]
    )


@router.get("/scenes/{scene}", response_model=SceneInfo)
async def describe(worker: WorkerOf, scene: Identifier) -> Response:
    """One scene with cameras, objects and their trajectories, extent and the recorded ego path."""
    return await scene_response(worker, scene)


@router.put("/scenes/{scene}/residency", response_model=SceneInfo)
async def load(worker: WorkerOf, scene: Identifier) -> Response:
    """Load a scene into memory; answers when it is there, 507 when the budget does not allow it."""
    await worker.residency.get(scene)
    return await scene_response(worker, scene)


@router.delete("/scenes/{scene}/residency", response_model=SceneInfo)
async def unload(worker: WorkerOf, scene: Identifier) -> Response:
    """Take a scene out of memory; 409 while sessions use it."""
    await worker.residency.unload(scene)
    return await scene_response(worker, scene)


@router.get("/scenes/{scene}/render", responses=FRAME_RESPONSES, response_class=Response)
async def render(worker: WorkerOf, scene: Identifier, asked: FrameQueryOf) -> Response:
    """One frame of the unedited scene, from where the recording vehicle was at ``t_us``."""
    media_type = asked.media_type()
    resident = await worker.residency.get(scene)
    shot = asked.shot(resident, ScenarioState.of(resident), media_type)
    return frame_response(await worker.pictures.take(shot), media_type)


async def scene_response(
    worker: WorkerOf, scene: str, *, status: int = 200, headers: dict[str, str] | None = None
) -> Response:
    """The full description of one scene."""
    listing = await worker.residency.listing(scene)
    state = worker.residency.state(scene)
    summary = await worker.residency.summary(scene) if listing.summary else None
    info = scene_info(listing, state, summary=summary, tracks=True)
    return info_response(info, status=status, headers=headers)
