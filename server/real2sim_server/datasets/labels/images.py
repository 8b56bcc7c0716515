"""The images of an instant, from one pass per camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import GROUND

from ...geometry.rotation import Float
from ...render import Backend, Frame, render_cameras
from ...render.ground_class import back_projected, with_ground
from ...scene import Camera, Scene
from ..drive import Moment
from .boxes import ObjectBox, boxes_at
from .surface import on_surface

MODALITIES = ("rgb", "median_depth", "instance", "semantic")


def ids_in(instance: NDArray[np.uint16]) -> set[int]:
    """Ids that an instance image shows, 0 too."""
    return set(np.flatnonzero(np.bincount(instance.ravel())).tolist())


@dataclass(frozen=True, eq=False)
class CameraImages:
    """What one camera sees.

    Attributes:
        camera: that looks.
        T_world_camera: [4, 4] its pose, OpenCV.
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32, along the camera's z axis [m], 0 where nothing is.
        instance: [H, W] uint16 ids, 0 is background, shadows of objects too.
        semantic: [H, W] uint8, see SEMANTIC_CLASSES.
    """

    camera: Camera
    T_world_camera: Float
    rgb: NDArray[np.uint8] = field(repr=False)
    depth: NDArray[np.float32] = field(repr=False)
    instance: NDArray[np.uint16] = field(repr=False)
    semantic: NDArray[np.uint8] = field(repr=False)


def draw_moment(
    scene: Scene, moment: Moment, cameras: Sequence[Camera], *, backend: str | Backend = "auto"
) -> list[CameraImages]:
    """Images of ``cameras`` in their order. Raises RenderError."""
    frames = render_cameras(
        moment.instances,
        cameras,
        moment.T_world_ego,
        sky=scene.sky,
        modalities=MODALITIES,
        backend=backend,
    )
    boxes = boxes_at(moment.placed)
    return [
        _labelled(scene, camera, frame, boxes)
        for camera, frame in zip(cameras, frames, strict=True)
    ]


def _labelled(
    scene: Scene, camera: Camera, frame: Frame, boxes: Sequence[ObjectBox]
) -> CameraImages:
    """The images of a frame; what is the shadow of an object becomes ground."""
    depth, instance = frame.images["median_depth"], frame.images["instance"].copy()
    pose = frame.T_world_camera
    points = back_projected(depth, camera.K, pose)
    semantic = with_ground(frame.images["semantic"], points, depth, scene.ground)
    present = ids_in(instance)
    for box in boxes:
        if box.instance_id in present:
            own = np.nonzero(instance == box.instance_id)
            shadow = ~on_surface(points[own], box.T_world_object, box.size)
            rows, columns = own[0][shadow], own[1][shadow]
            instance[rows, columns] = 0
            semantic[rows, columns] = GROUND
    return CameraImages(camera, pose, frame.images["rgb"], depth, instance, semantic)
