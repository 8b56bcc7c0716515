"""Where the lanes of a graph lie, in arrays and a grid as kernels take them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..geometry.transform import Float
from .lane import Lane
from .lane_kernels import count_cells, fill_cells

CELL_M, MAX_CELLS = 5.0, 4_000_000
LONGEST_SEGMENT_M = 20.0


class LaneIndex:
    """Segments of all lanes in arrays, and a grid over them, as kernels take them."""

    def __init__(self, lanes: tuple[Lane, ...]) -> None:
        self.lanes = lanes
        parts = [_segments(lane) for lane in lanes]
        counts = [len(quads) for _, quads in parts]
        self.segments = np.concatenate([p for p, _ in parts]) if parts else np.zeros((0, 7))
        self.quads = np.concatenate([q for _, q in parts]) if parts else np.zeros((0, 4, 2))
        self.lane_of = np.repeat(np.arange(len(lanes), dtype=np.int32), counts)
        self.kinds = np.array([lane.kind for lane in lanes], dtype=object)
        self.grid = self._grid()

    def of_kinds(self, kinds: Iterable[str]) -> NDArray[np.bool_]:
        """Which lanes are of these kinds, [L] bool."""
        wanted = frozenset(kinds)
        known = self._of_kinds.get(wanted)
        if known is None:
            known = np.array([kind in wanted for kind in self.kinds], dtype=np.bool_)
            self._of_kinds[wanted] = known
        return known

    @cached_property
    def _of_kinds(self) -> dict[frozenset[str], NDArray[np.bool_]]:
        return {}

    def _grid(self) -> tuple[NDArray[np.int64], NDArray[np.int32], Float, int, int]:
        """Segments by cell: of every cell that the rectangle around their rims touches."""
        ends = self.segments[:, :4].reshape(-1, 2, 2)
        corners = np.concatenate([self.quads, ends], axis=1)
        boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
        if not len(boxes):
            boxes = np.zeros((0, 4))
        low = boxes[:, :2].min(axis=0) if len(boxes) else np.zeros(2)
        high = boxes[:, 2:].max(axis=0) if len(boxes) else np.ones(2)
        size = np.maximum(high - low, 1.0)
        cell = max(CELL_M, float(np.sqrt(size.prod() / MAX_CELLS)), float(size.max()) / MAX_CELLS)
        columns, rows = (int(n) for n in np.floor(size / cell) + 1)
        frame = np.array([*low, cell])
        boxes = np.ascontiguousarray(boxes)
        first = count_cells(boxes, frame, columns, rows)
        return first, fill_cells(boxes, frame, columns, rows, first), frame, columns, rows


def _segments(lane: Lane) -> tuple[Float, Float]:
    """Segments [K, 7] (both ends, heading, arc length at both) and rims [K, 4, 2] of a lane, none
    longer than a few cells."""
    left, right = lane.rims
    s = lane.s
    longest = np.diff(s).max()
    if longest > LONGEST_SEGMENT_M:
        counts = np.ceil(np.diff(s) / LONGEST_SEGMENT_M).astype(int)
        inner = [
            np.linspace(a, b, n, endpoint=False)
            for a, b, n in zip(s[:-1], s[1:], counts, strict=True)
        ]
        s = np.concatenate([*inner, s[-1:]])
    lines = [
        np.stack([np.interp(s, lane.s, line[:, i]) for i in (0, 1)], axis=1)
        for line in (lane.centre, left, right)
    ]
    centre, left, right = lines
    a, b = centre[:-1], centre[1:]
    heading = np.arctan2(*(b - a).T[::-1])
    segments = np.column_stack([a, b, heading, s[:-1], s[1:]])
    return segments, np.stack([left[:-1], left[1:], right[1:], right[:-1]], axis=1)
