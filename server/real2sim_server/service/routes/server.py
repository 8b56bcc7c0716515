"""What this worker is and what it refuses to exceed."""

from __future__ import annotations

from importlib.metadata import version
from typing import get_args

from fastapi import APIRouter

from real2sim_proto import CONVENTIONS, PROTOCOL_VERSION
from real2sim_proto.base import Codec, Modality
from real2sim_proto.codec import MAX_CLIENT_MESSAGE_BYTES
from real2sim_proto.episode import MAX_SENSORS
from real2sim_proto.scenarios import MAX_OPERATIONS_PER_REQUEST
from real2sim_proto.scenes import Fleet, FleetMember, Limits, ServerInfo
from real2sim_proto.sessions import MAX_STEPS_PER_REQUEST
from real2sim_proto.version import SUPPORTED_SUBPROTOCOLS

from ...scene.lidar_catalogue import lidar_names
from ...scene.radar import RADARS
from ...settings import Settings
from ..http.auth import TokenRoute
from ..worker import WorkerOf

router = APIRouter(prefix="/v1", tags=["server"], route_class=TokenRoute)


@router.get("/server")
async def describe(worker: WorkerOf) -> ServerInfo:
    """Versions, device, limits, codecs, frames and units."""
    return ServerInfo(
        version=version("real2sim"),
        protocol_version=PROTOCOL_VERSION,
        subprotocols=list(SUPPORTED_SUBPROTOCOLS),
        worker_id=worker.settings.worker_id,
        device=worker.device,
        limits=limits_of(worker.settings),
        codecs=list(get_args(Codec)),
        modalities=list(get_args(Modality)),
        lidar_models=list(lidar_names()),
        radar_models=list(RADARS),
        conventions=CONVENTIONS,
    )


@router.get("/fleet")
async def fleet(worker: WorkerOf) -> Fleet:
    """The workers that share this one's store, with what each last told of itself."""
    members = [
        FleetMember.model_validate({**row.document, "worker_id": row.worker_id, "alive": row.alive})
        for row in await worker.leases.workers()
    ]
    return Fleet(workers=members)


def limits_of(settings: Settings) -> Limits:
    """The limits that ``settings`` and the protocol set."""
    return Limits(
        max_sessions=settings.max_sessions,
        max_request_bytes=settings.max_request_bytes,
        max_message_bytes=MAX_CLIENT_MESSAGE_BYTES,
        max_operations_per_request=MAX_OPERATIONS_PER_REQUEST,
        max_cameras_per_step=MAX_SENSORS,
        max_pixels_per_step=settings.max_pixels_per_step,
        max_rays_per_step=settings.max_rays_per_step,
        max_steps_per_request=MAX_STEPS_PER_REQUEST,
        scene_memory_bytes=settings.scene_memory_bytes,
        queue_length=settings.queue_length,
    )
