"""Views of objects in a camera image: pixels, boxes and visibility."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...edit import ObjectState, PlacedObjects
from ...edit.compose import NO_STRIDES, figure_of
from ...geometry import Float, apply_transform, invert_transform
from ...render import Backend, Instance, RasterOptions, rasterize
from ...render.types import Window
from ...scene import Scene, Stride
from .boxes import NEAR, Box2D, ObjectBox, cut_at_border, projected_box, truncation
from .images import CameraImages, body_of, rays_of, window_about
from .pixels import surface_mask

# Source of each label. The manifest of every export contains these texts.

HOW = {
    "box_3d": "box: pose and size that the drive has for the object, exact",
    "velocity": "box: derivative of the object's pose in the world [m/s]",
    "box_2d_modal": "rendered: bounding box of the object's pixels in the instance image, without "
    "blobs of fewer than 8 pixels",
    "box_2d_amodal": "box: bounding box of the projected 3D box, cut at the near plane and at the "
    "border of the image",
    "visibility": "rendered: pixels of the object in the scene over those it fills when it is "
    "drawn alone",
    "truncation": "box: share of the 3D box outside of the image, by area of the faces towards the "
    "camera",
    "instance": "rendered: object of a pixel's front, the Gaussian that takes its light to a fifth "
    "(where that is not reached, or passes draw labels, to a half); an object's shadow is ground, "
    "by its box or by LiDAR surfaces",
    "semantic": "rendered: class of the object by its category; of the background the ground by "
    "geometry, within 0.15 m of the scene's height field, the sky by opacity",
    "depth": "rendered: depth along the camera's z axis where a pixel's ray meets its front most, "
    "or of the LiDAR surfaces where beams measured them and they show the same object; of the "
    "ground that of the scene's height field [m]",
    "flow": "rendered depth and poses: where the surface of a pixel is in the other image; "
    "occluded where the other image shows something else there",
    "points": "rendered: points of the cameras' depth images along the beams of a spinning "
    "LiDAR, only where a camera looks",
    "lidar": "rendered: returns of the LiDAR through the scene's Gaussians, everything where it "
    "is at each ray's instant; the ego's motion is taken out; instance of the Gaussian that takes "
    "half of the ray's light, class by category, the ground by geometry",
    "keypoints": "body: COCO's 17 keypoints of people who are walking bodies, in the world, exact; "
    "in images hidden where nothing of the person is rendered within 0.2 m before them",
    "track": "box: poses of the object at the instants before and after",
    "detections": "box: boxes of the drive, moved, missed and made up as a detector might",
    "ego_future": "box: poses of the ego at the instants after, in the ego's frame",
    "ego": "map: speed of the drive; route and command along the recorded drive",
}
"""Source of each label: ``rendered``, ``box`` (poses and sizes of the drive)."""


MIN_BLOB_PIXELS = 8
"""Minimum size of connected parts of an object [px]."""

ALONE = RasterOptions(depth=False, instance=True, median_depth=True)


@dataclass(frozen=True)
class ObjectView:
    """One object in one image.

    Attributes:
        object_id, instance_id: ids of the object.
        amodal_box: bounds of the projected 3D box, clipped to near plane and image [px].
        modal_box: bounds of the object's visible pixels [px]; None without any.
        visible_pixels: number of the object's visible pixels.
        alone_pixels: number of its pixels in this image without other objects.
        truncation: share of the 3D box outside the image, 0 to 1.
    """

    object_id: str
    instance_id: int
    amodal_box: Box2D
    modal_box: Box2D | None
    visible_pixels: int
    alone_pixels: int
    truncation: float

    @property
    def visibility(self) -> float:
        """Share of its pixels in this image that are not occluded, 0 to 1."""
        return min(self.visible_pixels / self.alone_pixels, 1.0) if self.alone_pixels else 0.0


@dataclass(frozen=True, eq=False)
class CameraView:
    """The image, and the objects in it by increasing id."""

    images: CameraImages
    objects: tuple[ObjectView, ...]


def views_of(
    images: CameraImages,
    boxes: Sequence[ObjectBox],
    instances: Sequence[Instance],
    *,
    backend: str | Backend = "auto",
) -> CameraView:
    """Views of all objects with a box in the image.

    Args:
        images: images of the camera.
        boxes: boxes of all objects at this time.
        instances: rendered instances.
        backend: renders single objects.
    """
    camera = images.camera
    found = []
    for box in sorted(boxes, key=lambda b: b.instance_id):
        whole = projected_box(box.T_world_object, box.size, camera, images.T_world_camera)
        seen = None if whole is None else cut_at_border(whole, camera.width, camera.height)
        if whole is None or seen is None:
            continue
        window = window_about(box.instance_id, whole, camera)
        modal, visible = _modal(images.instance, window)
        held = images.alone.get(box.instance_id)
        depth = _drawn_alone(window, images, instances, backend) if held is None else held[1]
        found.append(
            ObjectView(
                object_id=box.object_id,
                instance_id=box.instance_id,
                amodal_box=seen,
                modal_box=modal,
                visible_pixels=visible,
                alone_pixels=_pixels_of(depth, window, box, images),
                truncation=truncation(box.T_world_object, box.size, camera, images.T_world_camera),
            )
        )
    return CameraView(images, tuple(found))


def _modal(instance: NDArray[np.uint16], window: Window) -> tuple[Box2D | None, int]:
    left, top = window.left, window.top
    part = instance[top : window.bottom, left : window.right]
    mask = without_blobs(part == window.instance_id)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None, 0
    box = (
        float(left + columns[0]),
        float(top + rows[0]),
        float(left + columns[-1] + 1),
        float(top + rows[-1] + 1),
    )
    return box, int(mask.sum())


def without_blobs(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask [H, W] without connected parts of fewer than MIN_BLOB_PIXELS pixels."""
    if not mask.any():
        return mask
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.view(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= MIN_BLOB_PIXELS
    large[0] = False
    kept: NDArray[np.bool_] = large[labels]
    return kept


def _drawn_alone(
    window: Window, images: CameraImages, instances: Sequence[Instance], backend: str | Backend
) -> NDArray[np.float32]:
    """Depths [h, w] of an object rendered alone."""
    left, top, right, bottom = window.left, window.top, window.right, window.bottom
    own = [i for i in instances if i.instance_id == window.instance_id]
    if not own or left >= right or top >= bottom:
        return np.zeros((max(bottom - top, 0), max(right - left, 0)), np.float32)
    K = images.camera.K.copy()
    K[:2, 2] -= left, top
    output = rasterize(
        own,
        invert_transform(images.T_world_camera)[None],
        K[None],
        right - left,
        bottom - top,
        options=ALONE,
        backend=backend,
    )
    assert output.median_depth is not None
    depth: NDArray[np.float32] = output.median_depth[0].cpu().numpy()
    return depth


def _pixels_of(
    depth: NDArray[np.float32], window: Window, box: ObjectBox, images: CameraImages
) -> int:
    """Mask of the pixels whose depths are on the object's surface."""
    mask = np.empty(depth.shape, np.bool_)
    rays = rays_of(images.camera.K, images.T_world_camera)
    body = body_of(box, box.T_world_object)
    surface_mask(depth, window.left, window.top, rays, body, mask)
    return int(without_blobs(mask).sum())


# --- Keypoints -----------------------------------------------------------------------------------

# COCO's 17 keypoints of people: positions and visibility.

UNDER = 0.2
"""Maximum depth of a joint below its visible skin [m]."""

OUTSIDE, HIDDEN, VISIBLE = 0, 1, 2
"""COCO's visibility flags: outside the image, occluded, visible."""


def keypoints_at(
    scene: Scene,
    placed: PlacedObjects[ObjectState],
    t_us: int,
    *,
    strides: Mapping[str, Stride] = NO_STRIDES,
) -> dict[str, Float]:
    """Keypoints [17, 3] of all walking people, world frame [m], by object id.

    Args:
        scene: scene of the objects.
        placed: their poses.
        t_us: time [us].
        strides: walking states of people without a trajectory.
    """
    found = {}
    for subject, transform in zip(placed.objects, placed.transforms, strict=True):
        figure = figure_of(scene, subject)
        if figure is not None:
            stride = strides.get(subject.object_id)
            own = figure.keypoints(subject.trajectory, t_us, stride=stride)
            found[subject.object_id] = apply_transform(transform, own * subject.scale)
    return found


def keypoints_in_image(
    points: Float, images: CameraImages, instance_id: int
) -> list[tuple[float, float, int]]:
    """Keypoints [17, 3] of the world in an image: u, v [px] and OUTSIDE, HIDDEN or VISIBLE.

    A keypoint is visible if the person's own surface is close in front of it. Keypoints outside
    have position 0, 0.

    Args:
        points: keypoints of one person [m].
        images: images of the camera.
        instance_id: id of the person's pixels.
    """
    local = apply_transform(invert_transform(images.T_world_camera), points)
    depths = local[:, 2]
    ahead = np.maximum(depths, NEAR)
    pixels = (local @ images.camera.K.T)[:, :2] / ahead[:, None]
    height, width = images.depth.shape
    inside = (depths > NEAR) & (pixels >= 0).all(axis=1) & (pixels < [width, height]).all(axis=1)
    u, v = np.where(inside[:, None], pixels, 0.0).T
    columns, rows = u.astype(np.int64), v.astype(np.int64)
    own = images.instance[rows, columns] == instance_id
    near = images.depth[rows, columns] > depths - UNDER
    flags = np.where(inside, np.where(own & near, VISIBLE, HIDDEN), OUTSIDE)
    return list(zip(u.tolist(), v.tolist(), flags.tolist(), strict=True))
