"""From the body of a view from anywhere to what is rendered."""

from __future__ import annotations

import numpy as np

from real2sim_proto import ErrorCode
from real2sim_proto.episode import SensorSpec
from real2sim_proto.views import FreeCamera, SceneView

from ...edit import posed_instances
from ...geometry.transform import transform_from
from ...scene import Camera, CameraRig, Scene, SceneError
from ..http.problems import ServiceError
from ..rendering.optics import lens_of
from ..rendering.renderer import RenderRequest
from ..rendering.responses import CODEC_OF, MSGPACK


def free_view_request(scene: Scene, view: SceneView, media_type: str) -> RenderRequest:
    """What to draw.

    Raises:
        EditError: UNKNOWN_OBJECT, for an object that the scene lacks.
        ServiceError: INVALID_REQUEST, for a lens that does not reach what its image shows.
    """
    t_us = scene.start_us if view.t_us is None else view.t_us
    poses = {posed.object_id: posed.pose for posed in view.objects}
    return RenderRequest(
        scene=scene,
        instances=posed_instances(scene, t_us, poses, others=view.others),
        # The cameras stand in the world, on a vehicle at its origin.
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
