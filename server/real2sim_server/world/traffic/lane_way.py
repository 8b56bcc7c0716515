"""Ways along the lanes of a map, as paths that traffic follows."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from ...scene.lane import TRAVELLED, Lane
from ...scene.lane_graph import LaneGraph
from ..path import LoggedPath

AHEAD, BEHIND = 600.0, 100.0
"""A way goes on so far from the end of its lane, and begins so far before it, where there are lanes
[m]."""


@dataclass(frozen=True, eq=False)
class LaneWay:
    """Lanes one after the other, where they fork those that turn least.

    Attributes:
        path: along their centre lines.
        lanes: in their order.
        starts: where each begins along the path [m].
        goes_on: whether there are more lanes behind its end.
    """

    path: LoggedPath
    lanes: tuple[Lane, ...]
    starts: tuple[float, ...]
    goes_on: bool

    def lane_at(self, s: float) -> Lane:
        """The lane at a place along the path [m]."""
        return self.lanes[max(bisect_right(self.starts, s) - 1, 0)]


_WAYS: WeakKeyDictionary[LaneGraph, dict[str, LaneWay]] = WeakKeyDictionary()


def way_through(graph: LaneGraph, lane_id: str) -> LaneWay:
    """The way through a lane; each is made once for a graph. Raises SceneError."""
    known = _WAYS.setdefault(graph, {})
    if lane_id not in known:
        known[lane_id] = _made(graph, lane_id)
    return known[lane_id]


def _made(graph: LaneGraph, lane_id: str) -> LaneWay:
    lane = graph.lane(lane_id)
    before = _chain(graph, lane, BEHIND, lambda at: graph.predecessors[at.lane_id])
    after = _chain(graph, lane, AHEAD, lambda at: at.successors)
    lanes = (*reversed(before), lane, *after)
    points = np.concatenate([one.centre for one in lanes])
    yaws = np.unwrap(np.concatenate([one.headings for one in lanes]))
    path = LoggedPath.through(points, yaws, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
    starts, reached = [], 0.0
    for k, one in enumerate(lanes):
        if k:
            reached += float(np.linalg.norm(one.centre[0, :2] - lanes[k - 1].centre[-1, :2]))
        starts.append(reached)
        reached += one.length
    onward = _travelled(graph, lanes[-1].successors)
    return LaneWay(path, lanes, tuple(starts), any(one not in lanes for one in onward))


def _chain(
    graph: LaneGraph, lane: Lane, reach: float, names: Callable[[Lane], Iterable[str]]
) -> list[Lane]:
    """Lanes one after the other from one on, without it, none twice."""
    found, length, at = list[Lane](), 0.0, lane
    while length < reach:
        onward = [n for n in _travelled(graph, names(at)) if n is not lane and n not in found]
        if not onward:
            break
        at = min(onward, key=lambda one: (one.turn, one.lane_id))
        found.append(at)
        length += at.length
    return found


def _travelled(graph: LaneGraph, names: Iterable[str]) -> list[Lane]:
    return [lane for lane in map(graph.lane, names) if lane.kind in TRAVELLED]
