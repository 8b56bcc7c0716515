"""What the scores need to know of one instant, and of the episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..._records import made_quickly
from ..ego.reference import PlannedTrajectory
from ..path import Float, LoopTransform
from ..storyboard.program import ShownSignal
from .road import DENSITY, RoadMap, in_lane, off_road

Side = Literal["front", "rear", "lateral", "stopped_ego", "stopped_track"]
"""Side of the ego on which a contact began, after nuPlan's collision types."""

VRU = frozenset({"pedestrian", "cyclist", "motorcycle", "bicycle", "person"})
VEHICLES = frozenset({"car", "vehicle", "van", "truck", "bus", "trailer", "tram"})

Lines = tuple[Float, NDArray[np.int64]]
"""Points [P, 2] [m] of lines, one line after another, and the end of each among them."""


class EgoSample(NamedTuple):
    """The ego at one instant: rear axle [m], [rad], velocities of it [m/s], [rad/s], [m/s^2]."""

    x: float
    y: float
    yaw: float
    speed: float
    lateral_speed: float
    acceleration: float
    yaw_rate: float
    steering: float
    s: float
    offset: float
    path_yaw: float
    z: float


@made_quickly
@dataclass(frozen=True, eq=False)
class ObjectSamples:
    """Objects at one instant, K of them.

    Attributes:
        ids, categories: by row.
        centres: [K, 3] float64, of their boxes, world [m].
        yaws: [K] float64 [rad].
        sizes: [K, 3] float64, (length, width, height) [m].
        velocities: [K, 2] float64, world [m/s].
    """

    ids: tuple[str, ...]
    categories: tuple[str, ...]
    centres: Float
    yaws: Float
    sizes: Float
    velocities: Float


@dataclass(frozen=True)
class ContactRecord:
    """A contact of the ego that began in this step, or went on with momentum.

    Attributes:
        object_id: None for the background.
        category: of the object; ``background``.
        side: of the ego.
        relative_speed, ego_speed, object_speed: when the contact began [m/s].
        impulse: on the ego [N s]; zeros where no momentum is exchanged.
        begun: whether the contact began in this step.
        since: when it did, as a fraction of the step.
    """

    object_id: str | None
    category: str
    side: Side
    relative_speed: float
    ego_speed: float
    object_speed: float
    impulse: tuple[float, float] = (0.0, 0.0)
    begun: bool = True
    since: float = 1.0


@made_quickly
@dataclass(frozen=True, eq=False)
class Instant:
    """One committed instant.

    Attributes:
        step, t_us: which one.
        ego: the controlled vehicle.
        others: all objects.
        contacts: of the step that led here.
        secondary: contacts between objects that began in it.
        plan: that the step was made with; None where there was no new trajectory.
        seam: over which the ego was put back before it moved; places of the instant before are
            where it takes them. None where it was not.
        signals: traffic signals of the storyboard, and what they show.
    """

    step: int
    t_us: int
    ego: EgoSample
    others: ObjectSamples
    contacts: tuple[ContactRecord, ...] = ()
    secondary: int = 0
    plan: PlannedTrajectory | None = None
    seam: LoopTransform | None = None
    signals: tuple[ShownSignal, ...] = ()


