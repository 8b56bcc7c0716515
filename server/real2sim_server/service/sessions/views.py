"""Images of a session by plain request."""

from __future__ import annotations

from collections.abc import Sequence

from fastapi import Response

from real2sim_proto.drive import Render
from real2sim_proto.episode import SensorSpec
from real2sim_proto.sessions import SessionRender

from ...world import World
from ...world.ranging import RangingSensors
from ..http.responses import choose_among, etag
from ..rendering.responses import CODEC_OF, choose_media_type
from .pipeline import StepPipeline
from .world_clouds import mounted_beside

MSGPACK = "application/msgpack"


async def looking(world: World, asked: SessionRender | Render) -> RangingSensors:
    """LiDARs and radars of a look aside. Raises WorldError: INVALID_REQUEST."""
    return await mounted_beside(asked.lidars, asked.radars, world.spec.dt_us)


async def view_response(
    pipeline: StepPipeline, world: World, asked: SessionRender, accept: str | None
) -> Response:
    """All frames and clouds as msgpack; a single image also as a file, if ``accept`` likes that
    best.

    In msgpack each frame has the codec its sensor names.

    Raises:
        ServiceError: NOT_ACCEPTABLE, or as StepPipeline.view().
    """
    sensors: Sequence[SensorSpec] = asked.sensors
    ranging = await looking(world, asked)
    single = not ranging and len(sensors) == 1 and len(sensors[0].modalities) == 1
    if single:
        media_type = choose_media_type(accept, sensors[0].modalities[0])
    else:
        media_type = choose_among([MSGPACK], accept, of="clouds, or more than one image")
    if media_type != MSGPACK:
        sensors = [sensors[0].model_copy(update={"codec": CODEC_OF[media_type]})]
    observation = await pipeline.view(world, sensors, ranging=ranging)
    timing = ", ".join(f"{stage};dur={ms:.2f}" for stage, ms in observation.timing_ms.items())
    headers = {
        "Server-Timing": timing,
        "Vary": "Accept",
        "Cache-Control": "no-store",
        "X-Real2Sim-Revision": etag(world.revision),
    }
    if media_type == MSGPACK:
        content = await pipeline.on_world_thread(observation.message.joined)
    else:
        content = bytes(observation.frames[0].data)
    return Response(content, media_type=media_type, headers=headers)
