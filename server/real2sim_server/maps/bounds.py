"""Lanes that maps give by their two rims, and graphs of parts that name what is not there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from ..geometry.rotation import Float
from ..scene import Lane, LaneGraph

STEP_M = 1.0
SAME_PLACE_M = 1e-3


def between(left: Float, right: Float) -> tuple[Float, Float] | None:
    """Centre line [N, 3] and widths [N] of the lane between two rims, each about a metre; None
    where they have no length.

    Both rims are gone along at once, by their share of length, as Lanelet2 and Argoverse do.
    """
    if len(left) < 2 or len(right) < 2:
        return None
    # The rims of some maps run against each other.
    if np.linalg.norm(left[0] - right[0]) + np.linalg.norm(left[-1] - right[-1]) > np.linalg.norm(
        left[0] - right[-1]
    ) + np.linalg.norm(left[-1] - right[0]):
        right = right[::-1]
    rims = (left, right)
    lengths = [float(np.linalg.norm(np.diff(r[:, :2], axis=0), axis=1).sum()) for r in rims]
    if max(lengths) < SAME_PLACE_M:
        return None
    count = max(int(np.ceil(max(lengths) / STEP_M)), 1) + 1
    a, b = (_evenly(rim, count) for rim in (left, right))
    centre, widths = (a + b) / 2, np.linalg.norm((a - b)[:, :2], axis=1)
    kept = np.concatenate(
        [[True], np.linalg.norm(np.diff(centre[:, :2], axis=0), axis=1) > SAME_PLACE_M]
    )
    return (centre[kept], widths[kept]) if kept.sum() > 1 else None


def _evenly(line: Float, count: int) -> Float:
    steps = np.linalg.norm(np.diff(line[:, :2], axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, s[-1], count)
    found: Float = np.column_stack([np.interp(at, s, line[:, i]) for i in range(3)])
    return found


def joined(lanes: Iterable[Lane], **parts: Any) -> LaneGraph:
    """A graph of lanes without their references to lanes that a cut-out of a map does not hold.

    Raises:
        SceneError: as :meth:`LaneGraph.of`.
    """
    there = {lane.lane_id: lane for lane in lanes}
    kept = [
        replace(
            lane,
            successors=tuple(n for n in lane.successors if n in there),
            left=lane.left if lane.left in there else None,
            right=lane.right if lane.right in there else None,
            opposite=lane.opposite if lane.opposite in there else None,
        )
        for lane in there.values()
    ]
    return LaneGraph.of(kept, **parts)
