"""Road geometry for scoring: off-road distance, lanes, directions and speed limits."""

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
"""Maximum distance between points of road lines [m]."""

MAX_SPACING = DENSITY * (1 + 1e-9)
"""Maximum spacing with a margin for rounding, which keeps the search exact [m]."""


@kernel
def off_road(middle, size, route, lanes, half_widths):
    """Off-road distance of a box, and the number of its quarters on the road.

    The road is the area within half a width of any line. A quarter is on the road if its centre is.

    Args:
        middle: centre x, y [m], yaw [rad] of the box.
        size: (length, width, height) of the box [m].
        route: points [R, 2] float64 and their ends [n] int64: line k has points ``ends[k - 1]`` to
            ``ends[k]``, at most ``DENSITY`` apart [m].
        lanes: other lines in the same form; may be empty.
        half_widths: half widths of the route and of the lanes [m].

    Returns:
        Distance of the worst corner from the road [m], at most 0 on the road; and 0 to 4 quarters.
    """
    x, y, yaw = middle
    cos, sin = math.cos(yaw), math.sin(yaw)
    points, beyond = np.empty((8, 2)), np.empty(8)
    for k in range(8):
        # Corners, then centres of quarters, which are half as far from the middle of the box.
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
    """Whether a pose is within half a width [m] of a line that runs in its direction.

    Args:
        place: x, y [m], yaw [rad].
        lines: as in :func:`off_road`; may be empty.
        half_width: half width of each lane [m].
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
    """Reduce ``beyond`` [P] [m] to the distances of points [P, 2] [m] from the strips of lines."""
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

    Points are at most ``DENSITY`` apart, so after a far point the search skips those that cannot
    be nearer than the best one.
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
"""Minimum off-road distance of a corner outside every lane and area [m]."""
ALONG = 0.5
"""Minimum cosine between an ego's heading and the lane that it drives along."""


class EgoPose(Protocol):
    """State of an ego: rear axle, world frame [m], heading [rad], offset from the route [m]."""

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
        """Offset from the route [m], positive left."""


@dataclass(frozen=True, eq=False)
class RoadMap:
    """Lane queries of the scores.

    Attributes:
        graph: lane graph, world frame.
    """

    graph: LaneGraph

    @classmethod
    def of(cls, graph: LaneGraph | None) -> RoadMap | None:
        """The road map of a lane graph.

        None without a graph, or if its lanes come only from the recorded drive. The scores then use
        the recording directly.
        """
        return None if graph is None or graph.source == "log" else cls(graph)

    def off_road(
        self, middle: tuple[float, float, float], size: tuple[float, float, float]
    ) -> tuple[float, int]:
        """Off-road distance [m] and number of quarters on the road; see :func:`.off_road`."""
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
        """Whether the centre of the ego box is in a lane of its direction or in a junction."""
        return self._along(ego, ahead, 1.0) or self._in_junction(ego, ahead)

    def lane_offset(self, ego: EgoPose) -> float:
        """Offset of the rear axle from the centre of the nearest lane [m].

        0 in junctions; outside all lanes, the offset from the route.
        """
        found = self.graph.nearest(ego.x, ego.y, ego.yaw)
        if found is None:
            return ego.offset
        return 0.0 if self.graph.lanes[found.lane_id].junction is not None else found.offset

    def is_against(self, ego: EgoPose, ahead: float) -> bool:
        """Whether the centre of the ego box is only in lanes of oncoming traffic."""
        if self._in_junction(ego, ahead) or self._along(ego, ahead, 1.0):
            return False
        return self._along(ego, ahead, -1.0)

    def speed_limit(self, ego: EgoPose) -> float | None:
        """Speed limit of the ego's lane [m/s]; None if unknown."""
        found = self.graph.nearest(ego.x, ego.y, ego.yaw, within=5.0)
        return None if found is None else self.graph.lanes[found.lane_id].speed_limit

    @cached_property
    def has_speed_limits(self) -> bool:
        """Whether any lane has a speed limit."""
        return any(lane.speed_limit is not None for lane in self.graph.lanes.values())

    def _along(self, ego: EgoPose, ahead: float, sign: float) -> bool:
        """Whether the centre is in a lane whose direction, times ``sign``, is the ego's."""
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
        """Plain values for a recording."""
        return lane_document(self.graph, with_roads=False).model_dump(mode="json")

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> RoadMap:
        """Inverse of :meth:`fields`. Raises ValueError for invalid values."""
        return cls(graph_of(SceneLanes.model_validate(fields)))


_QUARTERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
