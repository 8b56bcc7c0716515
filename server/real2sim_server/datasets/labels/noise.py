"""Boxes as a detector would give them: jittered, missed, and found where nothing is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...geometry.rotation import Float
from .boxes import ObjectBox

CAR_SIZE = (4.5, 1.8, 1.5)
REACH = 60.0
"""False detections are up to so far from the ego [m]."""


@dataclass(frozen=True)
class BoxNoise:
    """Errors of a detector.

    Attributes:
        position: standard deviation of each coordinate of the centre [m].
        size: of each edge, as a share of it.
        heading: [rad].
        missed: share of boxes that are not found.
        false: mean number of boxes in a frame where nothing is.
    """

    position: float = 0.0
    size: float = 0.0
    heading: float = 0.0
    missed: float = 0.0
    false: float = 0.0


def noisy_boxes(
    boxes: Sequence[ObjectBox], in_ego: Sequence[Float], noise: BoxNoise, seed: Sequence[int]
) -> list[dict[str, Any]]:
    """Detections of a frame: category, ``T_ego_object``, size, score and object id, None of false
    ones.

    Args:
        boxes: of the frame.
        in_ego: their poses [4, 4] in the ego frame.
        noise: of the detector.
        seed: the same gives the same detections.
    """
    rng = np.random.default_rng(list(seed))
    found = []
    for box, pose in zip(boxes, in_ego, strict=True):
        missed, score = rng.random() < noise.missed, rng.beta(8, 2)
        shift, stretch, turn = rng.standard_normal(3), rng.standard_normal(3), rng.standard_normal()
        if missed:
            continue
        moved = pose @ _about_z(turn * noise.heading)
        moved[:3, 3] += shift * noise.position
        size = np.array(box.size) * np.clip(1 + stretch * noise.size, 0.2, 5.0)
        found.append(_detection(box.object_id, box.category, moved, size, score))
    categories = sorted({box.category for box in boxes}) or ["car"]
    for _ in range(int(rng.poisson(noise.false))):
        category = categories[int(rng.integers(len(categories)))]
        sizes = [box.size for box in boxes if box.category == category] or [CAR_SIZE]
        size = np.array(sizes[0])
        pose = _about_z(rng.uniform(-math.pi, math.pi))
        away, around = REACH * math.sqrt(rng.random()), rng.uniform(-math.pi, math.pi)
        pose[:3, 3] = away * math.cos(around), away * math.sin(around), size[2] / 2
        found.append(_detection(None, category, pose, size, rng.beta(2, 5)))
    return found


def _detection(
    object_id: str | None, category: str, pose: Float, size: Float, score: float
) -> dict[str, Any]:
    return {
        "object_id": object_id,
        "category": category,
        "T_ego_object": pose.tolist(),
        "size": size.tolist(),
        "score": float(score),
    }


def _about_z(angle: float) -> Float:
    matrix = np.eye(4)
    matrix[0, 0] = matrix[1, 1] = math.cos(angle)
    matrix[1, 0] = math.sin(angle)
    matrix[0, 1] = -matrix[1, 0]
    return matrix
