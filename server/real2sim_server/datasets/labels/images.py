"""The images of a time step, from one pass per camera if the backend supports it; optical flow."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from real2sim_proto.conventions import SKY, UNLABELED

from ...geometry import Float, invert_transform
from ...render import Backend, render_cameras, select_backend
from ...render.frame import (
    classes_of,
    label_cameras,
    labels_while_drawing,
    shown_as_colour,
)
from ...render.types import Window
from ...scene import Camera, Scene, Sky
from ...scene.cloud import UNSEEN
from ..drive import Moment
from .boxes import Box2D, ObjectBox, boxes_at, projected_box
from .pixels import BODY, TYRE, carry, on_bodies, tell_apart

# --- Windows -------------------------------------------------------------------------------------

# The part of an image that contains the whole object.

MARGIN = 0.1
"""Margin for Gaussians outside the box, as a share of its projection; at least 8 px."""


def object_windows(
    boxes: Sequence[ObjectBox], camera: Camera, T_world_camera: Float
) -> list[Window]:
    """Windows of the objects in an image, in order."""
    found = []
    for box in boxes:
        whole = projected_box(box.T_world_object, box.size, camera, T_world_camera)
        if whole is not None:
            window = window_about(box.instance_id, whole, camera)
            if window.left < window.right and window.top < window.bottom:
                found.append(window)
    return found


def window_about(instance_id: int, whole: Box2D, camera: Camera) -> Window:
    """Window of whole pixels around a projected box."""
    wide = max(8.0, MARGIN * (whole[2] - whole[0]))
    high = max(8.0, MARGIN * (whole[3] - whole[1]))
    # The corners of boxes that extend behind the camera can have huge coordinates.
    return Window(
        instance_id,
        math.floor(min(max(whole[0] - wide, 0.0), float(camera.width))),
        math.floor(min(max(whole[1] - high, 0.0), float(camera.height))),
        math.ceil(max(min(whole[2] + wide, float(camera.width)), 0.0)),
        math.ceil(max(min(whole[3] + high, float(camera.height)), 0.0)),
    )


# --- Surfaces ------------------------------------------------------------------------------------

# A reconstructed object also contains the dark ground below it, which moves with it. These pixels
# are labelled as ground. They are located by the object's box and, for road vehicles, the wheels.

SURFACE_MARGIN = 0.1
"""Tolerance of surfaces outside the box [m], for inexact annotations."""

CLEARANCE = 0.12
"""Maximum height of the ground above the bottom face of the box [m]."""

SILL = 0.11
"""Share of a road vehicle's height with only the wheels, and the shadow between them."""

WHEELED = {
    "car": (0.15, 0.22, 0.3, 0.3),
    "van": (0.11, 0.16, 0.33, 0.3),
    "truck": (0.15, 0.145, 0.36, 0.26),
    "bus": (0.12, 0.155, 0.29, 0.26),
    "trailer": (0.15, 0.145, 0.36, 0.26),
}
"""For road vehicles: lower edge of the sides and radius of the wheels as shares of the height,
distance of the axles in front of and behind the centre as shares of the length.
"""

AXLES = 0.18, 0.43
"""Range of the wheels in front of and behind the centre, as shares of the length."""

CONTACT = 0.08
"""Wheel points lower than this above the bottom of the box are ground [m]."""


def on_surface(
    points: NDArray[np.floating], T_world_object: Float, box: ObjectBox
) -> NDArray[np.bool_]:
    """Mask [N] of the world points [N, 3] on an object's surface.

    Args:
        points: points at the object's pixels.
        T_world_object: [4, 4] of the box, at the instant of the points.
        box: gives size and category.
    """
    found = np.empty(len(points), np.bool_)
    on_bodies(np.asarray(points, np.float64), body_of(box, T_world_object), found)
    return found


def bodies_of(boxes: Sequence[ObjectBox]) -> Float:
    """Boxes as kernel arguments, [K, BODY], see ``is_surface``."""
    found = np.empty((len(boxes), BODY))
    for row, box in zip(found, boxes, strict=True):
        row[:] = body_of(box, box.T_world_object)
    return found


