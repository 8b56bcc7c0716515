"""The lanes near a vehicle, as observations show them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..scene.lane import Lane
from ..scene.lane_graph import LaneGraph
from .path import Float

RADIUS = 60.0
"""Places of centre lines are shown so far from the vehicle [m]."""
SPACING = 5.0
"""Between places along a lane, at most [m]."""
MOST_LANES, MOST_PLACES = 32, 32
"""The nearest lanes, and of each the places nearest to its own nearest one."""


class LanePiece(NamedTuple):
    """A piece of a lane.

    Attributes:
        lane: of the map.
        places: [K, 4] float64, x, y [m] and heading [rad] of its centre line in the world, and its
            width [m].
    """

    lane: Lane
    places: Float

    def fields(self) -> dict[str, Any]:
        """The wire's LaneShown as a plain map."""
        lane = self.lane
        return {
            "lane_id": lane.lane_id,
            "kind": lane.kind,
            "places": self.places,
            "speed_limit": lane.speed_limit,
            "successors": list(lane.successors),
            "left": lane.left,
            "right": lane.right,
            "opposite": lane.opposite,
            "may_change_left": lane.may_change_left,
            "may_change_right": lane.may_change_right,
            "junction": lane.junction,
        }


@dataclass(frozen=True, eq=False)
class _Places:
    """Places of all lanes: [P, 4] as of :class:`LanePiece`, the number of the lane of each [P], and
    a tree of them."""

    values: Float
    lane: NDArray[np.int64]
    tree: cKDTree


_KNOWN: WeakKeyDictionary[LaneGraph, _Places] = WeakKeyDictionary()


def lanes_around(graph: LaneGraph, x: float, y: float) -> tuple[LanePiece, ...]:
    """Pieces of the lanes near a place [m], the nearest lane first."""
    if graph not in _KNOWN:
        _KNOWN[graph] = _places_of(graph)
    known = _KNOWN[graph]
    near = np.array(sorted(known.tree.query_ball_point((x, y), RADIUS)), dtype=np.int64)
    if not len(near):
        return ()
    distances = np.hypot(*(known.values[near, :2] - (x, y)).T)
    # By distance, then by number, so that ties fall alike everywhere.
    order = near[np.lexsort((near, distances))]
    _, first = np.unique(known.lane[order], return_index=True)
    lanes = list(graph.lanes.values())
    inside = set(near.tolist())
    return tuple(
        LanePiece(lanes[known.lane[k]], known.values[_run(int(k), known.lane, inside)])
        for k in order[np.sort(first)[:MOST_LANES]]
    )


def _run(nearest: int, lane: NDArray[np.int64], inside: set[int]) -> slice:
    """Places around the nearest one, of its lane and within reach."""

    def reaches(k: int) -> bool:
        return 0 <= k < len(lane) and lane[k] == lane[nearest] and k in inside

    low = high = nearest
    while high - low + 1 < MOST_PLACES and (reaches(low - 1) or reaches(high + 1)):
        low -= reaches(low - 1)
        if high - low + 1 < MOST_PLACES:
            high += reaches(high + 1)
    return slice(low, high + 1)


def _places_of(graph: LaneGraph) -> _Places:
    parts = [_sampled(lane) for lane in graph.lanes.values()]
    values = np.concatenate(parts) if parts else np.zeros((0, 4))
    lane = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    return _Places(values, lane, cKDTree(values[:, :2]))


def _sampled(lane: Lane) -> Float:
    s = np.linspace(0.0, lane.length, int(np.ceil(lane.length / SPACING)) + 1)
    columns = (lane.centre[:, 0], lane.centre[:, 1], lane.headings, lane.widths)
    return np.column_stack([np.interp(s, lane.s, column) for column in columns])
