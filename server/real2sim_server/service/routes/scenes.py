"""Scenes: what there is, what is in memory, single frames."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from real2sim_proto.base import Identifier
from real2sim_proto.scenes import SceneInfo, SceneList

from ...edit import ScenarioState
from ..answers import FRAME_RESPONSES, frame_response, large_response
from ..disconnects import unless_gone
from ..views import scene_info
from ..worker import WorkerOf
from .frame_query import FrameQueryOf

router = APIRouter(prefix="/v1", tags=["scenes"])


@router.get("/scenes", response_model=SceneList)
async def list_scenes(worker: WorkerOf) -> Response:
    """Every scene below the worker's scene folder, resident or not, broken ones with the reason."""
    residency = worker.residency
    listed = [(item, residency.state(name)) for name, item in (await residency.refresh()).items()]

    def build() -> SceneList:
        infos = [scene_info(i, state, summary=i.summary, tracks=False) for i, state in listed]
        return SceneList(scenes=infos)

    return await large_response(build)


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
async def render(
    worker: WorkerOf, scene: Identifier, asked: FrameQueryOf, request: Request
) -> Response:
    """One frame of the unedited scene, from where the recording vehicle was at ``t_us``."""
    media_type = asked.media_type()
    resident = await worker.residency.get(scene)
    shot = asked.shot(resident, ScenarioState.of(resident), media_type)
    pictured = await unless_gone(request, worker.pictures.take(shot))
    return frame_response(pictured, media_type)


async def scene_response(
    worker: WorkerOf, scene: str, *, status: int = 200, headers: dict[str, str] | None = None
) -> Response:
    """The full description of one scene."""
    listing = await worker.residency.listing(scene)
    state = worker.residency.state(scene)
    summary = await worker.residency.summary(scene) if listing.summary else None
    return await large_response(
        lambda: scene_info(listing, state, summary=summary, tracks=True),
        status=status,
        headers=headers,
    )
