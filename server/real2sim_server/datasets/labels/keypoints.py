"""COCO's 17 keypoints of people: where they are, and whether an image shows them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...edit import ObjectState, PlacedObjects
from ...edit.compose import NO_STRIDES, figure_of
from ...geometry.rotation import Float
from ...geometry.transform import apply_transform, invert_transform
from ...scene import Scene, Stride
from .boxes import NEAR
from .images import CameraImages

UNDER = 0.2
"""A joint lies at most so far under the skin that is seen of it [m]."""

OUTSIDE, HIDDEN, VISIBLE = 0, 1, 2
"""COCO's flags: not in the image, in it behind something, seen."""


def keypoints_at(
    scene: Scene,
    placed: PlacedObjects[ObjectState],
    t_us: int,
    *,
    strides: Mapping[str, Stride] = NO_STRIDES,
) -> dict[str, Float]:
    """Keypoints [17, 3] of everybody who is a walking body, world frame [m], by object id.

    Args:
        scene: that the objects are of.
        placed: where they are.
        t_us: instant [us].
        strides: of those whom no trajectory leads.
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
    """Where an image has keypoints [17, 3] of the world: u, v [px] and OUTSIDE, HIDDEN or VISIBLE.

    A keypoint is seen where the person's own surface is close before it. What is outside has 0, 0.

    Args:
        points: of one person.
        images: of the camera.
        instance_id: of the person's pixels.
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
