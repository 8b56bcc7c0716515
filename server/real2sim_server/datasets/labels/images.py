"""The images of an instant, from one walk per camera where the backend can."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from real2sim_proto.semantics import SKY, UNLABELED

from ...geometry.rotation import Float
from ...render import Backend, render_cameras, select_backend
from ...render.frame import classes_of, label_cameras, labels_while_drawing
from ...render.types import Window
from ...scene import Camera, Scene
from ..drive import Moment
from .boxes import ObjectBox, boxes_at
from .pixels import tell_apart
from .surface import bodies_of
from .windows import object_windows

MODALITIES = ("rgb", "median_depth", "instance")
IDS = 1 << 16


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
        alone: by instance id the window of an object that is in the image, and its depths [h, w]
            float32 there, as if it stood alone; empty where passes draw that.
    """

    camera: Camera
    T_world_camera: Float
    rgb: NDArray[np.uint8] = field(repr=False)
    depth: NDArray[np.float32] = field(repr=False)
    instance: NDArray[np.uint16] = field(repr=False)
    semantic: NDArray[np.uint8] = field(repr=False)
    alone: Mapping[int, tuple[Window, NDArray[np.float32]]] = field(
        default_factory=dict, repr=False
    )


def draw_moment(
    scene: Scene, moment: Moment, cameras: Sequence[Camera], *, backend: str | Backend = "auto"
) -> list[CameraImages]:
    """Images of ``cameras`` in their order. Raises RenderError."""
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    boxes = boxes_at(moment.placed)
    draw = _in_one_walk if labels_while_drawing(chosen, cameras) else _in_passes
    found = draw(scene, moment, cameras, boxes, chosen)
    for images in found:
        _tell_apart(scene, moment, images, boxes)
    return found


def _in_one_walk(
    scene: Scene,
    moment: Moment,
    cameras: Sequence[Camera],
    boxes: Sequence[ObjectBox],
    backend: Any,
) -> list[CameraImages]:
    windows = [object_windows(boxes, camera, camera.pose(moment.T_world_ego)) for camera in cameras]
    frames = label_cameras(
        moment.instances, cameras, moment.T_world_ego, windows, sky=scene.sky, backend=backend
    )
    return [
        CameraImages(
            camera,
            frame.T_world_camera,
            frame.rgb,
            frame.depth,
            frame.instance,
            np.empty(frame.instance.shape, np.uint8),
            {w.instance_id: (w, alone) for w, alone in zip(asked, frame.alone, strict=True)},
        )
        for camera, frame, asked in zip(cameras, frames, windows, strict=True)
    ]


def _in_passes(
    scene: Scene,
    moment: Moment,
    cameras: Sequence[Camera],
    boxes: Sequence[ObjectBox],
    backend: Backend,
) -> list[CameraImages]:
    """By backends that draw a pass for each label; objects alone are drawn when asked for."""
    frames = render_cameras(
        moment.instances,
        cameras,
        moment.T_world_ego,
        sky=scene.sky,
        modalities=MODALITIES,
        backend=backend,
    )
    return [
        CameraImages(
            camera,
            frame.T_world_camera,
            frame.images["rgb"],
            frame.images["median_depth"].copy(),
            frame.images["instance"].copy(),
            np.empty((camera.height, camera.width), np.uint8),
        )
        for camera, frame in zip(cameras, frames, strict=True)
    ]


def _tell_apart(
    scene: Scene, moment: Moment, images: CameraImages, boxes: Sequence[ObjectBox]
) -> None:
    """Write the semantic image; what is the shadow of an object becomes ground."""
    tell_apart(
        images.depth,
        images.instance,
        images.semantic,
        rays_of(images.camera.K, images.T_world_camera),
        slots_of(boxes),
        bodies_of(boxes),
        classes_of(moment.instances),
        UNLABELED if scene.sky is None else SKY,
        *scene.ground.grid,
    )


def rays_of(K: Float, T_world_camera: Float) -> Float:
    """[3, 4] of the world: a pixel (x, y) of depth d is at ``d * rays[:, :3] @ (x, y, 1) +
    rays[:, 3]``."""
    return np.column_stack([T_world_camera[:3, :3] @ np.linalg.inv(K), T_world_camera[:3, 3]])


def slots_of(boxes: Sequence[ObjectBox]) -> NDArray[np.int16]:
    """Place [65536] of each instance id in ``boxes``, -1 for others."""
    slots = np.full(IDS, -1, np.int16)
    for slot, box in enumerate(boxes):
        slots[box.instance_id] = slot
    return slots