@dataclass(frozen=True, eq=False)
class ScoringContext:
    """What stays the same over an episode.

    Attributes:
        dt: clock step [s].
        horizon: steps.
        ego_size: (length, width, height) [m].
        rear_overhang: rear axle to the rear end of the box [m].
        ego_mass: [kg].
        route: [R, 2] float64, the recorded way [m].
        lanes: polylines [N, 2] of recorded vehicles, whose strips are drivable too.
        corridor, lane: half widths along route and lanes [m].
        speed_limit: [m/s] or None.
        start_s, route_end_s: along the route at the start, and where the log is at the horizon.
        expert_s: where the log is along the route at each step [m]; ``horizon`` + 1 of them.
        history: (speed, yaw) of the log before the start, one a clock step, oldest first.
        warmup_steps: steps in which the ego moved as recorded; they do not count.
        background: whether walls and poles of the background can be hit.
        reactive: whether any other road user sees the ego.
        no_action_impact: impact speed of a run in which the ego does not react [m/s]; None while
            it is not known, 0 where nothing is hit.
        road_map: of the scene; None: corridor and lanes come from the recorded drive.
    """

    dt: float
    horizon: int
    ego_size: tuple[float, float, float]
    rear_overhang: float
    ego_mass: float
    route: Float
    lanes: tuple[Float, ...]
    corridor: float
    lane: float
    speed_limit: float | None
    start_s: float
    route_end_s: float
    expert_s: tuple[float, ...]
    history: tuple[tuple[float, float], ...]
    warmup_steps: int = 0
    background: bool = False
    reactive: bool = False
    no_action_impact: float | None = None
    road_map: RoadMap | None = None

    @property
    def centre_ahead(self) -> float:
        """Rear axle to the centre of the box [m]."""
        return self.ego_size[0] / 2 - self.rear_overhang

    @cached_property
    def _route_points(self) -> Lines:
        """Points of the route; straight on beyond both ends."""
        return _lines([_extended(self.route)])

    @cached_property
    def _lane_points(self) -> Lines:
        return _lines([line for line in self.lanes if len(line) > 1])

    @property
    def road_lines(self) -> tuple[Lines, Lines]:
        """Points of the route and of the lanes, as :func:`.road_kernels.off_road` takes them."""
        return self._route_points, self._lane_points

    def off_road(self, ego: EgoSample) -> tuple[float, int]:
        """How far the worst corner of the ego box is off the road [m], 0 and less on it; and how
        many of its quarters, 0 to 4, have their middle on the road."""
        ahead = self.centre_ahead
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        if self.road_map is not None:
            return self.road_map.off_road((x, y, ego.yaw), self.ego_size)
        beyond, quarters = off_road(
            (x, y, ego.yaw),
            self.ego_size,
            self._route_points,
            self._lane_points,
            (self.corridor, self.lane),
        )
        return beyond, quarters

    def in_lane(self, ego: EgoSample) -> bool:
        """Whether the middle of the ego box is in its own lane, or in one that others drove in the
        ego's direction."""
        if self.road_map is not None:
            return self.road_map.in_lane(ego, self.centre_ahead)
        if abs(ego.offset) <= self.lane:
            return True
        ahead = self.centre_ahead
        x, y = ego.x + ahead * math.cos(ego.yaw), ego.y + ahead * math.sin(ego.yaw)
        return bool(in_lane((x, y, ego.path_yaw), self._lane_points, self.lane))

    def lane_offset(self, ego: EgoSample) -> float:
        """Distance from the middle of the lane [m], positive to the left: of the map's, else of the
        route."""
        return ego.offset if self.road_map is None else self.road_map.lane_offset(ego)

    def way_against(self, ego: EgoSample, way: float, gain: float) -> float:
        """How much of the ``way`` [m] of a step went against traffic: in oncoming lanes of the map,
        else what it lost along the route."""
        if self.road_map is None:
            return max(-gain, 0.0)
        return way if self.road_map.is_against(ego, self.centre_ahead) else 0.0

    def limit_at(self, ego: EgoSample) -> float | None:
        """The speed limit that holds for the ego [m/s]: that of the request, else of the map."""
        if self.speed_limit is not None or self.road_map is None:
            return self.speed_limit
        return self.road_map.speed_limit(ego)

    @property
    def knows_limits(self) -> bool:
        """Whether any speed limit is known."""
        known = self.road_map is not None and self.road_map.knows_limits
        return self.speed_limit is not None or known

    def fields(self) -> dict[str, Any]:
        """Plain values, for a recording; without a map there is no word of one."""
        plain = {k: getattr(self, k) for k in self.__dataclass_fields__}
        road_map = plain.pop("road_map")
        if road_map is not None:
            plain["road_map"] = road_map.fields()
        return plain | {
            "route": self.route,
            "lanes": list(self.lanes),
            "expert_s": list(self.expert_s),
            "history": [list(h) for h in self.history],
            "ego_size": list(self.ego_size),
        }

    @classmethod
    def from_fields(cls, fields: dict[str, Any]) -> ScoringContext:
        """The context that :meth:`fields` gave."""
        road_map = fields.get("road_map")
        return cls(
            **fields
            | {
                "road_map": None if road_map is None else RoadMap.from_fields(road_map),
                "lanes": tuple(np.asarray(line) for line in fields["lanes"]),
                "route": np.asarray(fields["route"]),
                "expert_s": tuple(fields["expert_s"]),
                "history": tuple((v, yaw) for v, yaw in fields["history"]),
                "ego_size": tuple(fields["ego_size"]),
            }
        )


def _lines(lines: Sequence[Float]) -> Lines:
    dense = [_dense(line) for line in lines]
    ends = np.cumsum([len(line) for line in dense], dtype=np.int64)
    return np.concatenate([np.zeros((0, 2)), *dense]), ends


def _extended(line: Float, *, back: float = 10.0, on: float = 60.0) -> Float:
    first = (line[0] - line[1]) / np.linalg.norm(line[0] - line[1])
    last = (line[-1] - line[-2]) / np.linalg.norm(line[-1] - line[-2])
    return np.vstack([line[0] + back * first, line, line[-1] + on * last])


def _dense(line: Float) -> Float:
    lengths = np.linalg.norm(np.diff(line, axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.append(np.arange(0.0, s[-1], DENSITY), s[-1])
    points: Sequence[Float] = [np.interp(at, s, line[:, k]) for k in (0, 1)]
    return np.stack(points, axis=1)
