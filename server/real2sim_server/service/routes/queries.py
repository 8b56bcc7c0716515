"""Queries of frames, sweeps and free views, shared by several routes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from fastapi import Depends, Header, Query, Response

from real2sim_proto import ErrorCode
from real2sim_proto.base import Identifier, Microseconds, Modality
from real2sim_proto.episode import SensorSpec
from real2sim_proto.sensors import LidarSpec
from real2sim_proto.sessions import FreeCamera, SceneView

from ...edit import ScenarioState, instances_at, posed_instances
from ...geometry import Float, apply_transform, transform_from
from ...render import Instance
from ...scene import Camera, CameraRig, Scene, SceneError
from ...world.ranging import Cloud, MountedLidar, mounted_sensors
from ..frames import cloud_parts, lens_of
from ..http.responses import ServiceError, choose_among, etag
from ..renderer import CODEC_OF, MSGPACK, RenderRequest, choose_media_type


@dataclass(frozen=True)
class FrameQuery:
    """Query and headers of a render or preview."""

    camera: Annotated[
        Identifier | None, Query(description="camera of the rig; default: the first")
    ] = None
    t_us: Annotated[
        Microseconds | None, Query(description="simulation time; default: start of the scenario")
    ] = None
    width: Annotated[
        int | None, Query(ge=16, le=8192, description="[px]; default: as recorded")
    ] = None
    modality: Modality = "rgb"
    accept: Annotated[
        str | None, Header(description="image/jpeg, image/png or application/msgpack")
    ] = None

    def media_type(self) -> str:
        """Format of the reply. Raises ServiceError: NOT_ACCEPTABLE."""
        return choose_media_type(self.accept, self.modality)

    def render_request(self, scene: Scene, state: ScenarioState, media_type: str) -> RenderRequest:
        """Render request from the pose of the recording vehicle.

        Raises:
            TimeOutOfRangeError: ``t_us`` outside the recording.
        """
        t_us = state.clock[0] if self.t_us is None else self.t_us
        return self.render_request_for(scene, instances_at(scene, state, t_us), t_us, media_type)

    def render_request_for(
        self,
        scene: Scene,
        instances: Sequence[Instance],
        t_us: int,
        media_type: str,
        T_world_vehicle: Float | None = None,
    ) -> RenderRequest:
        """Render request for the given instances and another path of the vehicle."""
        sensor = SensorSpec(
            camera=self.camera or scene.rig.names[0],
            modalities=[self.modality],
            width=self.width,
            codec=CODEC_OF[media_type],
        )
        return RenderRequest(
            scene=scene,
            instances=instances,
            T_world_vehicle=(
                scene.ego.transform(t_us) if T_world_vehicle is None else T_world_vehicle
            ),
            t_us=t_us,
            sensors=(sensor,),
        )


FrameQueryOf = Annotated[FrameQuery, Depends()]


# --- Sweeps --------------------------------------------------------------------------------------

POINTS = "application/octet-stream"
SWEEP_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "a point cloud as on the drive socket; or x, y, z in the world [m] and "
        "intensity of each return, float32, little-endian",
        "content": {
            media_type: {"schema": {"type": "string", "format": "binary"}}
            for media_type in (MSGPACK, POINTS)
        },
    }
}


@dataclass(frozen=True)
class SweepQuery:
    """Query and headers of a sweep."""

    lidar: Annotated[Identifier, Query(description="name in the catalogue")] = "synthetic-64"
    t_us: Annotated[
        Microseconds | None, Query(description="end of the sweep; default: start of the scenario")
    ] = None
    accept: Annotated[str | None, Header(description=f"{MSGPACK} or {POINTS}")] = None

    def media_type(self) -> str:
        """Format of the reply. Raises ServiceError: NOT_ACCEPTABLE."""
        return choose_among([MSGPACK, POINTS], self.accept, of="a sweep")

    def mounted(self) -> MountedLidar:
        """The sensor. Raises WorldError: INVALID_REQUEST if it is not in the catalogue."""
        return mounted_sensors([LidarSpec(lidar=self.lidar)], [], 1).lidars[0]

    def instant(self, state: ScenarioState) -> int:
        """Time of the last ray [us]."""
        return state.clock[0] if self.t_us is None else self.t_us


def sweep_response(cloud: Cloud, media_type: str, *, revision: int) -> Response:
    """The cloud as msgpack, or only its points."""
    if media_type == MSGPACK:
        content = b"".join(cloud_parts(cloud))
    else:
        rows = np.empty((cloud.count, 4), "<f4")
        rows[:, :3] = apply_transform(cloud.T_world_sensor, cloud.columns["points"])
        rows[:, 3] = cloud.columns["intensity"]
        content = rows.tobytes()
    headers = {
        "Vary": "Accept",
        "Cache-Control": "no-store",
        "X-Real2Sim-Revision": etag(revision),
        "X-Real2Sim-Points": str(cloud.count),
    }
    return Response(content, media_type=media_type, headers=headers)


SweepQueryOf = Annotated[SweepQuery, Depends()]


# --- Free views ----------------------------------------------------------------------------------


def free_view_request(scene: Scene, view: SceneView, media_type: str) -> RenderRequest:
    """Render request of a free view.

    Raises:
        EditError: UNKNOWN_OBJECT, for an object that the scene lacks.
        ServiceError: INVALID_REQUEST, for a lens that does not cover its image.
    """
    t_us = scene.start_us if view.t_us is None else view.t_us
    poses = {posed.object_id: posed.pose for posed in view.objects}
    return RenderRequest(
        scene=scene,
        instances=posed_instances(scene, t_us, poses, others=view.others),
        # The cameras are in the world frame, on a vehicle at its origin.
        T_world_vehicle=np.eye(4),
        t_us=t_us,
        sensors=[_sensor(camera, media_type) for camera in view.cameras],
        rig=CameraRig(tuple(_camera(camera) for camera in view.cameras)),
    )


def _camera(camera: FreeCamera) -> Camera:
    try:
        return Camera(
            name=camera.name,
            width=camera.width,
            height=camera.height,
            K=np.array(camera.K),
            T_vehicle_camera=transform_from(camera.pose.position, camera.pose.quaternion),
            lens=lens_of(camera.lens),
        )
    except SceneError as error:
        raise ServiceError(ErrorCode.INVALID_REQUEST, str(error)) from error


def _sensor(camera: FreeCamera, media_type: str) -> SensorSpec:
    return SensorSpec(
        camera=camera.name,
        modalities=camera.modalities,
        codec=camera.codec if media_type == MSGPACK else CODEC_OF[media_type],
        quality=camera.quality,
        effects=camera.effects,
    )
