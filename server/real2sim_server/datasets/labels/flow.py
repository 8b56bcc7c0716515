"""Optical flow from depth and poses, in both directions, and what is hidden in the other image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ...geometry.transform import invert_transform
from .boxes import ObjectBox
from .images import IDS, CameraImages
from .pixels import carry

BLOCK = np.ones((3, 3), np.uint8)


def flow_between(
    here: CameraImages,
    there: CameraImages,
    boxes_here: Sequence[ObjectBox],
    boxes_there: Sequence[ObjectBox],
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_]]:
    """Where the surface of each pixel of ``here`` is in the image ``there`` of the same camera.

    Objects are carried by their poses, all else stands still. What has no depth lies infinitely
    far away (sky).

    Returns:
        Flow [H, W, 2] float32 [px]; valid [H, W] bool, False where the surface is behind the
        camera then or its object is no longer there; occluded [H, W] bool, where the flow is valid
        and the other image shows something else at its end, or ends before.
    """
    shape = here.depth.shape
    flow, valid = np.empty((*shape, 2), np.float32), np.empty(shape, np.bool_)
    occluded = np.empty(shape, np.bool_)
    motions, slots = _motions(here, there, boxes_here, boxes_there)
    # Metres lie between two rows of a road far away: its surface is met between neighbours.
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
    """Of what stands and of each object, and which one each instance id has, see :func:`carry`."""
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
