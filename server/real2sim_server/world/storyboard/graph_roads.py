"""Roads of a lane graph, as a storyboard asks for them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from real2sim_proto import ErrorCode

from ...scene.errors import SceneError
from ...scene.lane import LANE_KINDS
from ...scene.lane_graph import LaneGraph
from ...scene.road import Road
from ..errors import WorldError
from ..path import Float, LoggedPath
from .roads import Place, RoadPoint, Way, path_through, skipping_zero

REACH = 2000.0
"""Ways go on so far, as long as there are lanes [m]."""


@dataclass(frozen=True, eq=False)
class GraphNetwork:
    """Roads with numbered lanes, of a map in OpenDRIVE. Where a road forks, a way goes on along
    the lane that turns least.

    Attributes:
        graph: in the frame of the world.
        ways: made so far, by lane and direction; each is the same whenever it is made.
    """

    graph: LaneGraph
    ways: dict[tuple[str, bool], Way] = field(default_factory=dict)

    def locate(self, x: float, y: float, h: float) -> RoadPoint | None:  # noqa: D102
        graph = self.graph
        near = graph.nearest(x, y, h, kinds=LANE_KINDS)
        if near is None or not near.inside:
            near = graph.nearest(x, y, kinds=LANE_KINDS)
        if near is None or not near.inside or near.lane_id not in graph.road_places:
            return None
        road, lane = graph.road_places[near.lane_id]
        s, t = graph.road(road).project(x, y)
        return RoadPoint(road, lane, s, t, graph.road(road).at(s)[3])

    def place(self, road: str, s: float, t: float) -> Place:  # noqa: D102
        found = self._road(road)
        x, y, z, h = found.at(s, t)
        beyond = min(s, 0.0) + max(s - found.length, 0.0)
        return Place(x + beyond * math.cos(h), y + beyond * math.sin(h), h, z)

    def middle(self, road: str, lane: int, s: float) -> float:  # noqa: D102
        return self._part(road, lane, s)[1]

    def drives_along(self, road: str, lane: int) -> bool:  # noqa: D102
        return self._road(road).runs_along(lane)

    def way(self, road: str, lane: int, s: float, *, along: bool) -> Way:  # noqa: D102
        lane_id = self._part(road, lane, s)[0]
        forwards = along == self.drives_along(road, lane)
        known = self.ways.get((lane_id, forwards))
        if known is None:
            path, length = self._path(lane_id, forwards=forwards)
            known = self.ways[lane_id, forwards] = Way(road, lane, along, path, length)
        return known

    def neighbour(self, road: str, lane: int, s: float, lanes: int) -> int:  # noqa: D102
        found = skipping_zero(lane, lanes)
        self._part(road, found, s)
        return found

    def route(self, places: list[Place]) -> LoggedPath:  # noqa: D102
        near = [self.graph.nearest(p.x, p.y, p.h, kinds=LANE_KINDS) for p in places]
        pieces = list[Float]()
        for a, b, place, there in zip(near, near[1:], places, places[1:], strict=False):
            ends = np.array([[place.x, place.y, 0.0], [there.x, there.y, 0.0]])
            if a is None or b is None:
                pieces.append(ends)
                continue
            names = self.graph.route(a.lane_id, b.lane_id)
            pieces.append(ends if names is None else self._between(names, a.s, b.s))
        return path_through([Place(x, y, 0.0) for x, y, _ in np.concatenate(pieces).tolist()])

    def _between(self, names: tuple[str, ...], start: float, end: float) -> Float:
        """Points along lanes from ``start`` on the first to ``end`` on the last; a change of lanes
        goes straight to the neighbour's middle."""
        lanes = [self.graph.lane(name) for name in names]
        parts = list[Float]()
        for k, lane in enumerate(lanes):
            low = start if k == 0 else 0.0
            high = end if k == len(lanes) - 1 else lane.length
            inner = lane.centre[(lane.s > low) & (lane.s < high)]
            parts += [np.array([lane.at(low)[:3]]), inner, np.array([lane.at(high)[:3]])]
        return np.concatenate(parts)

    def _road(self, road: str) -> Road:
        try:
            return self.graph.road(road)
        except SceneError as error:
            raise _refused(error) from error

    def _part(self, road: str, lane: int, s: float) -> tuple[str, float]:
        """Id of a lane of the graph, and t of its middle."""
        found = self._road(road)
        held = min(max(s, 0.0), found.length)
        try:
            part = found.lane(lane, held)
        except SceneError as error:
            raise _refused(error) from error
        return part.lane_id, part.centre_t(held)

    def _path(self, lane_id: str, *, forwards: bool) -> tuple[LoggedPath, float]:
        lanes, length = [self.graph.lane(lane_id)], 0.0
        before = self.graph.predecessors
        while length < REACH:
            length += lanes[-1].length
            names = lanes[-1].successors if forwards else before[lanes[-1].lane_id]
            onward = [self.graph.lane(n) for n in names]
            onward = [lane for lane in onward if lane not in lanes]
            if not onward:
                break
            lanes.append(min(onward, key=lambda lane: (lane.turn, lane.lane_id)))
        points = np.concatenate([lane.centre for lane in lanes[:: 1 if forwards else -1]])
        yaws = np.unwrap(
            np.concatenate([lane.headings for lane in lanes[:: 1 if forwards else -1]])
        )
        if not forwards:
            points, yaws = points[::-1], yaws[::-1] + math.pi
        path = LoggedPath.through(points, yaws, np.tile([0.0, 0.0, 1.0], (len(points), 1)))
        return path, path.length


def _refused(error: SceneError) -> WorldError:
    return WorldError(
        ErrorCode.INVALID_REQUEST,
        f"a position of the storyboard is nowhere on the map: {error}",
        hint="take a road and lane of the map",
    )
