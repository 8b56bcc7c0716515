"""The road as scores see it: how far a box is off it, its surface, lanes, directions and limits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from real2sim_proto.lanes import SceneLanes

from ..._numba import kernel
from ...scene import LaneGraph
from ...scene.io.document import graph_of, lane_document
from ...scene.lane import DRIVABLE

DENSITY = 0.25
"""Distance between points of the lines that roads are made of [m]."""

MAX_SPACING = DENSITY * (1 + 1e-9)
"""Spacings exceed ``DENSITY`` by rounding; the margin keeps the search exact [m]."""


@kernel
def off_road(middle, size, route, lanes, half_widths):
    """How far a box is off the road, and how many of its quarters have their middle on it.

    The road is all that lies within half a width of a line.

    Args:
        middle: x, y [m], yaw [rad] of the box.
        size: (length, width, height) of it [m].
        route: points [R, 2] float64 and their ends [n] int64: line k has the points from the end
            before to ``ends[k]``, each at most ``DENSITY`` from the one before [m].
        lanes: other lines in the same form; there may be none.
        half_widths: along the route and along the lanes [m].

    Returns:
        How far its worst corner is off the road [m], 0 and less on it; 0 to 4 quarters.
    """
    x, y, yaw = middle
    cos, sin = math.cos(yaw), math.sin(yaw)
    points, beyond = np.empty((8, 2)), np.empty(8)
    for k in range(8):
        # Corners and, half as far from the middle of the box, the middles of its quarters.
        far = 0.5 if k < 4 else 0.25
        u = far * size[0] if k % 4 < 2 else -far * size[0]
        v = far * size[1] if 0 < k % 4 < 3 else -far * size[1]
        points[k, 0], points[k, 1] = x + u * cos - v * sin, y + u * sin + v * cos
        beyond[k] = math.inf
    _narrow(beyond, points, route, half_widths[0])
    if beyond.max() > 0 and len(lanes[1]):
        _narrow(beyond, points, lanes, half_widths[1])
    inside = 0
    for k in range(4, 8):
        inside += beyond[k] <= 0
    return max(beyond[0], beyond[1], beyond[2], beyond[3]), inside


@kernel
def in_lane(place, lines, half_width):
    """Whether a place lies within half a width [m] of a line that goes on in its direction.

    Args:
        place: x, y [m], yaw [rad].
        lines: as in :func:`off_road`; there may be none.
        half_width: of each lane [m].
    """
    points, ends = lines
    x, y, yaw = place
    cos, sin = math.cos(yaw), math.sin(yaw)
    begin = 0
    for end in ends:
        for k in range(begin, end - 1):
            dx, dy = points[k, 0] - x, points[k, 1] - y
            if dx * dx + dy * dy <= half_width * half_width:
                on_x, on_y = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
                if on_x * cos + on_y * sin > 0.0:
                    return True
        begin = end
    return False


@kernel
def _narrow(beyond, places, lines, half_width):
    """Lower ``beyond`` [P] [m] to how far places [P, 2] [m] are off the strips along lines."""
    distance = math.inf
    for k in range(len(places)):
        x, y = places[k, 0], places[k, 1]
        if k == 0:
            bound = _rough_distance(x, y, lines[0])
        else:
            bound = distance + math.hypot(x - places[k - 1, 0], y - places[k - 1, 1])
        distance = _distance(x, y, lines, bound)
        beyond[k] = min(beyond[k], distance - half_width)


@kernel
def _rough_distance(x, y, points):
    """Distance [m] from (x, y) to the nearest of every 64th point."""
    least = math.inf
    for k in range(0, len(points), 64):
        dx, dy = points[k, 0] - x, points[k, 1] - y
        least = min(least, dx * dx + dy * dy)
    return math.sqrt(least)


@kernel
def _distance(x, y, lines, bound):
    """Distance [m] from (x, y) to the nearest point of lines, which is at most ``bound``.

    Where a point is farther away than the nearest one so far, as many of those after it are
    skipped as cannot be nearer, since each is at most ``DENSITY`` from the one before.
    """
    points, ends = lines
    best, k = bound, 0
    for end in ends:
        while k < end:
            dx, dy = points[k, 0] - x, points[k, 1] - y
            distance = math.sqrt(dx * dx + dy * dy)
            best = min(best, distance)
            k += max(int((distance - best) / MAX_SPACING), 1)
        k = end
    return best


MIN_BEYOND_M = 0.01
"""A corner off every lane and area is this far off the road at least."""
ALONG = 0.5
"""Cosine of the greatest angle between an ego and the lane that it drives along."""


class EgoPose(Protocol):
    """What is asked of an ego: rear axle in the world [m], heading [rad], offset from the route."""

    @property
    def x(self) -> float:
        """[m]."""

    @property
    def y(self) -> float:
        """[m]."""

    @property
    def yaw(self) -> float:
        """[rad]."""

    @property
    def offset(self) -> float:
        """To the left of the route [m]."""


@dataclass(frozen=True, eq=False)
class RoadMap:
    """The lanes of a scene as scores ask them.

    Attributes:
        graph: in the world frame.
    """

    graph: LaneGraph

    @classmethod
    def of(cls, graph: LaneGraph | None) -> RoadMap | None:
        """Of a map; None without one. Lanes made of the recorded drive alone are none: they know of
        no surface beside what was driven, and scores have that from the recording itself."""
        return None if graph is None or graph.source == "log" else cls(graph)

    def off_road(
        self, middle: tuple[float, float, float], size: tuple[float, float, float]
    ) -> tuple[float, int]:
        """As :func:`.off_road`: how far the worst corner of a box is off the road
        [m], and how many of its quarters have their middle on it."""
        x, y, yaw = middle
        cos, sin = math.cos(yaw), math.sin(yaw)
        turn = np.array([[cos, sin], [-sin, cos]])
        corners = _QUARTERS * [size[0] / 2, size[1] / 2] @ turn
        places = np.concatenate([corners, corners / 2]) + np.array([x, y])
        inside = self.graph.is_drivable(places)
        off = places[:4][~inside[:4]]
        beyond = max((self._beyond(p[0], p[1]) for p in off.tolist()), default=0.0)
        return beyond, int(inside[4:].sum())

    def _beyond(self, x: float, y: float) -> float:
        found = self.graph.nearest(x, y, kinds=DRIVABLE)
        if found is None:
            return MIN_BEYOND_M
        half = self.graph.lanes[found.lane_id].width(found.s) / 2
        return max(abs(found.offset) - half, MIN_BEYOND_M)

    def in_lane(self, ego: EgoPose, ahead: float) -> bool:
        """Whether the middle of the ego box is in a lane that runs its way, or in a junction."""
        return self._along(ego, ahead, 1.0) or self._in_junction(ego, ahead)

    def lane_offset(self, ego: EgoPose) -> float:
        """Distance of the rear axle from the middle of the nearest lane [m]; 0 in junctions, where
        nobody keeps one, and the offset from the route beside all lanes."""
        found = self.graph.nearest(ego.x, ego.y, ego.yaw)
        if found is None:
            return ego.offset
        return 0.0 if self.graph.lanes[found.lane_id].junction is not None else found.offset

    def is_against(self, ego: EgoPose, ahead: float) -> bool:
        """Whether the middle of the ego box is in a lane of oncoming traffic alone."""
        if self._in_junction(ego, ahead) or self._along(ego, ahead, 1.0):
            return False
        return self._along(ego, ahead, -1.0)

    def speed_limit(self, ego: EgoPose) -> float | None:
        """Of the lane that the ego drives in [m/s]; None where none is known."""
        found = self.graph.nearest(ego.x, ego.y, ego.yaw, within=5.0)
        return None if found is None else self.graph.lanes[found.lane_id].speed_limit

    @cached_property
    def knows_limits(self) -> bool:
        """Whether any lane has a speed limit."""
        return any(lane.speed_limit is not None for lane in self.graph.lanes.values())

    def _along(self, ego: EgoPose, ahead: float, sign: float) -> bool:
        """Whether the middle lies inside a lane whose direction, times ``sign``, is the ego's."""
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        heading = ego.yaw if sign > 0 else ego.yaw + math.pi
        found = self.graph.nearest(x, y, heading)
        return found is not None and found.inside and math.cos(heading - found.heading) > ALONG

    def _in_junction(self, ego: EgoPose, ahead: float) -> bool:
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        found = self.graph.nearest(x, y)
        return (
            found is not None
            and found.inside
            and self.graph.lanes[found.lane_id].junction is not None
        )

    def fields(self) -> dict[str, Any]:
        """Plain values, for a recording."""
        return lane_document(self.graph, with_roads=False).model_dump(mode="json")

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> RoadMap:
        """What :meth:`fields` gave. Raises ValueError for anything else."""
        return cls(graph_of(SceneLanes.model_validate(fields)))


_QUARTERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