def body_of(box: ObjectBox, T_world_object: Float) -> Float:
    """A body of :func:`bodies_of`, at another pose."""
    half = np.asarray(box.size) / 2
    to_object = invert_transform(T_world_object)[:3]
    lowest = -half[2] + min(CLEARANCE, half[2] / 4)
    limits: tuple[float, ...] = lowest, lowest, *[0.0] * 7
    if box.category in WHEELED:
        aside, (inner, outer) = half[1] - TYRE, AXLES
        sill = max(lowest, (2 * SILL - 1) * half[2])
        long, _, high = box.size
        side, radius, front, rear = WHEELED[box.category]
        seen = side * high, radius * high, front * long, rear * long
        limits = -half[2] + CONTACT, sill, aside, inner * long, outer * long, *seen
    return np.concatenate([to_object.ravel(), half, [SURFACE_MARGIN, *limits]])


MODALITIES = ("rgb", "median_depth", "instance")
IDS = 1 << 16
MAX_UNCERTAINTY = 255 * UNSEEN / 3
"""Maximum uncertainty of LiDAR surfaces that count, out of 255: that after two recorded beams."""
NO_LIDAR = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.uint16)


@dataclass(frozen=True, eq=False)
class CameraImages:
    """Images of one camera.

    Attributes:
        camera: the camera.
        T_world_camera: [4, 4] its pose, OpenCV.
        rgb: [H, W, 3] uint8.
        depth: [H, W] float32, along the camera's z axis [m], 0 for empty pixels.
        instance: [H, W] uint16 ids, 0 is background, including shadows of objects.
        semantic: [H, W] uint8, see SEMANTIC_CLASSES.
        alone: by instance id the window of an object in the image, and its depths [h, w] float32
            without other objects; empty if separate passes render these.
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
    """Images of ``cameras``, in order. Raises RenderError."""
    chosen = select_backend(backend) if isinstance(backend, str) else backend
    boxes = boxes_at(moment.placed)
    draw = _in_one_walk if labels_while_drawing(chosen, cameras) else _in_passes
    found = draw(scene.sky, moment, cameras, boxes, chosen)
    lidar = [NO_LIDAR] * len(found)
    if moment.surfaces:
        # Gaussians trained on images can be metres in front of the surface that they show.
        surfaces = [shown_as_colour(instance) for instance, _ in moment.surfaces]
        drawn = draw(None, replace(moment, instances=surfaces), cameras, (), chosen)
        lidar = [_measured(images, moment) for images in drawn]
    for images, measured in zip(found, lidar, strict=True):
        _tell_apart(scene, moment, images, measured, boxes)
    return found


def _measured(
    drawn: CameraImages, moment: Moment
) -> tuple[NDArray[np.float32], NDArray[np.uint16]]:
    """Depth and instance images of LiDAR surfaces, whose colours are their uncertainties; depth 0
    where no surface was fitted or no beam measured it.
    """
    is_fitted = np.zeros(IDS, np.bool_)
    is_fitted[[i.instance_id for i, known in moment.surfaces if known is not None]] = True
    drawn.depth[~is_fitted[drawn.instance] | (drawn.rgb[..., 0] > MAX_UNCERTAINTY)] = 0
    return drawn.depth, drawn.instance


def _in_one_walk(
    sky: Sky | None,
    moment: Moment,
    cameras: Sequence[Camera],
    boxes: Sequence[ObjectBox],
    backend: Any,
) -> list[CameraImages]:
    windows = [object_windows(boxes, camera, camera.pose(moment.T_world_ego)) for camera in cameras]
    frames = label_cameras(
        moment.instances, cameras, moment.T_world_ego, windows, sky=sky, backend=backend
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
    sky: Sky | None,
    moment: Moment,
    cameras: Sequence[Camera],
    boxes: Sequence[ObjectBox],
    backend: Backend,
) -> list[CameraImages]:
    """For backends with one pass per label; single objects are rendered on demand."""
    frames = render_cameras(
        moment.instances,
        cameras,
        moment.T_world_ego,
        sky=sky,
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
    scene: Scene,
    moment: Moment,
    images: CameraImages,
    lidar: tuple[NDArray[np.float32], NDArray[np.uint16]],
    boxes: Sequence[ObjectBox],
) -> None:
    """Write the semantic image; depths become those of LiDAR surfaces, shadows become ground."""
    tell_apart(
        images.depth,
        images.instance,
        images.semantic,
        rays_of(images.camera.K, images.T_world_camera),
        slots_of(boxes),
        bodies_of(boxes),
        classes_of(moment.instances),
        UNLABELED if scene.sky is None else SKY,
        lidar,
        *scene.ground.grid,
    )


def rays_of(K: Float, T_world_camera: Float) -> Float:
    """[3, 4] of the world: a pixel (x, y) of depth d is at ``d * rays[:, :3] @ (x, y, 1) +
    rays[:, 3]``."""
    return np.column_stack([T_world_camera[:3, :3] @ np.linalg.inv(K), T_world_camera[:3, 3]])


def slots_of(boxes: Sequence[ObjectBox]) -> NDArray[np.int16]:
    """Index [65536] of each instance id in ``boxes``, -1 for others."""
    slots = np.full(IDS, -1, np.int16)
    for slot, box in enumerate(boxes):
        slots[box.instance_id] = slot
    return slots


# --- Flow ----------------------------------------------------------------------------------------

# From depth and poses, in both directions, with occlusion in the other image.

BLOCK = np.ones((3, 3), np.uint8)


def flow_between(
    here: CameraImages,
    there: CameraImages,
    boxes_here: Sequence[ObjectBox],
    boxes_there: Sequence[ObjectBox],
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Position of the surface of each pixel of ``here`` in the image ``there`` of the same camera.

    Objects move with their poses, everything else is static. Pixels without depth are infinitely
    far away (sky).

    Returns:
        Flow [H, W, 2] float32 [px]; valid [H, W] bool, False where the surface is then behind the
        camera or its object no longer exists; occluded [H, W] bool, where the flow is valid and the
        other image shows something else at its end, or ends before.
    """
    shape = here.depth.shape
    flow, valid = np.empty((*shape, 2), np.float32), np.empty(shape, np.bool_)
    occluded = np.empty(shape, np.bool_)
    motions, slots = _motions(here, there, boxes_here, boxes_there)
    # On a distant road, two rows are metres apart, so depths are compared with their neighbours.
    low, high = (spread(there.depth, BLOCK) for spread in (cv2.erode, cv2.dilate))
    shown = low, high, there.instance
    carry(here.depth, here.instance, slots, motions, shown, flow, valid, occluded)
    return flow, valid, occluded


def _motions(
    here: CameraImages,
    there: CameraImages,
    boxes_here: Sequence[ObjectBox],
    boxes_there: Sequence[ObjectBox],
) -> tuple[NDArray[np.float32], NDArray[np.int16]]:
    """Motions of the static scene and of each object, and their index by instance id, see
    :func:`carry`.
    """
    to_camera = invert_transform(there.T_world_camera)
    later = {box.instance_id: box for box in boxes_there}
    slots = np.zeros(IDS, np.int16)
    moved = [np.eye(4)]
    for box in boxes_here:
        other = later.get(box.instance_id)
        slots[box.instance_id] = -1 if other is None else len(moved)
        if other is not None:
            moved.append(other.T_world_object @ invert_transform(box.T_world_object))
    inverse = np.linalg.inv(here.camera.K)
    motions = np.empty((len(moved), 3, 4), np.float32)
    for row, motion in zip(motions, moved, strict=True):
        between = to_camera @ motion @ here.T_world_camera
        row[:, :3] = there.camera.K @ between[:3, :3] @ inverse
        row[:, 3] = there.camera.K @ between[:3, 3]
    return motions, slots
