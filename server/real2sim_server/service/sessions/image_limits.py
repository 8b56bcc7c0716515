"""How many images one message may carry."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from real2sim_proto import ErrorCode
from real2sim_proto.codec import MAX_SERVER_MESSAGE_BYTES
from real2sim_proto.episode import SensorSpec

from ...render.modalities import modality_of
from ...scene import Camera, Scene
from ..http.problems import ServiceError
from ..rendering.renderer import check_known, check_sensors

MAX_IMAGE_BYTES = MAX_SERVER_MESSAGE_BYTES - 1024 * 1024
"""Of raw images in one message; the rest of it fits in what is left of a reader's limit."""


def cameras_of(scene: Scene, sensors: Sequence[SensorSpec], *, max_pixels: int) -> list[Camera]:
    """Cameras of sensors, in their order, at the sizes that these name.

    Raises:
        ServiceError: UNKNOWN_CAMERA, or INVALID_REQUEST for too many pixels or bytes, and for
            images that the scene lacks.
    """
    cameras = check_sensors(scene.rig, sensors, max_pixels=max_pixels)
    check_known(scene, sensors)
    check_message_bytes(raw_image_bytes(sensors, cameras))
    return cameras


def check_message_bytes(size: int) -> None:
    """Raises ServiceError: INVALID_REQUEST for raw images and clouds that no one message holds."""
    if size > MAX_IMAGE_BYTES:
        raise ServiceError(
            ErrorCode.INVALID_REQUEST,
            f"{size} bytes of raw images and clouds in one message; readers allow "
            f"{MAX_IMAGE_BYTES}",
            hint="ask for smaller or fewer images, or for codec 'jpeg' or 'png'",
        )


def raw_image_bytes(sensors: Sequence[SensorSpec], cameras: Iterable[Camera]) -> int:
    """Of the raw images of one instant; ``cameras``: of the sensors, in their order."""
    return sum(
        modality_of(modality).raw_bytes(camera.width, camera.height)
        for camera, sensor in zip(cameras, sensors, strict=True)
        for modality in sensor.modalities
        if sensor.codec == "raw"
    )
